"""Emulated STS servos: their rules, and the driver's bus on their bytes, over a virtual wire."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.servo_bus.feetech import registers as r
from deal_hw.drivers.servo_bus.feetech.bus import FeetechBus
from deal_hw.drivers.servo_bus.feetech.emulated_bus import StsBus
from deal_hw.drivers.servo_bus.feetech.emulated_servo import BOOT_NS, StsServo
from deal_hw.drivers.servo_bus.feetech.packets import BROADCAST, Fault, Instruction, encode, status
from deal_hw.drivers.servo_bus.feetech.registers import BLOCK_ADDRESS, BLOCK_BYTES, Block, TorqueMode
from deal_hw.drivers.servo_bus.interface import Answer
from deal_hw.drivers.servo_bus.registers import Register
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import FrameError, ProtocolError, TransportTimeoutError

RATE = 1_000_000
LATE_NS = 10**13


class Rig:
    """Emulated servos with the ids 1, 2, ... behind a virtual wire, and the driver's bus on it."""

    def __init__(self, count: int = 1, *, echo: bool = False) -> None:
        self.servos = [StsServo(servo, RATE) for servo in range(1, count + 1)]
        self.changes, self.lost = 0, 0
        self.sts = StsBus(self.servos, self._count_change, self._lose, echo=echo)
        self.clock = VirtualClock()
        self._tick_ns = 0
        transport = VirtualTransport(self, self.clock)
        transport.open()
        self.bus = FeetechBus(transport, self.clock, RATE, 0.003)
        self.servo = self.servos[0]

    def _count_change(self) -> None:
        self.changes += 1

    def _lose(self) -> bool:
        self.lost -= self.lost > 0
        return self.lost > 0

    @property
    def device_ns(self) -> int:
        """Time of the next tick of 1 ms, or of the next answer [ns]."""
        reply_ns = self.sts.next_ns
        return self._tick_ns if reply_ns is None else min(self._tick_ns, max(reply_ns, self.sts.now_ns))

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        self.sts.now_ns = max(self.sts.now_ns, self.clock.now_ns())
        self.sts.receive(data)

    def tick(self) -> bytes:
        """Send the next answer, or let a millisecond pass."""
        self.sts.now_ns = max(self.sts.now_ns, self.device_ns)
        reply_ns = self.sts.next_ns
        if reply_ns is not None and reply_ns <= self.sts.now_ns:
            return self.sts.take_reply()
        self._tick_ns += 1_000_000
        return b""

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.clock.advance_ns(round(seconds * 1e9))
        self.sts.now_ns = self.clock.now_ns()

    def number(self, register: Register, servo: int = 1) -> int:
        """Return a register as a host reads it, with its sign."""
        value = self.bus.read(servo, register)
        return r.decode(register, value.to_bytes(register.size, "little"))

    def command(self, register: Register, number: int, servo: int = 1) -> None:
        """Write a register as a host."""
        self.bus.write(servo, register, int.from_bytes(r.encode(register, number), "little"))

    def ask(self, instruction: int, params: bytes = b"", servo: int = 1) -> bytes:
        """Send a request, and return the bytes that come back within 5 ms."""
        before = len(self.bus.wire)
        self.bus._port.write(encode(servo, instruction, params))
        self.bus._port.flush()
        until_ns = self.clock.now_ns() + 5_000_000
        while self.bus._port.receive(until_ns):
            continue
        return b"".join(m.payload for m in list(self.bus.wire)[before:] if m.channel == "rx")

    def blocks(self) -> dict[int, Block]:
        """Return the blocks of all servos."""
        self.bus.ask([s.id for s in self.servos], BLOCK_ADDRESS, BLOCK_BYTES)
        found = self.bus.take(LATE_NS)
        assert found is not None
        return {servo: Block.unpack(data) for servo, data in found.items()}


@pytest.fixture
def rig() -> Rig:
    """One servo with the id 1."""
    return Rig()


# The wire.


