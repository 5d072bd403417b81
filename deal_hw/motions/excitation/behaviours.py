"""Behaviours that excite a robot for calibration: random set-points after balancing, and a sine sweep."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import Behaviour, centre, position_command
from deal_hw.motions.excitation.centring import Centring
from deal_hw.schema import STRICT
from deal_hw.types import FloatArray, JointCommand, RobotState

LONGEST_S = 3600.0
"""Longest run [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A part of the run with other commanded gains and limits, as factors of the usual ones."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    start: float
    """Start, as a fraction of the run."""
    stop: float
    """End, as a fraction of the run."""
    stiffness: float = 1.0
    damping: float = 1.0
    effort_limit: float = 1.0
    speed_limit: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.start < self.stop <= 1.0:
            raise ConfigurationError(
                f"segment {self.start!r}..{self.stop!r}: fractions of the run, 0 <= start < stop <= 1"
            )
        for name in ("stiffness", "damping", "effort_limit", "speed_limit"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigurationError(
                    f"segment factor {name} is {getattr(self, name)!r}; it must be a finite number above 0"
                )


def segment_command(command: JointCommand, segments: Sequence[Segment], fraction: float) -> JointCommand:
    """Return a command with its gains and limits times the factors of the first segment at this time."""
    for part in segments:
        if part.start <= fraction < part.stop:
            return dataclasses.replace(
                command,
                stiffness=part.stiffness * command.stiffness,
                damping=part.damping * command.damping,
                effort_limit=part.effort_limit * command.effort_limit,
                speed_limit=part.speed_limit * command.speed_limit,
            )
    return command


@dataclass(frozen=True, slots=True, kw_only=True)
class RichConfig:
    """Collection motion `rich`: balance, then random set-points; the pole may fall."""

    duration_s: float = 4.0
    """Length of the run [s]; segments are fractions of it."""
    balance_s: float = 0.6
    """Time of balancing at the start [s]; 0 without a policy."""
    amplitude: float = 0.12
    """Set-points are drawn within this distance of the default position [m or rad]."""
    hold_s: tuple[float, float] = (0.1, 0.3)
    """Shortest and longest time that a set-point is held [s]."""
    segments: tuple[Segment, ...] = (
        Segment(start=0.5, stop=0.75, stiffness=2.5, damping=0.5, effort_limit=0.15, speed_limit=2.5),
        Segment(start=0.75, stop=1.0, stiffness=2.5, damping=0.5, effort_limit=0.05, speed_limit=2.5),
    )
    """Parts of the run with other gains and limits; the first part that contains the time is used. By default
    the second half has low effort limits and a high speed limit, because a recording shows a limit only where
    it is reached. It also has high stiffness and low damping, because a slow cart never reaches the effort
    limit. docs/how-to/excitation.md has the figures."""

    def __post_init__(self) -> None:
        low, high = self.hold_s
        if not (
            0 < self.duration_s <= LONGEST_S
            and 0 <= self.balance_s <= LONGEST_S
            and 1e-6 <= self.amplitude <= 1e3
            and 1e-3 <= low <= high <= LONGEST_S
        ):
            raise ConfigurationError(
                f"not a usable motion: duration {self.duration_s:g} s, balance "
                f"{self.balance_s:g} s, amplitude {self.amplitude:g}, hold {low:g} to "
                f"{high:g} s; numbers above 0, at most {LONGEST_S:g} s"
            )


class RichBehaviour:
    """Balances with a policy, then commands random set-points for random times.

    Args:
        description: The robot.
        balance: Behaviour that balances at first; None starts with the set-points at once.
        config: The motion.
        seed: Seed of the set-points; ``reset`` repeats them.
    """

    def __init__(
        self, description: RobotDescription, balance: Behaviour | None, config: RichConfig, seed: int
    ) -> None:
        self._description = description
        self._balance = balance
        self._config = config
        self._seed = seed
        self._centre, self._centring = centre(description), Centring(description)
        self.action: FloatArray | None = None
        self.reset()

    def reset(self) -> None:
        """Restart with the same set-points."""
        self._rng = np.random.default_rng(self._seed)
        self._until_s = -math.inf
        self._target = self._centre
        self.action = None
        if self._balance is not None:
            self._balance.reset()

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the balancing command or the current set-point, with the gains of the segment."""
        if self._balance is not None and time_s < self._config.balance_s:
            wanted = self._balance.command(state, time_s)
            self.action = self._balance.action
            return self._scaled(wanted, time_s)
        self.action = None
        # Half a millisecond of slack: times are multiples of the control period, not exact in binary.
        if time_s + 5e-4 >= self._until_s:
            self._target = (
                self._centre + self._rng.uniform(-1.0, 1.0, self._centre.shape) * self._config.amplitude
            )
            self._until_s = time_s + self._rng.uniform(*self._config.hold_s)
        target = self._centring.added(self._target, state)
        return self._scaled(position_command(self._description, target), time_s)

    def _scaled(self, command: JointCommand, time_s: float) -> JointCommand:
        return segment_command(command, self._config.segments, time_s / self._config.duration_s)


CHIRP_AMPLITUDE: Final = 0.08
"""Amplitude of a chirp about the default position [m or rad]; small enough for the cart-pole's balance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChirpConfig:
    """Held-out motion family `chirp`: a sine sweep of the set-point."""

    duration_s: float = 4.0
    """Length of the sweep [s]."""
    low_hz: float = 0.3
    """Frequency at the start [Hz]."""
    high_hz: float = 4.0
    """Frequency at the end [Hz]."""

    def __post_init__(self) -> None:
        if not (self.duration_s > 0 and 0 < self.low_hz <= self.high_hz):
            raise ConfigurationError(f"not a usable chirp: {self}")


class ChirpBehaviour:
    """Moves the set-point of all actuated joints along a linear sine sweep."""

    action: FloatArray | None = None

    def __init__(self, description: RobotDescription, config: ChirpConfig | None = None) -> None:
        self._description = description
        self._config = config or ChirpConfig()
        self._centre, self._centring = centre(description), Centring(description)

    def reset(self) -> None:
        """No memory to clear."""

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the set-point at this time; the phase is the integral of a linearly growing frequency."""
        c = self._config
        slope = (c.high_hz - c.low_hz) / c.duration_s
        phase = 2 * math.pi * (c.low_hz * time_s + 0.5 * slope * time_s**2)
        target = self._centring.added(self._centre + CHIRP_AMPLITUDE * math.sin(phase), state)
        return position_command(self._description, target)
