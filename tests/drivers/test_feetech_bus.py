"""The host's side of a Feetech bus, against scripted answers: requests, echo, faults, late answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.drivers.servo_bus.feetech import registers as r
from deal_hw.drivers.servo_bus.feetech.bus import FeetechBus
from deal_hw.drivers.servo_bus.feetech.packets import (
    BROADCAST,
    Fault,
    Instruction,
    RequestFrame,
    RequestParser,
    encode,
    status,
)
from deal_hw.drivers.servo_bus.feetech.registers import BLOCK_ADDRESS, BLOCK_BYTES
from deal_hw.drivers.servo_bus.interface import Answer, ServoBus
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import DealHwError, FrameError, ProtocolError, TransportTimeoutError

ANSWER_S = 0.003
LATE_NS = 10**12


class Script:
    """A device that answers each request with the bytes that a test gives for it.

    Args:
        answer: Returns the bytes for a request.
        echo: Whether the adapter returns the requests.
    """

    def __init__(self, answer: Callable[[RequestFrame], bytes], *, echo: bool = False) -> None:
        self.device_ns, self.requests = 0, list[RequestFrame]()
        self.inbox, self.outbox = b"", b""
        self.answer, self._echo, self._parser = answer, echo, RequestParser()

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        self.inbox += data
        if self._echo:
            self.outbox += data
        for request in self._parser.feed(data):
            self.requests.append(request)
            self.outbox += self.answer(request)

    def tick(self) -> bytes:
        """Send what waits."""
        self.device_ns += 1_000_000
        out, self.outbox = self.outbox, b""
        return out


def bus_with(answer: Callable[[RequestFrame], bytes], *, echo: bool = False) -> tuple[FeetechBus, Script]:
    """Return a bus and the device that answers on it."""
    clock, device = VirtualClock(), Script(answer, echo=echo)
    transport = VirtualTransport(device, clock)
    transport.open()
    return FeetechBus(transport, clock, 1_000_000, ANSWER_S), device


def says(data: bytes, *, echo: bool = False) -> tuple[FeetechBus, Script]:
    """Return a bus on which every request is answered with these bytes."""
    return bus_with(lambda request: data, echo=echo)


def group(blocks: Mapping[int, bytes], errors: Mapping[int, int] | None = None) -> bytes:
    """Return the answers of servos to a sync read."""
    return b"".join(status(servo, (errors or {}).get(servo, 0), data) for servo, data in blocks.items())


BLOCKS = {servo: bytes([servo]) * 15 for servo in (1, 2, 3)}


def take(bus: ServoBus, servos: Sequence[int] = (1, 2, 3), size: int = 15) -> dict[int, bytes] | None:
    """Ask some servos, and return what they answered."""
    bus.ask(servos, 56, size)
    return bus.take(LATE_NS)


@pytest.mark.parametrize("echo", [False, True])
def test_read_by_the_manuals_example(echo: bool) -> None:
    """FF FF 01 04 02 38 02 BE asks servo 1 for its position, FF FF 01 04 00 18 05 DD is 1304."""
    bus, device = says(bytes.fromhex("FFFF01040018 05DD"), echo=echo)
    assert bus.read(1, r.PRESENT_POSITION) == 1304
    assert device.inbox.hex(" ") == "ff ff 01 04 02 38 02 be"
    assert (bus.errors, bus.alerts) == (0, {1: 0})
    assert [message.channel for message in bus.wire] == ["tx", "rx"]
    assert bus.received_bytes == (16 if echo else 8)
    assert bus.stamp_ns == bus.wire[-1].stamp_ns


@pytest.mark.parametrize("echo", [False, True])
def test_write_by_the_manuals_example(echo: bool) -> None:
    """One byte, confirmed by FF FF 01 02 00 FC."""
    bus, device = says(bytes.fromhex("FFFF010200FC"), echo=echo)
    bus.write(1, r.TORQUE_ENABLE, 1)
    assert device.requests == [RequestFrame(1, Instruction.WRITE, b"\x28\x01")]


@pytest.mark.parametrize("echo", [False, True])
def test_ping_reads_model_and_firmware(echo: bool) -> None:
    """Registers 0 to 4: firmware 3.10, little-endian, model 777 = 0x0309."""
    bus, device = says(status(1, Fault.VOLTAGE, bytes([3, 10, 0, 0x09, 0x03])), echo=echo)
    assert bus.ping(1) == Answer(777, 310)
    assert device.requests == [RequestFrame(1, Instruction.READ, b"\x00\x05")]
    assert bus.alerts == {1: Fault.VOLTAGE}


def test_an_echo_alone_is_no_answer() -> None:
    """Nobody is on the bus but the adapter that returns what was sent."""
    bus, _ = says(b"", echo=True)
    questions: tuple[Callable[[], object], ...] = (
        lambda: bus.ping(1),
        lambda: bus.read(1, r.PRESENT_POSITION),
        lambda: bus.write(1, r.TORQUE_ENABLE, 0),
        lambda: take(bus),
    )
    for question in questions:
        with pytest.raises(TransportTimeoutError, match="not answer"):
            question()
    assert bus.broadcast_ping(0.01) == {}
    assert bus.alerts == {}


def test_broadcast_ping_finds_all() -> None:
    """Each servo answers the ping, then its registers are read; noise counts, and hides nobody."""
    models = {1: (3, 10, 777), 6: (3, 9, 777)}

    def answer(request: RequestFrame) -> bytes:
        if request.servo == BROADCAST:
            return status(1, 0) + b"\xff\xff\x04\x02\x00\x00" + status(6, 0)
        major, minor, model = models[request.servo]
        return status(request.servo, 0, bytes([major, minor, 0]) + model.to_bytes(2, "little"))

    bus, device = bus_with(answer, echo=True)
    assert bus.broadcast_ping(0.1) == {1: Answer(777, 310), 6: Answer(777, 309)}
    assert device.requests[0] == RequestFrame(BROADCAST, Instruction.PING, b"")
    assert bus.errors == 1


def test_two_servos_of_one_id_are_left_out_of_a_search() -> None:
    """Their answers to a ping are the same bytes; those with registers stay corrupt."""
    bus, device = bus_with(
        lambda request: status(1, 0) if request.servo == BROADCAST else b"\xff\xff\x01\x07\x00\x03\x08"
    )
    assert bus.broadcast_ping(0.1) == {}
    assert bus.errors == len(device.requests) - 1 == 3


def test_silence_is_a_timeout_within_the_answers_time() -> None:
    """8 + 8 bytes of 10 bits at 1 Mbit/s are 0.16 ms, and 3 ms more are allowed."""
    clock = VirtualClock()
    transport = VirtualTransport(Script(lambda request: b""), clock)
    transport.open()
    bus = FeetechBus(transport, clock, 1_000_000, ANSWER_S)
    with pytest.raises(TransportTimeoutError, match="servo 1 does not answer"):
        bus.read(1, r.PRESENT_POSITION)
    assert clock.now_ns() == 3_160_000
    assert bus.errors == 1


def test_a_corrupt_answer_is_a_frame_error_and_the_next_one_is_sound() -> None:
    """Its checksum is wrong; the next request begins with an empty buffer."""
    answers = [b"\xff\xff\x01\x04\x00\x18\x05\xde", status(1, 0, b"\x18\x05")]
    bus, _ = bus_with(lambda request: answers.pop(0))
    with pytest.raises(FrameError, match="servo 1"):
        bus.read(1, r.PRESENT_POSITION)
    assert bus.read(1, r.PRESENT_POSITION) == 1304
    assert bus.errors == 1


def test_another_servos_answer_is_not_taken() -> None:
    """The id and the number of bytes have to fit."""
    bus, _ = says(status(2, 0, b"\x18\x05") + status(1, 0, b"\x18") + status(1, 0, b"\x19\x05"))
    assert bus.read(1, r.PRESENT_POSITION) == 1305


def test_a_late_answer_is_dropped_before_the_next_request() -> None:
    """The answer to the first read comes when nobody waits; the second read gets its own."""
    clock, device = VirtualClock(), Script(lambda request: b"")
    transport = VirtualTransport(device, clock)
    transport.open()
    bus = FeetechBus(transport, clock, 1_000_000, ANSWER_S)
    with pytest.raises(TransportTimeoutError):
        bus.read(1, r.PRESENT_POSITION)
    device.outbox = status(1, 0, b"\x01\x00")
    clock.advance_ns(10_000_000)
    device.answer = lambda request: status(1, 0, b"\x02\x00")
    assert bus.read(1, r.PRESENT_POSITION) == 2


def test_an_unconfirmed_write_is_read_back() -> None:
    """With response level 0 a servo answers reads only."""
    value = 0

    def answer(request: RequestFrame) -> bytes:
        nonlocal value
        if request.instruction == Instruction.WRITE:
            value = request.params[1]
            return b""
        return status(1, 0, bytes([value & 0x7F]))

    bus, device = bus_with(answer)
    bus.write(1, r.RESPONSE_LEVEL, 0)
    assert bus.errors == 0
    assert [request.instruction for request in device.requests] == [Instruction.WRITE, Instruction.READ]
    with pytest.raises(ProtocolError, match=r"does not confirm 130 in its register P Coefficient \(21\).* 2"):
        bus.write(1, r.P_GAIN, 130)


def test_an_unconfirmed_id_is_read_back_at_the_new_id() -> None:
    """The servo answers by its new id from now on."""
    bus, device = bus_with(
        lambda request: status(6, 0, b"\x06") if request == (6, Instruction.READ, b"\x05\x01") else b""
    )
    bus.write(1, r.ID, 6)
    assert device.requests[0] == RequestFrame(1, Instruction.WRITE, b"\x05\x06")


@pytest.mark.parametrize("value", [-1, 65536])
def test_values_that_no_register_has_are_refused(value: int) -> None:
    """A negative number has to be encoded with its sign bit first."""
    bus, device = says(b"")
    with pytest.raises(ValueError, match=r"Goal Position \(42\)"):
        bus.write(1, r.GOAL_POSITION, value)
    assert device.requests == []


# Groups.


@pytest.mark.parametrize("echo", [False, True])
def test_a_group_is_asked_with_writes_before_it_in_one_message(echo: bool) -> None:
    """Sync write by the manual's layout, then one sync read; each answer by its id."""
    bus, device = bus_with(
        lambda request: group(BLOCKS, {2: 4}) if request.instruction == Instruction.SYNC_READ else b"",
        echo=echo,
    )
    goals = {servo: bytes([servo, 8]) for servo in (1, 2, 3)}
    bus.ask((1, 2, 3), 56, 15, writes=[(42, goals)])
    assert bus.take(LATE_NS) == BLOCKS
    assert [message.channel for message in bus.wire].count("tx") == 1
    assert device.requests == [
        RequestFrame(BROADCAST, Instruction.SYNC_WRITE, bytes.fromhex("2a02 010108 020208 030308")),
        RequestFrame(BROADCAST, Instruction.SYNC_READ, bytes.fromhex("380f 010203")),
    ]
    assert (bus.errors, bus.alerts) == (0, {1: 0, 2: Fault.TEMPERATURE, 3: 0})
    assert bus.answer_bytes(3, 15, False) == len(group(BLOCKS)) == bus.answer_bytes(3, 15, True)