@pytest.mark.parametrize("echo", [False, True])
def test_the_driver_and_the_servos_agree(echo: bool) -> None:
    """Ping, search, read, write, sync write and sync read, with an adapter that echoes too."""
    rig = Rig(3, echo=echo)
    assert rig.bus.ping(2) == Answer(777, 310)
    assert rig.bus.broadcast_ping(0.01) == dict.fromkeys((1, 2, 3), Answer(777, 310))
    rig.command(r.P_GAIN, 16, servo=3)
    assert rig.servos[2].p_gain == 16
    for servo in rig.servos:
        servo.sense(1000 * servo.id, -servo.id, -350, 74, 31, 12, True)
    goals = {servo: r.encode(r.GOAL_POSITION, 100 * servo) for servo in (1, 2, 3)}
    rig.bus.ask((1, 2, 3), BLOCK_ADDRESS, BLOCK_BYTES, writes=[(r.GOAL_POSITION.address, goals)])
    found = rig.bus.take(LATE_NS)
    assert found is not None
    block = Block.unpack(found[3])
    assert (block.goal_position, block.position, block.speed, block.load) == (300, 3000, -3, -350)
    assert (block.temperature, block.current, block.moving, block.lock) == (31, 12, 1, 1)
    assert [servo.goal for servo in rig.servos] == [100, 200, 300]
    assert (rig.bus.errors, rig.sts.errors, rig.changes) == (0, 0, 2)


def test_the_time_of_a_group_is_that_of_its_bytes() -> None:
    """6 servos, 31 bytes each: 14 bytes out, 6 * 37 in, 10 us a byte: 2.36 ms; then 6 return delays."""
    rig = Rig(6)
    rig.blocks()
    assert rig.clock.now_ns() == 2_360_000
    for servo in rig.servos:
        servo.put(r.RETURN_DELAY, 250)
    rig.wait(0.01)
    start_ns = rig.clock.now_ns()
    # The answer has 3 ms beside its bytes, and 6 * 500 us are just that.
    rig.blocks()
    assert rig.clock.now_ns() - start_ns == 2_360_000 + 6 * 500_000


@pytest.mark.parametrize(("value", "seconds"), [(0, 0.0), (1, 1e-4), (49, 1e-4), (51, 1.02e-4), (250, 5e-4)])
def test_return_delays(rig: Rig, value: int, seconds: float) -> None:
    """2 us a unit, and at least 50 units unless 0."""
    rig.servo.put(r.RETURN_DELAY, value)
    assert rig.servo.return_delay_s == pytest.approx(seconds)


def test_a_missing_servo_leaves_the_others_answers() -> None:
    """The third answers in its own time, after an empty place."""
    rig = Rig(3)
    rig.servos[1].present = False
    rig.bus.ask((1, 2, 3), 56, 2)
    with pytest.raises(TransportTimeoutError, match=r"servos \(2,\) do not answer; servos \(1, 3\) did"):
        rig.bus.take(LATE_NS)
    # 11 bytes out, 3 places of 8 bytes.
    assert rig.clock.now_ns() == 350_000
    rig.servos[1].present = True
    rig.wait(0.01)
    assert set(rig.blocks()) == {1, 2, 3}


def test_a_lost_answer_is_one_missed_sample(rig: Rig) -> None:
    """Only answers with the present position are lost, and the next one comes."""
    rig.lost = 2
    assert rig.bus.read(1, r.P_GAIN) == 32
    with pytest.raises(TransportTimeoutError):
        rig.blocks()
    assert set(rig.blocks()) == {1}


def test_two_servos_of_one_id_answer_at_once() -> None:
    """Equal answers are one; different ones are corrupt, and the search leaves the id out."""
    rig = Rig(3)
    rig.servos[1].put(r.ID, 1)
    assert rig.bus.ping(1) == Answer(777, 310)
    rig.servos[0].sense(1000)
    rig.servos[1].sense(3007)
    with pytest.raises(FrameError, match="servo 1: its answer is corrupt"):
        rig.bus.read(1, r.PRESENT_POSITION)
    rig.servos[1].put(r.FIRMWARE_MINOR, 9)
    assert set(rig.bus.broadcast_ping(0.01)) == {3}


