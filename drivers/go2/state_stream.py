"""The stream of LowStates: what is sound and new in it, when it was sensed, and what was commanded then."""

from __future__ import annotations

from collections import Counter, deque
from typing import Final

from deal_hw.drivers.go2.protocol import LOW_STATE_BYTES, LowStateFrame, decode_low_state
from deal_hw.errors import (
    FrameError,
    ProtocolError,
    TransportLostError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.transport import Message

PERIOD_MS: Final = 2
RESTART_MS: Final = 1000
"""A clock that goes back further than this was restarted; by less, a state was overtaken."""
_DRIFT: Final = 5e-4
"""Largest rate difference between host and robot clock that counts as drift."""
_U32: Final = 1 << 32


class StateStream:
    """Judges each LowState by its bytes and its tick, and keeps the robot's time.

    Attributes:
        errors: Corrupt, missing, repeated and overtaken states so far.
        accepted: Sound new states so far.
        stale: States so far that were no newer than the one before.
        sequence: Number of the newest state, counted in periods of the robot's clock.
        device_ns: The robot's clock at the newest state, without its wraps [ns].
        offset_ns: Host clock minus robot clock, at the fastest transit seen [ns].

    Args:
        check_crc: Whether to verify checksums.
    """

    def __init__(self, check_crc: bool = True) -> None:
        self._check_crc = check_crc
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.errors = self.accepted = self.stale = self.device_ns = self.offset_ns = 0
        self.sequence = -1
        self._tick: int | None = None
        self._offset_at_ns = 0
        self._lengths: Counter[int] = Counter()
        self._refused: FrameError | None = None
        self._bad_crc = 0

    def take(self, message: Message) -> LowStateFrame | None:
        """Return the state in a message; None where it is corrupt or not new.

        Raises:
            TransportLostError: The robot's clock was restarted.
        """
        try:
            frame = decode_low_state(message.payload, self._check_crc)
        except FrameError as error:
            self._refuse(message.payload, error)
            return None
        tick = frame.tick_ms
        # Signed: a state that was overtaken is a little older, not four thousand million milliseconds newer.
        step = PERIOD_MS if self._tick is None else (tick - self._tick + _U32 // 2) % _U32 - _U32 // 2
        if step <= 0:
            self.errors += 1
            self.stale += 1
            if step < -RESTART_MS:
                before, self._tick = self._tick, None
                raise TransportLostError(
                    f"go2: the robot's clock went back from {before} to {tick} ms: it was restarted (connect "
                    "again once it has booted), or a second robot is on the network"
                )
            return None
        if self._tick is not None:
            self.errors += max(step // PERIOD_MS - 1, 0)
        first = self.accepted == 0
        self.device_ns = tick * 1_000_000 if first else self.device_ns + step * 1_000_000
        self.sequence += max(step // PERIOD_MS, 1)
        self._tick = tick
        self.accepted += 1
        self._keep_time(message.stamp_ns, first)
        return frame

    def complaint(self) -> ProtocolError | None:
        """Return what is wrong where states come and none is sound; None where none came, or some are."""
        if self.accepted or self._refused is None:
            return None
        if self._bad_crc:
            return VersionMismatchError(
                f"go2: {self._bad_crc} states have the right length, and none the checksum that its layout "
                "asks for; the robot's firmware and deal-hw disagree: update deal-hw"
            )
        length = self._lengths.most_common(1)[0][0]
        if length != LOW_STATE_BYTES:
            return WrongDeviceError(
                f"go2: the messages on rt/lowstate have {length} bytes, those of a Go2 {LOW_STATE_BYTES}: "
                "another robot type (G1 and H1 use this topic, too)? Choose the right robot or network"
            )
        return WrongDeviceError(f"go2: what comes on rt/lowstate is no state of a Go2: {self._refused}")

    def _refuse(self, payload: bytes, error: FrameError) -> None:
        self.errors += 1
        self._refused = error
        self._lengths[len(payload)] += 1
        self._bad_crc += "checksum" in str(error)

    def _keep_time(self, receive_ns: int, first: bool) -> None:
        offset = receive_ns - self.device_ns
        crept = self.offset_ns + round(_DRIFT * (receive_ns - self._offset_at_ns))
        self.offset_ns = offset if first else min(offset, crept)
        self._offset_at_ns = receive_ns


class CommandEcho:
    """Knows which command was in force when a state was sensed: the robot does not say it."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all commands."""
        self._sent: deque[tuple[int, int]] = deque(maxlen=4096)
        self._in_force: tuple[int, int] | None = None

    def note(self, sequence: int, stamp_ns: int) -> None:
        """A new command went out at a time of the host's clock [ns]."""
        self._sent.append((sequence, stamp_ns))

    def at(self, device_ns: int, offset_ns: int) -> tuple[int, int]:
        """Return number and age [ns] of the command in force at a time of the robot's clock; (-1, -1): none.

        When a command went out by the robot's clock is settled once, so that ages grow as the clock does.
        """
        while self._sent and self._sent[0][1] - offset_ns < device_ns:
            sequence, stamp_ns = self._sent.popleft()
            self._in_force = sequence, stamp_ns - offset_ns
        if self._in_force is None:
            return -1, -1
        return self._in_force[0], device_ns - self._in_force[1]