def test_post_sends_without_waiting() -> None:
    """Two sync writes in one message, and no answer."""
    bus, device = says(b"")
    assert bus.post([(40, {1: b"\1", 2: b"\1"}), (42, {1: b"\0\x08"})]) == 0
    assert device.inbox == encode(BROADCAST, 0x83, b"\x28\x01\x01\x01\x02\x01") + encode(
        BROADCAST, 0x83, b"\x2a\x02\x01\x00\x08"
    )


def test_a_long_sync_write_is_divided() -> None:
    """A frame has 250 bytes at most: 30 servos of 1 + 7 bytes, and the rest in another frame."""
    bus, device = says(b"")
    bus.post([(41, {servo: bytes(7) for servo in range(1, 41)})])
    assert [request.size for request in device.requests] == [248, 88]
    assert sum(len(request.params) - 2 for request in device.requests) == 40 * 8


@pytest.mark.parametrize("echo", [False, True])
def test_a_missing_servo_is_named(echo: bool) -> None:
    """The others answer in their places; the error names the missing one, and the next take is whole."""
    answers = [group({1: BLOCKS[1], 3: BLOCKS[3]}), group(BLOCKS)]
    bus, _ = bus_with(lambda request: answers.pop(0), echo=echo)
    with pytest.raises(TransportTimeoutError, match=r"servos \(2,\) do not answer; servos \(1, 3\) did"):
        take(bus)
    assert take(bus) == BLOCKS
    assert bus.errors == 1


