"""Dynamixel packets: the emulator's codec against the SDK's, known bytes, hostile streams on both sides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from dynamixel_easy_sdk.control_table import ControlTable
from dynamixel_sdk import PacketHandler
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.dynamixel.device import DynamixelDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.servo_bus import registers
from deal_hw.drivers.servo_bus.bus import Bus
from deal_hw.drivers.servo_bus.interface import SpoiltAnswerError
from deal_hw.drivers.servo_bus.packets import (
    Instruction,
    Packet,
    PacketParser,
    crc,
    fast_status,
    instruction,
    protocol_1_requests,
    protocol_1_status,
    status,
)
from deal_hw.drivers.servo_bus.registers import (
    BLOCK_ADDRESS,
    BLOCK_BYTES,
    PRESENT_POSITION,
    TORQUE_ENABLE,
    Block,
    Register,
)
from deal_hw.drivers.servo_bus.samples import SampleGrid, TickClock
from deal_hw.drivers.servo_bus.servos_side import at_once
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import DealHwError, FrameError, TransportTimeoutError
from deal_hw.testing.fake_device import FakeDevice

RANDOM_INPUTS = 100_000


def test_known_packets() -> None:
    """The e-Manual's own examples: ping of servo 1, and a read of Present Position with its answer."""
    assert instruction(1, Instruction.PING).hex(" ") == "ff ff fd 00 01 03 00 01 19 4e"
    read = instruction(1, Instruction.READ, (132).to_bytes(2, "little") + (4).to_bytes(2, "little"))
    assert read.hex(" ") == "ff ff fd 00 01 07 00 02 84 00 04 00 1d 15"
    assert status(1, 0, bytes([0xA6, 0, 0, 0])).hex(" ") == "ff ff fd 00 01 08 00 55 00 a6 00 00 00 8c c0"


@given(st.binary(max_size=300))
def test_the_crc_is_the_sdks(data: bytes) -> None:
    """Polynomial 0x8005, nothing reflected, from 0: as ROBOTIS' table has it."""
    assert crc(data) == PacketHandler(2.0).updateCRC(0, data, len(data))


bodies = st.binary(max_size=60) | st.lists(
    st.sampled_from([b"\xff", b"\xff\xff\xfd", b"\xfd", b"\x00", b"\x01"]), max_size=30
).map(b"".join)


@given(
    st.lists(st.tuples(st.integers(0, 253), st.integers(1, 0x54), bodies), min_size=1, max_size=5), st.data()
)
def test_packets_survive_any_cut_of_the_stream(
    packets: list[tuple[int, int, bytes]], data: st.DataObject
) -> None:
    """What was written is read, whatever its bytes, in whatever pieces it comes, with noise before it."""
    noise = data.draw(st.binary(max_size=20).filter(lambda n: b"\xff\xff\xfd" not in n and n[-1:] != b"\xff"))
    stream = noise + b"".join(instruction(*packet) for packet in packets)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    parser = PacketParser()
    found: list[Any] = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += parser.feed(stream[begin:end])
    assert [tuple(packet[:3]) for packet in found] == packets
    assert parser.errors == 0


@given(st.lists(st.tuples(st.integers(0, 252), bodies.filter(lambda b: len(b) < 40)), min_size=1, max_size=4))
def test_a_changed_byte_never_yields_another_packet(packets: list[tuple[int, bytes]]) -> None:
    """Whatever single byte changes, what comes out was put in; the next sound packet is found."""
    whole = [instruction(servo, Instruction.WRITE, body) for servo, body in packets]
    stream = b"".join(whole)
    allowed = {(servo, int(Instruction.WRITE), body) for servo, body in packets}
    for at in range(len(stream)):
        changed = stream[:at] + bytes([stream[at] ^ 0x41]) + stream[at + 1 :]
        parser = PacketParser()
        last = instruction(7, Instruction.PING)
        found = [tuple(p[:3]) for p in parser.feed(changed + last + last)]
        assert set(found) - {(7, 1, b"")} <= allowed
        assert (7, 1, b"") in found


