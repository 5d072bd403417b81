"""Channels out of the control process: cycles to the recorder, heartbeats and the report to the supervisor.

Both are Unix sockets of whole datagrams (SOCK_SEQPACKET). The control process never waits for them: a
datagram that the peer does not take at once is refused and counted.
"""

from __future__ import annotations

import contextlib
import enum
import json
import socket
import struct
from dataclasses import dataclass
from typing import Any

from deal_hw.data.recording.record import CycleRecord, encode
from deal_hw.errors import ConfigurationError, DatasetError

BUFFER_BYTES = 1 << 20
"""Requested buffer of the recorder's socket; the kernel grants up to net.core.wmem_max, twice 208 kB by
default."""
_MOST_REFUSED = 50
"""After this many successive refusals (one second at 50 Hz) the recorder is considered dead, and the run
ends."""
_MOST_WORD = 256
STARTING, LOADING, CONNECTING, HOMING, ARMING, RUNNING, LOWERING, MAKING_PASSIVE, HANDING_BACK = (
    "starting",
    "loading",
    "connecting",
    "homing",
    "arming",
    "running",
    "moving to the rest pose",
    "making passive",
    "handing back",
)
"""Phases of a run, in order; cycles run in RUNNING. A phase is reported before it begins."""
HEARTBEAT = "\0"
"""The supervisor's heartbeat."""
_BEAT = struct.Struct("<cqdI")


class Outcome(enum.Enum):
    """How a run ended."""

    FINISHED = "finished"
    STOPPED = "stopped"
    """Ended by the operator."""
    TRIPPED = "tripped"
    """Ended by the safety module."""
    FAILED = "failed"
    """Ended by an error."""


def socket_pair(buffer_bytes: int = BUFFER_BYTES) -> tuple[socket.socket, socket.socket]:
    """Return (sender, receiver) of a datagram channel; the sender never blocks."""
    sender, receiver = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, buffer_bytes)
    sender.setblocking(False)
    return sender, receiver


class RecordSender:
    """Hands cycle records to the recorder process: a sink for the control loop."""

    def __init__(self, sender: socket.socket) -> None:
        self._socket = sender
        self._refused_in_a_row = 0

    def __call__(self, record: CycleRecord) -> bool:
        """Send a record; return False if the recorder's queue is full.

        Raises:
            DatasetError: The recorder has ended, or has taken no record for a second.
        """
        try:
            self._socket.send(encode(record), socket.MSG_NOSIGNAL)
        except (BlockingIOError, ConfigurationError):
            self._refused_in_a_row += 1
            if self._refused_in_a_row >= _MOST_REFUSED:
                raise DatasetError(
                    f"the recorder has refused the last {self._refused_in_a_row} cycles: the disk is too "
                    "slow or hangs; record to another disk"
                ) from None
            return False
        except OSError as err:
            raise DatasetError(
                f"the recorder has ended ({err.strerror}); its recording up to then is complete; check "
                "disk and memory, then record again"
            ) from err
        self._refused_in_a_row = 0
        return True


@dataclass(frozen=True, slots=True)
class Beat:
    """One heartbeat.

    Attributes:
        stamp_ns: Send time on the machine's monotonic clock, which all processes share [ns].
        silence_s: The longest time until the next one [s].
        phase: Phase of the control process.
        count: Heartbeats before this one in the same phase.
    """

    stamp_ns: int
    silence_s: float
    phase: str
    count: int

    @property
    def stale_ns(self) -> int:
        """When the next heartbeat is overdue [ns]."""
        return self.stamp_ns + round(self.silence_s * 1e9)


class StatusSender:
    """The control process's end of the channel to the supervisor."""

    def __init__(self, sender: socket.socket) -> None:
        self._socket = sender
        self._phase = ""
        self._count = 0

    def beat(self, stamp_ns: int, phase: str, silence_s: float) -> None:
        """Send a heartbeat; without a supervisor it is dropped."""
        self._count = self._count + 1 if phase == self._phase else 0
        self._phase = phase
        try:
            beat = _BEAT.pack(b"H", stamp_ns, silence_s, self._count) + phase.encode()
            self._socket.send(beat, socket.MSG_NOSIGNAL)
        except OSError:
            return

    def fileno(self) -> int:
        """Return the descriptor, for ``select``."""
        return self._socket.fileno()

    def received(self) -> list[str]:
        """Return the supervisor's messages since the last call; never waits."""
        words: list[str] = []
        try:
            while word := self._socket.recv(_MOST_WORD, socket.MSG_DONTWAIT):
                words.append(word.decode("utf-8", "replace"))
        except OSError:
            pass
        return words

    def result(self, values: dict[str, Any]) -> None:
        """Send the run's result as JSON; may wait a second, since the robot is already passive."""
        self._socket.settimeout(1.0)
        try:
            self._socket.send(b"R" + json.dumps(values).encode(), socket.MSG_NOSIGNAL)
        except OSError:
            return


class StatusReceiver:
    """The supervisor's end."""

    def __init__(self, receiver: socket.socket) -> None:
        self._socket = receiver
        self._socket.setblocking(False)
        self.open = True
        """False once the control process has closed its end."""

    def fileno(self) -> int:
        """Return the descriptor, for ``select``."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close this end."""
        self.open = False
        self._socket.close()

    def tell(self, text: str) -> None:
        """Send a message to the control process; one that it does not take at once is lost."""
        with contextlib.suppress(OSError):
            self._socket.send(text.encode()[:_MOST_WORD], socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def receive(self) -> Beat | dict[str, Any] | None:
        """Return the next heartbeat or result; None if none is waiting."""
        try:
            try:
                datagram = self._socket.recv(1 << 18)
            except ConnectionResetError:
                # It closed without reading all our messages; the kernel reports that once, before its last
                # messages.
                datagram = self._socket.recv(1 << 18)
        except BlockingIOError:
            return None
        except OSError:
            datagram = b""
        if not datagram:
            self.open = False
            return None
        if datagram[:1] == b"R":
            values: dict[str, Any] = json.loads(datagram[1:])
            return values
        _, stamp_ns, silence_s, count = _BEAT.unpack_from(datagram)
        return Beat(stamp_ns, silence_s, datagram[_BEAT.size :].decode(), count)
