"""The chip's image under simavr: robot contract, homing, watchdog, end stops, lost counts, cycles, memory."""

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.avr_device import AvrDevice, Chip, eeprom, library
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.chips.host_firmware import Settings
from deal_hw.drivers.cartpole.chips.rig_device import Rig
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, candidate_truth, nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.protocol import Ack, Info, Result, State, Target
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Transport
from deal_hw.types import Status

MS = 1_000_000
NOMINAL = Settings(65536, 65536, 65536, 65536, 7, 0)
CLOSED_LEFT, CLOSED_RIGHT = (True, False), (False, True)
DOCS = (Path(__file__).parents[2] / "docs" / "how-to" / "firmware.md").read_text(encoding="utf-8")


def missing() -> str:
    """Return what these tests lack, and how to get it."""
    try:
        native.image()
        library()
    except ConfigurationError as error:
        return str(error)
    return ""


pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


class Board(Chip):
    """The chip alone, and what it says."""

    def __init__(self, memory: bytes) -> None:
        super().__init__(memory)
        self.decoder = protocol.FrameDecoder()
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
        for _ in range(ticks):
            for payload in self.decoder.feed(self.tick(cart, pole, switches, data)):
                message = protocol.decode(payload)
                if isinstance(message, State):
                    self.state = message
                else:
                    found.append(message)
            data = b""
        return found

    def say(self, message: protocol.AnyMessage, ticks: int = 10, **pins: object) -> list[protocol.AnyMessage]:
        """Send a message after a delimiter, and run some ticks."""
        return self.run(ticks, b"\0" + protocol.encode(message), **pins)  # type: ignore[arg-type]

    @property
    def status(self) -> Status:
        """Status bits of the last state frame."""
        return Status(self.state.status)

    def home(self, pole: int = 16) -> None:
        """Home by hand: the switch closes, the cart is carried to the middle, the pole turned upright."""
        self.say(protocol.Home(200))
        self.run(10, switches=CLOSED_LEFT)
        self.run(395, cart=40)  # 395 mm in 1 mm a tick.
        self.run(50)
        self.run(128, pole=pole)
        self.run(400)
        assert self.status == Status.HOMED

    def arm(self) -> None:
        """Home and arm."""
        self.home()
        assert self.say(protocol.Arm(201)) == [Ack(201, protocol.MessageType.ARM, Result.DONE)]
        assert self.outputs.armed


@pytest.fixture
def board() -> Iterator[Board]:
    """Return a chip with nominal trims that has started."""
    chip = Board(eeprom(NOMINAL, 16.0))
    chip.run(10)
    yield chip
    chip.close()


def target(number: int, position_um: int = 0) -> Target:
    """Return a target with the description's gains."""
    return Target(number, position_um, 80_000, 8_000, 4_000, 1_000_000)


def test_the_chip_introduces_itself_with_the_settings_of_its_eeprom(board: Board) -> None:
    """The serial number is 7; where the EEPROM's CRC is wrong nominal settings hold, with number 1."""
    (info,) = board.say(protocol.Hello(9, version=3))
    assert info == Info(9, "cartpole", (0, 1, 0), 1000, 200, 7)
    memory = bytearray(eeprom(NOMINAL, 16.0))
    memory[3] ^= 1
    other = Board(bytes(memory))
    other.run(10)
    (info,) = other.say(protocol.Hello(9))
    assert isinstance(info, Info)
    assert info.unique_id == 1
    other.close()


def test_state_frames_come_every_5_ms_with_the_pole_hanging(board: Board) -> None:
    """40 frames in 200 ms, none corrupt; at power-on the pole hangs: pi rad."""
    first = board.state.sequence
    board.run(200)
    assert board.state.sequence == first + 40
    assert (board.state.pole_urad, board.state.pole_urad_s, board.state.cart_um) == (3141592, 0, 0)
    assert board.decoder.errors == 0


def test_counts_are_positions(board: Board) -> None:
    """100 counts of 25 um, 1024 counts of 2 pi / 4096; 20 ms earlier there were 4000 um/s and less."""
    board.run(100, cart=1)
    board.run(64, pole=-16)
    assert board.state.cart_um == 2500
    board.run(50)
    assert board.state.pole_urad == pytest.approx((np.pi - np.pi / 2) * 1e6, abs=2)
    board.run(100, cart=2)
    assert board.state.cart_um_s == 50_000  # 2 counts of 25 um in 1 ms.


