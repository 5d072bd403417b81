"""The `deal-hw` command: finds the verb, passes its settings, and prints an error as one line."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any, TextIO, cast

from deal_hw.cli.verbs import JOBS, TOOLS, Verb
from deal_hw.cli.verbs import VERBS as VERBS
from deal_hw.documentation import page
from deal_hw.errors import DealHwError, MissingExtraError, UnknownNameError, short
from deal_hw.version import __version__

EXIT_OK = 0
EXIT_ERROR = 2
"""The request, a file or a device caused an error; the message names it."""
EXIT_INTERRUPTED = 130
"""Ctrl-C, as shells count it: 128 + SIGINT."""
EXIT_PIPE = 141
"""The reader of the output has closed it, as with ``| head``; as shells count it: 128 + SIGPIPE."""

LONGEST_MESSAGE = 2000
"""Longest error in one line [characters]: part of it may come from a file of unknown origin."""
TRACEBACK_VARIABLE = "DEAL_HW_TRACEBACK"


def help_text() -> str:
    """Return what `deal-hw --help` prints."""
    lines = [
        f"deal-hw {__version__}: record a robot, calibrate its simulator, retrain, deploy, compare.",
        "",
        "usage: deal-hw VERB [options]      deal-hw VERB --help lists the options of a verb",
    ]
    for title, verbs in (("the five jobs, in order", JOBS), ("tools", TOOLS)):
        lines += ["", f"{title}:"]
        for name, verb in verbs.items():
            lines += [f"  {name:<17} {verb.help}", f"  {'':<17}   deal-hw {verb.example}"]
    lines += [
        "",
        "No robot at hand? `deal-hw demo` needs none; `deal-hw emulate cartpole` prints a port to use.",
        "with every verb: --help explains its options; --help-all rare ones, too",
        f"with every verb: --traceback (or {TRACEBACK_VARIABLE}=1) shows the code that raised an error",
        "without a verb: --help, --version; --completion bash (or zsh) prints a script for the Tab key",
        f"documentation: {page('index.md')}; messages and help texts name its pages",
    ]
    return "\n".join(lines)


def find(name: str) -> Verb:
    """Return the verb of that name.

    Raises:
        UnknownNameError: There is no such verb; the message lists all verbs, and one of a similar name.
    """
    if name in VERBS:
        return VERBS[name]
    import difflib

    error = UnknownNameError("verb", name, VERBS)
    near = difflib.get_close_matches(name, VERBS, n=1)
    if near:
        error.args = (f"{error}; did you mean {near[0]!r}?",)
    raise error


def parse(name: str, arguments: Sequence[str]) -> tuple[Any, Callable[[Any], object]]:
    """Return a verb's settings, parsed from its command-line arguments, and the function that takes them.

    Raises:
        UnknownNameError: There is no such verb, or no such kind of its input.
        DealHwError: The arguments do not parse, or a setting refuses its value.
        SystemExit: The arguments are --help.
    """
    verb = find(name)
    import importlib

    module = importlib.import_module(verb.module)
    config, settings = getattr(module, verb.config), None
    if verb.urgent:
        from deal_hw.cli.plain_words import plain_settings

        settings = plain_settings(config, arguments)
    if settings is None:
        from deal_hw.cli.parsing import read_settings

        settings = read_settings(name, verb, config, arguments, getattr(module, "check_words", None))
    return settings, getattr(module, verb.function)


def run(name: str, arguments: Sequence[str]) -> int:
    """Run a verb with its command-line arguments and return its exit code.

    Raises:
        DealHwError: The arguments do not parse, the verb failed, or an extra is missing.
        SystemExit: The arguments are --help.
    """
    try:
        settings, function = parse(name, arguments)
        if name != "doctor" and not find(name).urgent:
            _name_problems()
        result = function(settings)
    except ModuleNotFoundError as err:
        package = (err.name or "").partition(".")[0]
        if isinstance(err, DealHwError) or package in {"", "deal_hw"}:
            raise
        raise MissingExtraError(package, find(name).extra or "all") from err
    code = getattr(result, "exit_code", result)
    return code if isinstance(code, int) and not isinstance(code, bool) else EXIT_OK


def _name_problems() -> None:
    """Print a line for each plug-in that is left out, if the verb uses the table of robots.

    ``deal-hw doctor`` shows them among its findings. An urgent verb does not load them.
    """
    if "deal_hw.robots" in sys.modules:
        from deal_hw.robots import plug_ins

        for one in plug_ins():
            if one.problem:
                print(f"deal-hw: warning: {one.problem}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code.

    Args:
        arguments: Arguments after `deal-hw` on the command line; by default those of this process.
    """
    _occupy_standard_streams()
    code = EXIT_INTERRUPTED
    try:
        with contextlib.redirect_stderr(cast(TextIO, _Stderr(sys.stderr))):
            code = _answer(list(sys.argv[1:] if arguments is None else arguments))
        if arguments is None:
            # The verb is done and has printed its result. From here a Ctrl-C must change nothing.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        if _flushed():
            return code
    except BrokenPipeError:
        if not _reader_is_gone():
            raise
    except KeyboardInterrupt:
        # Between the end of the verb and here.
        return code
    except SystemExit:
        if _flushed():
            raise
    finally:
        if arguments is None:
            # The process ends. Python would look through all objects for garbage once more, and after torch
            # was loaded that takes 0.4 s, on a busy computer 5 to 12 s.
            gc.freeze()
    # The interpreter flushes once more at its end, and would report an error.
    _to_nowhere(sys.stdout)
    return EXIT_PIPE


