"""Inputs: what a cart-pole's CAN bus, ODrive and Dynamixel servos send."""

from __future__ import annotations

import random
from collections.abc import Sequence

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips.controller import Controller, Firmware
from deal_hw.drivers.cartpole.chips.firmwares import usable_firmware
from deal_hw.drivers.cartpole.chips.host_firmware import CanHostFirmware, Settings
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.emulator.odrive_emulator import odrive_device
from deal_hw.drivers.cartpole.plant.sensor import Motor
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, REMOTE, Angle, CanLink, CanMessage
from deal_hw.drivers.cartpole.wire.odrive_frames import BROADCAST_NODE, LAYOUT, NODE_SHIFT, Command, pack
from deal_hw.drivers.cartpole.wire.odrive_link import DRIVE_NODE, ENCODER_NODE, OdriveLink, OdriveSettings
from deal_hw.drivers.servo_bus import packets
from deal_hw.drivers.servo_bus.bus import Bus
from deal_hw.drivers.servo_bus.registers import BLOCK_ADDRESS, BLOCK_BYTES
from deal_hw.drivers.transports.slcan_transport import LineReader, decode_line, encode_line
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import FrameError, TransportTimeoutError
from deal_hw.testing.fake_device import FakeDevice
from fuzz.kind import Kind, WireKind
from fuzz.mutations import damage_bytes, mended

_SERVOS = (1, 2)
_INFO = protocol.Info(1, "cartpole", (1, 2, 3), 1000, 200, 0x1234)
_ACK = protocol.Ack(2, protocol.MessageType.ARM, protocol.Result.DONE)


def _state(number: int) -> protocol.State:
    return protocol.State(number, 5_000_000, 1000, -2000, 3000, -4000, 500, 3, 5, 900)


def _can_frames() -> list[bytes]:
    """Return a part of a bus with one device; the twentieth state brings a heartbeat."""
    device = CanLink(unique_id=7)
    messages: list[CanMessage] = [_INFO, _ACK, *map(_state, range(38, 42))]
    return [b"".join(device.encode(message) for message in messages), device.encode(_state(40))]


