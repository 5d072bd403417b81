"""The supervisor: starts the control process, watches it, and makes the robot passive where it no longer can.

It owns the port for as long as it lives, so that nobody else takes the robot, and so that the passive command
can still be sent once the control process is dead. It never sends while the control process lives: two
writers on one port would tear each other's frames.
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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import FrameType
from typing import Any

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.control.handover import BUFFER_BYTES, Beat, StatusReceiver, socket_pair
from deal_hw.data.recorder_launch import RecorderHandle, RecorderOutcome

START_SILENCE_S = 30.0
"""How long a new control process may take to import and load before its first heartbeat [s]."""
OPERATOR = "stopped by the operator"
_POLL_S = 0.05
_GRACE_S = 3.0
"""How long a control process may take to exit after it closed its end [s]."""


@dataclass(frozen=True, slots=True)
class ChildEnd:
    """How the control process ended.

    Attributes:
        result: What it reported; None where it died without a word.
        exit_code: As ``subprocess`` gives it: negative for a signal.
        killed: Why the supervisor killed it; "" where it did not.
        stop_cause: Why the supervisor asked it to stop; "" where it did not.
        passive_confirmed: Whether the robot itself confirmed that it is passive.
        recorder: How the recording ended; None without a recorder.
    """

    result: dict[str, Any] | None
    exit_code: int
    killed: str
    stop_cause: str
    passive_confirmed: bool
    recorder: RecorderOutcome | None


class Supervisor:
    """Runs one control process to its end.

    Args:
        module: The control process's module, run with ``python -m``.
        plan: Its orders, as plain JSON values; it reads them from its standard input.
        port_fd: The open port, which it inherits; None where each process opens its own path.
        passive: Sends the passive command through the port and returns whether the robot confirmed it. Called
            only once the control process is dead.
        recorder: The recorder, ready; None to record nothing.
        on_beat: Called with each heartbeat.
        clock: For heartbeats; the machine's monotonic clock by default.
    """

    def __init__(
        self,
        *,
        module: str,
        plan: Mapping[str, Any],
        port_fd: int | None,
        passive: Callable[[], bool],
        recorder: RecorderHandle | None = None,
        on_beat: Callable[[Beat], None] = lambda beat: None,
        clock: Clock | None = None,
    ) -> None:
        self._module, self._plan, self._port_fd, self._passive = module, plan, port_fd, passive
        self._recorder, self._on_beat, self._clock = recorder, on_beat, clock or MonotonicClock()
        self._child: subprocess.Popen[bytes] | None = None
        self._status: StatusReceiver | None = None
        self._result: dict[str, Any] | None = None
        self._killed = self._stop_cause = ""
        self._stale_ns = 0
        self._phase = "starting"

    def run(self) -> ChildEnd:
        """Start the control process, watch it to its end, see to the robot and to the recording."""
        with self._operator_stops():
            status = self._status = self._start()
            try:
                self._watch(status)
            except BaseException:
                self._kill("the supervisor failed")
                raise
            finally:
                # Whatever went wrong up here: no control process is left alone, and the robot comes first.
                exit_code = self._reap()
                confirmed = bool(self._result and self._result.get("passive_confirmed")) or self._passive()
                outcome = self._recorder.finish() if self._recorder is not None else None
                status.close()
        return ChildEnd(self._result, exit_code, self._killed, self._stop_cause, confirmed, outcome)

    def stop(self, cause: str) -> None:
        """Ask the control process to end by its passive route; the operator's second wish kills it."""
        again, self._stop_cause = bool(self._stop_cause), self._stop_cause or cause
        if self._child is None or self._child.returncode is not None:
            return
        if not again:
            self._child.send_signal(signal.SIGTERM)
        elif cause == OPERATOR:
            self._kill("the operator asked twice")

    def tell(self, text: str) -> None:
        """Pass a word of the operator on to the control process, such as a key; safe from another thread."""
        if self._status is not None:
            self._status.tell(text)

    def _start(self) -> StatusReceiver:
        sender, receiver = socket_pair()
        inherited = [sender.fileno(), *([] if self._port_fd is None else [self._port_fd])]
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
            # A process group of its own: Ctrl-C in the terminal reaches the supervisor alone, which passes it
            # on.
            child = subprocess.Popen(
                [sys.executable, "-m", self._module],
                pass_fds=inherited,
                stdin=subprocess.PIPE,
                process_group=0,
            )
        self._child = child
        if self._recorder is not None:
            self._recorder.release()
        if self._stop_cause:
            child.send_signal(signal.SIGTERM)
        self._stale_ns = self._clock.now_ns() + round(START_SILENCE_S * 1e9)
        if child.stdin is not None:
            with contextlib.suppress(BrokenPipeError), child.stdin:
                child.stdin.write(json.dumps(plan).encode())
        return StatusReceiver(receiver)

    def _watch(self, status: StatusReceiver) -> None:
        """Return when the control process has said its last word, has died or was killed."""
        while status.open:
            left_s = (self._stale_ns - self._clock.now_ns()) * 1e-9
            if select.select([status], [], [], min(_POLL_S, max(left_s, 0.0) + 1e-3))[0]:
                while (message := status.receive()) is not None:
                    self._take(message)
            # Only after a wait that brought nothing: a supervisor that was itself held up finds old beats
            # first.
            elif self._clock.now_ns() > self._stale_ns:
                self._kill(f"it gave no sign of life while {self._phase}")
                return
            if self._recorder is not None and not self._stop_cause and (errors := self._recorder.errors()):
                self.stop(f"the recorder failed: {errors[0]}")

    def _take(self, message: Beat | dict[str, Any]) -> None:
        if isinstance(message, Beat):
            self._stale_ns, self._phase = message.stale_ns, message.phase
            self._on_beat(message)
        else:
            self._result = message

    def _kill(self, why: str) -> None:
        # SIGKILL also ends a process that was stopped by SIGSTOP.
        self._killed = self._killed or why
        if self._child is not None:
            self._child.kill()

    def _reap(self) -> int:
        """Return the exit code of the control process, which has said its last word or never will."""
        child = self._child
        if child is None:
            return 0
        try:
            return child.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            self._kill("it did not end after its last word")
            return child.wait()

    @contextlib.contextmanager
    def _operator_stops(self) -> Iterator[None]:
        """Pass Ctrl-C and SIGTERM on as the operator's stop."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def handler(number: int, frame: FrameType | None) -> None:
            self.stop(OPERATOR)

        before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, old in before.items():
                signal.signal(number, old)
