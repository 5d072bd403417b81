"""The safety filter: clips a command to the robot's limits and says what it clipped. Pure, no I/O."""

from __future__ import annotations

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.types import FloatArray, JointCommand


def is_finite(command: JointCommand) -> bool:
    """Return whether every number of a command is finite."""
    return all(
        bool(np.isfinite(part).all())
        for part in (
            command.position_target, command.velocity_target, command.stiffness, command.damping,
            command.effort, command.effort_limit, command.speed_limit,
        )
    )  # fmt: skip


class SafetyFilter:
    """Clips commands to ``description.limits``; arrays are (A,), in the order of the actuated joints."""

    def __init__(self, description: RobotDescription) -> None:
        limits = description.limits
        target = np.asarray(limits.target, dtype=float)
        self._low, self._high = target[:, 0], target[:, 1]
        self._step = np.asarray(limits.target_step, dtype=float)
        self._distance = np.asarray(limits.target_distance, dtype=float)
        self._maxima = {
            "stiffness": np.asarray(limits.stiffness, dtype=float),
            "damping": np.asarray(limits.damping, dtype=float),
            "effort_limit": np.asarray(limits.effort, dtype=float),
            "speed_limit": np.asarray(limits.speed, dtype=float),
        }

    def clip(
        self, wanted: JointCommand, previous: FloatArray, measured: FloatArray
    ) -> tuple[JointCommand, tuple[str, ...]]:
        """Return the command inside all limits, and the names of the limits that changed it.

        The absolute limit is applied last, so that it holds whatever the others ask for.

        Args:
            wanted: A finite command.
            previous: The last target sent, or the measured position before the first, (A,).
            measured: Measured positions of the actuated joints, (A,).
        """
        clipped: list[str] = []

        def bound(name: str, value: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
            result = np.minimum(np.maximum(value, low), high)
            if (result != value).any():
                clipped.append(name)
            return result

        target = bound("target_step", wanted.position_target, previous - self._step, previous + self._step)
        target = bound("target_distance", target, measured - self._distance, measured + self._distance)
        target = bound("target", target, self._low, self._high)
        parts = {
            name: bound(name, getattr(wanted, name), np.zeros_like(high), high)
            for name, high in self._maxima.items()
        }
        speed, effort = self._maxima["speed_limit"], self._maxima["effort_limit"]
        velocity = bound("velocity_target", wanted.velocity_target, -speed, speed)
        feed_forward = bound("effort", wanted.effort, -effort, effort)
        return (
            JointCommand(position_target=target, velocity_target=velocity, effort=feed_forward, **parts),
            tuple(clipped),
        )
