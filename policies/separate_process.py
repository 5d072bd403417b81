"""A process of its own for a network from anywhere: it may hang, crash or use all memory, and is killed then.

The process is a module of this package. It gets one end of a socket as an inherited descriptor, its parent's
process id and its limits, and answers messages.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from multiprocessing.connection import Pipe
from typing import Any, Final

from deal_hw.clock import Clock
from deal_hw.errors import PolicyError

MOST_BYTES: Final = 100_000_000
"""Longest message of the process."""
_DYING_S: Final = 1.0
_ONE_THREAD: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


class SeparateProcess:
    """Runs a module in a process of its own, and asks it.

    Args:
        module: The module, run as ``python -m module FD PARENT MEMORY_BYTES SECONDS arguments...``.
        arguments: Its further arguments.
        source: The file that it opens, for messages.
        does: What it does, for messages, such as "loading and trying the network".
        memory_bytes: Memory beyond that of its libraries.
        processor_s: Processor time, whole seconds [s].
        time_limit_s: Time for all answers together [s].
        clock: For the time limit.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        *,
        source: object,
        does: str,
        memory_bytes: int,
        processor_s: int,
        time_limit_s: float,
        clock: Clock,
    ) -> None:
        self._source, self._does = source, does
        self._processor_s, self._time_limit_s, self._clock = processor_s, time_limit_s, clock
        self._end_ns = clock.now_ns() + round(time_limit_s * 1e9)
        self._connection, theirs = Pipe()
        self._said = tempfile.TemporaryFile()
        with theirs:
            fd = theirs.fileno()
            # A session of its own: Ctrl-C in the terminal reaches only this process, which then kills it.
            self._child = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    module,
                    str(fd),
                    str(os.getpid()),
                    str(memory_bytes),
                    str(processor_s),
                    *arguments,
                ],
                pass_fds=[fd],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._said,
                start_new_session=True,
                env={**os.environ, **_ONE_THREAD},
            )

    @property
    def process_id(self) -> int:
        """Its process id."""
        return self._child.pid

    def close(self) -> None:
        """Kill the process."""
        self._child.kill()
        self._child.wait()
        self._connection.close()
        self._said.close()

    def send(self, content: bytes) -> None:
        """Send bytes.

        Raises:
            PolicyError: The process has ended; the message says how.
        """
        try:
            self._connection.send_bytes(content)
        except OSError as err:
            raise PolicyError(f"{self._source}: {self._describe_end()}") from err

    def ask(self, message: Any = None) -> dict[str, Any]:
        """Send a message of plain JSON values, None for none, and return the next answer.

        Raises:
            PolicyError: The answer is an error, comes too late, or the process has ended.
        """
        if message is not None:
            self.send(json.dumps(message).encode())
        reply: dict[str, Any] = json.loads(self.receive())
        if "error" in reply:
            raise PolicyError(reply["error"])
        return reply

    def receive(self) -> bytes:
        """Return the next message; errors as :meth:`ask`."""
        try:
            left_s = (self._end_ns - self._clock.now_ns()) * 1e-9
            if not self._connection.poll(max(left_s, 0.0)):
                raise PolicyError(
                    f"{self._source}: {self._does} was stopped after {self._time_limit_s:g} s; it is far too "
                    "slow, or this computer is too busy; give another policy, or end other programs"
                )
            return self._connection.recv_bytes(MOST_BYTES)
        except (EOFError, OSError) as err:
            raise PolicyError(f"{self._source}: {self._describe_end()}") from err

    def _describe_end(self) -> str:
        """Return text on how the process ended."""
        try:
            code = self._child.wait(_DYING_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            code = self._child.wait()
        if code == -signal.SIGXCPU:
            return (
                f"the network gave no answer within {self._processor_s} s of processor time; it "
                "loops for ever or is far too slow; give another policy"
            )
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        self._said.seek(0)
        last = self._said.read()[-400:].decode(errors="replace").strip().splitlines()
        words = f": {last[-1]}" if last else ""
        return f"the network crashes the process that runs it ({how}{words}); give another policy"
