"""Attachments of Zenoh messages that give their age without a common clock.

The robot's side stamps its messages with its own clock. A client returns the newest received stamp with each
message of its own, and numbers its messages. So the robot's side knows, by its own clock alone, the age of
the state that the client acted on, with both ways included. No wall clock is used. TCP's timestamps work
alike (RFC 7323). docs/reference/protocol-go2.md has the bytes for other languages.
"""

from __future__ import annotations

import secrets
import struct
from dataclasses import dataclass
from typing import Final

from deal_hw.documentation import page
from deal_hw.errors import FrameError

VERSION: Final = 1
_DESCRIBED: Final = page("reference/protocol-go2.md")
_STAMP, _ECHO = 1, 2
_STAMP_BYTES: Final = struct.Struct("<HHIQQ")
_ECHO_BYTES: Final = struct.Struct("<HHIQQQQ")


@dataclass(frozen=True, slots=True)
class Stamp:
    """Attachment from the robot's side.

    Attributes:
        session: Random number of its session; a new one after a restart.
        time_ns: Its clock [ns]; only differences have a meaning.
    """

    session: int
    time_ns: int

    def encode(self) -> bytes:
        """Return the attachment, 24 bytes."""
        return _STAMP_BYTES.pack(VERSION, _STAMP, 0, self.session, self.time_ns)


@dataclass(frozen=True, slots=True)
class Echo:
    """Attachment from a client.

    Attributes:
        stream: Random number of its session; a new one after each opening.
        sequence: Number of the message in the stream, rising; numbers may be left out.
        received: The newest received stamp; zeros before the first.
    """

    stream: int
    sequence: int
    received: Stamp

    def encode(self) -> bytes:
        """Return the attachment, 40 bytes."""
        return _ECHO_BYTES.pack(
            VERSION, _ECHO, 0, self.stream, self.sequence, self.received.session, self.received.time_ns
        )


def read_stamp(attachment: bytes) -> Stamp | None:
    """Return the stamp in an attachment; None if it is something else."""
    if len(attachment) != _STAMP_BYTES.size:
        return None
    version, kind, _, session, time_ns = _STAMP_BYTES.unpack(attachment)
    return Stamp(session, time_ns) if (version, kind) == (VERSION, _STAMP) else None


def read_echo(attachment: bytes) -> Echo:
    """Return the echo in a client's attachment.

    Raises:
        FrameError: It is something else, or empty.
    """
    if len(attachment) == _ECHO_BYTES.size:
        version, kind, _, stream, sequence, session, time_ns = _ECHO_BYTES.unpack(attachment)
        if (version, kind) == (VERSION, _ECHO):
            return Echo(stream, sequence, Stamp(session, time_ns))
    raise FrameError(
        f"an attachment of {len(attachment)} bytes that begins {attachment[:4].hex(' ')!r} is no "
        f"echo of version {VERSION} ({_ECHO_BYTES.size} bytes, {_DESCRIBED}): "
        "neither sequence nor age is known"
    )


class Echoes:
    """Numbers a client's messages and returns the newest stamp with each.

    Attributes:
        stream: Number of the stream.

    Args:
        stream: The same; random by default.
    """

    def __init__(self, stream: int | None = None) -> None:
        self.stream = secrets.randbits(64) if stream is None else stream
        self._sequence = -1
        self._heard = Stamp(0, 0)

    def hear(self, attachment: bytes) -> None:
        """Take the attachment of a received message from any sender."""
        self._heard = read_stamp(attachment) or self._heard

    def next(self) -> bytes:
        """Return the attachment of the next message."""
        self._sequence += 1
        return Echo(self.stream, self._sequence, self._heard).encode()
