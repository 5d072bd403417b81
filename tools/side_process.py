"""Run the two processes of a measurement of a wire: they read orders and print lines."""

from __future__ import annotations

import contextlib
import json
import select
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

from deal_hw.errors import TransportError


class SideProcess:
    """One of the two processes; it is ended with the block.

    Args:
        script: The program of both.
        name: "controller" or "robot".
        orders: Its orders on standard input.
    """

    def __init__(self, script: Path, name: str, orders: Mapping[str, Any]) -> None:
        self._name = name
        # A session of its own, so that only this process handles Ctrl-C in the terminal.
        self._process = subprocess.Popen(
            [sys.executable, str(script), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            bufsize=0,
        )
        with _pipe(self._process.stdin) as orders_pipe:
            orders_pipe.write(json.dumps(orders).encode())
        self._process.stdin = None  # Otherwise communicate() would flush it.
        self._out = b""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def stop(self) -> None:
        """Request its end and its result."""
        self._process.terminate()

    def expect(self, word: str, timeout_s: float) -> None:
        """Wait for a line.

        Raises:
            TransportError: Another came, or none in time.
        """
        line = self._line(timeout_s)
        if line != word:
            raise self._failed(line)

    def result(self, timeout_s: float, update: Callable[[float], None] | None = None) -> dict[str, Any]:
        """Wait for the result, and pass the elapsed seconds to ``update``.

        Raises:
            TransportError: The process failed, or printed nothing in time.
        """
        values: dict[str, Any] = json.loads(self._line(timeout_s, update) or "null") or {"error": "no result"}
        if "error" in values:
            raise self._failed(values["error"])
        return values

    def __enter__(self) -> SideProcess:
        return self

    def __exit__(self, *_: object) -> None:
        # SIGKILL ends a stopped process, too.
        self._process.kill()
        self._process.communicate()

    def _line(self, timeout_s: float, update: Callable[[float], None] | None = None) -> str:
        out, begun = _pipe(self._process.stdout), time.monotonic()
        while b"\n" not in self._out:
            passed = time.monotonic() - begun
            if passed > timeout_s:
                raise TransportError(f"the {self._name}'s process printed nothing for {timeout_s:g} s")
            if update is not None:
                update(passed)
            if select.select([out], [], [], 0.2)[0]:
                part = out.read(65536)
                if not part:
                    return ""
                self._out += part
        line, _, self._out = self._out.partition(b"\n")
        return line.decode()

    def _failed(self, printed: str) -> TransportError:
        self._process.kill()
        _, errors = self._process.communicate()
        with contextlib.suppress(ValueError, TypeError, KeyError):
            printed = json.loads(printed)["error"]
        return TransportError(
            f"the {self._name}'s process failed: {printed} {errors.decode().strip()[-2000:]}"
        )


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    """Return the requested pipe."""
    if pipe is None:
        raise TransportError("a process was started without its pipes")
    return pipe
