"""Inputs: messages from devices and from other processes."""

from __future__ import annotations

import json
import random
import zlib
from collections.abc import Callable, Sequence

import numpy as np
from cobs import cobs
from fakes.go2 import FakeGo2
from fastcrc import crc16

from deal_hw.data.recording.record import decode as decode_record
from deal_hw.data.recording.record import encode as encode_record
from deal_hw.data.recording.schemas import BODY, COMMAND, CYCLE, EVENT, ROBOT, STATE, WIRE
from deal_hw.drivers.cartpole.wire import protocol as serial
from deal_hw.drivers.go2.emulator.sport_service import ServiceServer, SportMode
from deal_hw.drivers.go2.emulator.truth import GO2
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.go2.messages.sport_state import LONG_BYTES, SHORT_BYTES, decode_sport_state
from deal_hw.drivers.unitree.cdr import CDR_HEADER, words_crc
from deal_hw.drivers.unitree.go_messages.frames import low_command_image, low_state_image
from deal_hw.drivers.unitree.remote import (
    REMOTE_BYTES,
    Remote,
    decode_remote,
    decode_wireless,
    encode_remote,
    encode_wireless,
)
from deal_hw.drivers.unitree.rpc import (
    Request,
    Response,
    decode_response,
    encode_request,
    encode_response,
)
from fuzz.kind import Kind, WireKind
from fuzz.mutations import damage_bytes, damage_json, mended
from fuzz.recordings import make_cycle

_MESSAGES = (ROBOT, STATE, COMMAND, CYCLE, EVENT, BODY, WIRE)


def _serial_stream() -> list[bytes]:
    """Return a part of the traffic of a cart-pole and its host."""
    frames = [
        serial.encode(message)
        for message in (
            serial.Hello(1),
            serial.Info(1, "cartpole", (1, 2, 3), 1000, 200, 0x1234),
            serial.Arm(2),
            serial.Ack(2, serial.MessageType.ARM, serial.Result.DONE),
            serial.Home(3),
            serial.Stop(4),
            serial.Target(5, 100_000, 80_000, 8_000, 4_000, 1_000_000),
            serial.State(6, 5_000_000, 1000, -2000, 3000, -4000, 500, 3, 5, 900),
        )
    ]
    return [b"\0" + b"".join(frames), frames[-1], frames[1]]


def _read_serial(data: bytes) -> None:
    """Cut a stream into frames, in two pieces as a port gives them, and decode each."""
    decoder = serial.FrameDecoder()
    half = len(data) // 2
    for payload in (*decoder.feed(data[:half]), *decoder.feed(data[half:])):
        serial.decode(payload)


