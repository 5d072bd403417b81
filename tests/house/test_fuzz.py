"""The fuzzer finds each kind of failure, and every reader survives a few inputs."""

from __future__ import annotations

import faulthandler
import gc
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOL = ROOT / "tools" / "fuzz_files.py"


def listed() -> list[str]:
    """Return the names of all kinds."""
    printed = subprocess.run([sys.executable, TOOL, "--list"], capture_output=True, text=True, check=True)
    return printed.stdout.split()


@pytest.mark.slow
def test_every_kind_survives_a_few_inputs() -> None:
    """No traceback, hang, long message or gigabyte in thirty inputs of each kind."""
    done = subprocess.run(
        [sys.executable, TOOL, "--count", "30", "--seed", "7"], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == listed()


def fail(data: bytes) -> None:
    raise KeyError("a")


def hang(data: bytes) -> None:
    while True:
        pass


def swallow_and_hang(data: bytes) -> None:
    try:
        hang(data)
    except Exception:
        return


def grow(data: bytes) -> None:
    bytearray(b"x" * (50 << 20))


def die(data: bytes) -> None:
    # pytest's fault handler would print this process's stack among the results of other tests.
    faulthandler.disable()
    os.abort()


def talk(data: bytes) -> None:
    from deal_hw.errors import DatasetError

    raise DatasetError("one line\nand another")


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (fail, "KeyError at test_fuzz.py"),
        (hang, "more than 0.5 s"),
        (swallow_and_hang, "more than 0.5 s"),
        (grow, "more than 40 MiB of memory"),
        (die, "the process died: status -6"),
        (talk, "a message of several lines"),
    ],
)
def test_failures_are_counted(
    read: Callable[[bytes], None], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each failure ends one input and has its name, and the run goes on."""
    monkeypatch.syspath_prepend(str(TOOL.parent))
    from fuzz.kind import WireKind
    from fuzz.mutations import damage_bytes
    from fuzz.run import run

    kind = WireKind(make=lambda: [b"good"], read=read, mutations=(damage_bytes,))
    found = run(kind, 2, 0, limit_s=0.5, limit_bytes=40 << 20)
    (failure,) = [what for what in found if what.startswith("FAILED")]
    assert words in failure and found[failure] == 2 and found["read"] == found["refused"] == 0


class Garbage:
    """Memory that only the collector frees."""

    def __init__(self) -> None:
        self.itself = self
        # Touched page by page: a copy that is freed would leave room in the heap for what grows later.
        self.memory = bytearray(120 << 20)
        self.memory[::4096] = b"x" * (120 << 20 >> 12)


def collect_and_grow(data: bytes) -> None:
    gc.collect()
    grow(data)


def test_garbage_of_the_parent_hides_no_growth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests that ran before left garbage: memory that an input takes counts, whatever is freed meanwhile."""
    monkeypatch.syspath_prepend(str(TOOL.parent))
    from fuzz.kind import WireKind
    from fuzz.mutations import damage_bytes
    from fuzz.run import run

    kind = WireKind(make=lambda: [b"good"], read=collect_and_grow, mutations=(damage_bytes,))
    gc.disable()
    try:
        Garbage()
        assert run(kind, 1, 0, limit_s=30.0, limit_bytes=40 << 20)["FAILED: more than 40 MiB of memory"] == 1
    finally:
        gc.enable()
        gc.collect()
