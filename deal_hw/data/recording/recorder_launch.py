"""Starts a recorder process and keeps its ends: the socket for the control process and the status pipe."""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deal_hw.child_process import own_process_group
from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import DatasetError
from deal_hw.load import TimeLimit
from deal_hw.signals import held_back

_POLL_S = 1.0


@dataclass(frozen=True, slots=True)
class RecorderOutcome:
    """How a recording ended.

    Attributes:
        complete: Every accepted record is in the file, and the file is closed properly.
        cycles: Cycles written.
        states: State samples written.
        errors: Errors, as texts.
    """

    complete: bool
    cycles: int
    states: int
    errors: tuple[str, ...]


class RecorderHandle:
    """A running recorder process; made by :func:`start_recorder`.

    Attributes:
        control_socket: The end for the control process, non-blocking. Pass its descriptor on, then call
            :meth:`release`: the recorder ends when the last copy is closed.
        process: The recorder process.
    """

    def __init__(
        self, control_socket: socket.socket, process: subprocess.Popen[bytes], status: int, clock: Clock
    ) -> None:
        self.control_socket = control_socket
        self.process = process
        self._status = status
        self._clock = clock
        self._pending = b""
        self._ended = False
        self._errors: list[str] = []
        self._ready = False
        self._finished: dict[str, Any] | None = None

    def wait_ready(self, own_s: float = 10.0) -> None:
        """Wait until the episode is open.

        Args:
            own_s: The time that the process may take, without that in which it waits for a processor [s].

        Raises:
            DatasetError: The file cannot be written, or the process did not come up in time.
        """
        limit = TimeLimit(self.process.pid, own_s, self._clock)
        while not self._ready and not self._errors and not self._ended and (left_s := limit.left_s) > 0:
            self._poll(min(left_s, _POLL_S))
        if self._errors:
            raise DatasetError(f"the recorder cannot start: {self._errors[0]}")
        if self._ended and not self._ready:
            raise DatasetError("the recorder process ended before it had started; check memory and disk")
        if not self._ready:
            raise DatasetError(f"the recorder process did not start in its time, {limit}")

    def errors(self) -> tuple[str, ...]:
        """Return the errors so far, such as a full disk; polls the status pipe, never waits."""
        self._poll(0.0)
        return tuple(self._errors)

    def release(self) -> None:
        """Close this process's copy of the control end; idempotent."""
        self.control_socket.close()

    def finish(self, own_s: float = 10.0) -> RecorderOutcome:
        """Close the control end and wait for the file to be closed; a recorder that hangs is killed.

        Args:
            own_s: As of :meth:`wait_ready`.
        """
        self.release()
        limit = TimeLimit(self.process.pid, own_s, self._clock)
        while not self._ended and (left_s := limit.left_s) > 0:
            self._poll(min(left_s, _POLL_S))
        if not self._ended:
            self._errors.append(f"the recorder was killed, since it did not end in its time, {limit}")
            self.process.kill()
            self._ended = True
        code = self.process.wait()
        if self._status >= 0:
            os.close(self._status)
            self._status = -1
        counts = self._finished or {"complete": False, "cycles": 0, "states": 0}
        if self._finished is None and not self._errors:
            self._errors.append(f"the recorder process ended without a report (exit code {code})")
        return RecorderOutcome(counts["complete"], counts["cycles"], counts["states"], tuple(self._errors))

    def _poll(self, timeout_s: float) -> None:
        if self._ended or not select.select([self._status], [], [], max(timeout_s, 0.0))[0]:
            return
        data = os.read(self._status, 65536)
        self._ended = not data
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            report = json.loads(line)
            if report["kind"] == "error":
                self._errors.append(report["message"])
            elif report["kind"] == "ready":
                self._ready = True
            else:
                self._finished = report


def start_recorder(path: Path, description: Mapping[str, Any], metadata: Mapping[str, Any]) -> RecorderHandle:
    """Start a recorder process.

    Args:
        path: The episode file to create.
        description: ``RobotDescription.to_json()``.
        metadata: Plain JSON values: robot, description digest, purpose, policy, task, ...
    """
    control_end, recorder_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    control_end.setblocking(False)
    status_read, status_write = os.pipe2(os.O_CLOEXEC)
    config = os.memfd_create("recorder-config")
    with open(os.dup(config), "w", encoding="utf-8") as file:
        json.dump({"description": description, "metadata": metadata}, file)
    os.lseek(config, 0, os.SEEK_SET)
    inherited = (recorder_end.fileno(), config, status_write)
    command = [sys.executable, "-m", "deal_hw.data.recording.recorder_process", "--fd", str(inherited[0])]
    command += ["--path", str(path), "--config-fd", str(config), "--status-fd", str(status_write)]
    try:
        # A process group of its own keeps the terminal's Ctrl-C away even while the interpreter starts.
        with held_back():
            process = subprocess.Popen(
                command, pass_fds=inherited, stdin=subprocess.DEVNULL, **own_process_group()
            )
    finally:
        recorder_end.close()
        os.close(config)
        os.close(status_write)
    return RecorderHandle(control_end, process, status_read, MonotonicClock())
