"""Common parts of all emulators: signals, real-time priority, and the truth at the end."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import priority
from deal_hw.errors import ConfigurationError
from deal_hw.reading import read_json, reading
from deal_hw.robots import robot_entry
from deal_hw.robots.connect import spoilt_on_purpose
from deal_hw.robots.emulation import Emulation
from deal_hw.signals import ENDING, taken
from deal_hw.transport import WireOptions
from deal_hw.workflows.emulation.settings import EmulateSettings
from deal_hw.workflows.options import File
from deal_hw.workflows.say import Say, silent

T = TypeVar("T")
S = TypeVar("S", bound=EmulateSettings)
_PARENT_CHECK_STEPS = 100
_FIFO_PRIORITY = 40
"""Below the priority of a control process, since the host must not wait for the emulator."""


@contextlib.contextmanager
def signalled() -> Iterator[tuple[threading.Event, threading.Event]]:
    """Yield two events, set by signals: by those that end a program (stop), and by SIGUSR1 (cut the wire).

    Ctrl-Z suspends an emulator, as any program. Afterwards the program's own handlers are restored.
    """
    stop, cut = threading.Event(), threading.Event()

    def handle(number: int) -> None:
        (cut if number == signal.SIGUSR1 else stop).set()

    with taken(handle, ENDING - {signal.SIGTSTP}):
        yield stop, cut


def with_parent(config: S) -> S:
    """Return the settings with the process whose end ends the emulator: by default the one that started it.

    A killed script or shell gives its children no signal, and an emulator would go on at real-time priority.
    Call it first: while the emulator starts, the other process may end.
    """
    # nohup makes a program ignore this signal, which asks it to go on.
    if config.parent is not None or signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return config
    return dataclasses.replace(config, parent=os.getppid())


@contextlib.contextmanager
def happenings(path: File | None, *logs: Sequence[tuple[int, int, str]]) -> Iterator[Callable[[], None]]:
    """Yield a function that appends new log entries to a file, one line of JSON each.

    A test program of a robot's commander reads there which commands arrive, while they arrive.

    Args:
        path: The file; None for none.
        logs: Growing lists of entries: device time [ms], host time [ns] and the event.
    """
    if path is None:
        yield lambda: None
        return
    written = [0] * len(logs)
    with Path(path).open("a", encoding="utf-8") as file:

        def tell() -> None:
            for number, log in enumerate(logs):
                for entry in log[written[number] :]:
                    file.write(json.dumps(entry) + "\n")
                    file.flush()
                written[number] = len(log)

        yield tell


def announced_faults(
    config: EmulateSettings, wire: str, port: str, options: WireOptions | None = None, *, loses: bool = False
) -> AbstractContextManager[object]:
    """Say to runs on this computer that the emulator spoils frames on purpose, if it does.

    Args:
        config: Its settings.
        wire: Its wire.
        port: Its port.
        options: More about a transport of topics.
        loses: Whether its profile loses frames.
    """
    name = spoilt_on_purpose(wire, port, options)
    if not (config.corrupt or config.drop or config.duplicate or loses) or name.held:
        return contextlib.nullcontext()
    return name


def realtime_priority() -> AbstractContextManager[None]:
    """Use real-time priority where permitted, since a real robot does not share the host's processor."""
    return priority(_FIFO_PRIORITY, children=True)


def run_until(
    step: Callable[[], bool], stop: threading.Event, duration_s: float | None, parent: int | None
) -> None:
    """Call ``step`` until it returns False, a signal, the time given [s], or the parent's end."""
    clock = MonotonicClock()
    end_ns = None if duration_s is None else clock.now_ns() + round(duration_s * 1e9)
    count = 0
    while not stop.is_set() and step():
        count += 1
        if end_ns is not None and clock.now_ns() >= end_ns:
            return
        if parent is not None and count % _PARENT_CHECK_STEPS == 0 and os.getppid() != parent:
            return


def serve(
    emulation: Emulation,
    config: EmulateSettings,
    what: str,
    stop: threading.Event,
    cut: threading.Event,
    *,
    announce: Say,
    report: Callable[[], Mapping[str, Any]],
    loses: bool = False,
) -> None:
    """Run an emulator until a stop, the given time or the end of its port, and reveal its truth.

    Args:
        emulation: The emulator, not yet opened.
        config: Its settings.
        what: What is emulated, for the second line.
        stop: Ends it.
        cut: Cuts the wire.
        announce: Called with the port first, and with the truth at the end.
        report: Returns the truth and what happened.
        loses: Whether its profile loses frames.
    """
    wire = config.transport or robot_entry(config.robot).emulated_on[0]
    try:
        port = emulation.open()
        announce(f"port {port}")
        announce(f"{what}; Ctrl-C ends")
        announce(next_line(config, port))
        with (
            announced_faults(config, wire, port, loses=loses),
            realtime_priority(),
            happenings(config.events_to, emulation.changes) as tell,
        ):

            def step() -> bool:
                if cut.is_set():
                    cut.clear()
                    emulation.cut()
                going_on = emulation.step()
                tell()
                return going_on

            run_until(step, stop, config.duration_s, config.parent)
    finally:
        emulation.close()
        reveal(report(), announce if config.reveal else silent, config.reveal_to)


def choose_truth(
    config: EmulateSettings,
    nominal: Callable[[str, int], T],
    draw: Callable[..., T],
    parse: Callable[[Mapping[str, Any]], T],
    range_ratio: float,
) -> T:
    """Return an emulated robot's hidden truth: the nominal values, those of a file, or drawn ones.

    Args:
        config: Chooses among them.
        nominal: Returns the nominal truth of a profile and a seed.
        draw: Returns a truth of a profile, a seed and a ``range_ratio``.
        parse: Makes a truth of a file's values.
        range_ratio: The ratio if the settings have none.

    Raises:
        ConfigurationError: The file holds no truth, or none can be drawn.
    """
    if config.nominal:
        return nominal(config.profile, config.seed)
    if config.truth_from is not None:
        return read_truth(Path(config.truth_from), parse)
    ratio = range_ratio if config.range_ratio is None else config.range_ratio
    return draw(config.profile, config.seed, range_ratio=ratio)


def read_truth(path: Path, parse: Callable[[Mapping[str, Any]], T]) -> T:
    """Return the truth that ``reveal`` wrote.

    Args:
        path: The file.
        parse: Makes the truth from its values.

    Raises:
        ConfigurationError: The file is missing, or contains no truth.
    """
    what, advice = "an emulator's truth", "--reveal-to writes one"
    values = read_json(path, dict[str, Any], what, advice, error=ConfigurationError)
    with reading(path, what, advice, error=ConfigurationError):
        return parse(values)


def next_line(config: EmulateSettings, port: str) -> str:
    """Return the line that says how to reach an emulated robot."""
    usual = type(config).transport
    transport = "" if config.transport == usual else f" --transport {config.transport}"
    return f"next, in another terminal: deal-hw doctor {config.robot} --port {port}{transport}"


def reveal(values: Mapping[str, Any], announce: Say, path: File | None) -> None:
    """Announce the truth as one line of JSON; also write it to a file, if one is given."""
    text = json.dumps(values)
    announce(text)
    if path is not None:
        Path(path).write_text(text + "\n", encoding="utf-8")