def test_a_missing_last_servo_costs_the_answers_time() -> None:
    """Nobody knows that it will not come: 11 bytes out, 63 in, 3 ms more."""
    clock = VirtualClock()
    transport = VirtualTransport(Script(lambda request: group({1: BLOCKS[1], 2: BLOCKS[2]})), clock)
    transport.open()
    bus = FeetechBus(transport, clock, 1_000_000, ANSWER_S)
    with pytest.raises(TransportTimeoutError, match=r"servos \(3,\)"):
        take(bus)
    assert clock.now_ns() == 3_740_000


def test_nobody_answers() -> None:
    """All are named."""
    bus, _ = says(b"")
    with pytest.raises(TransportTimeoutError, match=r"servos \(1, 2, 3\) do not answer$"):
        take(bus)


def test_one_corrupt_answer_is_one_missed_sample() -> None:
    """A changed bit in the second answer: the group fails with its name, the next one is sound."""
    data = bytearray(group(BLOCKS))
    data[25] ^= 4
    answers = [bytes(data), group(BLOCKS)]
    bus, _ = bus_with(lambda request: answers.pop(0))
    with pytest.raises(FrameError, match=r"servos \(2,\) did not answer soundly.*servos \(1, 3\) did"):
        take(bus)
    assert take(bus) == BLOCKS
    assert bus.errors == 1


