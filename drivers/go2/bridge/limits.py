"""Limits of a LowCmd: those of the driver's description, checked again on the robot's computer."""

from __future__ import annotations

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.drivers.go2.messages.low_command import LowCommand
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.motor_command import MODE_OFF, MODE_SERVO
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray

ROUNDING = 1e-5
"""Relative tolerance, since the wire has float32: a value at its float64 limit may exceed it by this
share."""


def is_damping(command: LowCommand) -> bool:
    """Return whether a command only brakes every joint; positions have no effect then."""
    return bool(
        (command.mode == MODE_SERVO).all()
        and (command.damping > 0.0).all()
        and not command.stiffness.any()
        and not command.effort.any()
        and not command.velocity.any()
    )


class CommandLimits:
    """Checks commands one by one.

    Args:
        description: The robot, with its limits.
        effort_margin: See :class:`~deal_hw.drivers.go2.bridge.config.BridgeConfig`.

    Raises:
        ConfigurationError: The description has no limits for legs.
    """

    def __init__(self, description: RobotDescription, effort_margin: float) -> None:
        limits = description.limits
        if limits.legs is None:
            raise ConfigurationError(
                f"robot {description.name!r} has no limits for legs, so it cannot be "
                "bridged; the bridge is for go2"
            )
        slack = 1.0 + ROUNDING
        self._joints = description.actuated
        low, high = np.array(limits.target).T
        self._low, self._high = low - ROUNDING * np.abs(low), high + ROUNDING * np.abs(high)
        self._stiffness = slack * np.array(limits.stiffness)
        self._damping = slack * np.array(limits.damping)
        self._effort = slack * np.array(limits.effort)
        self._predicted = effort_margin * np.array(limits.legs.effort)

    def complaint(self, command: LowCommand, frame: LowStateFrame | None) -> str:
        """Return a text on the limit that a command exceeds; "" if it may be sent.

        Args:
            command: As decoded.
            frame: The newest state; None before the first.
        """
        numbers = np.concatenate(
            (command.position, command.velocity, command.stiffness, command.damping, command.effort)
        )
        if not np.isfinite(numbers).all():
            return "a number is not finite"
        if not np.isin(command.mode, (MODE_OFF, MODE_SERVO)).all():
            return (
                f"motor modes {command.mode.tolist()}; allowed are {MODE_OFF} (off) and {MODE_SERVO} (servo)"
            )
        kp, kd = command.stiffness, command.damping
        # Without a gain a target has no effect. It is not checked: the vendor's "stop" values are outside any
        # range.
        target = np.where(kp > 0.0, command.position, 0.5 * (self._low + self._high))
        none = np.zeros_like(kp)
        for name, value, low, high, unit in (
            ("stiffness", kp, none, self._stiffness, "N·m/rad"),
            ("damping", kd, none, self._damping, "N·m·s/rad"),
            ("target", target, self._low, self._high, "rad"),
            ("feed-forward", command.effort, -self._effort, self._effort, "N·m"),
        ):
            if text := self._outside(name, value, low, high, unit):
                return text
        # Damping alone only removes energy, at any joint speed.
        if is_damping(command):
            return ""
        if frame is None:
            return "no valid state of the robot is known, so the requested torque is unknown"
        torque = kp * np.where(kp > 0.0, command.position - frame.position, 0.0)
        torque += kd * (np.where(kd > 0.0, command.velocity, 0.0) - frame.velocity) + command.effort
        return self._outside("torque now", torque, -self._predicted, self._predicted, "N·m")

    def _outside(self, name: str, value: FloatArray, low: FloatArray, high: FloatArray, unit: str) -> str:
        # Written so that a measured NaN counts as outside, too.
        wrong = ~((value >= low) & (value <= high))
        if not wrong.any():
            return ""
        joint = int(wrong.argmax())
        return (
            f"{name} of joint {self._joints[joint]!r} is {value[joint]:.4g} {unit}, allowed are "
            f"{low[joint]:.4g} to {high[joint]:.4g}"
        )