def test_a_servo_of_another_rate_hears_nothing() -> None:
    """It is silent at the host's rate, and answers at its own."""
    rig = Rig()
    rig.sts.host_baud_rate = 115_200
    with pytest.raises(TransportTimeoutError):
        rig.bus.ping(1)
    assert rig.sts.errors == 0
    rig.sts.host_baud_rate = RATE
    assert rig.bus.ping(1) == Answer(777, 310)


def test_nobody_answers_a_broadcast_but_ping_and_sync_read(rig: Rig) -> None:
    """Action, write and read to 254 are silent; a ping is answered by every servo."""
    assert rig.ask(Instruction.WRITE, b"\x15\x10", BROADCAST) == b""
    assert rig.servo.p_gain == 16
    assert rig.ask(Instruction.READ, b"\x15\x01", BROADCAST) == b""
    assert rig.ask(Instruction.ACTION, servo=BROADCAST) == b""
    assert rig.ask(Instruction.PING, servo=BROADCAST) == status(1, 0)


def test_unknown_requests_change_nothing(rig: Rig) -> None:
    """A corrupt one is counted, an unknown instruction is confirmed, a read behind the table is not."""
    rig.sts.receive(b"\xff\xff\x01\x04\x02\x38\x02\xbf")
    assert rig.sts.errors == 1
    assert rig.ask(0x55, b"\x01") == status(1, 0)
    assert rig.ask(Instruction.READ, b"\x7f\x02") == b""
    assert rig.ask(Instruction.READ, b"\x7f\x01") == status(1, 0, b"\0")


def test_an_incomplete_request_is_forgotten(rig: Rig) -> None:
    """A length of 0xF0 would take the next 240 bytes; after 10 ms of silence the servo begins again."""
    rig.receive(b"\xff\xff\x01\xf0\x03\x28\x01")
    with pytest.raises(TransportTimeoutError):
        rig.bus.read(1, r.ID)
    rig.wait(0.011)
    assert rig.bus.read(1, r.ID) == 1


def test_random_requests_do_not_upset_the_servos() -> None:
    """Bytes at random, and sound requests with a random inside: no exception, then a ping works."""
    rng = np.random.default_rng(0)
    rig = Rig(2)
    codes = [int(code) for code in Instruction if code is not Instruction.REBOOT]
    for k in range(20_000):
        body = rng.bytes(int(rng.integers(0, 24)))
        if k % 2:
            servo = int(rng.choice([0, 1, 2, 0xFD, 0xFE]))
            body = encode(servo, int(rng.choice(codes)), body)
        rig.receive(body)
        while rig.sts.next_ns is not None:
            rig.sts.take_reply()
    rig.wait(0.02)
    rig.servo.put(r.ID, 7)
    rig.receive(encode(7, Instruction.PING))
    assert rig.sts.take_reply() == status(7, rig.servo.error)


# Registers.


def test_factory_values(rig: Rig) -> None:
    """Of Feetech's table; torque off, EEPROM locked."""
    zeros = (r.BAUD_RATE, r.MIN_POSITION, r.HOMING_OFFSET, r.OPERATING_MODE, r.TORQUE_ENABLE, r.GOAL_POSITION)
    expected = {
        **dict.fromkeys(zeros, 0),
        **dict.fromkeys((r.ID, r.RESPONSE_LEVEL, r.LOCK), 1),
        **dict.fromkeys((r.MAX_TORQUE, r.TORQUE_LIMIT), 1000),
        r.MODEL_NUMBER: 777,
        r.MAX_POSITION: 4095,
        r.MAX_TEMPERATURE: 70,
        r.P_GAIN: 32,
        r.PROTECTION_CURRENT: 511,
        r.PROTECTIVE_TORQUE: 20,
        r.PROTECTION_TIME: 200,
        r.OVERLOAD_TORQUE: 80,
    }
    assert {register: rig.number(register) for register in expected} == expected
    assert StsServo(4, 500_000, model=2825).get(r.MODEL_NUMBER) == 2825
    assert StsServo(4, 500_000).baud_rate == 500_000


