"""The port to the STM32F103: core and image under QEMU, and its program with the registers in memory."""

import re
import select
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fakes.stm32_device import Stm32Chip, Stm32Device
from firmware_inputs import CAN, INSTALL_QEMU, MACHINE, SERIAL, RecordedCore, outputs, results_under_qemu

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.host_firmware import Settings, flash_page
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.plant.truth import candidate_truth, nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, CanLink, frame_id
from deal_hw.drivers.cartpole.wire.link import HostLink, SerialLink
from deal_hw.drivers.cartpole.wire.protocol import Ack, Info, Result, State, Target
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.types import Status

needs_compiler = pytest.mark.skipif(
    shutil.which(native.compiler()) is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
needs_arm = pytest.mark.skipif(
    shutil.which(native.ARM_CC[0]) is None, reason=f"no {native.ARM_CC[0]}: {native.ARM_INSTALL}"
)
needs_qemu = pytest.mark.skipif(shutil.which(MACHINE[0]) is None, reason=f"no {MACHINE[0]}: {INSTALL_QEMU}")
MS = 1_000_000
ROOT = Path(__file__).parents[2]
DOCS = (ROOT / "docs" / "how-to" / "firmware.md").read_text(encoding="utf-8")
NOMINAL = Settings(65536, 65536, 65536, 65536, 0xE000_0003, 0)
STILL = Motor(0.0, 0.0)
BOFF = 4


# The core for the Cortex-M3, under QEMU.


@needs_compiler
@needs_arm
@needs_qemu
@pytest.mark.parametrize("can", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_the_core_on_a_cortex_m3_gives_the_hosts_outputs(seed: int, can: bool, tmp_path: Path) -> None:
    """3000 ticks of commands, garbage and watchdog stops: bytes, forces, modes and set-points, bit by bit."""
    rng = np.random.default_rng(seed)
    trims = [int(trim) for trim in rng.integers(30_000, 200_000, 4)]
    core = RecordedCore(Settings(*trims, 7 + seed, 9 * seed), can=can)
    modes = {mode for *_, mode in outputs(core, seed, wire=CAN if can else SERIAL)}
    assert modes == {"IDLE", "HOMING", "ARMED"}
    assert results_under_qemu(core.calls, tmp_path) == core.results


def page(wire: str) -> dict[str, bytes]:
    """Return the frames of each message on a protocol page, the first of a kind."""
    text = (ROOT / "docs" / "reference" / f"protocol-cartpole-{wire}.md").read_text(encoding="utf-8")
    found: dict[str, bytes] = {}
    for name, cell in re.findall(r"^\| `(\w+)\(.*?\)` \| (`.*`) \|", text, re.MULTILINE):
        frames = re.findall(r"`([0-9A-F]{3})` `([0-9a-f ]+)`", cell)
        data = [(int(number, 16), bytes.fromhex(part)) for number, part in frames]
        can = b"".join(FRAME.pack(number, len(part), part) for number, part in data)
        found.setdefault(name, can if frames else bytes.fromhex(cell.strip("`")))
    return found


@needs_compiler
@needs_arm
@needs_qemu
@pytest.mark.parametrize("wire", ["serial", "can"])
def test_the_core_on_a_cortex_m3_passes_the_vectors_of_the_page(wire: str, tmp_path: Path) -> None:
    """Hello is answered by the page's info, arm before homing by its ack, a target moves."""
    frames, core = page(wire), RecordedCore(NOMINAL, can=wire == "can")
    for name in ("Hello", "Arm", "Home"):
        core.receive(frames[name], STILL)
    core.finish_homing()
    for name in ("Stop", "Arm", "Target"):
        core.receive(frames[name], STILL)
    core.control(STILL)
    core.report(Reading(0, 0, 0, 0, 0.0))
    found = results_under_qemu(core.calls, tmp_path)
    assert found.startswith(frames["Info"] + frames["Ack"])
    # -12.345 mm lie beyond 1 m/s times 1 ms: 80 N/m times -1 mm are -0.08 N, in pN.
    assert (-80_000_000_000).to_bytes(8, "little", signed=True) in found
    assert found == core.results


@needs_arm
@needs_qemu
def test_the_image_starts_under_qemu_and_speaks(tmp_path: Path) -> None:
    """Vectors, variables, SysTick, UART and its interrupt: the page's info and ack come, and states."""
    settings = tmp_path / "settings.bin"
    settings.write_bytes(flash_page(NOMINAL, 16.0))
    # A chip's memory holds anything at power-on.
    memory = tmp_path / "memory.bin"
    memory.write_bytes(bytes(range(256)) * 32)
    loads = [
        f"loader,file={file},addr={address:#x},force-raw=on"
        for file, address in ((settings, 0x0800_FC00), (memory, 0x2000_0000))
    ]
    image = str(native.stm32_image(qemu=True))
    chip = subprocess.Popen(
        [*MACHINE, "-serial", "stdio", "-kernel", image, "-device", loads[0], "-device", loads[1]],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
    )
    assert chip.stdin is not None and chip.stdout is not None
    decoder, vectors, answers = protocol.FrameDecoder(), page("serial"), b""
    states: list[State] = []
    try:
        asked = False
        while len(answers) < len(vectors["Info"] + vectors["Ack"]) or len(states) < 20:
            assert select.select([chip.stdout], [], [], 60.0)[0], "the image is silent"
            assert len(states) < 10_000, "the image does not answer"
            for payload in decoder.feed(chip.stdout.read(4096)):
                message = protocol.decode(payload)
                if isinstance(message, State):
                    states.append(message)
                else:
                    answers += protocol.encode(message)
            if states and not asked:
                chip.stdin.write(b"\0" + vectors["Hello"] + vectors["Arm"])
                asked = True
    finally:
        chip.kill()
        chip.communicate()
    assert answers == vectors["Info"] + vectors["Ack"]
    assert [state.sequence for state in states] == list(range(len(states)))
    # QEMU's pins are low: both switches are closed.
    assert {(s.pole_urad, s.cart_um, s.status) for s in states} == {(3141592, 0, int(Status.AT_END_STOP))}
    assert decoder.errors == 0


@needs_arm
def test_memory_use_is_the_one_in_the_docs(tmp_path: Path) -> None:
    """What the compiler's size tool says is what the page says, within 2 %."""
    printed = native.write_stm32_image(tmp_path)
    sizes = [int(text) for text in re.findall(r"(\d+) bytes", printed)]
    docs = DOCS + (ROOT / "docs" / "how-to" / "cartpole-odrive.md").read_text(encoding="utf-8")
    documented = re.findall(r"\| STM32F103C8: (?:flash|RAM), fixed \| (\d+) of", docs)
    assert sizes == pytest.approx([int(text) for text in documented], rel=0.02)
    for program, size in zip(native.STM32, sizes[::2], strict=True):
        code = (tmp_path / f"{program}.bin").read_bytes()
        assert len(code) == size
        # The stack's start and the entry point, in Thumb state.
        assert code[:4] == (0x2000_2000).to_bytes(4, "little")
        assert code[4] & 1


def test_without_the_compiler_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The package to install."""
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(
        ConfigurationError, match=r"arm-none-eabi-gcc, which is not installed; apt-get install"
    ):
        native.stm32_image()


# Its program with the registers in memory.


class Board(Stm32Chip):
    """The chip alone on a wire, and what it says."""

    def __init__(self, memory: bytes, *, can: bool, node: int = 1) -> None:
        super().__init__(memory, can=can)
        self.link: HostLink = CanLink(node) if can else SerialLink()
        self.raw = b""
        self.state = State(*[0] * 10)

    def run(
        self,
        ticks: int,
        data: bytes = b"",
        cart: int = 0,
        pole: int = 0,
        switches: tuple[bool, bool] = (False, False),
    ) -> list[protocol.AnyMessage]:
        """Run some ticks with counts for each; return what was reported beside the states."""
        found: list[protocol.AnyMessage] = []
        self.raw = b""
        for _ in range(ticks):
            out = self.tick(cart, pole, switches, data)
            self.raw += out
            for message in self.link.decode(out):
                if isinstance(message, State):
                    self.state = message
                else:
                    found.append(message)
            data = b""
        return found

    def say(self, message: protocol.AnyMessage, ticks: int = 10, **pins: object) -> list[protocol.AnyMessage]:
        """Send a message, and run some ticks."""
        return self.run(ticks, self.link.encode(message), **pins)  # type: ignore[arg-type]

    def arm(self) -> None:
        """Home by hand and arm."""
        self.say(protocol.Home(200))
        self.run(10, switches=(True, False))
        self.run(395, cart=40)  # 395 mm in 1 mm a tick.
        self.run(50)
        assert self.outputs.set_pole
        self.run(128, pole=16)
        self.run(400)
        assert self.state.status == Status.HOMED
        assert self.say(protocol.Arm(201)) == [Ack(201, protocol.MessageType.ARM, Result.DONE)]
        assert self.outputs.armed

    def frames(self, name: str) -> list[bytes]:
        """Return the data of the last run's frames of one name."""
        return [data for number, _, data in FRAME.iter_unpack(self.raw) if number == frame_id(name, 1)]


@pytest.fixture(params=[False, True], ids=["serial", "can"])
def board(request: pytest.FixtureRequest) -> Board:
    """Return a chip with nominal trims that has started, on either wire."""
    if shutil.which(native.compiler()) is None:
        pytest.skip("no C compiler: apt-get install gcc libc6-dev")
    chip = Board(flash_page(NOMINAL, 16.0), can=request.param)
    chip.run(10)
    return chip


@pytest.fixture
def node() -> Board:
    """Return such a chip on CAN."""
    if shutil.which(native.compiler()) is None:
        pytest.skip("no C compiler: apt-get install gcc libc6-dev")
    chip = Board(flash_page(NOMINAL, 16.0), can=True)
    chip.run(10)
    return chip


def target(number: int, position_um: int = 0) -> Target:
    """Return a target with the description's gains."""
    return Target(number, position_um, 80_000, 8_000, 4_000, 1_000_000)


def test_it_introduces_itself_with_the_settings_of_its_flash(board: Board) -> None:
    """Without them it has a number of its own, which the maker gave the chip."""
    (info,) = board.say(protocol.Hello(9, version=3))
    assert info == Info(9, "cartpole", (0, 1, 0), 1000, 200, 0xE000_0003)
    can = isinstance(board.link, CanLink)
    other = Board(b"\xff" * 30, can=can)
    other.run(10)
    (info,) = other.say(protocol.Hello(9))
    assert isinstance(info, Info)
    assert info.unique_id == 0x11111111 ^ 0x00300000 ^ 0x4


def test_states_come_every_5_ms_with_the_pole_hanging(board: Board) -> None:
    """40 in 200 ms, none torn or corrupt; the watchdog of the chip is served each millisecond."""
    first = board.state.sequence
    board.run(200)
    assert board.state.sequence == first + 40
    assert (board.state.pole_urad, board.state.pole_urad_s, board.state.cart_um) == (3141592, 0, 0)
    assert board.link.errors == 0
    assert board.outputs.unserved_ms == 0


def test_counts_are_positions(board: Board) -> None:
    """100 counts of 25 um to the right; back beyond 0 the counter of 16 bits wraps."""
    board.run(100, cart=1)
    board.run(64, pole=-16)
    board.run(10)
    assert board.state.cart_um == 2500
    assert board.state.pole_urad == pytest.approx(np.pi / 2 * 1e6, abs=2)
    board.run(200, cart=-2)
    board.run(10)
    assert board.state.cart_um == -7500


def test_arming_needs_homing_and_homing_the_switch(board: Board) -> None:
    """Refused before; the motor pulls left until the left switch closes, then right."""
    assert board.say(protocol.Arm(1)) == [Ack(1, protocol.MessageType.ARM, Result.NOT_HOMED)]
    assert board.say(protocol.Home(2)) == [Ack(2, protocol.MessageType.HOME, Result.DONE)]
    assert board.say(protocol.Arm(3)) == [Ack(3, protocol.MessageType.ARM, Result.HOMING)]
    board.run(300)
    assert board.outputs.pwm < -100
    board.run(2, switches=(True, False))
    board.run(300)
    assert board.outputs.pwm > 100
    assert board.say(protocol.Stop(4)) == [Ack(4, protocol.MessageType.STOP, Result.DONE)]
    assert board.outputs.pwm == 0


def test_force_is_stiffness_times_error_and_ends_in_silence(board: Board) -> None:
    """80 N/m times 20 mm is 1.6 N: a tenth of the PWM's 16 N; 200 ms after the last target it is off."""
    board.arm()
    for number in range(40):
        board.say(target(number, 20_000), ticks=2)
    at_um = board.state.cart_um
    assert board.outputs.pwm == pytest.approx(80e-6 * (20_000 - at_um) / 16 * 799, abs=1)
    board.run(185)
    assert board.outputs.pwm > 0
    board.run(20)
    assert (board.outputs.pwm, board.outputs.armed) == (0, 0)
    assert board.state.status == Status.HOMED | Status.WATCHDOG


def test_a_closed_switch_lets_no_force_towards_it(board: Board) -> None:
    """At the right end a target further right moves nothing, one to the left does."""
    board.arm()
    board.say(target(0, 50_000), ticks=60, switches=(False, True))
    assert board.outputs.pwm == 0
    assert Status.AT_END_STOP in Status(board.state.status)
    board.say(target(1, -50_000), ticks=120, switches=(False, True))
    assert board.outputs.pwm < 0


@needs_compiler
@pytest.mark.parametrize(("node", "kbit"), [(1, 500), (62, 250), (7, 1000)])
def test_node_and_bit_rate_are_those_of_the_settings(node: int, kbit: int) -> None:
    """It answers under its number; others' frames stop at the controller's filter."""
    chip = Board(flash_page(NOMINAL, 16.0, node, kbit), can=True, node=node)
    chip.run(10)
    assert chip.outputs.bit_rate == kbit * 1000
    assert len(chip.say(protocol.Hello(1))) == 1
    assert chip.outputs.filtered == 0
    chip.run(10, CanLink(2).encode(protocol.Hello(1)) + CanLink(node).encode(State(*[0] * 10)))
    assert (
        chip.outputs.filtered == 1 + 5 + 1
    )  # A request to node 2, a state and a heartbeat of another device.


def test_a_burst_of_frames_loses_none(node: Board) -> None:
    """20 targets back to back beside its own states: the newest is reported, nothing is torn."""
    node.arm()
    node.run(40, b"".join(node.link.encode(target(number)) for number in range(20)))
    assert node.state.command_sequence == 19
    node.run(100)
    assert node.frames("Heartbeat")
    assert node.frames("Errors") == []


def test_a_bus_without_another_node_drops_whole_messages(node: Board) -> None:
    """200 ms without acknowledge: the queue fills; then states come whole, and the drops are reported."""
    node.bus(silent=True)
    node.run(200)
    assert node.raw == b""
    node.bus()
    before = node.state.sequence
    node.run(200)
    assert node.state.sequence > before + 60
    assert isinstance(node.link, CanLink)
    assert (node.link.errors, node.link.torn) == (0, 0)
    (last, *_) = node.frames("Errors")[-1:]
    assert int.from_bytes(last[6:8], "little") > 20


def test_bus_off_is_counted_once_and_the_counters_of_the_controller_are_reported(node: Board) -> None:
    """The register ESR: bit 2 bus-off, transmit and receive errors in the upper bytes."""
    node.bus(errors=0x2A1F_0000 | BOFF)
    node.run(110)
    node.bus(errors=0x2A1F_0000)
    node.run(110)
    assert node.frames("Heartbeat")[-1][6:8] == bytes((0x1F, 0x2A))
    assert int.from_bytes(node.frames("Errors")[-1][4:6], "little") == 1


def test_a_frame_too_many_for_the_controller_is_counted_once(node: Board) -> None:
    """The flag FOVR0 is cleared; the next heartbeat has one overflow beside it, and requests are answered."""
    node.bus(overrun=True)
    assert len(node.say(protocol.Hello(1))) == 1
    node.run(110)
    assert [data[2:4] for data in node.frames("Errors")] == [b"\1\0"]


# The same on the mechanics of the cart-pole, with the driver in front of it.


def fake(link: Callable[[], HostLink], message: protocol.AnyMessage | None) -> CartpoleRobot:
    """Return a driver in front of a device that always says the same."""
    clock = VirtualClock()
    answer = b"" if message is None else link().encode(message)
    return CartpoleRobot(VirtualTransport(FakeDevice(answer), clock), clock, link=link)


class OnTheMechanics(RobotSuite):
    can = False

    @pytest.fixture
    def bench(self) -> Iterator[RobotBench]:
        clock, fault = VirtualClock(), OneBadFrame(10)
        device = Stm32Device(nominal_truth("ideal"), can=self.can, start_angle_rad=0.02)
        device.advance_to(20 * MS)
        clock.advance_ns(device.device_ns)
        wire = VirtualTransport(device, clock)
        link: Callable[[], HostLink] = CanLink if self.can else SerialLink
        yield RobotBench(
            robot=CartpoleRobot(FaultyTransport(wire, received=fault), clock, link=link),
            foreign=fake(link, Info(1, "toaster", (2, 3, 4), 1000, 200, 1)),
            newer=fake(link, Info(1, "cartpole", (2, 3, 4), 1000, 200, 1, 2)),
            silent=fake(link, None),
            unplug=wire.unplug,
            corrupt=fault.corrupt_next,
        )


@needs_compiler
class TestOnSerial(OnTheMechanics):
    """The contract of a robot on the serial wire."""


@needs_compiler
class TestOnCan(OnTheMechanics):
    """The contract of a robot on CAN."""

    can = True


@needs_compiler
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_robot_with_hidden_truth_homes_arms_and_follows(seed: int) -> None:
    """On CAN homing finds the middle within 2.5 mm and the pole upright; the cart gets where it is sent."""
    truth = candidate_truth("realistic", np.random.default_rng(seed), seed=seed, range_ratio=3.0, refused=0)
    clock = VirtualClock()
    device = Stm32Device(truth, can=True, start_angle_rad=0.02)
    device.advance_to(20 * MS)
    clock.advance_ns(device.device_ns)
    robot = CartpoleRobot(VirtualTransport(device, clock), clock, link=CanLink)
    robot.connect()
    robot.home(20.0)
    while Status.HOMED not in (state := robot.read_state(1.0)).status:
        assert state.device_ns < 20e9
    assert state.position[0] == pytest.approx(device.true_position[0], abs=2.5e-3)
    assert state.position[1] == pytest.approx(0.02, abs=4e-3)
    robot.arm(1.0)
    for _ in range(100):
        robot.send_command(default_command(robot, 0.1))
        for _ in range(4):
            state = robot.read_state(1.0)
    assert device.mode == "armed"
    assert device.true_position[0] == pytest.approx(0.1, abs=0.05)
    robot.passive()
    robot.disconnect()
    device.advance_to(device.device_ns + 10 * MS)
    assert device.mode == "idle"
    assert device.chip.outputs.unserved_ms == 0
