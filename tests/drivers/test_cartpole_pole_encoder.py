"""The pole encoder node: the core, its program with the registers in memory, its image under QEMU."""

import json
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from fakes.stm32_device import Stm32Chip
from firmware_inputs import CAN, INSTALL_QEMU, MACHINE, RecordedCore, outputs, results_under_qemu

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.controller import Mode
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.chips.host_firmware import CanHostFirmware, Settings, flash_page
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.emulator.odrive_drive import OdriveFirmware
from deal_hw.drivers.cartpole.emulator.odrive_emulator import PoleEncoder
from deal_hw.drivers.cartpole.emulator.odrive_endpoints import ENABLE_WATCHDOG, WATCHDOG_TIMEOUT
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.odrive_robot import OdriveRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, Angle, CanLink, CanMessage, frame_id
from deal_hw.drivers.cartpole.wire.odrive_frames import IDLE, Command, pack
from deal_hw.drivers.cartpole.wire.odrive_link import ENCODER_KIND, OdriveSettings
from deal_hw.drivers.cartpole.wire.protocol import Ack, Info, MessageType, Result
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite
from deal_hw.types import Status

needs_arm_tools = pytest.mark.skipif(
    shutil.which(native.ARM_CC[0]) is None or shutil.which(MACHINE[0]) is None,
    reason=f"no compiler or emulator of a Cortex-M3: {native.ARM_INSTALL}; {INSTALL_QEMU}",
)
pytestmark = pytest.mark.skipif(
    shutil.which(native.compiler()) is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
PARTS = OdriveSettings(enable_watchdog=ENABLE_WATCHDOG, watchdog_timeout=WATCHDOG_TIMEOUT)
NOMINAL = Settings(65536, 65536, 65536, 65536, 0xE000_0003, 0)
STILL = Motor(0.0, 0.0)
ESTIMATES = pack(PARTS.drive, Command.ENCODER_ESTIMATES, 0.5, 0.0)
URAD = 2e6 * 3.14159265 / 4096
BOFF = 4


# The core.


def core(node: int = 1) -> CanHostFirmware:
    """Return the core as an encoder node."""
    return CanHostFirmware(NOMINAL, lambda: 0, node, encoder=True)


def test_a_sample_by_hand(crc_bit_by_bit: Callable[[bytes], int]) -> None:
    """Offsets of the protocol page's table, packed by struct, with a CRC from its definition."""
    node, homed = core(5), 2
    node.receive(CanLink(5).encode(protocol.Home(1)), STILL)
    node.finish_homing()
    for _ in range(276):
        if node.control(STILL)[1]:
            out = node.report(Reading(9, 9, -2_824_507, -673_565, 9.0))
    parts = [struct.pack("<ii", -2_824_507, -673_565), struct.pack("<IBB", 275_000, 55, homed)]
    parts[1] += struct.pack("<H", crc_bit_by_bit(b"\x01" + b"".join(parts)))
    assert out == b"".join(FRAME.pack(5 << 5 | 21 + k, 8, part) for k, part in enumerate(parts))


@pytest.mark.parametrize("seed", range(3))
def test_the_node_in_python_gives_the_same_frames(seed: int) -> None:
    """3000 ticks of requests, targets, garbage and homings: it is never armed."""
    servo = Servo(nominal_truth().parameters, 1e-3)
    python = PoleEncoder(servo, NOMINAL.unique_id, CanLink(unique_id=NOMINAL.unique_id, device=True))
    found = list(outputs(core(), seed, wire=CAN))
    assert found == list(outputs(python, seed, wire=CAN))
    assert {mode for *_, mode in found} == {"IDLE", "HOMING"}
    assert {force for _, force, _ in found} == {0.0}


@needs_arm_tools
def test_the_core_on_a_cortex_m3_gives_the_hosts_outputs(tmp_path: Path) -> None:
    """As an encoder node, bit by bit."""
    recorded = RecordedCore(NOMINAL, can=True, encoder=True)
    assert len(list(outputs(recorded, 1, wire=CAN))) == 3000
    assert results_under_qemu(recorded.calls, tmp_path) == recorded.results


# Its program with the registers in memory.


class Node(Stm32Chip):
    """The chip on a bus with a drive that sends its estimates every 5 ms."""

    def __init__(
        self, memory: bytes | None = None, node: int = PARTS.encoder, drive: int = PARTS.drive
    ) -> None:
        page = flash_page(NOMINAL, 16.0, node, drive=drive) if memory is None else memory
        super().__init__(page, encoder=True)
        self.link = CanLink(node)
        self.ticks = 0
        self.raw = b""
        self.angles: list[Angle] = []
        self.estimates = pack(drive, Command.ENCODER_ESTIMATES, 0.5, 0.0)
        self.run(10)

    def run(self, ticks: int, data: bytes = b"", pole: int = 0, button: bool = False) -> list[CanMessage]:
        """Run some ticks with counts for each; keep the samples, and return what was reported beside them."""
        found: list[CanMessage] = []
        self.raw, self.angles = b"", []
        for _ in range(ticks):
            due = self.estimates if self.ticks % 5 == 0 else b""
            self.ticks += 1
            out = self.tick(0, pole, (button, False), due + data)
            data = b""
            self.raw += out
            for message in self.link.decode_all(out):
                (self.angles if isinstance(message, Angle) else found).append(message)  # type: ignore[arg-type]
        return found

    def frames(self, name: str) -> list[bytes]:
        """Return the data of the last run's frames of one name."""
        return [data for number, _, data in FRAME.iter_unpack(self.raw) if number == frame_id(name, 2)]


def test_it_introduces_itself_and_is_never_armed() -> None:
    """Hello in any version; arm is refused, before and while homing."""
    node = Node()
    (info,) = node.run(10, CanLink(2).encode(protocol.Hello(9, version=3)))
    assert info == Info(9, ENCODER_KIND, (0, 1, 0), 1000, 200, 0xE000_0003)
    for request, of, result in (
        (protocol.Arm(1), MessageType.ARM, Result.NOT_HOMED),
        (protocol.Home(2), MessageType.HOME, Result.DONE),
        (protocol.Arm(3), MessageType.ARM, Result.HOMING),
        (protocol.Stop(4), MessageType.STOP, Result.DONE),
    ):
        assert node.run(10, CanLink(2).encode(request)) == [Ack(request.request, of, result)]


def test_it_samples_when_the_estimates_come() -> None:
    """Each 5 ms, 0.27 ms after the frame began; a count is 1.534 mrad, 2 a millisecond are 3.068 rad/s."""
    node = Node()
    node.run(100, pole=2)
    assert [a.pole_urad_s for a in node.angles[6:]] == pytest.approx(
        [2000 * URAD] * 14, abs=0.05 * 2000 * URAD
    )
    node.run(100, pole=-2)
    steps = [(b.pole_urad - a.pole_urad, b.device_us - a.device_us) for a, b in pairwise(node.angles)]
    assert [angle for angle, _ in steps] == pytest.approx([-10 * URAD] * 19, abs=2)
    assert {time for _, time in steps} == {5000}
    assert node.angles[0].device_us % 1000 == pytest.approx(270, abs=20)
    assert [a.pole_urad_s for a in node.angles[6:]] == pytest.approx(
        [-2000 * URAD] * 14, abs=0.05 * 2000 * URAD
    )
    assert [a.sequence for a in node.angles] == list(range(22, 42))
    assert len(node.frames("Heartbeat")) == 1
    assert (node.link.errors, node.link.torn, node.outputs.unserved_ms) == (0, 0, 0)


def test_a_drive_of_another_rate_does_not_change_the_velocity() -> None:
    """Estimates every 20 ms, and behind another frame on the bus: velocity and time are the chip's own."""
    node = Node()
    node.estimates = b""
    found = []
    for _ in range(10):
        node.run(20, CanLink(2).encode(protocol.Stop(1)) + ESTIMATES, pole=2)
        found += node.angles
    assert [b.device_us - a.device_us for a, b in pairwise(found)] == [20_000] * 9
    assert found[0].device_us % 1000 == pytest.approx(430, abs=20)
    assert [a.pole_urad_s for a in found[2:]] == pytest.approx([2000 * URAD] * 8, abs=0.05 * 2000 * URAD)


def test_homing_ends_by_the_button_with_the_pole_upright() -> None:
    """Neither alone; 300 ms of both. The pole hangs at power-on; the turns before are forgotten."""
    node = Node()
    node.run(2)
    assert node.run(10, CanLink(2).encode(protocol.Home(1))) == [Ack(1, MessageType.HOME, Result.DONE)]
    assert node.outputs.set_pole
    node.run(400, button=True)
    assert node.angles[-1].pole_urad == pytest.approx(3.141593e6, abs=2)
    assert node.angles[-1].status == Status.HOMING
    node.run(256, pole=8)
    node.run(256, pole=16)
    node.run(400)
    assert node.angles[-1].status == Status.HOMING
    node.run(290, button=True)
    assert node.angles[-1].status == Status.HOMING
    node.run(20, button=True)
    assert (node.angles[-1].status, node.angles[-1].pole_urad_s) == (Status.HOMED, 0)
    assert node.angles[-1].pole_urad == pytest.approx(0, abs=2)
    assert not node.outputs.set_pole
    assert node.run(10, CanLink(2).encode(protocol.Arm(2))) == [Ack(2, MessageType.ARM, Result.NOT_HOMED)]


def test_foreign_traffic_stops_at_the_filter() -> None:
    """The drive's other frames, other nodes, another node's samples; an unknown request is an error."""
    node = Node()
    foreign = [
        pack(0, Command.HEARTBEAT, 0, IDLE, 0, 0),
        pack(0, Command.TORQUES, 0.0, 0.0),
        pack(1, Command.ENCODER_ESTIMATES, 0.0, 0.0),
        CanLink(3).encode(protocol.Hello(1)),
        CanLink(2, unique_id=5).encode(Angle(1, 0, 0, 0, 0)),
    ]
    assert node.run(10, b"".join(foreign)) == []
    assert node.outputs.filtered == 4 + 2
    node.run(100, FRAME.pack(2 << 5 | 7, 2, b"\1\1"))
    assert [data[:2] for data in node.frames("Errors")] == [b"\1\0"]


@pytest.mark.parametrize(
    ("memory", "node", "drive", "kbit"),
    [
        (b"\xff" * 32, 2, 0, 500),
        (flash_page(NOMINAL, 16.0, 62, 250, 61), 62, 61, 250),
        (flash_page(NOMINAL, 16.0, 7, 1000, 9), 7, 9, 1000),
    ],
)
def test_numbers_and_bit_rate_are_those_of_the_settings(
    memory: bytes, node: int, drive: int, kbit: int
) -> None:
    """An erased flash is node 2 beside drive 0, as the driver's defaults."""
    chip = Node(memory, node, drive)
    assert chip.outputs.bit_rate == 1000 * kbit
    assert len(chip.run(100, CanLink(node).encode(protocol.Hello(1)))) == 1
    assert len(chip.angles) == 20
    assert chip.outputs.filtered == 0


def test_bus_off_and_an_overrun_are_counted_and_survived() -> None:
    """The controller's register ESR: bit 2 bus-off, transmit and receive errors in the upper bytes."""
    node = Node()
    node.bus(errors=0x2A1F_0000 | BOFF, overrun=True)
    node.run(5)
    node.bus(errors=0x2A1F_0000)
    node.run(100)
    assert len(node.angles) == 20
    assert node.frames("Heartbeat")[-1][6:8] == bytes((0x1F, 0x2A))
    assert node.frames("Errors")[-1] == struct.pack("<4H", 0, 1, 1, 0)


def test_without_acknowledge_whole_samples_are_dropped() -> None:
    """Half a second: the queue fills; then samples come whole and fresh, and the drops are reported."""
    node = Node()
    node.bus(silent=True)
    node.run(500)
    assert node.raw == b""
    node.bus()
    node.run(500)
    assert len(node.angles) > 90
    assert (node.link.errors, node.link.torn) == (0, 0)
    assert int.from_bytes(node.frames("Errors")[-1][6:8], "little") > 50
    assert node.angles[-1].device_us > 1_000_000


# The same behind the driver.


class ChipAsFirmware:
    """The program behind the interface of the emulated node's firmware; a hand turns the pole and presses."""

    armings = 0
    frame_errors = 0
    setpoint = 0.0
    watchdog = False

    def __init__(self) -> None:
        self.homings = 0
        self._chip = Stm32Chip(flash_page(NOMINAL, 16.0, PARTS.encoder), encoder=True)
        self._host = CanLink(PARTS.encoder, device=True)
        self._inbox = self._out = b""
        self._status = Status.NONE
        self._counts, self._ticks, self._button = 2048, 0, False

    @property
    def mode(self) -> Mode:
        """Homing or not, by its newest sample."""
        return Mode.HOMING if Status.HOMING in self._status else Mode.IDLE

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """The chip takes it in its next millisecond."""
        if any(isinstance(message, protocol.Home) for message in self._host.decode(data)):
            self.homings, self._status, self._button = self.homings + 1, Status.HOMING, False
        self._inbox += data
        return b""

    def control(self, motor: Motor) -> tuple[float, bool]:
        """Run a millisecond, unless a report does."""
        self._ticks += 1
        if (self._ticks - 1) % 5:
            self._tick(0)
        return 0.0, False

    def report(self, reading: Reading) -> bytes:
        """Run the millisecond in which the drive's estimates come, with all motion since the last one."""
        counts = round(reading.pole_urad / URAD)
        moved = (counts - self._counts + 2048) % 4096 - 2048
        self._counts += moved
        self._inbox += ESTIMATES
        self._tick(moved)
        out, self._out = self._out, b""
        for message in CanLink(PARTS.encoder).decode_all(out):
            if isinstance(message, Angle):
                self._status = Status(message.status)
        return out

    def finish_homing(self) -> None:
        """The cart is in the middle and the pole upright: press."""
        self._button = True

    def _tick(self, moved: int) -> None:
        data, self._inbox = self._inbox, b""
        self._out += self._chip.tick(0, moved, (self._button, False), data)


def fake(answer: bytes) -> OdriveRobot:
    """Return a driver in front of nodes that always say the same."""
    clock = VirtualClock()
    return OdriveRobot(VirtualTransport(FakeDevice(answer), clock), clock, OdriveSettings())


class TestOdriveRobotWithTheChip(RobotSuite):
    """The contract of a robot with the bytes that the node's program sends."""

    @pytest.fixture
    def bench(self) -> Iterator[RobotBench]:
        clock, fault = VirtualClock(), OneBadFrame(-3)
        device = CartpoleDevice(
            nominal_truth("ideal"),
            firmware=lambda truth, mechanics: OdriveFirmware(
                truth, PARTS, ChipAsFirmware(), mechanics.command_delay
            ),
        )
        wire = VirtualTransport(device, clock)
        heartbeat = pack(PARTS.drive, Command.HEARTBEAT, 0, IDLE, 0, 0)
        info = Info(1, ENCODER_KIND, (2, 3, 4), 1000, 200, 1)
        yield RobotBench(
            robot=OdriveRobot(FaultyTransport(wire, received=fault), clock, PARTS),
            foreign=fake(heartbeat + CanLink(2).encode(Info(1, "toaster", (2, 3, 4), 1000, 200, 1))),
            newer=fake(heartbeat + CanLink(2, 2).encode(info)),
            silent=fake(b""),
            unplug=wire.unplug,
            corrupt=fault.corrupt_next,
        )


# Its image for the chip.


@needs_arm_tools
def test_the_image_samples_under_qemu(tmp_path: Path) -> None:
    """Estimates wait in the CAN controller, which is memory there: the answer gets into its mailboxes."""
    base, esr = 0x2000_1000, 0x2A1F_0000 | BOFF
    # A chip's memory holds anything at power-on.
    memory = bytearray(range(256)) * 32
    memory[0x1000:0x1280] = bytes(0x280)
    # MSR, TSR with three empty mailboxes, RF0R with a frame, ESR; its id, its length.
    for at, value in ((0x04, 1), (0x08, 7 << 26), (0x0C, 1), (0x18, esr), (0x1B0, 9 << 21), (0x1B4, 8)):
        memory[0x1000 + at : 0x1004 + at] = value.to_bytes(4, "little")
    command = [*MACHINE, "-serial", "none", "-qmp", "stdio"]
    command += ["-kernel", str(native.stm32_image("pole-encoder-stm32", qemu=True))]
    for address, data in ((0x0800_FC00, flash_page(NOMINAL, 16.0, 2)), (0x2000_0000, memory)):
        (tmp_path / f"{address:x}").write_bytes(data)
        command += ["-device", f"loader,file={tmp_path / f'{address:x}'},addr={address:#x},force-raw=on"]
    save = {"val": base, "size": 640, "filename": str(tmp_path / "registers")}
    chip = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    assert chip.stdin is not None and chip.stdout is not None
    registers = b""
    try:
        chip.stdout.readline()
        for name, arguments in [("qmp_capabilities", {}), *[("pmemsave", save)] * 20_000]:
            chip.stdin.write(json.dumps({"execute": name, "arguments": arguments}).encode())
            assert json.loads(chip.stdout.readline()) == {"return": {}}
            registers = (tmp_path / "registers").read_bytes() if arguments else b""
            if registers[0x180:0x184] == ((2 << 5 | 15) << 21 | 1).to_bytes(4, "little"):
                break
    finally:
        chip.kill()
        chip.communicate()
    # Angle1 was in the first mailbox, before Errors.
    errors, angle, beat = (struct.unpack_from("<II8s", registers, 0x180 + 16 * box) for box in range(3))
    assert [(found[0] >> 21, found[1]) for found in (angle, beat, errors)] == [(86, 8), (77, 8), (79, 8)]
    assert beat[2] == struct.pack("<IBBBB", 0xE000_0003, 1, 0, 0x1F, 0x2A)
    assert errors[2] == struct.pack("<4H", 0, 0, 1, 0)
    first = FRAME.pack(85, 8, struct.pack("<ii", 3_141_592, 0))
    (sample,) = CanLink(2).decode_all(first + FRAME.pack(86, 8, angle[2]))
    assert isinstance(sample, Angle)
    assert (sample.sequence, sample.status) == (0, 0)
    # Bit rate and filters are in the controller.
    assert struct.unpack_from("<I", registers, 0x1C) == (1 << 24 | 1 << 20 | 14 << 16 | 3,)
    assert struct.unpack_from("<4I", registers, 0x240) == (2 << 26, 0xFF00_0006, 9 << 21, 0xFFE0_0006)