@pytest.mark.slow
def test_a_hundred_thousand_random_inputs_do_not_upset_the_servos() -> None:
    """Bytes at random, and sound packets with a random inside: no exception, and then a ping works."""
    rng = np.random.default_rng(0)
    device = DynamixelDevice(nominal_truth())
    codes = [int(code) for code in Instruction if code is not Instruction.REBOOT]
    for k in range(RANDOM_INPUTS):
        body = rng.bytes(int(rng.integers(0, 24)))
        if k % 2:
            servo = int(rng.choice([0, 1, 2, 3, 0xFD, 0xFE]))
            body = instruction(servo, int(rng.choice(codes)), body)
        device.receive(body)
        if k % 1000 == 999:
            device.advance_to(device.device_ns + 10**8)
    # A random write may have changed an id or switched answers off; a restart forgets neither.
    device.receive(bytes(2048))
    device.servos[0].put(registers.ID, 1)
    device.servos[0].put(registers.STATUS_RETURN_LEVEL, 2)
    device.servos[1].put(registers.ID, 2)
    device.advance_to(device.device_ns + 10**9)
    device.receive(instruction(1, Instruction.PING))
    assert status(1, device.servos[0].alert, bytes([0xA6, 4, 46]))[:8] in device.advance_to(
        device.device_ns + 10**9
    )


@given(st.binary(max_size=200), st.booleans())
@settings(max_examples=400)
def test_hostile_answers_do_not_upset_the_driver(data: bytes, fast: bool) -> None:
    """Whatever comes as an answer is a sound block or one of two errors."""
    sound = fast_status([(1, 0, bytes(BLOCK_BYTES)), (2, 0, bytes(BLOCK_BYTES))], 2 * (BLOCK_BYTES + 4))
    for answer in (data, sound[: len(data)] + data, sound[:40] + data + sound[40 + len(data) :]):
        bus = bus_that_hears(answer)
        bus.ask((1, 2), BLOCK_ADDRESS, BLOCK_BYTES, fast=fast)
        try:
            found = bus.take(10**12)
        except (TransportTimeoutError, FrameError):
            continue
        assert found is not None
        assert {len(block) for block in found.values()} == {BLOCK_BYTES}


@given(st.binary(max_size=64))
@settings(max_examples=300)
def test_hostile_answers_to_single_questions(data: bytes) -> None:
    """Ping, read, write and the search: an answer or an error of ours."""
    questions: tuple[Callable[[Any], object], ...] = (
        lambda bus: bus.ping(1),
        lambda bus: bus.read(1, PRESENT_POSITION),
        lambda bus: bus.write(1, TORQUE_ENABLE, 0),
        lambda bus: bus.ping_protocol_1(1),
        lambda bus: bus.broadcast_ping(0.01),
    )
    for answer in (data, status(1, 0, data), status(1, 0x84, data), protocol_1_status(1, data[:4])):
        for question in questions:
            try:
                question(bus_that_hears(answer))
            except DealHwError:
                continue


def bus_that_hears(answer: bytes) -> Bus:
    """Return a bus on which every question is answered with these bytes."""
    clock = VirtualClock()
    transport = VirtualTransport(FakeDevice(answer), clock)
    transport.open()
    return Bus(transport, clock, 1_000_000, 0.003)


@example([bytes(BLOCK_BYTES), (b"\xff\xfd\xfd\xff\xff\xfd" * BLOCK_BYTES)[:BLOCK_BYTES]])
@given(
    st.lists(
        bodies.map(lambda b: (b * BLOCK_BYTES + bytes(BLOCK_BYTES))[:BLOCK_BYTES]), min_size=2, max_size=2
    )
)
def test_group_answers_are_read_as_they_were_sent(blocks: list[bytes]) -> None:
    """Fast or plain, stuffed or not: the driver's SDK reads what the emulator's codec wrote."""
    data = dict(zip((1, 2), blocks, strict=True))
    fast = fast_status([(servo, 0, block) for servo, block in data.items()], 2 * (BLOCK_BYTES + 4))
    for is_fast, answer in ((True, fast), (False, b"".join(status(s, 0, b) for s, b in data.items()))):
        bus = bus_that_hears(answer)
        bus.ask((1, 2), BLOCK_ADDRESS, BLOCK_BYTES, fast=is_fast)
        assert bus.take(10**12) == data