@pytest.mark.parametrize("noise", [b"\xff\xff\x05\x10", b"\x00\xff", b"\xff\xff\x01\x02\x00\xfc"])
def test_noise_before_a_group_costs_nothing(noise: bytes) -> None:
    """Even if it looks like the beginning of a frame: at the deadline that is given up."""
    bus, _ = says(noise + group(BLOCKS))
    assert take(bus) == BLOCKS
    assert bus.errors == 0


def test_a_deadline_before_the_answer_returns_none() -> None:
    """The answer may still come, and does."""
    bus, _ = says(group(BLOCKS))
    bus.ask((1, 2, 3), 56, 15)
    assert bus.take(0) is None
    assert bus.take(LATE_NS) == BLOCKS


def test_a_group_behind_another() -> None:
    """Both are answered; each take returns its own."""
    answers = [group(BLOCKS), status(1, 0, b"\x01\x02")]
    bus, _ = bus_with(lambda request: answers.pop(0))
    bus.ask((1, 2, 3), 56, 15)
    bus.ask((1,), 56, 2, behind=True)
    assert (bus.take(LATE_NS), bus.take(LATE_NS)) == (BLOCKS, {1: b"\x01\x02"})


def test_a_group_behind_another_that_is_incomplete() -> None:
    """Servo 3 is missing in the first; the answers behind end it, and are kept."""
    answers = [group({1: BLOCKS[1], 2: BLOCKS[2]}), group(BLOCKS)]
    bus, _ = bus_with(lambda request: answers.pop(0))
    bus.ask((1, 2, 3), 56, 15)
    bus.ask((1, 2, 3), 56, 15, behind=True)
    with pytest.raises(TransportTimeoutError, match=r"servos \(3,\)"):
        bus.take(LATE_NS)
    assert bus.take(LATE_NS) == BLOCKS


def test_a_new_question_forgets_the_one_before() -> None:
    """Its answer is not taken for the new one's."""
    old = {servo: bytes(15) for servo in BLOCKS}
    answers = [group(old), group(BLOCKS)]
    bus, _ = bus_with(lambda request: answers.pop(0))
    bus.ask((1, 2, 3), 56, 15)
    bus._port.receive(LATE_NS)
    assert take(bus) == BLOCKS


