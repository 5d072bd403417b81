"""Settings and report of a run of the control loop."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Any

from deal_hw.control.loop.timing import LoopTimingReport
from deal_hw.control.safety.passive import PassiveConfig
from deal_hw.errors import ConfigurationError
from deal_hw.schema import plain


class Outcome(enum.Enum):
    """How a run ended."""

    FINISHED = "finished"
    STOPPED = "stopped"
    """Ended by the operator."""
    TRIPPED = "tripped"
    """Ended by the safety module."""
    FAILED = "failed"
    """Ended by an error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """Settings of one run."""

    duration_s: float
    """Length of the run, counted in control periods [s]."""
    dry_run: bool = False
    """Compute everything but send no command: the robot is neither homed nor armed."""
    home: bool = True
    """Bring the robot to its start pose first."""
    home_timeout_s: float = 20.0
    arm_timeout_s: float = 1.0
    state_timeout_s: float = 1.0
    """Longest wait for the first state sample [s]."""
    passive: PassiveConfig = field(default_factory=PassiveConfig)
    """How the passive command is repeated at the end, until the robot confirms it."""
    record_wire: bool = True
    """Also record the raw bytes."""
    hand_back: bool = False
    """At the end, return the robot to its own controller."""
    hand_back_timeout_s: float = 10.0

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ConfigurationError(f"a run of {self.duration_s!r} s is too short; give a length above 0 s")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopReport:
    """Result of one run.

    Attributes:
        outcome: How it ended.
        reason: The reason, for the operator.
        passive_confirmed: Whether the robot itself reported that its motors no longer follow commands; also
        True if it was never commanded.
        loop_timing: How regular the loop's cycles were.
        clipped: Number of cycles in which a limit changed the command, by limit.
        cycles_sent: Commands sent.
        error: Name of the error's class, after a failure.
        flags: Failed checks of the safety module that ended it.
    """

    outcome: Outcome
    reason: str
    passive_confirmed: bool
    loop_timing: LoopTimingReport
    clipped: dict[str, int]
    cycles_sent: int
    error: str = ""
    flags: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = plain(self)
        return values
