"""How well a cart-pole was balanced, from its reported states: the task of the DEAL paper's Table 2.

The task never changes, so that results can be compared: 10 s of balancing from the home pose (cart in the
middle, pole upright, at rest). The result is computed from the reported states, the only ones that a real
robot has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.types import FloatArray, Trajectory

CART, POLE = 0, 1
"""Index of each joint."""

TASK_SECONDS = 10.0
FALLEN_RAD = 0.5
"""A pole beyond this angle counts as fallen [rad]: no cart of this size can raise it again."""


_SLACK_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class BalanceResult:
    """One run of the task.

    Attributes:
        angle_error_rad: Mean |pole angle| [rad]. The angle is taken modulo a turn: after a fall it is the
            remaining angle to upright, pi at most. All samples count alike.
        cart_speed_m_s: Mean |cart velocity| [m/s].
        fell: Whether the pole was ever beyond :data:`FALLEN_RAD`.
        upright_s: Time until then, or the whole duration [s].
        duration_s: The whole duration [s].
    """

    angle_error_rad: float
    cart_speed_m_s: float
    fell: bool
    upright_s: float
    duration_s: float


def wrapped_angle(angle: FloatArray) -> FloatArray:
    """Return angles modulo a turn, in [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def balance_result(
    position: FloatArray, velocity: FloatArray, period_s: float, duration_s: float | None = None
) -> BalanceResult:
    """Return the result of one run.

    Args:
        position: Reported joint positions (cart, pole), (T, 2).
        velocity: Reported joint velocities, (T, 2).
        period_s: Time between samples [s].
        duration_s: How long the run should have lasted [s]. If the safety module ended it early, the missing
            time counts as a hanging pole and a cart at rest. None: the recorded time.
    """
    missing = 0 if duration_s is None else max(0, round(duration_s / period_s) - len(position))
    # A recording has one sample more or less than its duration, depending on the time of the first one.
    if missing * period_s > _SLACK_S:
        position = np.concatenate([position, np.tile([0.0, np.pi], (missing, 1))])
        velocity = np.concatenate([velocity, np.zeros((missing, 2))])
    angle = np.abs(wrapped_angle(position[:, POLE]))
    fallen = angle > FALLEN_RAD
    fell = bool(fallen.any())
    return BalanceResult(
        angle_error_rad=float(angle.mean()),
        cart_speed_m_s=float(np.abs(velocity[:, CART]).mean()),
        fell=fell,
        upright_s=(int(np.argmax(fallen)) if fell else len(angle)) * period_s,
        duration_s=len(angle) * period_s,
    )


def recorded_balance(trajectory: Trajectory) -> BalanceResult | None:
    """Return the result of a recording, from its first to its last sample; None if it has fewer than two."""
    if len(trajectory.device_s) < 2:
        return None
    period_s = float(np.median(np.diff(trajectory.device_s)))
    return balance_result(trajectory.position, trajectory.velocity, period_s)
