"""What travels beside a Zenoh message, so that its age is known without a clock that both sides share.

The robot's side stamps what it sends with its own clock. A client returns the newest stamp that it has heard
with each message of its own, and numbers them. The robot's side then knows, by its own clock alone, how old
the state was that the client acted on, the way there and back included: wall clocks play no part. TCP's
timestamps work alike (RFC 7323). Page 'Go2 messages' of the documentation has the bytes for other languages.
"""

from __future__ import annotations

import secrets
import struct
from dataclasses import dataclass
from typing import Final

from deal_hw.errors import FrameError

VERSION: Final = 1
_STAMP, _ECHO = 1, 2
_STAMP_BYTES: Final = struct.Struct("<HHIQQ")
_ECHO_BYTES: Final = struct.Struct("<HHIQQQQ")


@dataclass(frozen=True, slots=True)
class Stamp:
    """What the robot's side writes.

    Attributes:
        session: Random number of its session; another one after a restart.
        time_ns: Its clock [ns]; only differences mean anything.
    """

    session: int
    time_ns: int

    def encode(self) -> bytes:
        """Return the attachment, 24 bytes."""
        return _STAMP_BYTES.pack(VERSION, _STAMP, 0, self.session, self.time_ns)


@dataclass(frozen=True, slots=True)
class Echo:
    """What a client writes.

    Attributes:
        stream: Random number of its session; another one after each opening.
        sequence: Number of the message in the stream, rising; numbers may be left out.
        heard: The newest stamp that it has heard; zeros before the first.
    """

    stream: int
    sequence: int
    heard: Stamp

    def encode(self) -> bytes:
        """Return the attachment, 40 bytes."""
        return _ECHO_BYTES.pack(
            VERSION, _ECHO, 0, self.stream, self.sequence, self.heard.session, self.heard.time_ns
        )


def read_stamp(attachment: bytes) -> Stamp | None:
    """Return the stamp in an attachment; None where it is something else."""
    if len(attachment) != _STAMP_BYTES.size:
        return None
    version, kind, _, session, time_ns = _STAMP_BYTES.unpack(attachment)
    return Stamp(session, time_ns) if (version, kind) == (VERSION, _STAMP) else None


def read_echo(attachment: bytes) -> Echo:
    """Return what a client wrote.

    Raises:
        FrameError: It is something else, or nothing.
    """
    if len(attachment) == _ECHO_BYTES.size:
        version, kind, _, stream, sequence, session, time_ns = _ECHO_BYTES.unpack(attachment)
        if (version, kind) == (VERSION, _ECHO):
            return Echo(stream, sequence, Stamp(session, time_ns))
    raise FrameError(
        f"an attachment of {len(attachment)} bytes that begins {attachment[:4].hex(' ')!r} is no "
        f"echo of version {VERSION} ({_ECHO_BYTES.size} bytes, page 'Go2 messages' of the documentation): "
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
        """Take the attachment of a message that came, whoever sent it."""
        self._heard = read_stamp(attachment) or self._heard

    def next(self) -> bytes:
        """Return the attachment of the next message."""
        self._sequence += 1
        return Echo(self.stream, self._sequence, self._heard).encode()
