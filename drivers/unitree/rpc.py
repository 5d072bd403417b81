"""Requests to and responses from the services of Unitree's robots, as CDR.

Types unitree_api::msg::dds_::Request_ and Response_ (unitree_sdk2 @ 21d0a3b). Parameters and data are JSON.
Both messages are written byte by byte, because they hold a string and have no static layout.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from deal_hw.drivers.unitree.cdr import CDR_HEADER
from deal_hw.errors import FrameError

_REQUEST: Final = struct.Struct("<4sqqqi?")
_RESPONSE: Final = struct.Struct("<4sqqi")
_LENGTH: Final = struct.Struct("<I")
_LONGEST: Final = 1 << 20
"""A length beyond this is invalid, at any length of the payload."""


@dataclass(frozen=True, slots=True)
class Request:
    """A call to a service.

    Attributes:
        identity: The caller's number of this call; the response repeats it.
        api: Number of the function.
        parameter: JSON text.
        lease: For exclusive services; 0: none.
        priority: 0: ordinary.
        no_reply: Whether the service stays silent.
        binary: More bytes.
    """

    identity: int
    api: int
    parameter: str = "{}"
    lease: int = 0
    priority: int = 0
    no_reply: bool = False
    binary: bytes = b""


@dataclass(frozen=True, slots=True)
class Response:
    """The answer to a request.

    Attributes:
        identity: The request's number.
        api: The request's function.
        code: 0: done; otherwise the service's error.
        data: JSON text.
        binary: More bytes.
    """

    identity: int
    api: int
    code: int = 0
    data: str = ""
    binary: bytes = b""

    def json(self) -> dict[str, Any]:
        """Return the data as a JSON object; empty if there is none.

        Raises:
            FrameError: The data are no JSON object.
        """
        try:
            values = json.loads(self.data) if self.data else {}
        except (ValueError, RecursionError) as error:
            raise FrameError(f"response to {self.api}: {self.data[:60]!r} is not JSON: {error}") from error
        if not isinstance(values, dict):
            raise FrameError(f"response to {self.api}: {self.data[:60]!r} is not a JSON object")
        return values


def encode_request(request: Request) -> bytes:
    """Return a request as CDR with header."""
    fixed = _REQUEST.pack(
        CDR_HEADER, request.identity, request.api, request.lease, request.priority, request.no_reply
    )
    return _with_text(fixed, request.parameter, request.binary)


def decode_request(payload: bytes) -> Request:
    """Return the request in a payload.

    Raises:
        FrameError: Wrong header, cut short, or lengths that do not fit.
    """
    _check(payload, "Request", _REQUEST.size)
    _, identity, api, lease, priority, no_reply = _REQUEST.unpack_from(payload)
    parameter, binary = _text_of(payload, "Request", _REQUEST.size)
    return Request(identity, api, parameter, lease, priority, no_reply, binary)


CLAIM_TEXTS: Final = {"id": 200, "who": 200, "state": 200}
STATUS_TEXTS: Final = {"control": 40, "reason": 400}
"""Texts of a claim and of the bridge's status (who controls the robot, and why) -> most characters."""
HEARD_TEXTS: Final = {"heard": 200}
"""Further text of the status, which older bridges lack: the streams that reached it."""


def encode_note(values: Mapping[str, Any]) -> bytes:
    """Return a message between deal-hw's own programs: JSON in a request without an answer."""
    return encode_request(Request(identity=0, api=0, parameter=json.dumps(dict(values)), no_reply=True))


def read_note(payload: bytes, texts: Mapping[str, int]) -> dict[str, str] | None:
    """Return the texts in such a message, each cut to its largest length; None if one is missing."""
    try:
        values = json.loads(decode_request(payload).parameter)
    except (FrameError, ValueError, RecursionError):
        return None
    if not isinstance(values, dict) or not all(isinstance(values.get(name), str) for name in texts):
        return None
    return {name: values[name][:most] for name, most in texts.items()}


def encode_response(response: Response) -> bytes:
    """Return a response as CDR with header."""
    fixed = _RESPONSE.pack(CDR_HEADER, response.identity, response.api, response.code)
    return _with_text(fixed, response.data, response.binary)


def decode_response(payload: bytes) -> Response:
    """Return the response in a payload.

    Raises:
        FrameError: Wrong header, cut short, or lengths that do not fit.
    """
    _check(payload, "Response", _RESPONSE.size)
    _, identity, api, code = _RESPONSE.unpack_from(payload)
    data, binary = _text_of(payload, "Response", _RESPONSE.size)
    return Response(identity, api, code, data, binary)


def _aligned(at: int) -> int:
    # CDR aligns from the end of the 4-byte header. That header is a whole word, so offsets from the start are
    # aligned too.
    return -(-at // 4) * 4


def _with_text(fixed: bytes, text: str, binary: bytes) -> bytes:
    out = bytearray(fixed)
    encoded = text.encode() + b"\0"
    for part in (encoded, binary):
        out += bytes(_aligned(len(out)) - len(out)) + _LENGTH.pack(len(part)) + part
    return bytes(out)


def _text_of(payload: bytes, name: str, at: int) -> tuple[str, bytes]:
    text, at = _sequence(payload, name, at)
    binary, at = _sequence(payload, name, at)
    if len(payload) - at > 3:
        raise FrameError(f"{name}: {len(payload) - at} bytes too many at its end")
    if not text.endswith(b"\0"):
        raise FrameError(f"{name}: the text does not end with a zero byte")
    try:
        return text[:-1].decode(), binary
    except UnicodeDecodeError as error:
        raise FrameError(f"{name}: the text is not UTF-8: {error}") from error


def _sequence(payload: bytes, name: str, at: int) -> tuple[bytes, int]:
    at = _aligned(at)
    if at + 4 > len(payload):
        raise FrameError(f"{name}: {len(payload)} bytes end before byte {at + 4}")
    (length,) = _LENGTH.unpack_from(payload, at)
    at += 4
    if length > _LONGEST or at + length > len(payload):
        raise FrameError(f"{name}: a part of {length} bytes at byte {at} does not fit {len(payload)} bytes")
    return payload[at : at + length], at + length


def _check(payload: bytes, name: str, least: int) -> None:
    if len(payload) < least:
        raise FrameError(f"{name}: {len(payload)} bytes, at least {least} are needed")
    # The header's last byte may give the number of padding bytes at the payload's end.
    if payload[:3] != CDR_HEADER[:3]:
        raise FrameError(f"{name}: the CDR header is {payload[:4].hex(' ')}, expected {CDR_HEADER.hex(' ')}")
