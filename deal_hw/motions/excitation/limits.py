"""How large an excitation may be, from a description's ranges, steps, speeds and efforts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import centre
from deal_hw.types import FloatArray

MARGIN = 0.9
"""Share of a limit that an excitation may use; noise and the transition from balancing need the rest."""


def room(description: RobotDescription) -> FloatArray:
    """Return the largest offset of each actuated joint to either side of the centre, (A,); 0 if it has none.

    Raises:
        ConfigurationError: No joint has room, or an actuator.
    """
    description.require_actuators()
    low, high = np.array(description.limits.target).T
    if description.excitation_range:
        inner = np.array(description.excitation_range).T
        low, high = np.maximum(low, inner[0]), np.minimum(high, inner[1])
    around = centre(description)
    found = np.maximum(np.minimum(around - low, high - around), 0.0)
    # If a joint does not follow at all, its position error is the whole offset.
    found = MARGIN * np.minimum(found, np.array(description.limits.target_distance))
    if not np.isfinite(found).all():
        endless = [n for n, width in zip(description.actuated, found, strict=True) if not np.isfinite(width)]
        raise ConfigurationError(
            f"the range of {', '.join(endless)} of {description.name!r} is unknown, so no excitation can "
            "be planned; write its position_range into robot.yaml"
        )
    if not np.any(found > 0):
        raise ConfigurationError(
            f"no joint of {description.name!r} has room around its centre {around.tolist()} within the "
            f"target limits {list(description.limits.target)}; change default pose or limits"
        )
    return np.asarray(found)


def predicted_effort(description: RobotDescription, offsets: FloatArray) -> FloatArray:
    """Return the PD effort of servos that follow a signal, before any limit, (T, A).

    A description has only the gains of a servo: kd v = kp (target - x), a first-order lag with the corner kp
    / kd. Inertia, friction and load are missing, so the effort of heavy joints is underestimated; the
    device's own effort limit protects it.

    Args:
        description: The robot.
        offsets: The signal at each control period, (T, A).
    """
    kp, kd = np.array(description.stiffness), np.array(description.damping)
    rate = np.where(kd > 0, kp / np.where(kd > 0, kd, 1.0), 0.0)
    follow = -np.expm1(-rate / description.control_rate_hz)
    position = np.zeros(offsets.shape[1])
    out = np.empty_like(offsets)
    for t, target in enumerate(offsets):
        out[t] = kp * (target - position)
        position = position + follow * (target - position)
    return out


def fit_to_limits(description: RobotDescription, offsets: FloatArray, *, smooth: bool) -> FloatArray:
    """Return the factor, at most 1, by which each joint's signal must be scaled to keep the limits, (A,).

    The limits: target range, change of the target between two commands, half the trip speed, and for smooth
    signals the predicted effort. Steps request more effort than available on purpose, to show the effort
    limit.

    Args:
        description: The robot.
        offsets: The signal at each control period, (T, A).
        smooth: Whether effort and speed count.
    """
    limits = description.limits
    step = np.max(np.abs(np.diff(offsets, axis=0, prepend=0.0)), axis=0)
    pairs = [
        (np.max(np.abs(offsets), axis=0), room(description)),
        (step, MARGIN * np.array(limits.target_step)),
    ]
    if smooth and description.actuation == "position":
        trip = np.array(limits.trip_velocity)[list(description.actuated_index)]
        pairs.append((step * description.control_rate_hz, np.where(description.servos, 0.5 * trip, np.inf)))
        effort = np.max(np.abs(predicted_effort(description, offsets)), axis=0)
        pairs.append((effort, np.where(description.servos, limits.effort, np.inf)))
    scale = np.ones(offsets.shape[1])
    for found, most in pairs:
        over = (found > most) & np.isfinite(most)
        # An infinite limit is no limit.
        ratio = np.where(over, most, 0.0) / np.where(over, found, 1.0)
        scale = np.where(over, np.minimum(scale, ratio), scale)
    return np.asarray(scale)


def largest_factor(default: Sequence[float], most: Sequence[float]) -> float:
    """Return the largest factor, at least 1, on defaults, (A,), that stays within limits, (A,)."""
    ratios = [m / d for d, m in zip(default, most, strict=True) if d > 0 and math.isfinite(d)]
    return max(min(ratios, default=1.0), 1.0)
