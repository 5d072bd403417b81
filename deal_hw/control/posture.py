"""Standing up before a behaviour and lying down after it, for robots with legs; the safety filter judges it.

A robot with legs starts and ends lying: limp legs then change nothing. Targets move between poses along a
smooth curve, from the pose that is measured at the first cycle, so that nothing depends on how it lies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.control.behaviours import Behaviour, position_command
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray, JointCommand, RobotState


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureConfig:
    """How long each part takes."""

    fold_s: float = 1.5
    """From the measured pose to the rest pose [s]."""
    rise_s: float = 1.5
    """From the rest pose to the default pose [s]."""
    settle_s: float = 0.5
    """Held in the default pose before the behaviour begins [s]."""
    lie_s: float = 2.0
    """From where the behaviour ends to the rest pose [s]."""

    def __post_init__(self) -> None:
        for name in ("fold_s", "rise_s", "settle_s", "lie_s"):
            if not 0.2 <= getattr(self, name) < 60:
                raise ConfigurationError(f"{name} is {getattr(self, name)!r} s; allowed: 0.2 to 60")

    @property
    def before_s(self) -> float:
        """Time before the behaviour begins [s]."""
        return self.fold_s + self.rise_s + self.settle_s

    @property
    def added_s(self) -> float:
        """Time that standing up and lying down add to the behaviour's [s]."""
        return self.before_s + self.lie_s


class PostureBehaviour:
    """Stands up, does what it is given, lies down.

    Args:
        inner: What to do while standing.
        description: The robot; it must have a rest pose.
        seconds: How long ``inner`` runs [s].
        config: The times of the rest.

    Raises:
        ConfigurationError: The robot has no rest pose.
    """

    def __init__(
        self, inner: Behaviour, description: RobotDescription, seconds: float, config: PostureConfig
    ) -> None:
        if not description.rest_position:
            raise ConfigurationError(f"robot {description.name!r} has no rest pose to stand up from")
        index = list(description.actuated_index)
        self._inner, self._description, self._seconds, self._config = inner, description, seconds, config
        self._rest = np.array(description.rest_position)[index]
        self._default = np.array(description.default_position)[index]
        self._index = index
        self._start: FloatArray | None = None
        self._last = self._default

    @property
    def action(self) -> FloatArray | None:
        """The inner behaviour's action."""
        return self._inner.action

    @property
    def duration_s(self) -> float:
        """Length of all parts together [s]."""
        return self._seconds + self._config.added_s

    def reset(self) -> None:
        """Begin anew."""
        self._inner.reset()
        self._start, self._last = None, self._default

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the command of the part that it is time for."""
        c = self._config
        if self._start is None:
            self._start = state.position[self._index]
        if time_s < c.fold_s:
            return self._towards(self._start, self._rest, time_s / c.fold_s)
        if time_s < c.before_s:
            return self._towards(self._rest, self._default, (time_s - c.fold_s) / c.rise_s)
        since_s = time_s - c.before_s
        if since_s < self._seconds:
            command = self._inner.command(state, since_s)
            # A target that is not a number trips the safety module; lying down must not begin at it.
            if np.isfinite(command.position_target).all():
                self._last = command.position_target
            return command
        return self._towards(self._last, self._rest, (since_s - self._seconds) / c.lie_s)

    def _towards(self, begin: FloatArray, end: FloatArray, share: float) -> JointCommand:
        share = min(max(share, 0.0), 1.0)
        return position_command(self._description, begin + (3 - 2 * share) * share**2 * (end - begin))