@pytest.mark.parametrize(
    ("register", "number"),
    [
        (r.RESPONSE_LEVEL, 2),
        (r.BAUD_RATE, 5),
        (r.TORQUE_ENABLE, 3),
        (r.MAX_TORQUE, 1001),
        (r.OPERATING_MODE, 4),
    ],
)
def test_values_out_of_range_change_nothing(rig: Rig, register: Register, number: int) -> None:
    """The servo confirms, and keeps its value."""
    before = rig.servo.get(register)
    rig.bus.write(1, register, number)
    assert rig.servo.get(register) == before
    rig.command(r.RESPONSE_LEVEL, 0)
    with pytest.raises(ProtocolError, match="does not confirm"):
        rig.bus.write(1, register, number)


def test_read_only_registers_stay(rig: Rig) -> None:
    """In one write with registers that may be written, these are."""
    rig.servo.sense(1234)
    rig.bus.write(1, Register(54, 4, "Lock to Present Position"), 0x1111_0000)
    assert (rig.servo.get(r.LOCK), rig.servo.get(r.PRESENT_POSITION)) == (0, 1234)


@pytest.mark.parametrize(("lock", "kept"), [(r.LOCKED, 32), (r.UNLOCKED, 16)])
def test_the_eeproms_lock(rig: Rig, lock: int, kept: int) -> None:
    """A write acts at once; with Lock 1 a restart forgets it. The restart locks again."""
    rig.command(r.LOCK, lock)
    rig.command(r.P_GAIN, 16)
    assert rig.servo.p_gain == 16
    assert rig.ask(Instruction.REBOOT) == b""
    assert rig.servo.p_gain == kept
    assert rig.servo.get(r.LOCK) == r.LOCKED


def test_a_restart_is_silent_and_forgets_ram(rig: Rig) -> None:
    """0.8 s without an answer; then torque off, no goal and the torque limit of the EEPROM."""
    rig.command(r.LOCK, 0)
    rig.command(r.MAX_TORQUE, 500)
    assert rig.servo.torque_limit == 1000
    rig.command(r.TORQUE_ENABLE, 1)
    rig.command(r.GOAL_POSITION, 3000)
    rig.servo.sense(1500)
    rig.servo.reboot(rig.clock.now_ns())
    with pytest.raises(TransportTimeoutError):
        rig.bus.read(1, r.ID)
    rig.wait(BOOT_NS / 1e9)
    block = rig.blocks()[1]
    assert (block.torque_mode, block.goal_position, block.torque_limit) == (TorqueMode.OFF, 1500, 500)


def test_a_goal_is_the_present_position_until_one_is_written(rig: Rig) -> None:
    """A hand turns the servo: with torque it stays there. An old goal is not forgotten with the torque."""
    rig.servo.sense(1000)
    rig.command(r.TORQUE_ENABLE, 1)
    rig.servo.sense(990)
    assert rig.servo.goal == rig.number(r.GOAL_POSITION) == 1000
    rig.command(r.TORQUE_ENABLE, 0)
    rig.servo.sense(3000)
    rig.command(r.TORQUE_ENABLE, 1)
    assert rig.servo.goal == 1000


def test_a_new_id_and_response_level(rig: Rig) -> None:
    """The confirmation has the old id; with level 0 there is none, but reads are answered."""
    assert rig.ask(Instruction.WRITE, b"\x05\x09") == status(1, 0)
    assert rig.servo.id == 9
    rig.bus.write(9, r.RESPONSE_LEVEL, 0)
    rig.bus.write(9, r.P_GAIN, 20)
    assert rig.servo.p_gain == 20
    assert rig.ask(Instruction.WRITE, b"\x15\x18", 9) == b""
    assert rig.ask(Instruction.PING, b"", 9) == status(9, 0)


