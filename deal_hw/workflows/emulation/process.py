"""Starts a verb that serves a port in its own process, for programs that need a robot."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from typing_extensions import Self

from deal_hw.clock import MonotonicClock
from deal_hw.errors import TransportError
from deal_hw.load import TimeLimit
from deal_hw.ranges import option

START_S = 60.0
"""How long a verb may take to print its port, without the time in which it waits for a processor [s]."""
_POLL_S = 1.0


class VerbProcess:
    """A running verb that prints ``port PORT`` first; a context manager.

    It ends when this process ends, in any way.

    Args:
        verb: The verb.
        arguments: Its options, as on the command line.
        what: Its name in messages; by default from the verb.
        prefix: A command under which it runs, such as ``ip netns exec NAME``.
    """

    def __init__(self, verb: str, *arguments: str, what: str = "", prefix: Sequence[str] = ()) -> None:
        self._what = what or f"deal-hw {verb}"
        self._command = [
            *prefix,
            sys.executable,
            "-m",
            "deal_hw",
            verb,
            "--parent",
            str(os.getpid()),
            *arguments,
        ]
        self._process: subprocess.Popen[bytes] | None = None
        self.port = ""

    def start(self) -> str:
        """Start it and return its port.

        Raises:
            TransportError: It did not start; the message contains its output.
        """
        # In its own session: the host handles Ctrl-C in the terminal and needs the robot for that.
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, bufsize=0
        )
        if self._process.stdout is None:
            raise TransportError(f"{self._what} has no standard output")
        limit = TimeLimit(self._process.pid, START_S, MonotonicClock())
        readable: list[Any] = []
        while not readable and (left_s := limit.left_s) > 0:
            readable = select.select([self._process.stdout], [], [], min(left_s, _POLL_S))[0]
        line = self._process.stdout.readline().decode() if readable else ""
        word, _, port = line.strip().partition(" ")
        if word != "port" or not port:
            why = "it ended without a message" if readable else f"not in its time, {limit}"
            _, errors = self.stop()
            raise TransportError(f"{self._what} did not start: {errors.strip()[-2000:] or why}")
        self.port = port
        return port

    def stop(self, timeout_s: float = 10.0) -> tuple[str, str]:
        """Stop it; return its output after the first line, and its messages."""
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
        """Its process id.

        Raises:
            TransportError: It is not running.
        """
        if self._process is None:
            raise TransportError(f"{self._what} is not running")
        return self._process.pid

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop it. If it had ended by itself, this explains why the robot became unreachable.

        Raises:
            TransportError: It had ended, and the block ended in an error of a transport.
        """
        status = self._process.poll() if self._process is not None else None
        _, errors = self.stop()
        if status is not None and isinstance(error, TransportError):
            raise TransportError(
                f"{self._what} ended by itself with status {status}, so its port is gone; its last "
                f"messages: {errors.strip()[-500:] or 'none'}"
            ) from error


class EmulatorProcess(VerbProcess):
    """A running emulator.

    Args:
        robot: The robot to emulate.
        options: Further command-line options, such as ``"--seed", "3"``.
    """

    def __init__(self, robot: str, *options: str) -> None:
        super().__init__("emulate", robot, *options, what="the emulator")


def arguments(settings: Any, default: Any) -> list[str]:
    """Return the command-line options for the settings that differ from a verb's defaults.

    Args:
        settings: A settings dataclass, possibly nested.
        default: The same without options.
    """
    words: list[str] = []
    for field in dataclasses.fields(settings):
        value, usual = getattr(settings, field.name), getattr(default, field.name)
        flag = option(field.name)
        if value == usual:
            continue
        if dataclasses.is_dataclass(value):
            words += arguments(value, usual)
        elif isinstance(value, bool):
            words.append(flag if value else flag.replace("--", "--no-", 1))
        else:
            words += [flag, *map(str, value if isinstance(value, tuple) else (value,))]
    return words
