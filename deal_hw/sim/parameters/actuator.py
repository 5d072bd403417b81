"""Parameter kinds of position servos: force = clip(kp (setpoint - q) - kd q', +-limit)."""

from __future__ import annotations

from collections.abc import Sequence

from deal_hw.sim.fields import Array, Fields, element_id


def servo_stiffness(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set kp [N/m or N·m/rad]."""
    gain, bias = fields.get("actuator_gainprm"), fields.get("actuator_biasprm")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        gain[:, actuator, 0] = values
        bias[:, actuator, 1] = -values


def servo_damping(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set kd [N·s/m or N·m·s/rad]."""
    bias = fields.get("actuator_biasprm")
    for name in elements:
        bias[:, element_id(fields.model, "actuator", name), 2] = -values


def servo_effort_limit(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the effort limit [N or N·m], the same to both sides."""
    limit = fields.get("actuator_forcerange")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        limit[:, actuator, 0] = -values
        limit[:, actuator, 1] = values