def test_a_registered_write_waits_for_action() -> None:
    """Both servos move at the same Action; a second one does nothing."""
    rig = Rig(2)
    for servo in (1, 2):
        assert rig.ask(Instruction.REG_WRITE, b"\x2a\x00\x08", servo) == status(servo, 0)
    assert [s.get(r.GOAL_POSITION) for s in rig.servos] == [0, 0]
    assert rig.number(r.ASYNC_WRITE) == 1
    assert rig.ask(Instruction.ACTION, servo=BROADCAST) == b""
    assert [s.get(r.GOAL_POSITION) for s in rig.servos] == [2048, 2048]
    rig.command(r.GOAL_POSITION, 5)
    assert rig.ask(Instruction.ACTION) == status(1, 0)
    assert rig.servo.get(r.GOAL_POSITION) == 5


def test_factory_reset_and_backup(rig: Rig) -> None:
    """All but the id, to the last backup, at first as it left the factory."""
    rig.command(r.ID, 5)
    rig.command(r.P_GAIN, 16, servo=5)
    assert rig.ask(Instruction.FACTORY_RESET, servo=5) == status(5, 0)
    assert (rig.servo.id, rig.servo.p_gain) == (5, 32)
    rig.command(r.P_GAIN, 16, servo=5)
    rig.ask(Instruction.BACKUP, servo=5)
    rig.command(r.P_GAIN, 8, servo=5)
    rig.ask(Instruction.FACTORY_RESET, servo=5)
    rig.servo.reboot(0)
    assert (rig.servo.id, rig.servo.p_gain) == (5, 16)


def test_an_id_that_no_servo_has(rig: Rig) -> None:
    """254 is for all: the servo confirms, and keeps its id."""
    rig.bus.write(1, r.ID, BROADCAST)
    assert rig.servo.id == 1


# Positions and goals.


@pytest.mark.parametrize(
    ("shaft", "offset", "shown"),
    [
        (1304, 0, 1304),
        # Present = shaft - offset.
        (1304, 256, 1048),
        (1304, -2047, 3351),
        # One turn: 100 - 1000 = -900, and 4096 - 900 = 3196.
        (100, 1000, 3196),
        (4096 + 100, 0, 100),
        (-1, 0, 4095),
    ],
)
def test_the_homing_offset(rig: Rig, shaft: int, offset: int, shown: int) -> None:
    """As LeRobot writes it, with the sign in bit 11."""
    rig.command(r.HOMING_OFFSET, offset)
    rig.servo.sense(shaft)
    assert rig.number(r.PRESENT_POSITION) == shown


def test_more_than_one_turn(rig: Rig) -> None:
    """With bit 4 of Phase the position goes on; -1 is 0x8001. A restart and Reset forget the turns."""
    rig.command(r.PHASE, 12 | r.MULTI_TURN)
    rig.servo.sense(-1)
    assert rig.bus.read(1, r.PRESENT_POSITION) == 0x8001
    rig.servo.sense(3 * 4096 + 5)
    assert rig.number(r.PRESENT_POSITION) == 12293
    rig.servo.sense(40_000)
    assert rig.number(r.PRESENT_POSITION) == 32767
    assert rig.ask(Instruction.RESET) == status(1, 0)
    assert rig.number(r.PRESENT_POSITION) == 40_000 % 4096


@pytest.mark.parametrize(
    ("goal", "low", "high", "shaft_goal"),
    [
        (2048, 0, 4095, 2148),
        (3000, 1000, 2000, 2100),
        (500, 1000, 2000, 1100),
        (-5, 0, 4095, 100),
        # Both limits 0: none.
        (5000, 0, 0, 5100),
    ],
)
def test_position_limits(rig: Rig, goal: int, low: int, high: int, shaft_goal: int) -> None:
    """The servo keeps within its limits; the shaft is the homing offset of 100 further."""
    for register, number in ((r.MIN_POSITION, low), (r.MAX_POSITION, high), (r.HOMING_OFFSET, 100)):
        rig.command(register, number)
    rig.servo.sense(1600)
    rig.command(r.GOAL_POSITION, goal)
    assert rig.servo.goal == shaft_goal
    assert rig.number(r.GOAL_POSITION) == goal
    assert rig.number(r.TARGET_POSITION) == shaft_goal - 100


