"""Runs inputs through a reader in a child process, so that a hang or a crash ends only the child."""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import mmap
import os
import random
import resource
import signal
import struct
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from deal_hw.errors import DealHwError
from fuzz.kind import FileKind, Kind

_STEP = struct.Struct("<QQQ")
"""Shared with the child: number of the input in progress, inputs read, inputs refused."""
_HARD_BYTES = 6 << 30
"""Address space that a child may add before an allocation fails [B]."""


_PATIENCE = 12
"""Limit of an input's wall-clock time over its processor time, because other programs run, too."""


class _HangError(BaseException):
    """The time limit of one input passed; no reader catches this."""


def run(kind: Kind, count: int, seed: int, limit_s: float, limit_bytes: int) -> Counter[str]:
    """Return the number of inputs read, refused and failed; input n depends on seed and n only."""
    found: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        seeds = list(kind.make(_made(Path(folder) / "make")) if isinstance(kind, FileKind) else kind.make())
        start = 0
        while start < count:
            shared = mmap.mmap(-1, _STEP.size)
            _STEP.pack_into(shared, 0, start, 0, 0)
            reading, writing = os.pipe()
            sys.stdout.flush()
            child = os.fork()
            if child == 0:
                os.close(reading)
                _child(kind, seeds, range(start, count), seed, shared, writing, limit_s, limit_bytes, folder)
            os.close(writing)
            with open(reading, encoding="utf-8", errors="replace") as report:
                failure = report.read().strip()
            _, status = os.waitpid(child, 0)
            number, read, refused = _STEP.unpack_from(shared)
            found.update(read=read, refused=refused)
            if status != 0 and not failure:
                failure = f"the process died: status {os.waitstatus_to_exitcode(status)}"
            if failure:
                found[f"FAILED: {failure.splitlines()[0]}"] += 1
                if found[f"FAILED: {failure.splitlines()[0]}"] == 1:
                    print(f"--- input {number} (seed {seed}): {failure}")
            start = number + 1
    return found


def make_input(kind: Kind, seeds: Sequence[bytes], seed: int, number: int) -> bytes:
    """Return input ``number`` of a seed."""
    rng = random.Random(f"{seed}:{number}")
    return rng.choice(kind.mutations)(rng, rng.choice(seeds), seeds)


def _child(
    kind: Kind,
    seeds: Sequence[bytes],
    numbers: range,
    seed: int,
    shared: mmap.mmap,
    writing: int,
    limit_s: float,
    limit_bytes: int,
    folder: str,
) -> None:
    """Read inputs until one fails; ends the process."""
    failure = ""
    try:
        _guard()
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        base = _forget_peak()
        read = refused = 0
        for number in numbers:
            _STEP.pack_into(shared, 0, number, read, refused)
            data = make_input(kind, seeds, seed, number)
            # A hang inside C code never reaches the signal's handler, so the process is ended.
            faulthandler.dump_traceback_later(2 * _PATIENCE * limit_s, exit=True)
            outcome = _outcome(kind, data, Path(folder) / "read", limit_s)
            faulthandler.cancel_dump_traceback_later()
            if _peak() - base > limit_bytes:
                outcome = f"more than {limit_bytes >> 20} MiB of memory"
            if outcome not in ("read", "refused"):
                failure = outcome
                break
            read, refused = read + (outcome == "read"), refused + (outcome == "refused")
        _STEP.pack_into(shared, 0, number, read, refused)
    except BaseException:
        failure = f"the fuzzer itself failed\n{traceback.format_exc()}"
    os.write(writing, failure.encode("utf-8", "backslashreplace")[:60_000])
    os._exit(0)


def _guard() -> None:
    def ring(number: int, frame: object) -> None:
        raise _HangError

    signal.signal(signal.SIGALRM, ring)
    signal.signal(signal.SIGPROF, ring)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + _HARD_BYTES, hard))


def _forget_peak() -> int:
    """Return the memory in use, above which the peak is counted from now on [B].

    The parent's garbage is not collected, because an input could fill the freed memory without being noticed.
    """
    gc.freeze()
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak()


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _outcome(kind: Kind, data: bytes, folder: Path, limit_s: float) -> str:
    """Return "read", "refused", or the failure in the first line and its traceback below."""
    source: Path | bytes = data
    if isinstance(kind, FileKind):
        _clear(folder)
        source = folder / kind.name
        source.parent.mkdir(parents=True, exist_ok=True)
        source.write_bytes(data)
    try:
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        signal.setitimer(signal.ITIMER_REAL, _PATIENCE * limit_s)
        try:
            kind.read(source)  # type: ignore[arg-type]
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
    except _HangError:
        return f"more than {limit_s:g} s\n{traceback.format_exc()}"
    except DealHwError as error:
        return _judged(str(error))
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        at = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}"
        ours = next((f for f in reversed(frames) if "site-packages" not in f.filename), frames[-1])
        return f"{type(error).__name__} at {at}, from {Path(ours.filename).name}:{ours.lineno}\n" + (
            traceback.format_exc()
        )
    return "read"


def _judged(message: str) -> str:
    """Return "refused" for a message that a user can be shown."""
    if not message.strip():
        return "refused without a message"
    if len(message.splitlines()) > 1:
        return f"a message of several lines\n{message[:2000]}"
    if len(message) > 1000:
        return f"a message of more than 1000 characters\n{message[:2000]}"
    try:
        message.encode()
    except UnicodeEncodeError:
        return f"a message that no terminal can print\n{message!r}"
    return "refused"


def _clear(folder: Path) -> None:
    """Remove the last input's files."""
    for path, folders, files in os.walk(folder, topdown=False):
        for name in files:
            os.unlink(os.path.join(path, name))
        for name in folders:
            with contextlib.suppress(NotADirectoryError):
                os.rmdir(os.path.join(path, name))
    folder.mkdir(exist_ok=True)


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder
