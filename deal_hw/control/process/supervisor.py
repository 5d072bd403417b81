"""The supervisor: starts and watches the control process; makes the robot passive if that process cannot.

It owns the port as long as it lives. No other program can then take the robot, and the passive command can
still be sent after the control process has died. It never sends while the control process lives: two writers
on one port would corrupt each other's frames. It sends nothing if the control process had not begun to
command the robot. The control process also watches the supervisor ( :mod:`deal_hw.control.process.watchdog`).
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from deal_hw.child_process import own_process_group
from deal_hw.clock import Clock, MonotonicClock
from deal_hw.control.process.channel import (
    BUFFER_BYTES,
    HEARTBEAT,
    LOADING,
    STARTING,
    Beat,
    StatusReceiver,
    socket_pair,
)
from deal_hw.control.process.realtime import priority, raise_priority
from deal_hw.control.process.run_note import RunNote
from deal_hw.control.process.watchdog import SUPERVISOR_SILENCE_S
from deal_hw.data.recording.recorder_launch import RecorderHandle, RecorderOutcome
from deal_hw.load import TimeLimit
from deal_hw.priorities import SUPERVISOR_PRIORITY
from deal_hw.signals import held_back, name, reason, taken

START_SILENCE_S = 30.0
"""How long a new control process may take to import and load before its first heartbeat [s], without the time
in which it waits for a processor."""
PATIENCE_S = 1.0
"""A control process that was asked to end is killed by a further request only after this time [s]. It needs
0.25 s at most (measured). A session that ends sends SIGTERM and SIGHUP to each process, and a key that is
held repeats."""
_POLL_S = 0.05
AWAY_S = 0.8
"""A supervisor that did not run for this long, since it was stopped, may find another commander [s]: a claim
on a robot's wire expires after this time."""
GRACE_S = 3.0
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
        note: Where other programs read how the run is; the control process keeps it open, too.
        patience_s: Time after which a further request to end kills the control process [s].
        grace_s: Time for the control process to exit after it closed its end of the channel [s].
    """

    _stale_ns: int
    _limit: TimeLimit

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
        note: RunNote | None = None,
        patience_s: float = PATIENCE_S,
        grace_s: float = GRACE_S,
    ) -> None:
        self._note = note
        self._keep_fds = tuple(keep_fds) if note is None else (*keep_fds, note.fileno())
        self._patience_ns, self._grace_s = round(patience_s * 1e9), grace_s
        self._module, self._plan, self._port_fd, self._passive = module, plan, port_fd, passive
        self._recorder, self._on_beat, self._clock = recorder, on_beat, clock or MonotonicClock()
        self._child: subprocess.Popen[bytes] | None = None
        self._status: StatusReceiver | None = None
        self._result: dict[str, Any] | None = None
        self._killed = self._stop_cause = self._signal = ""
        self._asked_ns = self._beat_ns = 0
        self._phase = STARTING
        self._ran_ns: int | None = None
        self.was_away = False
        """Whether this process did not run for :data:`AWAY_S`, while its control process commanded."""

    def run(self) -> ChildEnd:
        """Run the control process to its end, then make the robot passive and close the recording."""
        with taken(self._signalled), priority(SUPERVISOR_PRIORITY, lock=True):
            self._say_passive(None)
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
                self._say_passive(confirmed)
                outcome = self._recorder.finish() if self._recorder is not None else None
                status.close()
        return ChildEnd(
            self._result, exit_code, self._killed, self._stop_cause, confirmed, outcome, self._signal
        )

    def stop(self, cause: str, number: int = signal.SIGTERM) -> None:
        """Ask the control process to end by its passive route; a request much later kills it.

        Args:
            cause: Why; the first one counts.
            number: The signal by which it is asked.
        """
        again, self._stop_cause = bool(self._stop_cause), self._stop_cause or cause
        if not again:
            self._asked_ns = self._clock.now_ns()
        child = self._child
        if child is None or child.returncode is not None:
            return
        if not again:
            child.send_signal(number)
        elif self._clock.now_ns() - self._asked_ns >= self._patience_ns:
            self._kill(child, "it did not end when it was asked, and was asked again")

    def _signalled(self, number: int) -> None:
        """Ask the control process to end, by the same signal, so that it knows the reason, too."""
        self._signal = self._signal or name(number)
        self.stop(reason(number), number)

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
        # A file, not a pipe: no signal of a broken pipe, and no wait for a child that does not read.
        with sender, open(os.memfd_create("orders"), "w+b") as orders, held_back():
            orders.write(json.dumps(plan).encode())
            orders.seek(0)
            # In its own process group: Ctrl-C in the terminal reaches only the supervisor, which passes it
            # on.
            child = subprocess.Popen(
                [sys.executable, "-m", self._module],
                pass_fds=inherited,
                stdin=orders,
                **own_process_group(),
            )
        self._child = child
        if self._recorder is not None:
            self._recorder.release()
        if self._stop_cause:
            child.send_signal(signal.SIGTERM)
        self._stale_ns = self._clock.now_ns() + round(START_SILENCE_S * 1e9)
        self._limit = TimeLimit(child.pid, START_SILENCE_S, self._clock)
        self._status = StatusReceiver(receiver)
        return child, self._status

    def _watch(self, child: subprocess.Popen[bytes], status: StatusReceiver) -> None:
        """Return after the control process has sent its last message, has died or was killed."""
        while status.open:
            if (now_ns := self._clock.now_ns()) >= self._beat_ns:
                status.tell(HEARTBEAT)
                self.promise(SUPERVISOR_SILENCE_S)
                self._beat_ns = now_ns + round(_POLL_S * 1e9)
            left_s = (self._due_ns() - self._clock.now_ns()) * 1e-9
            ready = select.select([status], [], [], min(_POLL_S, max(left_s, 0.0) + 1e-3))[0]
            self._notice_absence()
            if ready:
                while (message := status.receive()) is not None:
                    self._take(message)
            # Only after a wait without messages: if the supervisor itself was delayed, old heartbeats are
            # still waiting.
            elif self._clock.now_ns() > self._due_ns():
                limit = f" in its time, {self._limit}" if self._starts else ""
                self._kill(child, f"it sent no heartbeat while {self._phase}{limit}")
                return
            if self._recorder is not None and not self._stop_cause and (errors := self._recorder.errors()):
                self.stop(f"the recorder failed: {errors[0]}")

    @property
    def _starts(self) -> bool:
        """Whether the control process imports and loads, at ordinary priority, and commands nothing yet."""
        return self._phase in (STARTING, LOADING)

    def _due_ns(self) -> int:
        """Return when the next heartbeat is overdue [ns]; who starts may wait for a processor longer."""
        return self._stale_ns + (round(self._limit.waited_s * 1e9) if self._starts else 0)

    def _take(self, message: Beat | dict[str, Any]) -> None:
        if isinstance(message, Beat):
            self._stale_ns, self._phase = message.stale_ns, message.phase
            self._on_beat(message)
        else:
            self._result = message
            if message.get("passive_confirmed"):
                # At once: the control process may take seconds to exit.
                self._say_passive(True)

    def promise(self, silence_s: float) -> None:
        """Say to other programs that this process works, and how long it may be silent from now on [s]."""
        if self._note is not None:
            self._note.beat(self._clock.now_ns() + round(silence_s * 1e9))

    def _say_passive(self, passive: bool | None) -> None:
        if self._note is not None:
            self._note.say_passive(passive)

    def _notice_absence(self) -> None:
        now_ns = self._clock.now_ns()
        if self._ran_ns is not None and now_ns - self._ran_ns > round(AWAY_S * 1e9):
            self.was_away = True
        self._ran_ns = now_ns

    def _kill(self, child: subprocess.Popen[bytes], why: str) -> None:
        # SIGKILL also ends a process stopped by SIGSTOP.
        self._killed = self._killed or why
        child.kill()
        raise_priority(child.pid)

    def _reap(self, child: subprocess.Popen[bytes]) -> int:
        """Return the exit code of the control process, which sends no more messages."""
        self.promise(self._grace_s + SUPERVISOR_SILENCE_S)
        try:
            # A wait with a limit polls with pauses of up to 50 ms, in which a robot may be stiff.
            return child.wait() if self._killed else child.wait(self._grace_s)
        except subprocess.TimeoutExpired:
            self._kill(child, "it did not end after its last message")
            return child.wait()