def test_a_goal_is_not_reached_over_the_wrap_around(rig: Rig) -> None:
    """From 4090 to 10 the servo turns back 4080 ticks, and not 16 forward."""
    rig.servo.sense(4096 + 4090)
    rig.command(r.GOAL_POSITION, 10)
    assert rig.servo.goal == 4096 + 10


def test_calibrating_the_middle(rig: Rig) -> None:
    """128 in Torque Enable: the present position is 2048, also after a restart; the torque stays."""
    rig.servo.sense(1000)
    rig.command(r.TORQUE_ENABLE, 1)
    rig.bus.write(1, r.TORQUE_ENABLE, r.CALIBRATE_MIDDLE)
    assert rig.number(r.HOMING_OFFSET) == -1048
    assert rig.number(r.PRESENT_POSITION) == 2048
    assert rig.servo.torque_mode is TorqueMode.ON
    rig.servo.reboot(0)
    assert rig.servo.get(r.PRESENT_POSITION) == 2048
    # The instruction has a position: 1000 = 0x03E8.
    assert rig.ask(Instruction.CALIBRATE, b"\xe8\x03") == b""
    rig.wait(1.0)
    assert rig.ask(Instruction.CALIBRATE, b"\xe8\x03") == status(1, 0)
    assert rig.number(r.PRESENT_POSITION) == 1000
    rig.ask(Instruction.CALIBRATE)
    assert rig.number(r.PRESENT_POSITION) == 2048


def test_the_middle_has_one_place_that_no_offset_reaches(rig: Rig) -> None:
    """At 0 the offset would be -2048, of which bit 11 is the sign: the servo shows 2047."""
    rig.servo.sense(0)
    rig.ask(Instruction.CALIBRATE)
    assert (rig.number(r.HOMING_OFFSET), rig.number(r.PRESENT_POSITION)) == (-2047, 2047)


def test_what_the_physics_reads(rig: Rig) -> None:
    """Gains, limits and the three kinds of torque."""
    for mode in TorqueMode:
        rig.command(r.TORQUE_ENABLE, mode)
        assert rig.servo.torque_mode is mode
    for register, number in (
        (r.P_GAIN, 16),
        (r.D_GAIN, 33),
        (r.I_GAIN, 2),
        (r.TORQUE_LIMIT, 500),
        (r.GOAL_SPEED, 1000),
        (r.ACCELERATION, 254),
        (r.OPERATING_MODE, 1),
    ):
        rig.command(register, number)
    s = rig.servo
    assert (s.p_gain, s.d_gain, s.i_gain, s.torque_limit) == (16, 33, 2, 500)
    assert (s.goal_speed, s.acceleration, s.mode) == (1000, 254, r.StsMode.SPEED)


# Protections.


def overloaded(rig: Rig) -> StsServo:
    """Return the servo after it has pushed with 90 % towards 3000 for longer than its protection allows."""
    rig.command(r.TORQUE_ENABLE, 1)
    rig.command(r.GOAL_POSITION, 3000)
    rig.servo.sense(2000, load=900)
    rig.wait(0.001)
    rig.wait(2.0)
    return rig.servo


def test_an_overload_reduces_the_torque(rig: Rig) -> None:
    """80 % for 2 s; then 20 %, and every answer says so."""
    rig.command(r.TORQUE_ENABLE, 1)
    rig.servo.sense(2000, load=-800)
    rig.wait(0.001)
    rig.wait(1.999)
    assert (rig.servo.torque_limit, rig.servo.error) == (1000, 0)
    rig.wait(0.001)
    assert (rig.servo.torque_limit, rig.servo.error) == (200, Fault.OVERLOAD)
    assert rig.blocks()[1].status == Fault.OVERLOAD
    assert rig.bus.alerts == {1: Fault.OVERLOAD}
    assert rig.servo.torque_mode is TorqueMode.ON


