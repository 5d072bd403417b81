"""Count what a verb runs until a function is called: files, functions and child processes.

    python tools/trace_verb.py calibrate runs/first/dataset
    python tools/trace_verb.py --until ControlLoop.run --list deploy cartpole --port PORT --policy policy.onnx

Runs the verb in this process and ends it when the named function is called, before its body. Counted are:

loaded
    files of this package that were imported. Whoever follows the verb may meet each of them.
files, functions
    functions of this package that were called, and the files in which they lie. Bodies of modules and
    classes, comprehensions in them, and generated methods do not count; comprehensions and functions inside
    functions count as part of the function around them.
child processes
    programs that were started, forks included.
"""

from __future__ import annotations

import argparse
import collections
import inspect
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

FIRST_FIT = ("refine", "fit_output_error")
"""The first fit of `calibrate`: of the default pipeline, and of those that compare predictions."""
STARTS = frozenset({"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.exec"})
"""Audit events of Python that start a program."""
FOLDERS = ("deal_hw", "calib", "drivers", "policies")
FUNCTION = inspect.CO_OPTIMIZED | inspect.CO_NEWLOCALS
"""Flags of the code of functions; that of modules and classes lacks the first."""

COMPREHENSIONS = frozenset({"<listcomp>", "<setcomp>", "<dictcomp>", "<genexpr>"})
"""In the body of a module or a class, they run while it is imported."""


class ReachedError(BaseException):
    """The named function was called."""


class Trace:
    """Notes which functions of a checkout run.

    Args:
        root: The checkout.
        until: Functions by their qualified names; a call of one ends the run.
    """

    def __init__(self, root: Path, until: Sequence[str]) -> None:
        self._folders = tuple(f"{root / name}/" for name in FOLDERS)
        self._root, self._until = f"{root}/", frozenset(until)
        self.functions: dict[str, set[str]] = collections.defaultdict(set)
        """Names of functions by file."""
        self.programs: list[str] = []
        self.reached = ""

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        """Note a call; for `sys.setprofile`."""
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(self._folders):
            return
        if code.co_flags & FUNCTION == FUNCTION:
            name = qualified(code)
            if name in self._until and not self.reached:
                self.reached = name
                sys.setprofile(None)
                raise ReachedError
            if name:
                self.functions[code.co_filename.removeprefix(self._root)].add(name)

    def audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Note a program that is started; for `sys.addaudithook`."""
        if event in STARTS and not self.reached:
            # A fork of `subprocess` is not told separately.
            words = arguments[1] if len(arguments) > 1 else (event,)
            self.programs.append(" ".join(map(str, words)) if isinstance(words, list | tuple) else str(words))

    def loaded(self) -> list[str]:
        """Return the files of this checkout that were imported."""
        every = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
        return sorted({file.removeprefix(self._root) for file in every if file and self._is_ours(file)})

    def _is_ours(self, file: str) -> bool:
        return file.startswith(self._folders)


def qualified(code: CodeType) -> str:
    """Return the name of a function with its class, of what is inside it that of the function; else ""."""
    name: str = getattr(code, "co_qualname", code.co_name)
    name = name.partition(".<locals>")[0]
    return "" if name.rpartition(".")[2] in COMPREHENSIONS else name


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a verb, print what ran; return 0, or 2 if the verb ended without a call of the function."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--until",
        action="append",
        metavar="NAME",
        help="a function, also several times; default: the first fit",
    )
    parser.add_argument("--list", action="store_true", help="print each file with its functions")
    parser.add_argument("words", nargs=argparse.REMAINDER, metavar="VERB ...", help="as after `deal-hw`")
    given = parser.parse_args(arguments)
    trace = traced(given.until or FIRST_FIT, given.words)
    for line in lines(trace, listed=given.list):
        print(line)
    return 0 if trace.reached else 2


def traced(until: Sequence[str], words: Sequence[str]) -> Trace:
    """Return what a verb ran before it called one of the functions."""
    trace = Trace(Path(__file__).resolve().parents[1], until)
    sys.addaudithook(trace.audit)
    threading.setprofile(trace)
    sys.setprofile(trace)
    try:
        from deal_hw.cli.main import run

        run(words[0], words[1:])
    except ReachedError:
        pass
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return trace


def lines(trace: Trace, *, listed: bool) -> Iterator[str]:
    """Yield what is printed."""
    if listed:
        for file, names in sorted(trace.functions.items()):
            yield f"{file}: {', '.join(sorted(names))}"
    count = sum(map(len, trace.functions.values()))
    yield (
        f"until {trace.reached or 'the end'}: {len(trace.loaded())} files loaded, {count} functions in "
        f"{len(trace.functions)} files called, {len(trace.programs)} child processes"
    )
    yield from (f"    {program[:100]}" for program in trace.programs)


if __name__ == "__main__":
    sys.exit(main())