def test_arming_needs_homing_and_homing_needs_the_switch(board: Board) -> None:
    """Refused before and during homing; the motor pulls left until the switch closes, then right."""
    assert board.say(protocol.Arm(1)) == [Ack(1, protocol.MessageType.ARM, Result.NOT_HOMED)]
    assert board.say(protocol.Home(2)) == [Ack(2, protocol.MessageType.HOME, Result.DONE)]
    assert board.say(protocol.Arm(3)) == [Ack(3, protocol.MessageType.ARM, Result.HOMING)]
    board.run(300)
    assert board.outputs.pwm < -100
    board.run(2, switches=CLOSED_LEFT)
    board.run(300)
    assert board.outputs.pwm > 100
    assert board.status == Status.HOMING
    assert board.say(protocol.Stop(4)) == [Ack(4, protocol.MessageType.STOP, Result.DONE)]
    board.run(1)
    assert board.outputs.pwm == 0
    assert board.status == Status.NONE


def test_homing_without_a_switch_ends_in_a_fault(board: Board) -> None:
    """After 15 s of pulling the motor is off, the fault bit is set and nothing may be armed."""
    board.say(protocol.Home(1))
    board.run(15_010)
    assert board.outputs.pwm == 0
    assert board.status == Status.FAULT
    assert board.say(protocol.Arm(2)) == [Ack(2, protocol.MessageType.ARM, Result.NOT_HOMED)]


def test_the_pole_must_be_upright_and_stay_so_for_300_ms(board: Board) -> None:
    """The lamp asks for it; a pole that passes by does not count, one that was set does, less its turns."""
    board.say(protocol.Home(1))
    board.run(10, switches=CLOSED_LEFT)
    board.run(395, cart=40)
    board.run(50)
    assert board.outputs.set_pole
    board.run(100, pole=41)  # Past the top, and round again.
    board.run(20)
    assert board.status == Status.HOMING
    board.run(100, pole=61)
    board.run(50, pole=-1)
    board.run(100)
    # 2048 + 4100 + 6100 - 50 counts are 12 198, 90 counts short of three turns: -0.138 rad is not upright.
    assert board.status == Status.HOMING
    board.run(60, pole=1)
    board.run(320)
    assert board.status == Status.HOMED
    assert board.state.pole_urad == pytest.approx(-30 / 4096 * 2 * np.pi * 1e6, abs=2)
    assert not board.outputs.set_pole


def test_force_is_stiffness_times_error(board: Board) -> None:
    """80 N/m times 20 mm is 1.6 N: a tenth of the PWM's 16 N; parts of a step are carried over."""
    board.arm()
    board.say(target(0, 20_000), ticks=2)
    for number in range(1, 40):
        board.say(target(number, 20_000), ticks=2)
    at_um = board.state.cart_um
    mean = 0.0
    board.say(target(40, 20_000), ticks=2)
    for _ in range(100):
        board.run(1)
        mean += board.outputs.pwm / 100
    # The chip divides 16 N into 799 steps.
    assert mean == pytest.approx(80e-6 * (20_000 - at_um) / 16 * 799, rel=2e-3)
    assert board.state.effort_mn == pytest.approx(80e-3 * (20_000 - at_um), abs=1)


def test_silence_switches_the_motor_off_in_200_ms(board: Board) -> None:
    """The PWM is there in the 190th millisecond after the last target, and gone in the 210th."""
    board.arm()
    board.say(target(0, 50_000), ticks=190)
    assert board.outputs.pwm > 0
    board.run(20)
    assert (board.outputs.pwm, board.outputs.armed) == (0, 0)
    assert board.status == Status.HOMED | Status.WATCHDOG


def test_a_closed_switch_lets_no_force_towards_it(board: Board) -> None:
    """At the right end a target further right moves nothing, one to the left does."""
    board.arm()
    board.say(target(0, 50_000), ticks=60, switches=CLOSED_RIGHT)
    assert board.outputs.pwm == 0
    assert Status.AT_END_STOP in board.status
    board.say(target(1, -50_000), ticks=120, switches=CLOSED_RIGHT)
    assert board.outputs.pwm < 0


