"""Strength of a demonstration: judged by its recording, and repeated stronger or gentler if needed.

Robots differ by large factors: a set-point that trips one cart does not overcome the friction of another.
Like a person at the robot, the search uses the recording only, never hidden values.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from deal_hw.data.recording.excitation import Excitation
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.motions.excitation.behaviours import RichConfig, Segment
from deal_hw.motions.excitation.limits import largest_factor, room

LEAST_FOLLOWED = 0.3
"""An actuated joint that covers less than this share of its commanded range hardly moves."""

LEAST_NOISE_RATIO = 20.0
"""Motion below this many standard deviations of the sensor's noise contains little information on a joint."""

LEAST_FREE_RATIO = 100.0
"""The same for a joint without a motor, which either overcomes its friction and swings, or stays."""

LOWEST_LEVEL, HIGHEST_LEVEL = -3.0, 3.0
LOWEST_EFFORT = 0.1
"""Commanded effort limits below this share are halved for a stronger demonstration."""

HELD_FACTOR = 8.0
"""Factor on low commanded effort limits, from two steps up."""

FINEST = 0.5
"""Half a step, tried between a level that hardly moves the robot and one that trips the safety module."""

ATTEMPTS = 4


def joint_noise(description: RobotDescription) -> tuple[float, ...]:
    """Return the standard deviation of each joint's reported position by the description, (J,)."""
    return tuple(map(float, description.sensor.position_std))


def shortfalls(found: Excitation, description: RobotDescription) -> tuple[str, ...]:
    """Return a sentence for each joint that hardly moved in a recording; empty if the motion is large enough.

    Args:
        found: Movement and commands of the recording.
        description: The robot.
    """
    words = []
    commanded = dict(zip(description.actuated, found.target_range, strict=True))
    for name, unit, span, noise in zip(
        description.joint_names,
        description.position_units,
        found.position_range,
        joint_noise(description),
        strict=True,
    ):
        asked = commanded.get(name)
        if asked is None:
            least, why = LEAST_FREE_RATIO * noise, f"{LEAST_FREE_RATIO:g} times the sensor's noise"
        else:
            least, why = LEAST_FOLLOWED * asked, f"{LEAST_FOLLOWED:.0%} of the commanded range"
            if least < LEAST_NOISE_RATIO * noise:
                least, why = LEAST_NOISE_RATIO * noise, f"{LEAST_NOISE_RATIO:g} times the sensor's noise"
        if span < least:
            words.append(f"{name} moved {span:.2g} {unit}, less than {least:.2g} {unit} ({why})")
    return tuple(words)


def with_excitation_level(config: RichConfig, level: float, description: RobotDescription) -> RichConfig:
    """Return the motion, stronger or gentler by some steps, within the safety limits.

    A step up: set-points 1.5 times as far and held 1.5 times as long, stiffer and less damped gains, higher
    limits (except deliberately low ones), half the balancing time. A step down: nearer set-points, softer and
    more damped gains, lower limits.

    Args:
        config: The motion at level 0.
        level: Steps up, or down if negative; half steps are allowed.
        description: The robot.

    Raises:
        ConfigurationError: The level is outside the allowed range.
    """
    if not LOWEST_LEVEL <= level <= HIGHEST_LEVEL:
        raise ConfigurationError(
            f"excitation level {level:g}: allowed are {LOWEST_LEVEL:g} to {HIGHEST_LEVEL:g}; 0 is the "
            "motion itself"
        )
    if level == 0:
        return config
    up, down = max(level, 0.0), max(-level, 0.0)
    amplitude = config.amplitude * 1.5**up * 0.6**down
    most = room(description)
    balance_s = config.balance_s * 0.5**up
    return dataclasses.replace(
        config,
        # A user's own amplitude may already exceed the room; the safety filter clips it.
        amplitude=min(amplitude, max(float(np.min(most[most > 0])), config.amplitude)),
        hold_s=(config.hold_s[0] * 1.5**up, config.hold_s[1] * 1.5**up),
        balance_s=balance_s if level > LOWEST_LEVEL and up < 2 else 0.0,
        segments=tuple(_scaled(part, level, description) for part in _whole(config.segments)),
    )


def _whole(segments: tuple[Segment, ...]) -> tuple[Segment, ...]:
    """Return segments that cover the whole run; the gaps get the description's own gains."""
    return (*segments, Segment(start=0.0, stop=1.0))