class EchoingDevice:
    """Servos behind an adapter that returns the host's bytes, with another master's packets between.

    Args:
        answer: What the servos answer to each message.
        foreign: What another master sends before.
    """

    def __init__(self, answer: bytes, foreign: bytes = b"") -> None:
        self.device_ns = 0
        self._answer, self._foreign, self._out = answer, foreign, b""

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        self._out += data + self._foreign + self._answer

    def tick(self) -> bytes:
        """Send what waits."""
        self.device_ns += 1_000_000
        out, self._out = self._out, b""
        return out


def bus_behind(device: EchoingDevice) -> Bus:
    """Return a bus over a device."""
    clock = VirtualClock()
    transport = VirtualTransport(device, clock)
    transport.open()
    return Bus(transport, clock, 1_000_000, 0.003)


BOTH = {servo: bytes([servo]) * BLOCK_BYTES for servo in (1, 2)}
ANSWERS = {
    True: fast_status([(servo, 0, block) for servo, block in BOTH.items()], 2 * (BLOCK_BYTES + 4)),
    False: b"".join(status(servo, 0, block) for servo, block in BOTH.items()),
}


@pytest.mark.parametrize("fast", [True, False])
def test_an_echo_is_neither_an_answer_nor_another_master(fast: bool) -> None:
    """Of requests to a group, and of goals."""
    bus = bus_behind(EchoingDevice(ANSWERS[fast]))
    for _ in range(3):
        bus.ask((1, 2), BLOCK_ADDRESS, BLOCK_BYTES, fast=fast, writes=[(116, {1: BOTH[1][:4]})])
        assert bus.take(10**12) == BOTH
    assert bus.echoes and bus.watch.sign is None


@pytest.mark.parametrize("fast", [True, False])
def test_another_masters_packets_are_told_from_answers(fast: bool) -> None:
    """They cost no answer; two are a sign."""
    foreign = instruction(0xFE, Instruction.SYNC_WRITE, bytes([116, 0, 4, 0, 1, 0, 8, 0, 0]))
    bus = bus_behind(EchoingDevice(ANSWERS[fast], foreign))
    for known in (False, True):
        bus.ask((1, 2), BLOCK_ADDRESS, BLOCK_BYTES, fast=fast)
        assert bus.take(10**12) == BOTH
        assert (bus.watch.sign is not None) is known
    assert bus.watch.sign is not None and bus.watch.sign.packet == "a packet (sync write) to all servos"


@pytest.mark.parametrize("doubled", [1, 2])
def test_a_group_names_the_servos_whose_answers_are_sound(doubled: int) -> None:
    """The others', where two servos of one id answer at the same time."""
    blocks = [(servo, 0, block) for servo, block in BOTH.items()]
    twin = (doubled, 0, bytes([7]) * BLOCK_BYTES)
    spoilt = b"".join(
        at_once([status(*one), status(*twin)]) if one[0] == doubled else status(*one) for one in blocks
    )
    bus = bus_that_hears(spoilt)
    bus.ask((1, 2), BLOCK_ADDRESS, BLOCK_BYTES)
    with pytest.raises(SpoiltAnswerError) as caught:
        bus.take(10**12)
    assert caught.value.answered == (3 - doubled,)


def test_a_spoilt_part_of_a_fast_answer_is_not_taken() -> None:
    """The last servo's CRC is right: it is made of the bytes as they came."""
    good, twin = ((1, 0, BOTH[1]), (1, 0, bytes([6]) * BLOCK_BYTES))
    spoilt = fast_status([good, twin, (2, 0, BOTH[2])], 2 * (BLOCK_BYTES + 4))
    answers = [ANSWERS[True], spoilt]
    device = EchoingDevice(b"")
    bus = bus_behind(device)
    for answer in answers:
        device._answer = answer
        bus.ask((1, 2), BLOCK_ADDRESS, BLOCK_BYTES, fast=True)
        if answer is not spoilt:
            assert bus.take(10**12) == BOTH
            continue
        with pytest.raises(SpoiltAnswerError) as caught:
            bus.take(10**12)
        assert caught.value.answered == (2,)


