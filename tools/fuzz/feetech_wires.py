"""Inputs: what a host and Feetech's servos send on their bus."""

from __future__ import annotations

import random
from collections.abc import Sequence

from deal_hw.clock import VirtualClock
from deal_hw.drivers.servo_bus.feetech import packets
from deal_hw.drivers.servo_bus.feetech.bus import FeetechBus
from deal_hw.drivers.servo_bus.feetech.emulated_bus import StsBus
from deal_hw.drivers.servo_bus.feetech.emulated_servo import StsServo
from deal_hw.drivers.servo_bus.feetech.packets import BROADCAST, Instruction
from deal_hw.drivers.servo_bus.feetech.registers import BLOCK_ADDRESS, BLOCK_BYTES
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import FrameError, TransportTimeoutError
from deal_hw.testing.fake_device import FakeDevice
from fuzz.kind import Kind, WireKind
from fuzz.mutations import damage_bytes, mended

_SERVOS = (1, 2, 3)


def requests() -> list[bytes]:
    """Return a sync write, a read, a write and a sync read."""
    goals = b"".join(bytes([servo, 0, 8, 0, 0, 0xE8, 3]) for servo in _SERVOS)
    return [
        packets.encode(BROADCAST, Instruction.SYNC_WRITE, b"\x2a\x06" + goals),
        packets.encode(1, Instruction.READ, b"\x38\x02"),
        packets.encode(2, Instruction.WRITE, b"\x2a\xff\xff\x01\x02\x00"),
        packets.encode(BROADCAST, Instruction.SYNC_READ, bytes([BLOCK_ADDRESS, BLOCK_BYTES, *_SERVOS])),
    ]


def read_requests(data: bytes) -> list[bytes]:
    """Return the requests that a servo finds, one entry each."""
    parser = packets.RequestParser()
    found = [*parser.feed(data), *parser.finish()]
    return [bytes([frame.servo, frame.instruction]) + frame.params for frame in found]


def answers() -> bytes:
    """Return the answer of three servos to a group read."""
    return b"".join(packets.status(servo, 0, bytes(range(servo, servo + BLOCK_BYTES))) for servo in _SERVOS)


def read_answers(data: bytes) -> dict[int, bytes]:
    """Return what the driver takes from the answer to a group read."""
    clock = VirtualClock()
    transport = VirtualTransport(FakeDevice(data), clock)
    transport.open()
    bus = FeetechBus(transport, clock, 1_000_000, 0.003)
    bus.ask(_SERVOS, BLOCK_ADDRESS, BLOCK_BYTES)
    return bus.take(10**12) or {}


def _serve(data: bytes) -> None:
    """Receive as emulated servos do, in two pieces, and send all answers."""
    servos = StsBus([StsServo(servo, 1_000_000) for servo in _SERVOS], lambda: None, lambda: False)
    half = len(data) // 2
    for part in (data[:half], data[half:]):
        servos.receive(part)
        while servos.next_ns is not None:
            servos.now_ns = servos.next_ns
            servos.take_reply()


def _read_answers(data: bytes) -> None:
    try:
        read_answers(data)
    except (FrameError, TransportTimeoutError):
        return


def _mend_frame(data: bytes) -> bytes:
    """Return a frame with the length and the checksum of its bytes, as far as it has them."""
    if not 6 <= len(data) <= 259:
        return data
    body = data[2:3] + bytes([len(data) - 4]) + data[4:-1]
    return data[:2] + body + bytes([packets.checksum(body)])


def _any_request(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Return a sound request of any instruction to a servo or to all, with any parameters."""
    params = damage_bytes(rng, data, others)[: rng.randrange(250)]
    return packets.encode(rng.choice((*_SERVOS, BROADCAST)), rng.choice([*Instruction, 0x55]), params)


def _any_answer(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Return sound answers of any servos and any length before the right one."""
    body = damage_bytes(rng, data, others)[: rng.randrange(250)]
    return packets.status(rng.randrange(256), rng.randrange(256), body) + data


KINDS: dict[str, Kind] = {
    "wire_feetech_requests": WireKind(
        make=requests,
        read=_serve,
        mutations=(damage_bytes, mended(damage_bytes, _mend_frame), _any_request),
    ),
    "wire_feetech_answers": WireKind(
        make=lambda: [answers()], read=_read_answers, mutations=(damage_bytes, _any_answer)
    ),
}