def _scaled(part: Segment, level: float, description: RobotDescription) -> Segment:
    limits, up, down = description.limits, max(level, 0.0), max(-level, 0.0)

    def within(factor: float, now: float, default: tuple[float, ...], most: tuple[float, ...]) -> float:
        return min(now * factor, max(largest_factor(default, most), now))

    return dataclasses.replace(
        part,
        stiffness=within(1.6**up * 0.8**down, part.stiffness, description.stiffness, limits.stiffness),
        damping=within(0.5**up * 1.5**down, part.damping, description.damping, limits.damping),
        effort_limit=within(
            _effort_factor(part.effort_limit, up, down),
            part.effort_limit,
            description.effort_limit,
            limits.effort,
        ),
        speed_limit=within(1.5**up * 0.5**down, part.speed_limit, description.speed_limit, limits.speed),
    )


def _effort_factor(sent: float, up: float, down: float) -> float:
    """Return the factor on an effort limit that is commanded at this share of the description's."""
    if down:
        return float(0.7**down)
    if sent >= 1 or not up:
        return float(2.0**up)
    # A low limit must be reached to be identified. A creeping joint needs little effort, so the lowest limit
    # is halved. A joint that does not move after the first step is held by friction, which low efforts cannot
    # overcome.
    return (0.5 if sent < LOWEST_EFFORT else 1.0) * (HELD_FACTOR if up > 1 else 1.0)


@dataclass(frozen=True, slots=True)
class Attempt:
    """One recording and its assessment.

    Attributes:
        level: Excitation level.
        shortfalls: A sentence for each joint that hardly moved.
        tripped: Why the safety module ended it; "" if it did not.
    """

    level: float
    shortfalls: tuple[str, ...]
    tripped: str

    @property
    def enough(self) -> bool:
        """Whether the recording is complete and has enough motion."""
        return not self.shortfalls and not self.tripped


class ExcitationLevelSearch:
    """Chooses excitation levels until a recording is complete and has enough motion (ask and tell).

    Args:
        level: First level.
        attempts: Largest number of recordings.
        rearm: Whether another recording may follow a trip of the safety module. On a real robot a person must
        check it first.

    Raises:
        ConfigurationError: The first level is outside the range, or attempts is below 1.
    """

    def __init__(self, level: float = 0.0, attempts: int = ATTEMPTS, *, rearm: bool = True) -> None:
        if not LOWEST_LEVEL <= level <= HIGHEST_LEVEL:
            raise ConfigurationError(
                f"excitation level {level:g}: allowed are {LOWEST_LEVEL:g} (gentlest) to {HIGHEST_LEVEL:g} "
                "(strongest)"
            )
        if attempts < 1:
            raise ConfigurationError(f"{attempts} attempts at a recording: give at least 1")
        self._most, self._rearm = attempts, rearm
        self.level = level
        self.attempts: list[Attempt] = []
        self.words = ""

    def tell(self, found: tuple[str, ...], tripped: str = "") -> bool:
        """Take the outcome of the recording at `level`; return whether to record again at the new level.

        Afterwards `words` is a text on the problem and the next step.

        Args:
            found: Result of :func:`shortfalls`.
            tripped: Why the safety module ended it; "" if it did not.
        """
        attempt = Attempt(self.level, found, tripped)
        self.attempts.append(attempt)
        self.words = ""
        if attempt.enough:
            return False
        how = "gentler" if tripped else "stronger"
        following = self._following(-1.0 if tripped else 1.0)
        why = f"the safety module ended it ({tripped})" if tripped else f"it hardly moves: {'; '.join(found)}"
        end = self._end(following, how, bool(tripped))
        if not end:
            self.level = following
        self.words = f"{why}; {end or f'recording again, {how} (excitation level {following:g})'}"
        return not end

    def _following(self, step: float) -> float:
        """Return the level one step away, or half a step if the full step was tried."""
        tried = [(a.level - self.level) * step for a in self.attempts]
        nearest = min((t for t in tried if 0 < t <= 1), default=2.0)
        return self.level + step * min(1.0, nearest / 2)

    def _end(self, following: float, how: str, tripped: bool) -> str:
        """Return why there is no further attempt, as text; "" if there is one."""
        if not LOWEST_LEVEL <= following <= HIGHEST_LEVEL:
            return "it is the gentlest level" if tripped else "it is the strongest level"
        if abs(following - self.level) < FINEST:
            return f"half a step {how} was tried before"
        if tripped and not self._rearm:
            return f"check the robot, then record again with --excitation-level {following:g}"
        if len(self.attempts) >= self._most:
            return f"the number of recordings is used up; continue with --excitation-level {following:g}"
        return ""

    @property
    def best(self) -> int:
        """Index of the best recording: complete and moving, else moving, else complete, then strongest."""

        def worth(index: int) -> tuple[bool, bool, float]:
            attempt = self.attempts[index]
            return not attempt.shortfalls, not attempt.tripped, attempt.level

        return max(range(len(self.attempts)), key=worth)