def test_lost_counts_stop_the_motor_until_homed_again(board: Board) -> None:
    """An encoder faster than the chip can count (12 m/s) is a fault: the position is not known any more."""
    board.arm()
    board.say(target(0, 50_000), ticks=60)
    assert board.outputs.pwm > 0
    board.run(10, cart=480)
    board.run(10)
    assert board.outputs.pwm == 0
    assert board.status == Status.FAULT
    board.run(50)
    board.home(pole=0)


@pytest.mark.parametrize("cart", [40, -60, 80])
def test_no_count_is_lost_up_to_2_m_s(board: Board, cart: int) -> None:
    """1, 1.5 and 2 m/s, the pole at two turns a second, a target every 20 ms: each step ends in time."""
    board.run(10)
    before = board.state
    for number in range(20):
        board.say(target(number), ticks=20, cart=cart, pole=8)
    board.run(10)
    assert board.state.cart_um - before.cart_um == 400 * cart * 25
    assert board.state.pole_urad - before.pole_urad == pytest.approx(3200 / 4096 * 2e6 * np.pi, abs=2)
    assert board.longest_step < 14_000
    assert (board.complaints, board.decoder.errors) == (0, 0)


def test_the_longest_step_is_the_one_in_the_docs(board: Board) -> None:
    """A control step with a state frame, armed, with targets at 50 Hz and at rest."""
    board.arm()
    board.longest_step = 0
    for number in range(50):
        board.say(target(number, 1000 * number), ticks=20)
    (documented,) = re.findall(r"\| armed, at rest, targets at 50 Hz \| ([\d ]+) \|", DOCS)
    assert board.longest_step == pytest.approx(int(documented.replace(" ", "")), rel=0.05)
    assert board.longest_step < 16_000 * 0.75


def test_memory_use_is_the_one_in_the_docs(tmp_path: Path) -> None:
    """What avr-size says is what the page says, within 2 %; both fit with room."""
    sizes = [int(text) for text in re.findall(r"(\d+) bytes", native.write_image(tmp_path))]
    documented = re.findall(r"\| ATmega328P: (?:flash|RAM), fixed \| (\d+) of", DOCS)
    assert sizes == pytest.approx([int(text) for text in documented], rel=0.02)
    assert (tmp_path / "cartpole.hex").read_text().endswith(":00000001FF\n")


