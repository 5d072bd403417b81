"""What a run says of itself to other programs on this computer: its robot, how that is reached, how it is.

The note is a file in memory, named after the robot. The run's supervisor and control process keep it open, so
it is gone when both have ended, however they end. Other programs of the same user find it in ``/proc``. The
supervisor writes until when it may be silent, so that others see whether it hangs.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

_NAME = "deal-hw-run:"
_LONGEST_NAME = 50
"""The system takes 249 bytes; a robot may be the path of a file."""


class RunNote:
    """The note of this process's run; a context manager.

    Args:
        robot: The robot's name.
        facts: How it is reached, as plain JSON values.
    """

    def __init__(self, robot: str, facts: Mapping[str, Any]) -> None:
        self._robot = robot
        fixed = {"robot": robot, "pid": os.getpid()}
        self._facts = {**facts, **fixed, "passive": True, "silent_until_ns": None}
        self._fd = -1

    def fileno(self) -> int:
        """Return the descriptor that the control process inherits."""
        return self._fd

    def say_passive(self, passive: bool | None) -> None:
        """Say whether the robot is passive, or was not commanded yet.

        Args:
            passive: Whether it confirmed that it is; None while it may be commanded.
        """
        self._facts["passive"] = passive
        self._write()

    def beat(self, silent_until_ns: int) -> None:
        """Say that the run works.

        Args:
            silent_until_ns: When the next call comes at the latest, on the machine's monotonic clock [ns].
        """
        self._facts["silent_until_ns"] = silent_until_ns
        self._write()

    def _write(self) -> None:
        text = json.dumps(self._facts).encode()
        # One write at one place, then the rest goes: a reader meets one of the two texts, or tries again.
        os.pwrite(self._fd, text, 0)
        os.ftruncate(self._fd, len(text))

    def __enter__(self) -> Self:
        self._fd = os.memfd_create(_NAME + Path(self._robot).name[:_LONGEST_NAME])
        self.say_passive(True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._fd)


@dataclass(frozen=True, slots=True)
class FoundRun:
    """Another program's run; a context manager that closes the note.

    Attributes:
        fd: Its note.
        pid: The process that the operator started.
        facts: The note's text when it was found.
    """

    fd: int
    pid: int
    facts: Mapping[str, Any]

    @property
    def passive(self) -> bool | None:
        """Whether its robot is passive by now; None while it may be commanded."""
        found: bool | None = (_read(self.fd) or self.facts)["passive"]
        return found

    def hangs(self, now_ns: int) -> bool:
        """Return whether the run is silent for longer than it may be; False while it promises nothing.

        Args:
            now_ns: The machine's monotonic clock [ns].
        """
        until_ns = (_read(self.fd) or self.facts).get("silent_until_ns")
        return until_ns is not None and now_ns > until_ns

    def holders(self) -> list[int]:
        """Return the processes of the run that live: it, and its control process."""
        mine = os.fstat(self.fd)
        return [
            pid
            for pid, path in _notes()
            if pid != os.getpid()
            and (found := _stat(path)) is not None
            and (found.st_dev, found.st_ino) == (mine.st_dev, mine.st_ino)
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self.fd)


def find_runs() -> list[FoundRun]:
    """Return the runs on this computer that this user may look at, except those of this process."""
    found: dict[int, FoundRun] = {}
    for pid, path in _notes():
        if pid == os.getpid():
            continue
        with contextlib.suppress(OSError):
            fd = os.open(path, os.O_RDONLY)
            facts = _read(fd)
            # The control process has the note, too. A process that has ended left it to its child.
            if facts is None or facts["pid"] in found:
                os.close(fd)
            else:
                found[facts["pid"]] = FoundRun(fd, facts["pid"], facts)
    return list(found.values())


def _notes() -> Iterator[tuple[int, Path]]:
    """Yield each process with a note, and the path of the note."""
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            with contextlib.suppress(OSError):
                for path in (process / "fd").iterdir():
                    if os.readlink(path).startswith(f"/memfd:{_NAME}"):
                        yield int(process.name), path
                        break


def _stat(path: Path) -> os.stat_result | None:
    with contextlib.suppress(OSError):
        return path.stat()
    return None


def _read(fd: int) -> dict[str, Any] | None:
    """Return the note's text; None where it is just being written."""
    with contextlib.suppress(ValueError):
        facts = json.loads(os.pread(fd, os.fstat(fd).st_size, 0))
        if isinstance(facts, dict) and {"pid", "passive", "robot"} <= set(facts):
            return facts
    return None
