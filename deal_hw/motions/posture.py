"""Standing up before a behaviour and lying down after it, for robots with legs; both pass the safety filter.

A robot with legs starts and ends lying, so that limp legs are harmless. Targets move between poses along a
smooth curve. It starts at the measured pose of the first cycle, so any lying pose is fine.

The end: a policy is slowed to zero velocity, targets move to the default pose, the robot stands there until
it is still, then it lies down. A trot that is left in mid-stride may tip over while lying down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import Behaviour, PolicyBehaviour, position_command
from deal_hw.motions.planned_end import PlannedEnd, battery_reason
from deal_hw.motions.velocity import SlowedVelocity
from deal_hw.types import FloatArray, JointCommand, RobotState

SLOW_S: Final = 0.8
"""Time from the requested velocity to zero; from 1 m/s this is about an eighth of gravity [s]."""
STEP_S: Final = 0.2
"""Time at zero velocity before the policy ends, half a step of the gait [s]."""
STANCE_S: Final = 0.3
"""Time from the behaviour's last pose to the default pose [s]. A foot in the air comes down in it."""
STILL_S: Final = 0.3
"""The robot stands after this time without motion [s]; the body's sway after a step has passed in it."""
STAND_MOST_S: Final = 3.0
"""Longest wait for that; then the robot lies down all the same [s]. Without slowing down first, the longest
of 50 ends was 1.4 s (emulator)."""
STILL_RAD_S: Final = 0.5
"""A joint, or the base about an axis, that is faster moves [rad/s]; as in the check of floor or stand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureConfig:
    """Durations of the parts."""

    fold_s: float = 1.5
    """From the measured pose to the rest pose [s]."""
    rise_s: float = 1.5
    """From the rest pose to the default pose [s]."""
    settle_s: float = 0.5
    """Time in the default pose before the behaviour begins [s]."""
    lie_s: float = 2.0
    """From the default pose to the rest pose, after the behaviour [s]."""

    def __post_init__(self) -> None:
        for name in ("fold_s", "rise_s", "settle_s", "lie_s"):
            if not 0.2 <= getattr(self, name) < 60:
                raise ConfigurationError(f"{name} is {getattr(self, name)!r} s; allowed: 0.2 to 60")

    @property
    def before_s(self) -> float:
        """Time before the behaviour begins [s]."""
        return self.fold_s + self.rise_s + self.settle_s

    def after_s(self, *, slows: bool) -> float:
        """Return the time after the behaviour, for a robot that stands still at once [s].

        Args:
            slows: Whether the behaviour is slowed first.
        """
        return (SLOW_S + STEP_S if slows else 0.0) + STANCE_S + STILL_S + self.lie_s

    @property
    def patience_s(self) -> float:
        """Most time that the end may take beyond :meth:`after_s`, until the robot is still [s]."""
        return STAND_MOST_S - STILL_S


class PostureBehaviour:
    """Stands up, runs another behaviour, comes to a stand, lies down.

    Attributes:
        inner: As the argument.
        end: Takes requests for an earlier end, and tells how far the end is.

    Args:
        inner: The behaviour while standing.
        description: The robot; it must have a rest pose.
        seconds: How long ``inner`` runs [s].
        config: Durations of the other parts.
        slowed: The requested velocity of ``inner``, which is slowed before it ends; None if it has none.
        end: As the attribute; by default a new one.

    Raises:
        ConfigurationError: The robot has no rest pose.
    """

    def __init__(
        self,
        inner: Behaviour,
        description: RobotDescription,
        seconds: float,
        config: PostureConfig,
        *,
        slowed: SlowedVelocity | None = None,
        end: PlannedEnd | None = None,
    ) -> None:
        if not description.rest_position:
            raise ConfigurationError(
                f"robot {description.name!r} has no rest pose to stand up from; use --stand False"
            )
        index = list(description.actuated_index)
        self.inner, self._description, self._seconds, self._config = inner, description, seconds, config
        self._slowed, self.end = slowed, end or PlannedEnd()
        self._slow_s = 0.0 if slowed is None else SLOW_S + STEP_S
        self._rest = np.array(description.rest_position)[index]
        self._default = np.array(description.default_position)[index]
        self._index = index
        # Cycles lie on a grid; half a period of slack keeps rounding from shifting a part by one.
        self._slack_s = 0.5 / description.control_rate_hz
        self.reset()

    @property
    def action(self) -> FloatArray | None:
        """The inner behaviour's action."""
        return self.inner.action

    @property
    def duration_s(self) -> float:
        """Length of all parts together, for a robot that stands still at once [s]."""
        c = self._config
        return c.before_s + self._seconds + c.after_s(slows=self._slowed is not None)

    @property
    def longest_s(self) -> float:
        """Most time of all parts together [s]."""
        return self.duration_s + self._config.patience_s

    def reset(self) -> None:
        """Restart from the beginning."""
        self.inner.reset()
        self._start: FloatArray | None = None
        self._last = self._default
        # Times at which the parts of the end began [s], and pose from which the present one began.
        self._ended_s: float | None = None
        self._stance_s: float | None = None
        self._moved_s: float | None = None
        self._lies_s: float | None = None
        self._from = self._default

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the command of the current part."""
        c, end = self._config, self.end
        if self._start is None:
            self._start = state.position[self._index]
        if reason := battery_reason(state, self._description.limits.legs):
            end.request(reason)
        if time_s < c.before_s and self._lies_s is None and end.reason:
            # It stands on four feet or lies: nothing to slow, and no reason to rise.
            self._lie(time_s, "it lies down")
        if self._lies_s is not None:
            return self._lying(time_s - self._lies_s)
        if time_s < c.fold_s:
            return self._towards(self._start, self._rest, time_s / c.fold_s)
        if time_s < c.before_s:
            return self._towards(self._rest, self._default, (time_s - c.fold_s) / c.rise_s)
        if self._ended_s is None:
            if time_s - c.before_s < self._seconds and not end.reason:
                return self._run_inner(state, time_s)
            self._ended_s = time_s
            end.note(end.reason or "the time is up")
            if self._slowed is not None:
                self._slowed.slow(time_s - c.before_s, SLOW_S)
        if time_s - self._ended_s < self._slow_s - self._slack_s:
            return self._run_inner(state, time_s)
        return self._standing(state, time_s)

    def _run_inner(self, state: RobotState, time_s: float) -> JointCommand:
        command = self.inner.command(state, time_s - self._config.before_s)
        # A NaN target trips the safety module; the end must not start from it.
        if np.isfinite(command.position_target).all():
            self._last = command.position_target
        return command

    def _standing(self, state: RobotState, time_s: float) -> JointCommand:
        """Move to the default pose, and stand there until the robot is still."""
        if self._stance_s is None:
            self._stance_s, self._from = time_s, self._last
            self.end.note("it comes to its default pose")
        since_s = time_s - self._stance_s
        if since_s < STANCE_S - self._slack_s:
            return self._towards(self._from, self._default, since_s / STANCE_S)
        fastest = _fastest(state)
        if self._moved_s is None or fastest > STILL_RAD_S:
            self._moved_s = time_s
        if time_s - self._moved_s >= STILL_S - self._slack_s:
            self._lie(time_s, "it stands still, and lies down")
        elif since_s - STANCE_S >= STAND_MOST_S - self._slack_s:
            self._lie(time_s, f"after {STAND_MOST_S:g} s it still moves at {fastest:.2f} rad/s; it lies down")
        return self._towards(self._default, self._default, 1.0)

    def _lie(self, time_s: float, step: str) -> None:
        self._lies_s, self._from = time_s, self._last
        self.end.note(step)

    def _lying(self, since_s: float) -> JointCommand:
        # The cycle of this command lasts one period.
        self.end.over = since_s >= self._config.lie_s - 3 * self._slack_s
        return self._towards(self._from, self._rest, since_s / self._config.lie_s)

    def _towards(self, begin: FloatArray, end: FloatArray, share: float) -> JointCommand:
        share = min(max(share, 0.0), 1.0)
        self._last = begin + (3 - 2 * share) * share**2 * (end - begin)
        return position_command(self._description, self._last)


def _fastest(state: RobotState) -> float:
    """Return the highest speed of a joint, or of the base about an axis [rad/s]."""
    base = 0.0 if state.body is None else float(np.max(np.abs(state.body.angular_velocity)))
    return max(float(np.max(np.abs(state.velocity))), base)


def limited_for(behaviour: Behaviour, description: RobotDescription) -> RobotDescription:
    """Return a robot with the limits of what a behaviour does: a climb, if its policy observes a platform."""
    inner = behaviour.inner if isinstance(behaviour, PostureBehaviour) else behaviour
    climbs = isinstance(inner, PolicyBehaviour) and inner.follows_obstacle
    return description.in_climb() if climbs else description