def test_without_the_tools_they_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The package to install, and the emulator without it."""
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(ConfigurationError, match=r"avr-gcc, which is not installed; apt-get install gcc-avr"):
        native.image()


# The chip on the mechanics.


class Bench:
    """A chip on an emulated cart-pole, and the driver."""

    def __init__(self, truth: CartpoleTruth, wrap: Callable[[Transport], Transport] = lambda t: t) -> None:
        """Start the chip: it does not hear what comes before."""
        self.clock = VirtualClock()
        self.device = AvrDevice(truth, start_angle_rad=0.02)
        self.device.advance_to(20 * MS)
        self.clock.advance_ns(self.device.device_ns)
        self.virtual = VirtualTransport(self.device, self.clock)
        self.robot = CartpoleRobot(wrap(self.virtual), self.clock)


def fake(answer: bytes) -> CartpoleRobot:
    """Return a driver in front of a device that always says the same."""
    clock = VirtualClock()
    return CartpoleRobot(VirtualTransport(FakeDevice(answer), clock), clock)


class TestCartpoleOnTheChip(RobotSuite):
    @pytest.fixture
    def bench(self) -> Iterator[RobotBench]:
        fault = OneBadFrame(10)
        chip = Bench(nominal_truth("ideal"), lambda transport: FaultyTransport(transport, received=fault))
        known = Info(1, "cartpole", (2, 3, 4), 1000, 200, 1)
        yield RobotBench(
            robot=chip.robot,
            foreign=fake(protocol.encode(replace(known, kind="toaster"))),
            newer=fake(protocol.encode(replace(known, version=2))),
            silent=fake(b""),
            unplug=chip.virtual.unplug,
            corrupt=fault.corrupt_next,
        )
        chip.device.close()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_robot_with_hidden_truth_homes_arms_and_follows(seed: int) -> None:
    """Homing finds the middle within 2.5 mm and the pole upright; the cart then gets where it is sent."""
    bench = Bench(
        candidate_truth("realistic", np.random.default_rng(seed), seed=seed, range_ratio=3.0, refused=0)
    )
    robot = bench.robot
    robot.connect()
    robot.home(20.0)
    while Status.HOMED not in (state := robot.read_state(1.0)).status:
        assert state.device_ns < 20e9
    assert state.position[0] == pytest.approx(bench.device.true_position[0], abs=2.5e-3)
    assert state.position[1] == pytest.approx(0.02, abs=4e-3)
    robot.arm(1.0)
    for number in range(100):
        robot.send_command(default_command(robot, 0.1))
        for _ in range(4):
            state = robot.read_state(1.0)
        assert Status.FAULT not in state.status, number
    assert bench.device.mode == "armed"
    assert bench.device.true_position[0] == pytest.approx(0.1, abs=0.05)
    robot.passive()
    robot.disconnect()
    bench.device.advance_to(bench.device.device_ns + 10 * MS)
    assert bench.device.mode == "idle"
    assert bench.device.chip.complaints == 0
    assert bench.device.chip.longest_step < 14_000
    bench.device.close()


def test_the_chip_moves_the_same_robot_as_the_float_servo() -> None:
    """Random steps of up to 100 mm for 1.2 s: cart paths differ by less than 1 mm rms, beside the zero."""
    truth = nominal_truth("ideal")
    paths = []
    for device in (CartpoleDevice(truth, start_angle_rad=0.02), AvrDevice(truth, start_angle_rad=0.02)):
        device.advance_to(19 * MS)
        device.receive(protocol.encode(protocol.Home(1)))
        device.advance_to(7999 * MS)
        assert device.mode == "held"
        device.receive(protocol.encode(protocol.Arm(2)))
        device.advance_to(8019 * MS)
        rng, path = np.random.default_rng(0), []
        for number in range(30):
            device.receive(protocol.encode(target(number, int(rng.integers(-100_000, 100_000)))))
            for _ in range(40):
                device.tick()
                path.append(device.true_position[0])
        paths.append(np.array(path))
    apart = paths[1] - paths[0]
    assert apart.std() < 1e-3
    assert abs(apart.mean()) < 2e-3
    assert np.ptp(paths[0]) > 0.05


@pytest.mark.real_time
def test_the_emulator_runs_the_chip_behind_a_port(tmp_path: Path) -> None:
    """`emulate cartpole --firmware avr` as a process: connect, home, and the serial number of seed 3."""
    from deal_hw.clock import MonotonicClock
    from deal_hw.robots.connect import make_robot
    from deal_hw.workflows.emulation.process import EmulatorProcess

    with EmulatorProcess(
        "cartpole", "--nominal", "--profile", "ideal", "--seed", "3", "--firmware", "avr"
    ) as it:
        robot = make_robot("cartpole", "serial", it.port, MonotonicClock())
        robot.connect()
        robot.home(30.0)
        while Status.HOMED not in (state := robot.read_state(5.0)).status:
            assert state.device_ns < 30e9
        robot.disconnect()


def test_the_build_of_the_emulator_is_that_of_the_firmware() -> None:
    """What rig.h says of encoders, switches and PWM is what the emulated cart-pole has."""
    text = (native.SOURCES / "rig.h").read_text()
    value = {name: int(number) for name, number in re.findall(r"#define (RIG_\w+) (\d+)U?L?", text)}
    build = Rig()
    assert value["RIG_NM_PER_COUNT"] == round(build.m_per_count * 1e9)
    assert value["RIG_COUNTS_PER_TURN"] == build.counts_per_turn
    assert value["RIG_URAD_PER_COUNT_Q20"] == round(2 * np.pi * 1e6 / build.counts_per_turn * 2**20)
    assert value["RIG_SWITCH_UM"] == round(build.switch_m * 1e6)
    assert value["RIG_PWM_TOP"] == build.pwm_top
    nominal = re.findall(r"nominal = \{.*?, 1, 0\}, (\d+)\}", (native.SOURCES / "avr" / "main.c").read_text())
    assert nominal == [str(round(build.full_force_n * 1000))]