def _read_can(data: bytes) -> None:
    whole = data[: len(data) // FRAME.size * FRAME.size]
    host = CanLink()
    for part in (data, whole, whole[::-1]):
        list(host.decode_all(part))


def _host_frames() -> list[bytes]:
    """Return what a host sends to a node: its requests and two targets."""
    host = CanLink()
    messages: list[CanMessage] = [
        protocol.Hello(1),
        protocol.Home(2),
        protocol.Arm(3),
        protocol.Target(4, 100_000, 80_000, 8_000, 4_000, 1_000_000),
        protocol.Target(5, -100_000, 80_000, 8_000, 4_000, 1_000_000),
        protocol.Stop(6),
    ]
    return [b"".join(host.encode(message) for message in messages), host.encode(messages[3])]


def _hear_host(data: bytes) -> None:
    """Receive as a node does, in Python and, where there is a compiler, in the firmware's C core.

    Raises:
        RuntimeError: They differ.
    """
    still, number = Motor(0.0, 0.0), 7
    servo = Servo(nominal_truth().parameters, 0.001)
    nodes: list[Firmware] = [Controller(servo, number, lambda: 0, CanLink(unique_id=number, device=True))]
    if usable_firmware("auto") == "host":
        nodes.append(CanHostFirmware(Settings(65536, 65536, 65536, 65536, number, 0), lambda: 0, 1))
    parts = (data, data[: len(data) // FRAME.size * FRAME.size])
    found = [
        (*(node.receive(part, still) for part in parts), node.mode, node.homings, node.frame_errors)
        for node in nodes
    ]
    if found[-1] != found[0]:
        raise RuntimeError(f"Python gives {found[0]}, the C core {found[-1]}")


def _odrive_frames() -> list[bytes]:
    """Return an ODrive's heartbeat and estimates, and an encoder node's samples."""
    drive = pack(DRIVE_NODE, Command.HEARTBEAT, 0, 8, 0, 0) + pack(
        DRIVE_NODE, Command.ENCODER_ESTIMATES, 0.5, -0.25
    )
    encoder = CanLink(ENCODER_NODE, unique_id=7)
    samples = b"".join(encoder.encode(Angle(number, 1000 * number, 5, 6, 0)) for number in range(1, 4))
    return [drive + encoder.encode(_INFO) + samples + drive, drive, samples]


def _drive_frames() -> list[bytes]:
    """Return what a host may send to an ODrive: every frame of CANSimple, as data and as a remote frame."""
    frames = []
    for command, layout in LAYOUT.items():
        identifier = DRIVE_NODE << NODE_SHIFT | command
        data = bytes(range(1, layout.size + 1))
        frames += [FRAME.pack(identifier, layout.size, data), FRAME.pack(identifier | REMOTE, 0, b"")]
    return [b"".join(frames), *frames]


def _hear_drive(data: bytes) -> None:
    """Receive as an emulated ODrive and its encoder do, and run until every report was sent."""
    device = odrive_device(nominal_truth(), OdriveSettings())
    device.receive(data[: len(data) // FRAME.size * FRAME.size])
    device.advance_to(25_000_000)


def _other_command(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Return a sound frame to the drive with any number of a command and any data."""
    length = rng.randrange(9)
    flag = rng.choice((0, 0, REMOTE))
    identifier = rng.choice((DRIVE_NODE, BROADCAST_NODE)) << NODE_SHIFT | rng.randrange(32) | flag
    return data + FRAME.pack(identifier, length, rng.randbytes(length))


def _read_odrive(data: bytes) -> None:
    link = OdriveLink(OdriveSettings(), VirtualClock())
    link.encode(protocol.Hello(1))
    for _ in range(2):
        list(link.decode(data[: len(data) // FRAME.size * FRAME.size]))


def _lines() -> list[bytes]:
    channels = (("123", b"\1\2\3"), ("7ff", bytes(8)), ("000", b""))
    return [b"".join(encode_line(*line) for line in channels) + b"\rV1013\r\x07t1230\r"]


def _read_lines(data: bytes) -> None:
    reader, half = LineReader(), len(data) // 2
    for line in (*reader.feed(data[:half]), *reader.feed(data[half:])):
        decode_line(line)


def _requests() -> list[bytes]:
    return [
        packets.instruction(packets.BROADCAST, packets.Instruction.SYNC_WRITE, bytes(range(64, 84))),
        packets.instruction(1, packets.Instruction.READ, b"\x84\0\x04\0")
        + packets.instruction(2, packets.Instruction.WRITE, b"\x40\0\xff\xff\xfd\x01"),
    ]


def _read_requests(data: bytes) -> None:
    """Read as a servo does, in two pieces."""
    parser, half = packets.PacketParser(), len(data) // 2
    for part in (data[:half], data[half:]):
        list(parser.feed(part))
    list(packets.protocol_1_requests(data))


def blocks(*, fast: bool) -> bytes:
    """Return the answer of both servos to a group read."""
    parts = [(servo, 0, bytes(range(servo, servo + BLOCK_BYTES))) for servo in _SERVOS]
    if fast:
        return packets.fast_status(parts, len(_SERVOS) * (BLOCK_BYTES + 4))
    return b"".join(packets.status(*part) for part in parts)


def read_answer(data: bytes, fast: bool) -> dict[int, bytes]:
    """Return what the driver takes from the answer to a group read."""
    clock = VirtualClock()
    transport = VirtualTransport(FakeDevice(data), clock)
    transport.open()
    bus = Bus(transport, clock, 1_000_000, 0.003)
    bus.ask(_SERVOS, BLOCK_ADDRESS, BLOCK_BYTES, fast=fast)
    return bus.take(10**12) or {}


def _read_answer(data: bytes) -> None:
    for fast in (True, False):
        try:
            read_answer(data, fast)
        except (FrameError, TransportTimeoutError):
            continue


def _mend_packet(data: bytes) -> bytes:
    return data[:-2] + packets.crc(data[:-2]).to_bytes(2, "little")


def _odd_packet(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Return a sound packet of any servo, error or instruction, and parameters."""
    return packets.packet(
        rng.randrange(256), damage_bytes(rng, data, others)[: rng.randrange(1, 300)] or b"\0"
    )


KINDS: dict[str, Kind] = {
    "wire_can": WireKind(make=_can_frames, read=_read_can, mutations=(damage_bytes,)),
    "wire_can_node": WireKind(make=_host_frames, read=_hear_host, mutations=(damage_bytes,)),
    "wire_odrive": WireKind(make=_odrive_frames, read=_read_odrive, mutations=(damage_bytes,)),
    "wire_odrive_drive": WireKind(
        make=_drive_frames, read=_hear_drive, mutations=(damage_bytes, _other_command)
    ),
    "wire_slcan": WireKind(make=_lines, read=_read_lines, mutations=(damage_bytes,)),
    "wire_servo_requests": WireKind(
        make=_requests, read=_read_requests, mutations=(damage_bytes, mended(damage_bytes, _mend_packet))
    ),
    "wire_servo_answers": WireKind(
        make=lambda: [blocks(fast=True), blocks(fast=False)],
        read=_read_answer,
        mutations=(damage_bytes, mended(damage_bytes, _mend_packet), _odd_packet),
    ),
}