def test_a_load_that_comes_and_goes_is_no_overload(rig: Rig) -> None:
    """The protection time begins anew."""
    rig.command(r.TORQUE_ENABLE, 1)
    for load in (900, 100, 900):
        rig.servo.sense(2000, load=load)
        rig.wait(1.5)
    assert rig.servo.error == 0


@pytest.mark.parametrize(
    ("act", "ends"),
    [
        (lambda rig: rig.command(r.GOAL_POSITION, 3500), False),
        (lambda rig: rig.command(r.GOAL_POSITION, 1500), True),
        (lambda rig: rig.command(r.TORQUE_ENABLE, 0), True),
        (lambda rig: rig.ask(Instruction.RESET), True),
        (lambda rig: rig.command(r.P_GAIN, 16), False),
    ],
)
def test_how_an_overload_ends(rig: Rig, act: Callable[[Rig], object], ends: bool) -> None:
    """With a goal on the other side, without torque, and with Reset."""
    servo = overloaded(rig)
    assert servo.error == Fault.OVERLOAD
    act(rig)
    assert servo.error == (0 if ends else Fault.OVERLOAD)
    assert servo.torque_limit == (1000 if ends else 200)


def test_without_its_condition_an_overload_is_only_shown(rig: Rig) -> None:
    """Bit 5 of Unloading Condition."""
    rig.command(r.UNLOAD_CONDITIONS, 0)
    servo = overloaded(rig)
    assert (servo.error, servo.torque_limit) == (Fault.OVERLOAD, 1000)


@pytest.mark.parametrize(
    ("sensed", "fault", "mode"),
    [
        ({"temperature": 71}, Fault.TEMPERATURE, TorqueMode.OFF),
        ({"temperature": 70}, Fault(0), TorqueMode.ON),
        # Unloading Condition has no voltage bit at the factory.
        ({"voltage": 39}, Fault.VOLTAGE, TorqueMode.ON),
        ({"voltage": 81}, Fault.VOLTAGE, TorqueMode.ON),
        ({"voltage": 80}, Fault(0), TorqueMode.ON),
    ],
)
def test_temperature_and_voltage(rig: Rig, sensed: dict[str, int], fault: Fault, mode: TorqueMode) -> None:
    """Shown as long as they last; the torque does not come back by itself."""
    rig.command(r.TORQUE_ENABLE, 1)
    rig.servo.sense(2000, **sensed)
    block = rig.blocks()[1]
    assert (block.status, block.torque_mode) == (fault, mode)
    rig.servo.sense(2000)
    assert (rig.servo.error, rig.servo.torque_mode) == (0, mode)


def test_a_current_for_too_long_switches_the_torque_off(rig: Rig) -> None:
    """More than 511 * 6.5 mA for 2 s."""
    rig.command(r.TORQUE_ENABLE, 1)
    for current, seconds in ((511, 5.0), (512, 0.001), (512, 2.0)):
        assert rig.servo.torque_mode is TorqueMode.ON
        rig.servo.sense(2000, current=current)
        rig.wait(seconds)
    assert (rig.servo.error, rig.servo.torque_mode) == (Fault.CURRENT, TorqueMode.OFF)
    rig.servo.sense(2000)
    rig.command(r.TORQUE_ENABLE, 0)
    assert rig.servo.error == 0


def test_faults_that_a_test_chooses(rig: Rig) -> None:
    """A sensor fault stays until Reset; its bit is in every answer."""
    rig.servo.fail(Fault.ENCODER | Fault.OVERLOAD)
    assert rig.servo.torque_limit == 200
    rig.command(r.TORQUE_ENABLE, 0)
    assert rig.bus.alerts == {1: Fault.ENCODER}
    rig.ask(Instruction.RESET)
    assert rig.servo.error == 0
