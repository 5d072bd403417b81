"""The supervisor: starts and watches the control process; makes the robot passive if that process cannot.

It owns the port as long as it lives. No other program can then take the robot, and the passive command can
still be sent after the control process has died. It never sends while the control process lives: two writers
on one port would corrupt each other's frames. It sends nothing if the control process had not begun to
command the robot. The control process also watches the supervisor ( :mod:`deal_hw.control.vigil`).
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any

from deal_hw.child_process import own_process_group
from deal_hw.clock import Clock, MonotonicClock
from deal_hw.control.process_channel import (
    BUFFER_BYTES,
    HEARTBEAT,
    STARTING,
    Beat,
    StatusReceiver,
    socket_pair,
)
from deal_hw.control.realtime import SUPERVISOR_PRIORITY, hurry, priority
from deal_hw.data.recording.recorder_launch import RecorderHandle, RecorderOutcome

START_SILENCE_S = 30.0
"""How long a new control process may take to import and load before its first heartbeat [s]."""
OPERATOR = "stopped by the operator"
SUSPENDED = "suspended by the operator (Ctrl-Z)"
_POLL_S = 0.05
_MOST_STOPS = 3
"""After this many stop requests of the operator, the next one ends the repeating of the passive command."""
_GRACE_S = 3.0
"""How long a control process may take to exit after it closed its end of the channel [s]."""


@dataclass(frozen=True, slots=True)
class ChildEnd:
    """How the control process ended.

    Attributes:
        result: Its report; None if it died without one.
        exit_code: As in ``subprocess``: negative for a signal.
        killed: Why the supervisor killed it; "" if it did not.
        stop_cause: Why the supervisor asked it to stop; "" if it did not.
        passive_confirmed: Whether the robot itself confirmed that it is passive.
        recorder: How the recording ended; None without a recorder.
        signal: Name of the signal by which the operator ended it, such as "SIGINT"; "" without one.
    """

    result: dict[str, Any] | None
    exit_code: int
    killed: str
    stop_cause: str
    passive_confirmed: bool
    recorder: RecorderOutcome | None
    signal: str


class Supervisor:
    """Runs one control process to its end.

    Args:
        module: The control process's module, run with ``python -m``.
        plan: Its settings, as plain JSON values; it reads them from its standard input.
        port_fd: The open port, which it inherits; None if each process opens its own connection.
        passive: Sends the passive command through the port and returns whether the robot confirmed it. Called
        only after the control process has died, with its last phase and whether it tried the same without
        success.
        The function decides whether to send.
        recorder: The recorder, ready; None to record nothing.
        on_beat: Called with each heartbeat.
        clock: For heartbeats; the machine's monotonic clock by default.
        keep_fds: More descriptors that live as long as the control process, such as a claim.
    """

    _stale_ns: int

    def __init__(
        self,
        *,
        module: str,
        plan: Mapping[str, Any],
        port_fd: int | None,
        passive: Callable[[str, bool], bool],
        recorder: RecorderHandle | None = None,
        on_beat: Callable[[Beat], None] = lambda beat: None,
        clock: Clock | None = None,
        keep_fds: Sequence[int] = (),
    ) -> None:
        self._keep_fds = tuple(keep_fds)
        self._module, self._plan, self._port_fd, self._passive = module, plan, port_fd, passive
        self._recorder, self._on_beat, self._clock = recorder, on_beat, clock or MonotonicClock()
        self._child: subprocess.Popen[bytes] | None = None
        self._status: StatusReceiver | None = None
        self._result: dict[str, Any] | None = None
        self._killed = self._stop_cause = self._signal = ""
        self._stops = self._beat_ns = 0
        self._phase = STARTING

    def run(self) -> ChildEnd:
        """Run the control process to its end, then make the robot passive and close the recording."""
        with self._operator_stops(), priority(SUPERVISOR_PRIORITY, lock=True):
            child, status = self._start()
            try:
                self._watch(child, status)
            except BaseException:
                self._kill(child, "the supervisor failed")
                raise
            finally:
                # After any error here: no control process may stay alone, and the robot comes first.
                exit_code = self._reap(child)
                confirmed = bool(self._result and self._result.get("passive_confirmed"))
                confirmed = confirmed or self._passive(self._phase, self._result is not None)
                outcome = self._recorder.finish() if self._recorder is not None else None
                status.close()
        return ChildEnd(
            self._result, exit_code, self._killed, self._stop_cause, confirmed, outcome, self._signal
        )

    @property
    def abandoned(self) -> bool:
        """Whether the operator has asked so often that even the passive command ends."""
        return self._stops > _MOST_STOPS

    def stop(self, cause: str) -> None:
        """Ask the control process to end by its passive route; the operator's second request kills it."""
        self._stops += 1
        again, self._stop_cause = bool(self._stop_cause), self._stop_cause or cause
        child = self._child
        if child is None or child.returncode is not None:
            return
        if not again:
            child.send_signal(signal.SIGTERM)
        elif cause in (OPERATOR, SUSPENDED):
            self._kill(child, "the operator asked twice")

    def tell(self, text: str) -> None:
        """Pass a message of the operator to the control process, such as a key; safe from another thread."""
        if self._status is not None:
            self._status.tell(text)

    def _start(self) -> tuple[subprocess.Popen[bytes], StatusReceiver]:
        sender, receiver = socket_pair()
        inherited = [sender.fileno(), *self._keep_fds, *([] if self._port_fd is None else [self._port_fd])]
        plan = {
            **self._plan,
            "port_fd": self._port_fd,
            "status_fd": sender.fileno(),
            "parent_pid": os.getpid(),
        }
        if self._recorder is not None:
            record = self._recorder.control_socket
            record.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
            inherited.append(record.fileno())
            plan["record_fd"] = record.fileno()
        with sender:
            # In its own process group: Ctrl-C in the terminal reaches only the supervisor, which passes it
            # on.
            child = subprocess.Popen(
                [sys.executable, "-m", self._module],
                pass_fds=inherited,
                stdin=subprocess.PIPE,
                **own_process_group(),
            )
        self._child = child
        if self._recorder is not None:
            self._recorder.release()
        if self._stop_cause:
            child.send_signal(signal.SIGTERM)
        self._stale_ns = self._clock.now_ns() + round(START_SILENCE_S * 1e9)
        assert child.stdin is not None
        with contextlib.suppress(BrokenPipeError), child.stdin as orders:
            orders.write(json.dumps(plan).encode())
        self._status = StatusReceiver(receiver)
        return child, self._status

    def _watch(self, child: subprocess.Popen[bytes], status: StatusReceiver) -> None:
        """Return after the control process has sent its last message, has died or was killed."""
        while status.open:
            if (now_ns := self._clock.now_ns()) >= self._beat_ns:
                status.tell(HEARTBEAT)
                self._beat_ns = now_ns + round(_POLL_S * 1e9)
            left_s = (self._stale_ns - self._clock.now_ns()) * 1e-9
            if select.select([status], [], [], min(_POLL_S, max(left_s, 0.0) + 1e-3))[0]:
                while (message := status.receive()) is not None:
                    self._take(message)
            # Only after a wait without messages: if the supervisor itself was delayed, old heartbeats are
            # still waiting.
            elif self._clock.now_ns() > self._stale_ns:
                self._kill(child, f"it sent no heartbeat while {self._phase}")
                return
            if self._recorder is not None and not self._stop_cause and (errors := self._recorder.errors()):
                self.stop(f"the recorder failed: {errors[0]}")

    def _take(self, message: Beat | dict[str, Any]) -> None:
        if isinstance(message, Beat):
            self._stale_ns, self._phase = message.stale_ns, message.phase
            self._on_beat(message)
        else:
            self._result = message

    def _kill(self, child: subprocess.Popen[bytes], why: str) -> None:
        # SIGKILL also ends a process stopped by SIGSTOP.
        self._killed = self._killed or why
        child.kill()
        hurry(child.pid)

    def _reap(self, child: subprocess.Popen[bytes]) -> int:
        """Return the exit code of the control process, which sends no more messages."""
        try:
            # A wait with a limit polls with pauses of up to 50 ms, in which a robot may be stiff.
            return child.wait() if self._killed else child.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            self._kill(child, "it did not end after its last message")
            return child.wait()

    @contextlib.contextmanager
    def _operator_stops(self) -> Iterator[None]:
        """Pass on Ctrl-C, SIGTERM and Ctrl-Z as the operator's stop."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def handler(number: int, frame: FrameType | None) -> None:
            self._signal = self._signal or signal.Signals(number).name
            self.stop(SUSPENDED if number == signal.SIGTSTP else OPERATOR)

        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGTSTP)
        before = {number: signal.signal(number, handler) for number in numbers}
        try:
            yield
        finally:
            for number, old in before.items():
                signal.signal(number, old)