def test_the_newer_of_two_answers_counts() -> None:
    """An answer to the former request comes after the new request: its servo's next answer replaces it."""
    bus, _ = says(status(1, Fault.CURRENT, bytes(15)) + group(BLOCKS))
    assert take(bus) == BLOCKS
    assert bus.alerts[1] == 0


WRITE_GOAL = encode(1, Instruction.WRITE, bytes([42, 0, 8]))
SYNC_GOALS = encode(BROADCAST, Instruction.SYNC_WRITE, bytes([42, 2, 1, 0, 8, 2, 0, 8]))


@pytest.mark.parametrize(
    ("packet", "named"),
    [(WRITE_GOAL, "a packet (write) to servo 1"), (SYNC_GOALS, "a packet (sync write) to all servos")],
)
@pytest.mark.parametrize("place", ["before", "behind"])
def test_another_masters_packets_are_told_from_answers(packet: bytes, named: str, place: str) -> None:
    """They cost no answer. Two are a sign, also those that come when nothing is asked."""
    bus, _ = says(packet + group(BLOCKS) if place == "before" else group(BLOCKS) + packet)
    assert take(bus) == BLOCKS
    assert bus.watch.sign is None
    assert take(bus) == BLOCKS
    # What came behind the group is found before the next request.
    assert take(bus) == BLOCKS
    assert bus.watch.sign is not None and bus.watch.sign.packet == named
    assert not bus.echoes


def test_an_echo_is_no_other_master() -> None:
    """Of requests to one servo, to a group, and of goals, however many."""
    bus, _ = says(group(BLOCKS), echo=True)
    for goal in range(5):
        bus.post([(42, {1: bytes([goal, 8]), 2: bytes([goal, 8])})])
        assert take(bus) == BLOCKS
    assert bus.echoes and bus.watch.sign is None and bus.errors == 0


def test_faults_of_a_servo_are_no_packet_of_another_master() -> None:
    """Voltage and sensor together are the number of the instruction Write."""
    faults = dict.fromkeys(BLOCKS, Fault.VOLTAGE | Fault.ENCODER)
    bus, _ = says(group({servo: bytes([1]) * 15 for servo in BLOCKS}, faults))
    for _ in range(4):
        assert take(bus) is not None
    assert bus.watch.sign is None


def test_two_answers_of_one_servo_are_noted() -> None:
    """With one answer each, nobody answers twice."""
    answers = [group({1: BLOCKS[1]}) + group(BLOCKS), group(BLOCKS)]
    bus, _ = bus_with(lambda request: answers.pop(0))
    assert take(bus) == BLOCKS and bus.doubled == {1}
    assert take(bus) == BLOCKS and not bus.doubled


@given(st.binary(max_size=200))
@settings(max_examples=300)
def test_hostile_answers_do_not_upset_the_bus(data: bytes) -> None:
    """Whatever comes as an answer is sound or an error of ours."""
    sound = group({1: bytes(BLOCK_BYTES), 2: bytes(BLOCK_BYTES)})
    for answer in (data, sound[: len(data)] + data, sound[:40] + data + sound[40 + len(data) :]):
        bus, _ = says(answer, echo=len(data) % 2 == 1)
        bus.ask((1, 2), BLOCK_ADDRESS, BLOCK_BYTES)
        try:
            found = bus.take(LATE_NS)
        except (TransportTimeoutError, FrameError):
            continue
        assert found is not None
        assert {len(block) for block in found.values()} == {BLOCK_BYTES}


@given(st.binary(max_size=64))
def test_hostile_answers_to_single_questions(data: bytes) -> None:
    """Ping, read, write and the search: an answer or an error of ours."""
    questions: tuple[Callable[[FeetechBus], object], ...] = (
        lambda bus: bus.ping(1),
        lambda bus: bus.read(1, r.PRESENT_POSITION),
        lambda bus: bus.write(1, r.TORQUE_ENABLE, 0),
        lambda bus: bus.broadcast_ping(0.01),
    )
    for answer in (data, status(1, 0, data), status(1, 0x84, data)):
        for question in questions:
            try:
                question(says(answer)[0])
            except DealHwError:
                continue
