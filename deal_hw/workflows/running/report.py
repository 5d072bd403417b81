"""Reports of collect, deploy and replay, on each episode and on the whole run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw import errors
from deal_hw.control.process.channel import Outcome
from deal_hw.documentation import page
from deal_hw.workflows.say import html_table, text_table

if TYPE_CHECKING:
    from deal_hw.control.loop.timing import LoopTimingReport
    from deal_hw.data.recording.excitation import Excitation
    from deal_hw.motions.scores.balance import BalanceResult
    from deal_hw.motions.scores.replay_error import ReplayError
    from deal_hw.motions.scores.velocity_error import VelocityError

_HEAD = ("episode", "outcome", "reason", "states", "clipped cycles", "recording")
_EXIT_CODES = {Outcome.FINISHED: 0, Outcome.TRIPPED: 3, Outcome.FAILED: 2, Outcome.STOPPED: 130}


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeReport:
    """How one episode went.

    Attributes:
        path: The recording, or None.
        outcome: How the episode ended.
        reason: The reason, as text.
        passive_confirmed: Whether the robot itself confirmed that it is passive.
        loop_timing: How regular the control loop was; None if it never ran or was killed.
        clipped: Number of cycles in which a limit changed a command, by limit.
        cycles_sent: Commands sent.
        states_recorded: State samples in the file.
        warnings: Warnings for the operator.
        error: Name of the error's class, after a failure.
        flags: Failed checks of the safety module that ended it.
        motion: How much the recording moves; None without a recording.
        walk: How well a walking robot followed the requested velocity, by its own sensors; None without a
        walk or a recording.
        balance: How well a policy held the cart-pole's pole up, as the robot reported; None without such a
        policy.
        replay: Distance of a replay's motion from the recorded one; None for other runs.
        ran_s: How long commands were sent [s].
        planned_s: Planned length [s]; 0 if unknown.
    """

    path: Path | None
    outcome: Outcome
    reason: str
    passive_confirmed: bool
    loop_timing: LoopTimingReport | None = None
    clipped: dict[str, int] = field(default_factory=dict)
    cycles_sent: int = 0
    states_recorded: int = 0
    warnings: tuple[str, ...] = ()
    error: str = ""
    flags: tuple[str, ...] = ()
    motion: Excitation | None = None
    walk: VelocityError | None = None
    balance: BalanceResult | None = None
    replay: ReplayError | None = None
    ran_s: float = 0.0
    planned_s: float = 0.0

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
            "flags": list(self.flags),
        }

    def lines(self) -> list[str]:
        """Return the report for the operator, without the warnings, and without the error that follows it."""
        failed = self.outcome is Outcome.FAILED
        lines = [self.outcome.value if failed else f"{self.outcome.value}: {self.reason}"]
        if self.planned_s and self.cycles_sent:
            hit = "" if self.clipped or self.outcome is Outcome.TRIPPED else "; no limit was hit"
            of = "" if self.outcome is Outcome.FINISHED else f" of {self.planned_s:.1f}"
            lines.append(f"  ran for {self.ran_s:.1f}{of} s{hit}")
        if self.loop_timing is not None and self.loop_timing.cycles:
            lines += ["  " + line for line in self.loop_timing.lines()]
        for limit, cycles in self.clipped.items():
            lines.append(f"  clipped by the safety filter: {limit} in {cycles} cycles")
        if self.path is not None:
            lines.append(f"  recorded {self.states_recorded} states in {self.path}")
            if self.outcome in (Outcome.TRIPPED, Outcome.FAILED):
                lines.append("  calibrate leaves this episode out")
            if self.outcome is Outcome.TRIPPED:
                lines.append(f"  to see why: deal-hw inspect {self.path} ({page('troubleshooting.md')})")
        if self.walk is not None and self.walk.seconds:
            lines.append(
                f"  velocity error, by leg odometry and IMU: {self.walk.velocity_m_s:.2f} m/s, "
                f"{self.walk.yaw_rad_s:.2f} rad/s over {self.walk.seconds:.0f} s of walking"
            )
        if self.balance is not None:
            from deal_hw.motions.scores.balance import FALLEN_RAD

            lines.append(
                f"  pole upright (within {FALLEN_RAD} rad) for {self.balance.upright_s:.1f} of "
                f"{self.balance.duration_s:.1f} s; mean |angle| {self.balance.angle_error_rad:.3f} rad, "
                f"mean |cart speed| {self.balance.cart_speed_m_s:.3f} m/s"
            )
        if self.replay is not None:
            worst = int(np.argmax(self.replay.position))
            lines.append(
                f"  difference from the recording at most {self.replay.position[worst]:.3g} rad or m (RMS "
                f"of joint {self.replay.joint_names[worst]!r}), over {self.replay.seconds:.1f} s"
            )
        return lines

    def raise_error(self) -> None:
        """Raise the error that ended the episode, with its class in the control process."""
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
        dataset: The dataset's folder, or None.
        episodes: The episodes, in order; if one did not finish, it is the last.
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

    @property
    def paths(self) -> tuple[Path, ...]:
        """The recordings, in order."""
        return tuple(episode.path for episode in self.episodes if episode.path is not None)

    def table(self) -> str:
        """Return one line per episode, as text."""
        return text_table(_HEAD, self._cells())

    def _repr_html_(self) -> str:
        return html_table(_HEAD, self._cells())

    def _cells(self) -> list[tuple[Any, ...]]:
        return [
            (
                number,
                one.outcome.value,
                one.reason,
                one.states_recorded,
                sum(one.clipped.values()),
                one.path or "",
            )
            for number, one in enumerate(self.episodes)
        ]
