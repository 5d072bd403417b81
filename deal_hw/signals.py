"""The one place that takes signals, for every process of a run and for the bridge.

A signal whose default action ends a program would leave a robot without its commander. A Go2 then holds its
last command for ever. So each process that commands a robot, or watches or records one that does, takes all
such signals and ends by its passive route. Not taken are:

- SIGKILL and SIGSTOP, which nobody can take;
- SIGSEGV, SIGBUS, SIGFPE and SIGILL: they report a fault of the program itself, and a return from the handler
  would run the faulty instruction again, for ever. The other process of the run sees the death at once;
- SIGCHLD, SIGCONT, SIGURG and SIGWINCH, which end no program;
- SIGTTIN and SIGTTOU, which are ignored: a program in the background then gets an error from the terminal, or
  just writes, and is not stopped with a stiff robot;
- SIGPIPE, which is ignored: the write to a closed pipe or socket fails with an error. Another program on the
  network would end ours otherwise, by closing a connection over TLS;
- SIGXFSZ: Python ignores it, and the write beyond the limit fails with an error, which ends the run;
- SIGHUP, if it was ignored when the program started: that is what ``nohup`` asks for;
- others for which the program around has a handler, or which it ignores: they do not end it.
"""

from __future__ import annotations

import contextlib
import faulthandler
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

ENDING: Final = frozenset(int(number) for number in signal.valid_signals()) - {
    signal.SIGKILL,
    signal.SIGSTOP,
    signal.SIGSEGV,
    signal.SIGBUS,
    signal.SIGFPE,
    signal.SIGILL,
    signal.SIGCHLD,
    signal.SIGCONT,
    signal.SIGURG,
    signal.SIGWINCH,
    signal.SIGTTIN,
    signal.SIGTTOU,
    signal.SIGPIPE,
    signal.SIGXFSZ,
}
"""Signals that end or suspend a program by default, the real-time signals included."""
FOR_US: Final = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGTSTP})
"""Taken even if the program around ignores or handles them. A shell lets programs in the background ignore
SIGINT and SIGQUIT."""
_IGNORED: Final = (signal.SIGTTIN, signal.SIGTTOU, signal.SIGPIPE)

OPERATOR: Final = "stopped by the operator"
SUSPENDED: Final = "suspended by the operator (Ctrl-Z)"
_REASONS: Final[dict[int, str]] = {
    signal.SIGINT: OPERATOR,
    signal.SIGTERM: OPERATOR,
    signal.SIGQUIT: OPERATOR,
    signal.SIGTSTP: SUSPENDED,
    signal.SIGHUP: "the terminal or the session was closed (SIGHUP)",
}


def name(number: int) -> str:
    """Return a signal's name, such as "SIGHUP" or "SIGRTMIN+3"."""
    first = int(signal.SIGRTMIN)
    if first <= number <= signal.SIGRTMAX:
        return f"SIGRTMIN+{number - first}" if number > first else "SIGRTMIN"
    return signal.Signals(number).name


def reason(number: int) -> str:
    """Return why a signal ends a run, for the operator."""
    return _REASONS.get(number, f"stopped by the signal {name(number)}")


def take(handle: Callable[[int], None], numbers: Iterable[int] = ENDING) -> dict[int, Any]:
    """Have signals call ``handle`` from now on, and let in those that were held back.

    Call it in the main thread. Python runs ``handle`` there, between two of its instructions; an exception
    that it raises comes out there.

    Args:
        handle: Called with the number of each signal.
        numbers: The signals.

    Returns:
        The handlers of before, by number.
    """

    def handler(number: int, frame: object) -> None:
        handle(number)

    before: dict[int, Any] = {}
    for number in numbers:
        if _is_ours(number):
            before[number] = signal.signal(number, handler)
    for number in _IGNORED:
        before[number] = signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, before)
    return before


def _is_ours(number: int) -> bool:
    if number in FOR_US:
        return True
    if number == signal.SIGABRT and faulthandler.is_enabled():
        # Its handler prints where the program aborts, and lets it die.
        return False
    if number == signal.SIGHUP:
        return signal.getsignal(number) is not signal.SIG_IGN
    return signal.getsignal(number) is signal.SIG_DFL


@contextlib.contextmanager
def taken(handle: Callable[[int], None], numbers: Iterable[int] = ENDING) -> Iterator[None]:
    """Have signals call ``handle`` inside the block; afterwards handlers and mask are those of before.

    Python allows handlers in the main thread only: in another thread all signals are left as they are.

    Args:
        handle: Called with the number of each signal.
        numbers: The signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    before = take(handle, numbers)
    try:
        yield
    finally:
        for number, old in before.items():
            # None: a handler that was not set from Python, and cannot be set again.
            signal.signal(number, signal.SIG_DFL if old is None else old)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextlib.contextmanager
def held_back() -> Iterator[None]:
    """Hold ending signals back inside the block, also from a child that is started there.

    The child inherits the mask. So no signal ends it before it has called :func:`take`, which lets them in.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