def test_signs_of_a_block() -> None:
    """Registers come without sign: -1 as 65535, -4096 as 4294963200."""
    table = bytearray(256)
    for address, data in (
        (64, b"\x01"),
        (70, b"\x20"),
        (80, b"\x67\x03"),
        (84, b"\x46\x00"),
        (98, b"\xff"),
        (102, b"\xb9\x02"),
        (112, b"\x66\x06\0\0"),
        (116, b"\x00\xf0\xff\xff"),
        (120, b"\xff\x7f"),
        (123, b"\x02"),
        (126, b"\xff\xff"),
        (128, b"\xfd\xff\xff\xff"),
        (132, b"\x01\x00\x00\x80"),
    ):
        table[address : address + len(data)] = data
    block = Block.unpack(bytes(table[BLOCK_ADDRESS : BLOCK_ADDRESS + BLOCK_BYTES]))
    assert block == Block(
        torque_enable=1,
        led=0,
        hardware_error=0x20,
        d_gain=871,
        i_gain=0,
        p_gain=70,
        bus_watchdog=0xFF,
        goal_pwm=0,
        goal_current=697,
        profile_acceleration=0,
        profile_velocity=1638,
        goal_position=-4096,
        tick_ms=32767,
        moving_status=2,
        present_current=-1,
        present_velocity=-3,
        present_position=-(2**31) + 1,
    )


@pytest.mark.parametrize("model", [1190, 1200, 1020, 1030, 1060, 1070])
def test_addresses_are_those_of_the_sdks_tables(model: int) -> None:
    """XL330, XM430, XL430 and XC430 agree with our addresses and sizes, in all names that they know."""
    table = ControlTable.getControlTable(model)
    known = [r for r in vars(registers).values() if isinstance(r, Register) and r.name in table]
    assert len(known) >= 27
    for register in known:
        item = table[register.name]
        assert (item.address, item.size) == (register.address, register.size), register.name


def test_hardware_errors_are_told_with_their_remedies() -> None:
    """Each bit has its words; a bit that nobody knows is shown as it is."""
    printed = registers.explain_hardware_error(0b100101)
    assert printed.split("; ")[0].startswith("input voltage out of its limits (check the supply")
    assert "overheated" in printed
    assert "overload" in printed
    assert "unknown bits 0x40" in registers.explain_hardware_error(0x40)


def test_a_protocol_1_ping_and_its_answer() -> None:
    """FF FF 01 02 01 FB asks servo 1; the SDK reads our answer."""
    assert list(protocol_1_requests(bytes.fromhex("00ffff010201fb"))) == [(1, 1, b"")]
    assert protocol_1_status(1, b"").hex() == "ffff010200fc"


@given(st.integers(0, 32767), st.lists(st.integers(1, 200_000), min_size=1, max_size=30))
def test_ticks_are_counted_on_over_their_wraps(start: int, steps_ms: list[int]) -> None:
    """Whatever the pauses, the time is what passed; no restart is seen."""
    clock, time_ms = TickClock(), 0
    assert clock.read(start, 0) == 0
    for step in steps_ms:
        time_ms += step
        assert clock.read((start + time_ms) % 32768, time_ms * 1_000_000) == time_ms
    assert not clock.restarted


def test_a_clock_that_begins_anew_is_a_restart() -> None:
    """20 s of ticks, 0.4 s of silence, then a tick of 100 ms: the servo restarted, time goes on."""
    clock = TickClock()
    clock.read(20_000, 0)
    assert clock.read(100, 400_000_000) == 400
    assert clock.restarted


def test_samples_fall_on_the_nearest_point_of_the_grid() -> None:
    """5 ms points: a tick early or late is moved, a second one for a point left out, a gap keeps numbers."""
    grid = SampleGrid(5)
    assert [(grid.place(t), grid.number) for t in (100, 105, 111, 114, 115, 132)] == [
        (0, 0),
        (0, 1),
        (-1, 2),
        (1, 3),
        (None, 3),
        (-2, 6),
    ]
    grid.begin()
    assert (grid.place(137), grid.number) == (0, 7)


def test_packet_names_are_what_a_test_can_compare() -> None:
    """The parser yields servo, instruction and parameters without stuffing, and the bytes on the wire."""
    (found,) = PacketParser().feed(instruction(3, Instruction.WRITE, b"\x40\x00\xff\xff\xfd"))
    # Header 4, id, length 2, instruction, 5 parameters, one stuffed byte, CRC 2.
    assert found == Packet(3, 3, b"\x40\x00\xff\xff\xfd", 16)
