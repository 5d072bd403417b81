"""The parameters that a calibration searches of any model, where nobody names others."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Final

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters import KIND_TABLE
from deal_hw.sim.parameters.fields import element_names
from deal_hw.sim.parameters.followers import natural_followers
from deal_hw.sim.parameters.kind import Kind, joint_of

DEFAULT_KINDS: Final = (
    "dof_frictionloss",
    "dof_damping",
    "dof_armature",
    "servo_stiffness",
    "servo_damping",
    "motor_gain",
    "body_mass",
    "encoder_bias",
    "servo_effort_limit",
)
"""What an owner doubts, in the order of the space; an effort limit only where a drive reaches it."""
_ZEROS: Final = ("dof_frictionloss", "dof_damping", "dof_armature")


def default_space(model: Any, at_limit: Collection[str] = ()) -> ParameterSpace:
    """Return what an owner doubts of a model: friction, damping, armature, gains, masses and zeros.

    A quantity that is 0 in the model has no ratio around it, so it is not searched. Of a joint's two dampings
    the smaller one is left out, since they add up, unless the drive reaches its effort limit: there the limit
    acts, and cuts the drive's damping, but not the joint's. Without a measured mass or a known torque, no
    motion shows the common scale of masses, frictions and gains: the expected value of each mass holds it
    (:func:`~deal_hw.sim.parameters.with_doubts`).

    Args:
        model: The MjModel.
        at_limit: Actuators that reach their effort limit.

    Returns:
        Parameters with the kind's usual range and scale, without priors, each of one element.

    Raises:
        ConfigurationError: The model has no such quantity at an element with a name.
    """
    actuators = enumerate(element_names(model, "actuator"))
    limited = {joint_of(model, index) for index, name in actuators if name in at_limit}
    found = [
        kind.usual_parameter(model, index, element)
        for kind in (KIND_TABLE[name] for name in DEFAULT_KINDS)
        for index, element, value in usable_elements(model, kind)
        if value > 0 or kind.scale == "linear"
        if element in at_limit or kind.name != "servo_effort_limit"
        if not _is_doubled(model, kind, index, limited)
    ]
    if not found:
        raise ConfigurationError(
            "the model has no named joint or actuator with a friction, damping, armature or gain above 0; "
            "name them in the MJCF and give them values"
        )
    return ParameterSpace(found)


def left_at_zero(model: Any) -> dict[str, list[str]]:
    """Return the joints whose friction, damping or armature is 0: the default space lacks these.

    A joint whose servo has a damping above 0 needs no other.
    """
    servos = [index for index, _, value in usable_elements(model, KIND_TABLE["servo_damping"]) if value > 0]
    damped = {model.joint(joint_of(model, index)).name for index in servos}
    found = {}
    for kind in _ZEROS:
        served = damped if kind == "dof_damping" else ()
        rows = usable_elements(model, KIND_TABLE[kind])
        found[kind] = [name for _, name, value in rows if value == 0 and name not in served]
    return {kind: joints for kind, joints in found.items() if joints}


def usable_elements(model: Any, kind: Kind) -> Iterator[tuple[int, str, float]]:
    """Yield number, name and value of each element that can have a kind; 0 where a model has no value.

    Elements without a name, which no parameter can name, and the world are none of them.
    """
    # What a joint that follows another one does to the motion acts on that one, too.
    led = {f.joint for f in natural_followers(model)} if kind.element == "joint" else set()
    for index, name in enumerate(element_names(model, kind.element)):
        if not name or index in led or (kind.element == "body" and index == 0):
            continue
        try:
            if kind.usable is not None:
                kind.usable(model, index, name)
        except ConfigurationError:
            continue
        yield index, name, 0.0 if kind.baseline is None else kind.baseline(model, index)


def _is_doubled(model: Any, kind: Kind, index: int, limited: Collection[int]) -> bool:
    """Return whether another damping of the joint is larger: they add up, and one of them is enough.

    In ``limited`` joints both act.
    """
    if kind.name not in ("servo_damping", "dof_damping"):
        return False
    joint = index if kind.element == "joint" else joint_of(model, index)
    if joint in limited:
        return False
    own, of_servo = _dampings(model, joint)
    return own > of_servo if kind.name == "servo_damping" else own <= of_servo


def _dampings(model: Any, joint: int) -> tuple[float, float]:
    """Return the damping of a joint, and the largest of its servos; 0 for an actuator of no joint."""
    if joint < 0:
        return 0.0, 0.0
    served = [
        value
        for index, _, value in usable_elements(model, KIND_TABLE["servo_damping"])
        if joint_of(model, index) == joint
    ]
    return float(np.ravel(model.dof_damping[model.jnt_dofadr[joint]])[0]), max(served, default=0.0)
