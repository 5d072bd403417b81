"""What a run of the control loop is told, and what it reports."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Any

from deal_hw.control.loop_timing import LoopTimingReport
from deal_hw.control.passive import PassiveConfig
from deal_hw.errors import ConfigurationError


class Outcome(enum.Enum):
    """How a run ended."""

    FINISHED = "finished"
    STOPPED = "stopped"
    """By the operator."""
    TRIPPED = "tripped"
    """By the safety module."""
    FAILED = "failed"
    """By an error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """Settings of one run."""

    duration_s: float
    """Length of the run, counted in control periods [s]."""
    dry_run: bool = False
    """Compute everything and send nothing: the robot is neither homed nor armed."""
    home: bool = True
    """Bring the robot to its start pose first."""
    home_timeout_s: float = 20.0
    arm_timeout_s: float = 1.0
    state_timeout_s: float = 1.0
    """How long to wait for the first state sample [s]."""
    passive: PassiveConfig = field(default_factory=PassiveConfig)
    """How long the passive command is repeated at the end, until the robot shows it."""
    record_wire: bool = True
    """Hand the raw bytes to the recorder, too."""
    hand_back: bool = False
    """At the end, return the robot to the controller that it came with."""
    hand_back_timeout_s: float = 10.0

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ConfigurationError(f"a run must last longer than 0 s, not {self.duration_s!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopReport:
    """What came out of one run.

    Attributes:
        outcome: How it ended.
        reason: In words, for the operator.
        passive_confirmed: Whether the robot itself said that its motors no longer follow commands; also True
            where it was never commanded.
        loop_timing: How regular it was.
        clipped: Cycles in which each limit changed the command, by limit.
        cycles_sent: Commands sent.
        error: Name of the error's class where it failed.
    """

    outcome: Outcome
    reason: str
    passive_confirmed: bool
    loop_timing: LoopTimingReport
    clipped: dict[str, int]
    cycles_sent: int
    error: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "outcome": self.outcome.value,
            "reason": self.reason,
            "passive_confirmed": self.passive_confirmed,
            "loop_timing": self.loop_timing.to_json(),
            "clipped": self.clipped,
            "cycles_sent": self.cycles_sent,
            "error": self.error,
        }
