"""Messages and questions of a run; the command line shows them on a terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from deal_hw.control.process.channel import Beat
from deal_hw.workflows.say import Say, silent, to_stderr

if TYPE_CHECKING:
    from deal_hw.workflows.design_excitation import ExcitationReport
    from deal_hw.workflows.running.report import EpisodeReport

OnBeat = Callable[[Beat], None]
"""Called with each heartbeat of the control process, in the thread that waits for it."""


def ignore(beat: Beat) -> None:
    """Do nothing with a heartbeat."""


class RunView:
    """Passes messages on and asks no questions.

    Args:
        say: Called with each message.
        warn: Called with what the operator must know, such as that the robot must be switched off by hand;
        ``say`` by default.
    """

    def __init__(self, say: Say = silent, warn: Say | None = None) -> None:
        self._say, self._warn = say, warn or say

    @classmethod
    def of_python(cls, say: Say) -> RunView:
        """Return the view of a program with its ``say``; without one, warnings go to standard error."""
        return cls(say, to_stderr if say is silent else say)

    def warn(self, text: str) -> None:
        """Show a warning to the operator."""
        self._warn(text)

    def note(self, text: str) -> None:
        """Show a note."""
        self._say(text)

    def progress(self, title: str, seconds: float) -> AbstractContextManager[OnBeat]:
        """Show the progress of an episode of the given length [s]."""
        return contextlib.nullcontext(ignore)

    def notify(self, done: int, total: int, text: str) -> None:
        """Show the progress of the search for a motion."""

    def designed(self, robot: str, report: ExcitationReport) -> None:
        """Show the motion that was found for a robot."""
        self._say(report.plan.words)

    def ended(self, report: EpisodeReport) -> None:
        """Show how an episode ended."""
        for line in report.lines():
            self._say(line)
        for warning in report.warnings:
            self.warn(f"warning: {warning}")

    def confirm(self, warning: str, question: str) -> bool | None:
        """Ask the operator; None if nobody can answer."""
        return None
