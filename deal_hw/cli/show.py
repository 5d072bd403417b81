"""Output of a run on the terminal: a progress bar, messages, a report on each episode."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from deal_hw.cli.piped import PipedProgress
from deal_hw.control.process.channel import MAKING_PASSIVE, RUNNING, Beat
from deal_hw.workflows.running.view import OnBeat, RunView, ignore
from deal_hw.workflows.say import to_stderr

if TYPE_CHECKING:
    from deal_hw.workflows.design_excitation import ExcitationReport
    from deal_hw.workflows.running.report import EpisodeReport


@dataclass(frozen=True, slots=True)
class SecondsBar:
    """A bar on the terminal; without a terminal, the text of the next line.

    Attributes:
        passed: Sets the elapsed time [s].
        say: Sets the current activity; "": the run itself.
    """

    passed: Callable[[float], None]
    say: Callable[[str], None]


@contextlib.contextmanager
def seconds_bar(title: str, seconds: float, quiet: bool = False) -> Iterator[SecondsBar]:
    """Show a bar on a terminal while the block runs, elsewhere a line every ten seconds."""
    if quiet or not sys.stderr.isatty():
        with PipedProgress(title, quiet) as piped:
            yield SecondsBar(lambda passed: piped.at(f"running, {passed:.0f} of {seconds:.0f} s"), piped.at)
        return
    # Imported here: rich takes longer to load than all other imports on a robot's computer.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=seconds)
        yield SecondsBar(
            lambda passed: bar.update(task, completed=min(passed, seconds)),
            lambda doing: bar.update(task, description=f"{title}: {doing}" if doing else title),
        )


class Terminal(RunView):
    """Shows messages on standard error, prints reports, asks on standard input.

    Args:
        quiet: Whether to show only what the operator must know.
    """

    def __init__(self, quiet: bool = False) -> None:
        super().__init__(to_stderr)
        self._quiet = quiet

    def note(self, text: str) -> None:
        """See :class:`RunView`."""
        if not self._quiet:
            super().note(text)

    @contextlib.contextmanager
    def progress(self, title: str, seconds: float) -> Iterator[OnBeat]:
        """Show a bar on a terminal, elsewhere lines; each reason why the robot is not passive at once."""
        if self._quiet:
            yield ignore
            return
        with seconds_bar(title, seconds) as bar:
            started_ns = 0
            trouble = ""

            def on_beat(beat: Beat) -> None:
                nonlocal started_ns, trouble
                # The last part counts seconds; the bar, or a line every ten seconds, shows it.
                reason, counted, _ = beat.phase.rpartition("; ")
                if counted and reason.startswith(f"{MAKING_PASSIVE}: ") and reason != trouble:
                    trouble = reason
                    print(f"{title}: {beat.phase}", file=sys.stderr, flush=True)
                if beat.phase != RUNNING:
                    bar.say(beat.phase)
                    return
                if not started_ns:
                    started_ns = beat.stamp_ns
                    bar.say("")
                if beat.count % 10 == 0:
                    bar.passed((beat.stamp_ns - started_ns) * 1e-9)

            yield on_beat

    def notify(self, done: int, total: int, text: str) -> None:
        """See :class:`RunView`."""
        if not self._quiet and sys.stderr.isatty():
            from deal_hw.cli.design_excitation import note

            note(done, total, text)

    def designed(self, robot: str, report: ExcitationReport) -> None:
        """See :class:`RunView`."""
        if not self._quiet:
            from deal_hw.cli.design_excitation import print_design

            print_design(robot, report)

    def ended(self, report: EpisodeReport) -> None:
        """See :class:`RunView`."""
        if self._quiet:
            return
        print("\n".join(report.lines()))
        for warning in report.warnings:
            print(f"warning: {warning}", file=sys.stderr)

    def confirm(self, warning: str, question: str) -> bool | None:
        """See :class:`RunView`."""
        if not sys.stdin.isatty():
            return None
        print(warning, file=sys.stderr)
        return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")
