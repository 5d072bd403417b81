"""The safety filter: clips a command to the robot's limits and reports the clipping. Pure, no I/O."""

from __future__ import annotations

import dataclasses

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.types import FloatArray, JointCommand


def is_finite(command: JointCommand) -> bool:
    """Return whether every number of a command is finite."""
    return all(
        bool(np.isfinite(part).all())
        for part in (
            command.position_target,
            command.velocity_target,
            command.stiffness,
            command.damping,
            command.effort,
            command.effort_limit,
            command.speed_limit,
        )
    )


def keep_effort(
    command: JointCommand,
    position: FloatArray,
    velocity: FloatArray,
    most: FloatArray,
    span: tuple[FloatArray, FloatArray],
) -> tuple[JointCommand, tuple[str, ...]]:
    """Return a command whose predicted effort is at most ``most``, and the names of the changed parts.

    The predicted effort is that of the drive now: kp (q* - q) + kd (dq* - dq) + feed-forward. The excess is
    removed from the parts that push in its direction, one after another and none past zero. First the
    position target moves towards the measured position, then feed-forward and velocity target shrink. Last,
    for the spring of a joint outside ``span`` and for the braking of a fast joint, the gains shrink. The
    velocity target never moves towards a measured velocity: it would still drive a joint that has slowed
    down.

    Args:
        command: A finite command, its target inside ``span``; arrays (A,).
        position: Measured positions, (A,).
        velocity: Measured velocities, (A,).
        most: Largest effort, (A,) [N or N·m].
        span: Lowest and highest target, (A,) each.
    """
    kp, kd = command.stiffness, command.damping
    target, rate, push = command.position_target, command.velocity_target, command.effort

    def effort() -> FloatArray:
        return kp * (target - position) + kd * (rate - velocity) + push

    total = effort()
    if not (np.abs(total) > most).any():
        return command, ()
    sign = np.sign(total)
    # Slightly below the limit, so that rounding does not reduce a second part.
    goal = most * (1.0 - 1e-9)

    def share(part: FloatArray) -> FloatArray:
        """Return the share of a part of the effort that may stay, 0..1."""
        part, now = sign * part, sign * effort()
        taken = np.minimum(now - goal, part)
        return np.divide(part - taken, part, out=np.ones_like(part), where=(now > most) & (part > 0.0))

    keep = share(kp * (target - position))
    target = np.where(keep < 1.0, np.clip(position + keep * (target - position), *span), target)
    push = push * share(push)
    rate = rate * share(kd * rate)
    kp = kp * share(kp * (target - position))
    kd = kd * share(kd * (rate - velocity))
    lowered = bool((kp < command.stiffness).any() or (kd < command.damping).any())
    return (
        dataclasses.replace(
            command, position_target=target, velocity_target=rate, stiffness=kp, damping=kd, effort=push
        ),
        ("predicted_effort", "gains") if lowered else ("predicted_effort",),
    )


class SafetyFilter:
    """Clips commands to ``description.limits``; arrays are (A,), in the order of the actuated joints."""

    def __init__(self, description: RobotDescription) -> None:
        limits = description.limits
        target = np.asarray(limits.target)
        self._low, self._high = target[:, 0], target[:, 1]
        self._step = np.asarray(limits.target_step)
        self._distance = np.asarray(limits.target_distance)
        self._maxima = {
            "stiffness": np.asarray(limits.stiffness),
            "damping": np.asarray(limits.damping),
            "effort_limit": np.asarray(limits.effort),
            "speed_limit": np.asarray(limits.speed),
        }
        legs = limits.legs
        self._effort = None if legs is None else np.asarray(legs.effort)

    def accepts(self, command: JointCommand) -> bool:
        """Return whether every number is finite, except limits of speed or effort that the robot lacks."""
        limited = {
            name: np.where(sent == self._maxima[name], 0.0, sent)
            for name in ("speed_limit", "effort_limit")
            for sent in [getattr(command, name)]
        }
        return is_finite(dataclasses.replace(command, **limited))

    def clip(
        self, wanted: JointCommand, previous: FloatArray, measured: FloatArray, velocity: FloatArray
    ) -> tuple[JointCommand, tuple[str, ...]]:
        """Return the command inside all limits, and the names of the limits that changed it.

        The absolute limit is applied after step and distance, so that it always holds. The limit of the
        predicted effort (robots with legs) comes last; after it all others hold except that of the step.

        Args:
            wanted: A finite command.
            previous: The last target sent, or the measured position before the first, (A,).
            measured: Measured positions of the actuated joints, (A,).
            velocity: Measured velocities of the actuated joints, (A,).
        """
        clipped: list[str] = []

        def bound(name: str, value: FloatArray, low: FloatArray | float, high: FloatArray) -> FloatArray:
            result = np.minimum(np.maximum(value, low), high)
            if (result != value).any():
                clipped.append(name)
            return result

        target = bound("target_step", wanted.position_target, previous - self._step, previous + self._step)
        target = bound("target_distance", target, measured - self._distance, measured + self._distance)
        target = bound("target", target, self._low, self._high)
        parts = {name: bound(name, getattr(wanted, name), 0.0, high) for name, high in self._maxima.items()}
        speed, effort = self._maxima["speed_limit"], self._maxima["effort_limit"]
        rate = bound("velocity_target", wanted.velocity_target, -speed, speed)
        feed_forward = bound("effort", wanted.effort, -effort, effort)
        command = JointCommand(position_target=target, velocity_target=rate, effort=feed_forward, **parts)
        if self._effort is not None:
            span = (self._low, self._high)
            command, names = keep_effort(command, measured, velocity, self._effort, span)
            clipped.extend(names)
        return command, tuple(clipped)
