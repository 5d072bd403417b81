"""Standing up before a behaviour and lying down after it, for robots with legs; both pass the safety filter.

A robot with legs starts and ends lying, so that limp legs are harmless. Targets move between poses along a
smooth curve. It starts at the measured pose of the first cycle, so any lying pose is fine.
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
    """Durations of the parts."""

    fold_s: float = 1.5
    """From the measured pose to the rest pose [s]."""
    rise_s: float = 1.5
    """From the rest pose to the default pose [s]."""
    settle_s: float = 0.5
    """Time in the default pose before the behaviour begins [s]."""
    lie_s: float = 2.0
    """From the behaviour's last pose to the rest pose [s]."""

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
        """Total time of standing up and lying down [s]."""
        return self.before_s + self.lie_s


class PostureBehaviour:
    """Stands up, runs another behaviour, lies down.

    Args:
        inner: The behaviour while standing.
        description: The robot; it must have a rest pose.
        seconds: How long ``inner`` runs [s].
        config: Durations of the other parts.

    Raises:
        ConfigurationError: The robot has no rest pose.
    """

    def __init__(
        self, inner: Behaviour, description: RobotDescription, seconds: float, config: PostureConfig
    ) -> None:
        if not description.rest_position:
            raise ConfigurationError(
                f"robot {description.name!r} has no rest pose to stand up from; use --stand False"
            )
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
        """Restart from the beginning."""
        self._inner.reset()
        self._start, self._last = None, self._default

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the command of the current part."""
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
            # A NaN target trips the safety module; lying down must not start from it.
            if np.isfinite(command.position_target).all():
                self._last = command.position_target
            return command
        return self._towards(self._last, self._rest, (since_s - self._seconds) / c.lie_s)

    def _towards(self, begin: FloatArray, end: FloatArray, share: float) -> JointCommand:
        share = min(max(share, 0.0), 1.0)
        return position_command(self._description, begin + (3 - 2 * share) * share**2 * (end - begin))
