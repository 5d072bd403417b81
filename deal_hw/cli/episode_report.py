"""What collect, deploy and replay report: each episode, the whole run, and how it goes meanwhile."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deal_hw import errors
from deal_hw.cli.seconds_bar import seconds_bar
from deal_hw.control.loop import Outcome
from deal_hw.control.loop_timing import LoopTimingReport
from deal_hw.control.process_channel import MAKING_PASSIVE, RUNNING, Beat
from deal_hw.control.velocity_error import VelocityError
from deal_hw.data.recording.excitation import Excitation

_EXIT_CODES = {Outcome.FINISHED: 0, Outcome.TRIPPED: 3, Outcome.FAILED: 2, Outcome.STOPPED: 130}


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeReport:
    """How one episode went.

    Attributes:
        path: The recording; None where nothing was recorded.
        outcome: How it ended.
        reason: In words.
        passive_confirmed: Whether the robot itself confirmed that it is passive.
        loop_timing: How regular the control loop was; None where it never ran or was killed.
        clipped: Cycles in which each limit changed a command, by limit.
        cycles_sent: Commands sent.
        states_recorded: State samples in the file.
        warnings: What the operator should know.
        error: Name of the error's class where it failed.
        motion: How much the recording moves; None where nothing was recorded.
        walk: How well a walking robot followed what it was told, by its own sensors; None where it did not
            walk or nothing was recorded.
    """

    path: Path | None
    outcome: Outcome
    reason: str
    passive_confirmed: bool
    loop_timing: LoopTimingReport | None
    clipped: dict[str, int]
    cycles_sent: int
    states_recorded: int
    warnings: tuple[str, ...]
    error: str = ""
    motion: Excitation | None = None
    walk: VelocityError | None = None

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "outcome": self.outcome.value,
            "reason": self.reason,
            "passive_confirmed": self.passive_confirmed,
            "loop_timing": self.loop_timing.to_json() if self.loop_timing is not None else None,
            "clipped": self.clipped,
            "cycles_sent": self.cycles_sent,
            "states_recorded": self.states_recorded,
            "warnings": list(self.warnings),
            "error": self.error,
        }

    def raise_error(self) -> None:
        """Raise the error that ended the episode, as the class that it was in the control process."""
        if self.outcome is not Outcome.FAILED:
            return
        kind = getattr(errors, self.error, errors.DealHwError)
        if not issubclass(kind, errors.DealHwError) or kind in (
            errors.UnknownNameError,
            errors.MissingExtraError,
        ):
            kind = errors.DealHwError
        raise kind(self.reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """How a run of episodes went.

    Attributes:
        dataset: The dataset's folder; None where nothing was recorded.
        episodes: The episodes, in order; the last is the one that did not finish, if any.
    """

    dataset: Path | None
    episodes: tuple[EpisodeReport, ...]

    @property
    def outcome(self) -> Outcome:
        """How the last episode ended."""
        return self.episodes[-1].outcome

    @property
    def exit_code(self) -> int:
        """For the shell: 0 finished, 2 failed, 3 tripped by the safety module, 130 stopped."""
        return _EXIT_CODES[self.outcome]


def print_report(report: EpisodeReport) -> None:
    """Print an account for the operator."""
    print(f"{report.outcome.value}: {report.reason}")
    if report.loop_timing is not None:
        print("\n".join("  " + line for line in report.loop_timing.lines()))
    for limit, cycles in report.clipped.items():
        print(f"  clipped by the safety filter: {limit} in {cycles} cycles")
    if report.path is not None:
        print(f"  recorded {report.states_recorded} states in {report.path}")
    if report.walk is not None and report.walk.seconds:
        print(
            f"  velocity error, by leg odometry and IMU: {report.walk.velocity_m_s:.2f} m/s, "
            f"{report.walk.yaw_rad_s:.2f} rad/s over {report.walk.seconds:.0f} s of walking"
        )
    for warning in report.warnings:
        print(f"warning: {warning}", file=sys.stderr)


@contextlib.contextmanager
def progress(title: str, seconds: float) -> Iterator[Callable[[Beat], None]]:
    """Show a progress bar on a terminal; everywhere, each second, trouble in making the robot passive."""
    with seconds_bar(title, seconds) as bar:
        started_ns = 0
        trouble = ""

        def on_beat(beat: Beat) -> None:
            nonlocal started_ns, trouble
            if beat.phase.startswith(f"{MAKING_PASSIVE}: ") and beat.phase != trouble:
                trouble = beat.phase
                print(f"{title}: {trouble}", file=sys.stderr, flush=True)
            if beat.phase != RUNNING:
                bar.say(f"{title}: {beat.phase}")
                return
            if not started_ns:
                started_ns = beat.stamp_ns
                bar.say(title)
            if beat.count % 10 == 0:
                bar.passed((beat.stamp_ns - started_ns) * 1e-9)

        yield on_beat
