"""Parameter sets that robots of Unitree share."""

from __future__ import annotations

from collections.abc import Sequence

from deal_hw.parameters import Parameter, ParameterSpace

Groups = Sequence[tuple[str, tuple[str, ...]]]
"""Names, each with the joints that share a value."""


def each(joints: Sequence[str]) -> Groups:
    """Return a group for each joint."""
    return tuple((joint, (joint,)) for joint in joints)


def joint_space(
    groups: Groups,
    *,
    stiffness: Sequence[float],
    damping: Sequence[float],
    frictionloss: Sequence[float],
    armature: Sequence[float],
    bias: Sequence[str] = (),
    bias_rad: float = 0.1,
) -> ParameterSpace:
    """Return stiffness, damping, frictionloss and armature of joints whose base is held.

    Damping is the damping at the joint: the sum of the motor's and of the joint's viscous friction. No
    recording determines the two alone.

    Args:
        groups: The joints (G).
        stiffness: Nominal values, (G,) [N·m/rad].
        damping: The same [N·m·s/rad].
        frictionloss: The same [N·m].
        armature: The same [kg·m²].
        bias: Joints that have an encoder bias, too.
        bias_rad: Largest bias to both sides [rad].
    """
    rows = (
        ("stiffness", "servo_stiffness", "N·m/rad", stiffness),
        ("damping", "servo_damping", "N·m·s/rad", damping),
        ("frictionloss", "dof_frictionloss", "N·m", frictionloss),
        ("armature", "dof_armature", "kg·m²", armature),
    )
    parameters = [
        Parameter.around(f"{group}.{name}", kind, elements, unit, value)
        for name, kind, unit, values in rows
        for (group, elements), value in zip(groups, values, strict=True)
    ]
    return ParameterSpace([*parameters, *(Parameter.encoder_bias(joint, bias_rad) for joint in bias)])


def gain_space(joints: Sequence[str], stiffness: float, damping: float) -> ParameterSpace:
    """Return stiffness and damping of each joint's motor, with the same nominal values for all."""
    return ParameterSpace(
        [
            Parameter.around(f"{joint}.{name}", kind, (joint,), unit, value)
            for name, kind, unit, value in (
                ("stiffness", "servo_stiffness", "N·m/rad", stiffness),
                ("damping", "servo_damping", "N·m·s/rad", damping),
            )
            for joint in joints
        ]
    )


def walk_space(
    gains: ParameterSpace,
    parts: Groups,
    *,
    trunk_kg: float,
    floor_friction: float,
    frictionloss: float,
) -> ParameterSpace:
    """Return the parameters for a walk: gains, the trunk and its load, friction of floor and joints.

    Args:
        gains: Gains of each joint.
        parts: Joints that share a friction, by the part's name.
        trunk_kg: Nominal mass of the trunk [kg].
        floor_friction: Nominal sliding friction of the floor.
        frictionloss: Nominal friction of each joint [N·m].
    """
    return ParameterSpace(
        [
            *gains.parameters,
            Parameter.around("base.mass", "body_mass", ("base",), "kg", trunk_kg, ratio=1.5),
            Parameter.around("floor.friction", "geom_friction", ("floor",), "-", floor_friction, ratio=2.0),
            *(
                Parameter.around(f"{part}s.frictionloss", "dof_frictionloss", joints, "N·m", frictionloss)
                for part, joints in parts
            ),
        ]
    )
