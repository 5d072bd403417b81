"""A progress bar for work that takes a known time."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any


class SecondsBar:
    """A bar on the terminal; without one, nothing.

    Args:
        bar: A rich Progress; None: there is no terminal.
        title: What is going on.
        seconds: How long it takes [s].
    """

    def __init__(self, bar: Any, title: str, seconds: float) -> None:
        self._bar, self._seconds = bar, seconds
        self._task = bar.add_task(title, total=seconds) if bar is not None else None

    def passed(self, seconds: float) -> None:
        """So many seconds have passed [s]."""
        if self._bar is not None:
            self._bar.update(self._task, completed=min(seconds, self._seconds))

    def say(self, title: str) -> None:
        """Something else is going on."""
        if self._bar is not None:
            self._bar.update(self._task, description=title)


@contextlib.contextmanager
def seconds_bar(title: str, seconds: float, quiet: bool = False) -> Iterator[SecondsBar]:
    """Show a bar while the block runs, if standard error is a terminal and nobody asked for quiet."""
    if quiet or not sys.stderr.isatty():
        yield SecondsBar(None, title, seconds)
        return
    # Only here: rich takes longer to load than all else that a robot's computer needs.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        yield SecondsBar(bar, title, seconds)