@contextlib.contextmanager
def _terminated_like_ctrl_c() -> Iterator[None]:
    """Let SIGTERM end the verb as Ctrl-C does: files become whole, and child processes end.

    A verb that drives or emulates a robot takes signals itself.
    """
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return
    came = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = True
        raise KeyboardInterrupt

    before: dict[signal.Signals, Any] = {signal.SIGTERM: signal.SIG_DFL}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        before[signal.SIGINT] = signal.default_int_handler
    for number in before:
        signal.signal(number, interrupt)
    try:
        yield
    except ImportError:
        # A library's compiled module, while it loads, makes an error of its own of the interrupt.
        if came:
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _to_nowhere(stream: TextIO) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class _Stderr:
    """The error output. If its reader closes it, the work continues, with the same exit code."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):
            # Text left in the buffer would fail again at the interpreter's end and change the exit code.
            with contextlib.suppress(OSError, ValueError):
                _to_nowhere(self._stream)
        return len(text)

    def flush(self) -> None:
        self.write("")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _occupy_standard_streams() -> None:
    """Open the null device for each standard stream that the process was started without.

    Otherwise the next opened file, a recording or a robot's port, gets the stream's number, and a library's
    prints go into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")


def _answer(given: list[str]) -> int:
    show_traceback = "--traceback" in given or os.environ.get(TRACEBACK_VARIABLE, "0") not in {"", "0"}
    given = [word for word in given if word != "--traceback"]
    try:
        if not given or given[0] in {"-h", "--help", "help"}:
            print(help_text())
            return EXIT_OK
        if given[0] == "--version":
            print(f"deal-hw {__version__}")
            return EXIT_OK
        if given[0] == "--completion":
            from deal_hw.cli.completion import completion

            print(completion(given[1] if len(given) > 1 else "", VERBS), end="")
            return EXIT_OK
        with _terminated_like_ctrl_c():
            return run(given[0], given[1:])
    except KeyboardInterrupt:
        print("deal-hw: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (DealHwError, OSError) as err:
        # A broken pipe may be that of a robot, an error, or that of our output after its reader closed it.
        if show_traceback or (isinstance(err, BrokenPipeError) and _reader_is_gone()):
            raise
        # An OSError (no such file, disk full) is not a bug and becomes one line, too.
        print(f"deal-hw: error: {short(str(err), LONGEST_MESSAGE)}", file=sys.stderr)
        return EXIT_ERROR


def _flushed() -> bool:
    """Flush the output and return whether its reader took it."""
    try:
        # None where the process was started without an output.
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        return False
    except OSError:
        # A full disk: the interpreter tries again at its end and reports the error.
        pass
    return True


def _reader_is_gone() -> bool:
    """Return whether the broken pipe is that of the output."""
    if not _flushed():
        return True
    # Unbuffered output leaves nothing to flush; then only the pipe itself shows its state.
    import select

    if sys.stdout is None or not hasattr(select, "poll"):
        return False
    output = select.poll()
    try:
        output.register(sys.stdout.fileno(), 0)
    except OSError:
        # Not a file: the output was replaced by an object in memory.
        return False
    return bool(output.poll(0))


if __name__ == "__main__":
    sys.exit(main())