def _reframed(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Damage one payload of a stream and frame it with a right checksum."""
    payloads = serial.FrameDecoder().feed(data)
    damaged = damage_bytes(rng, rng.choice(payloads), payloads)[: serial.MAX_FRAME - 4]
    return b"\0" + bytes(cobs.encode(damaged + crc16.ibm_3740(damaged).to_bytes(2, "little"))) + b"\0"


def _mend_words(image_of: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return a function that writes the correct checksum into a Go2 message of any length."""

    def mend(data: bytes) -> bytes:
        image = image_of(data)
        return data[:-4] + words_crc(image[: len(image) // 4 * 4]).to_bytes(4, "little")

    return mend


def _low_states() -> list[bytes]:
    robot = FakeGo2()
    quiet = encode_low_state(robot.state())
    robot.remote = Remote(0x220, left_x=0.5)
    return [quiet, encode_low_state(robot.state())]


def low_commands() -> list[bytes]:
    """Return a command whose values differ from joint to joint."""
    values = np.linspace(-1.0, 1.0, 12)
    return [LowCommandEncoder().encode(LowCommand(values, values, np.abs(values), np.abs(values), values))]


def _read_low_state(data: bytes) -> None:
    frame = decode_low_state(data)
    frame.values()
    decode_remote(frame.remote)


def _responses() -> list[bytes]:
    return [
        encode_response(Response(7, 1001, 0, json.dumps({"form": "0", "name": "ai"}))),
        encode_response(Response(7, 1001, 7002, "", b"\1\2\3")),
    ]


def _read_response(data: bytes) -> None:
    decode_response(data).json()


def _odd_response(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Return a valid response with wrong data."""
    text = damage_json(rng, b'{"form": "0", "name": "ai", "more": [1, {"a": 2}]}', others)
    return encode_response(Response(7, 1001, 0, text.decode()))


def _requests() -> list[bytes]:
    return [encode_request(Request(7, 1001)), encode_request(Request(8, 1002, '{"name": "ai"}', 3, 1, True))]


def _serve(data: bytes) -> None:
    """Act on a request as the emulator's services do."""
    ServiceServer(SportMode(GO2)).answer("motion_switcher", data, np.zeros(12), 1000)


def _odd_request(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    text = damage_json(rng, b'{"name": "ai", "switch": 1, "more": [1, {"a": 2}]}', others)
    return encode_request(Request(8, rng.choice((1001, 1002, 1003)), text.decode()))


def _remotes() -> list[bytes]:
    remote = Remote(0x220, 0.5, -0.5, 1.0, 0.0)
    return [encode_remote(remote), encode_remote(None), encode_wireless(remote)]


def _read_remote(data: bytes) -> None:
    (decode_remote if len(data) >= REMOTE_BYTES else decode_wireless)(data)


def _sport_states() -> list[bytes]:
    return [bytes(CDR_HEADER) + bytes(size - 4) for size in (SHORT_BYTES, LONG_BYTES)]


def _records() -> list[bytes]:
    return [encode_record(make_cycle(number, body)) for number in (0, 3) for body in (False, True)]


def _mend_record(data: bytes) -> bytes:
    return data if len(data) < 8 else data[:-4] + zlib.crc32(data[:-4]).to_bytes(4, "little")


def _messages() -> list[bytes]:
    """Return one message of each type in a recording; the first byte names the type."""
    values = np.linspace(0.0, 1.0, 3)
    bodies = (
        ROBOT.encode("{}", ("cart", "pole"), ("cart",)),
        STATE.encode(1, 2, 3, 4, 5, 6, values, values, values),
        COMMAND.encode(1, 2, 3, *[values] * 7),
        CYCLE.encode(1, 2, 3, 4, 5, 6, True, values, "ACTIVE"),
        EVENT.encode(1, "kind", "message", "{}"),
        BODY.encode(1, 2, *[values] * 6, 0.5, 28.0, 1.0, values, 3),
        WIRE.encode(1, b"payload"),
    )
    return [bytes([number]) + body for number, body in enumerate(bodies)]


def _read_message(data: bytes) -> None:
    _MESSAGES[data[0] % len(_MESSAGES) if data else 0].decode(data[1:])


KINDS: dict[str, Kind] = {
    "wire_serial": WireKind(make=_serial_stream, read=_read_serial, mutations=(damage_bytes, _reframed)),
    "wire_low_state": WireKind(
        make=_low_states,
        read=_read_low_state,
        mutations=(damage_bytes, mended(damage_bytes, _mend_words(low_state_image))),
    ),
    "wire_low_command": WireKind(
        make=low_commands,
        read=decode_low_command,
        mutations=(damage_bytes, mended(damage_bytes, _mend_words(low_command_image))),
    ),
    "wire_rpc": WireKind(make=_responses, read=_read_response, mutations=(damage_bytes, _odd_response)),
    "wire_service": WireKind(make=_requests, read=_serve, mutations=(damage_bytes, _odd_request)),
    "wire_remote": WireKind(make=_remotes, read=_read_remote, mutations=(damage_bytes,)),
    "wire_sport_state": WireKind(make=_sport_states, read=decode_sport_state, mutations=(damage_bytes,)),
    "wire_record": WireKind(
        make=_records, read=decode_record, mutations=(damage_bytes, mended(damage_bytes, _mend_record))
    ),
    "wire_message": WireKind(make=_messages, read=_read_message, mutations=(damage_bytes,)),
}
