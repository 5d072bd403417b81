"""Starts ``deal-hw emulate`` as a process of its own, for programs that need a robot on a port."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
from types import TracebackType
from typing import Self

from deal_hw.errors import TransportError

START_TIMEOUT_S = 60.0


class EmulatorProcess:
    """A running emulator; a context manager. It ends when this process ends, however that happens.

    Args:
        robot: The robot to emulate.
        options: Further command-line options, such as ``"--seed", "3"``.
    """

    def __init__(self, robot: str, *options: str) -> None:
        self._command = [
            sys.executable, "-m", "deal_hw.cli.emulate", robot, "--parent", str(os.getpid()), *options,
        ]  # fmt: skip
        self._process: subprocess.Popen[bytes] | None = None
        self.port = ""

    def start(self) -> str:
        """Start the emulator and return its port.

        Raises:
            TransportError: It did not come up; the message holds what it said.
        """
        # A session of its own: Ctrl-C in the terminal is the host's to handle, and the host needs the robot
        # for that.
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, bufsize=0
        )
        if self._process.stdout is None:
            raise TransportError("the emulator has no standard output")
        readable, _, _ = select.select([self._process.stdout], [], [], START_TIMEOUT_S)
        line = self._process.stdout.readline().decode() if readable else ""
        word, _, port = line.strip().partition(" ")
        if word != "port" or not port:
            _, errors = self.stop()
            raise TransportError(f"the emulator did not start: {errors.strip()[-2000:] or 'it said nothing'}")
        self.port = port
        return port

    def stop(self, timeout_s: float = 10.0) -> tuple[str, str]:
        """Stop the emulator; return what it printed since its first line, and its messages."""
        process, self._process = self._process, None
        if process is None:
            return "", ""
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            out, errors = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            out, errors = process.communicate()
        return out.decode(), errors.decode()

    @property
    def pid(self) -> int:
        """Process id of the running emulator.

        Raises:
            TransportError: It is not running.
        """
        if self._process is None:
            raise TransportError("the emulator is not running")
        return self._process.pid

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
