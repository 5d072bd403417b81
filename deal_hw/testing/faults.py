"""Faults of a wire, on request: corrupt, lost and repeated frames, and a cable that is pulled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.clock import Clock
from deal_hw.errors import ConfigurationError, TransportLostError
from deal_hw.transport import Message, Transport, TransportWrapper


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultRates:
    """Probabilities of faults of a frame, each from 0 to 1.

    Attributes:
        corrupt: One byte becomes another.
        drop: The frame is lost.
        duplicate: The frame comes twice.
    """

    corrupt: float = 0.0
    drop: float = 0.0
    duplicate: float = 0.0

    def __post_init__(self) -> None:
        for name in ("corrupt", "drop", "duplicate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigurationError(f"{name} is a probability from 0 to 1, got {getattr(self, name)}")


class FrameFaults:
    """Applies :class:`FaultRates` to a byte stream of delimited frames, or to whole messages.

    Attributes:
        corrupted: Frames changed so far.
        dropped: Frames lost so far.
        duplicated: Frames repeated so far.

    Args:
        rates: Probabilities of the faults.
        rng: Source of randomness.
        delimiter: End of a frame; None: every call is one frame.
    """

    def __init__(
        self, rates: FaultRates, rng: np.random.Generator, delimiter: bytes | None = b"\x00"
    ) -> None:
        self.corrupted = self.dropped = self.duplicated = 0
        self._rates = rates
        self._rng = rng
        self._delimiter = delimiter

    def apply(self, data: bytes) -> bytes:
        """Return the part of ``data`` (whole frames) that arrives."""
        if self._delimiter is None:
            return self._frame(data)
        frames = data.split(self._delimiter)
        out = b"".join(self._frame(frame + self._delimiter) for frame in frames[:-1])
        return out + frames[-1]

    def _frame(self, frame: bytes) -> bytes:
        corrupt, drop, duplicate = self._rng.random(3) < (
            self._rates.corrupt,
            self._rates.drop,
            self._rates.duplicate,
        )
        if drop:
            self.dropped += 1
            return b""
        if corrupt and frame:
            self.corrupted += 1
            changed = bytearray(frame)
            changed[int(self._rng.integers(len(frame)))] ^= int(self._rng.integers(1, 256))
            frame = bytes(changed)
        if duplicate:
            self.duplicated += 1
            return frame + frame
        return frame


class OneBadFrame(FrameFaults):
    """Changes one byte of the next message on request.

    Args:
        byte: Which one of the message's bytes; negative counts from the end.
    """

    def __init__(self, byte: int) -> None:
        super().__init__(FaultRates(), np.random.default_rng(0), None)
        self._byte = byte
        self._armed = False

    def corrupt_next(self) -> None:
        """Make the next message corrupt."""
        self._armed = True

    def apply(self, data: bytes) -> bytes:
        """Flip bits of the byte; none becomes 0, which would end a COBS frame."""
        if not self._armed:
            return data
        self._armed = False
        self.corrupted += 1
        changed = bytearray(data)
        changed[self._byte] = changed[self._byte] ^ 0x55 or 1
        return bytes(changed)


class RecordFaults(FrameFaults):
    """Faults of frames of a fixed size. Their first bytes are spared: CAN controllers filter by identifiers.

    Args:
        rates: Probabilities of the faults.
        rng: Source of randomness.
        size: Bytes of a frame.
        header: Bytes at its beginning that stay.
    """

    def __init__(self, rates: FaultRates, rng: np.random.Generator, *, size: int, header: int) -> None:
        super().__init__(rates, rng, None)
        self._size, self._header = size, header

    def apply(self, data: bytes) -> bytes:
        """Treat each frame's data alone; a repeated frame has its header again."""
        out, width = b"", self._size - self._header
        for k in range(0, len(data), self._size):
            head, body = data[k : k + self._header], data[k + self._header : k + self._size]
            left = self._frame(body)
            out += b"".join(head + left[j : j + width] for j in range(0, len(left), width))
        return out


class FaultyTransport(TransportWrapper):
    """A transport with faults.

    Args:
        inner: The transport that works.
        received: Faults of messages from the device.
        sent: Faults of messages to the device.
        clock: Measures waiting across lost messages; without it each lost message starts the wait again.
    """

    def __init__(
        self,
        inner: Transport,
        received: FrameFaults | None = None,
        sent: FrameFaults | None = None,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(inner)
        self._received = received
        self._sent = sent
        self._clock = clock
        self._unplugged = False

    def unplug(self) -> None:
        """Pull the cable."""
        self._unplugged = True

    def open(self) -> None:
        """Open the inner transport."""
        self._check()
        self._inner.open()

    def reopen(self) -> None:
        """Open the inner transport again."""
        self._check()
        self._inner.reopen()

    def send(self, message: Message) -> None:
        """Send the message after its faults."""
        self._check()
        payload = message.payload if self._sent is None else self._sent.apply(message.payload)
        if payload:
            self._inner.send(Message(message.channel, payload, message.stamp_ns))

    def receive(self, timeout_s: float) -> Message:
        """Receive a message after its faults; a lost one never arrives."""
        start_ns = self._clock.now_ns() if self._clock else 0
        left_s = timeout_s
        while True:
            self._check()
            message = self._inner.receive(left_s)
            if self._clock:
                left_s = max(0.0, timeout_s - (self._clock.now_ns() - start_ns) / 1e9)
            payload = message.payload if self._received is None else self._received.apply(message.payload)
            if payload:
                return Message(message.channel, payload, message.stamp_ns)

    def _check(self) -> None:
        if self._unplugged:
            raise TransportLostError("the cable was pulled (fault injection)")
