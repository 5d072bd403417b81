"""A commented params.yaml for any MJCF, as a start to edit."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from deal_hw.documentation import page
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters import KIND_TABLE
from deal_hw.sim.parameters.fields import element_id, element_names
from deal_hw.sim.parameters.kind import Kind, joint_of
from deal_hw.sim.parameters.yaml_space import parse_space

_HEAD = """\
# Parameters of {title} for `deal-hw calibrate --parameters`. Remove what you know or do not want to search.
# Every key is explained in {page}. Nominal values are the model's.
# A value of 0 has no ratio, so its line is commented out: give it a `nominal` or a `range`, remove the #.
# Measure what you can: `weighed: 0.35` fixes a mass, `prior: {{mean: 0.35, std: 0.02}}` says +-0.02 kg.
# `{{kind: inertial, elements: BODY}}` searches a body's ten inertial parameters around the model's values.
parameters:
"""
_LAWS = """\
  # Laws that no field of an MJCF holds. calibrate tries them itself where the model explains too little.
  # To search one, or more of them, yourself:
  # - {{kind: dof_friction_stribeck, elements: {joint}, nominal: {rest:.3g}}}  # more friction at rest by this
  # - {{kind: dof_stribeck_speed, elements: {joint}, nominal: 0.1}}  # speed at which that has fallen to 1/e
  # - {{kind: dof_friction_load, elements: {joint}, nominal: 0.02}}  # friction a torque through the gear
"""
_ON = (
    "dof_frictionloss",
    "dof_damping",
    "dof_armature",
    "servo_stiffness",
    "servo_damping",
    "motor_gain",
    "body_mass",
    "encoder_bias",
)
_OFF = ("dof_friction_creep",)
_LIMIT = "servo_effort_limit"


def template(model: Any, title: str = "this model", at_limit: Collection[str] = ()) -> str:
    """Return a params.yaml with what an owner doubts: friction, damping, armature, gains, masses and zeros.

    A drive's effort limit follows as a comment, and so does the smaller one of a joint's two dampings, unless
    the drive reaches its limit: there the limit acts, and cuts the drive's damping, but not the joint's.
    Without a measured mass or a known torque, no motion shows the common scale of masses, frictions and
    gains: the expected value of each mass holds it.

    Args:
        model: The MjModel.
        title: Name of the model in the head of the file.
        at_limit: Actuators that reach their effort limit.
    """
    lines = [_HEAD.format(title=title, page=page("reference/parameters.md"))]
    for name in _ON:
        lines += _section(model, KIND_TABLE[name], _searchable(model, KIND_TABLE[name], at_limit))
    for name in _OFF:
        lines += _section(model, KIND_TABLE[name], ())
    limited = [name for name, value, _ in _rows(model, KIND_TABLE[_LIMIT]) if name in at_limit and value > 0]
    lines += _section(model, KIND_TABLE[_LIMIT], limited)
    if not any(line.startswith("  - ") for line in lines):
        raise ConfigurationError(
            f"{title} has no named joint or actuator with a friction, damping, armature or gain above 0; "
            "name them in the MJCF and give them values"
        )
    filters = [row for row in _rows(model, KIND_TABLE["command_lag"]) if row[1] > 0]
    if filters:
        lines.append("  # Filters of the MJCF: remove the # to search their time constants.\n")
        lines += [
            f"  # - {{kind: command_lag, elements: {_quoted(n)}}}  # {v:.6g} s\n" for n, v, _ in filters
        ]
    rubbing = [(name, value) for name, value, _ in _rows(model, KIND_TABLE["dof_frictionloss"]) if value > 0]
    if rubbing:
        lines.append(_LAWS.format(joint=_quoted(rubbing[0][0]), rest=rubbing[0][1]))
    return "".join(lines)


def left_at_zero(model: Any) -> dict[str, list[str]]:
    """Return the joints whose friction, damping or armature is 0: the template does not search these.

    A joint whose servo has a damping above 0 needs no other.
    """
    servos = [name for name, value, _ in _rows(model, KIND_TABLE["servo_damping"]) if value > 0]
    damped = {model.joint(joint_of(model, element_id(model, "actuator", name))).name for name in servos}
    found = {}
    for kind in ("dof_frictionloss", "dof_damping", "dof_armature"):
        served = damped if kind == "dof_damping" else ()
        found[kind] = [
            name for name, value, _ in _rows(model, KIND_TABLE[kind]) if value == 0 and name not in served
        ]
    return {kind: joints for kind, joints in found.items() if joints}


def default_space(model: Any, at_limit: Collection[str] = ()) -> ParameterSpace:
    """Return the default parameters of a model: those of its :func:`template`."""
    text = template(model, at_limit=at_limit)
    return parse_space(text, model, "the default parameters (see --write-parameters)")


def _section(model: Any, kind: Kind, active: Collection[str]) -> list[str]:
    rows = list(_rows(model, kind))
    if not rows:
        return []
    lines = [f"  # {kind.name} [{rows[0][2]}]; moves along: {kind.along}\n"]
    for element, value, unit in rows:
        text = f"- {{kind: {kind.name}, elements: {_quoted(element)}}}"
        # The sum with 0 makes -0.0 a 0.
        lines.append(f"  {'' if element in active else '# '}{text}  # {value + 0.0:.6g} {unit}\n")
    return lines


def _searchable(model: Any, kind: Kind, at_limit: Collection[str]) -> list[str]:
    """Return the elements of which an owner doubts a quantity that the model has."""
    return [
        element
        for element, value, _ in _rows(model, kind)
        if (kind.scale == "linear" or value > 0) and not _doubled(model, kind, element, at_limit)
    ]


def _doubled(model: Any, kind: Kind, element: str, at_limit: Collection[str]) -> bool:
    """Return whether another damping of the joint is larger: they add up, and one of them is enough."""
    if kind.name not in ("servo_damping", "dof_damping"):
        return False
    joint = element_id(model, kind.element, element)
    joint = joint if kind.element == "joint" else joint_of(model, joint)
    if any(joint_of(model, element_id(model, "actuator", name)) == joint for name in at_limit):
        return False
    own, of_servo = _dampings(model, joint)
    return own > of_servo if kind.name == "servo_damping" else own <= of_servo


def _dampings(model: Any, joint: int) -> tuple[float, float]:
    """Return the damping of a joint, and the largest of its servos; 0 for an actuator of no joint."""
    if joint < 0:
        return 0.0, 0.0
    servo = KIND_TABLE["servo_damping"]
    served = [
        value
        for name, value, _ in _rows(model, servo)
        if joint_of(model, element_id(model, servo.element, name)) == joint
    ]
    return float(np.ravel(model.dof_damping[model.jnt_dofadr[joint]])[0]), max(served, default=0.0)


def _rows(model: Any, kind: Kind) -> Iterable[tuple[str, float, str]]:
    for index, name in enumerate(element_names(model, kind.element)):
        if not name or (kind.element == "body" and index == 0):
            continue
        try:
            if kind.usable is not None:
                kind.usable(model, index, name)
        except ConfigurationError:
            continue
        yield name, 0.0 if kind.baseline is None else kind.baseline(model, index), kind.unit_of(model, index)


def _quoted(name: str) -> str:
    """Quote a name, so that YAML always reads it as text."""
    return '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
