"""A commented params.yaml for any MJCF, as a start to edit: the default space, written for people."""

from __future__ import annotations

from typing import Any, Final

from deal_hw.documentation import page
from deal_hw.sim.parameters import KIND_TABLE
from deal_hw.sim.parameters.default_space import DEFAULT_KINDS, default_space, usable_elements

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
_LAST: Final = "servo_effort_limit"
_KINDS: Final = (*(name for name in DEFAULT_KINDS if name != _LAST), "dof_friction_creep", _LAST)
"""Kinds with a section, in the order of the file."""


def template(model: Any, title: str = "this model") -> str:
    """Return a params.yaml with a line for each parameter of the default space.

    What could be searched beside it follows as comments: quantities that are 0, effort limits, the smaller
    one of a joint's two dampings, filters of the MJCF, and laws that no MJCF holds.

    Args:
        model: The MjModel.
        title: Name of the model in the head of the file.

    Raises:
        ConfigurationError: The model has nothing to search.
    """
    searched = {(p.kind, element) for p in default_space(model) for element in p.elements}
    lines = [_HEAD.format(title=title, page=page("reference/parameters.md"))]
    for name in _KINDS:
        lines += _section(model, name, searched)
    filters = [row for row in usable_elements(model, KIND_TABLE["command_lag"]) if row[2] > 0]
    if filters:
        lines.append("  # Filters of the MJCF: remove the # to search their time constants.\n")
        lines += [
            f"  # - {{kind: command_lag, elements: {_quoted(n)}}}  # {v:.6g} s\n" for _, n, v in filters
        ]
    rubbing = [row for row in usable_elements(model, KIND_TABLE["dof_frictionloss"]) if row[2] > 0]
    if rubbing:
        _, joint, friction = rubbing[0]
        lines.append(_LAWS.format(joint=_quoted(joint), rest=friction))
    return "".join(lines)


def _section(model: Any, name: str, searched: set[tuple[str, str]]) -> list[str]:
    kind = KIND_TABLE[name]
    rows = [(kind.unit_of(model, index), element, v) for index, element, v in usable_elements(model, kind)]
    if not rows:
        return []
    lines = [f"  # {name} [{rows[0][0]}]; moves along: {kind.along}\n"]
    for unit, element, value in rows:
        mark = "" if (name, element) in searched else "# "
        # The sum with 0 makes -0.0 a 0.
        entry = f"- {{kind: {name}, elements: {_quoted(element)}}}"
        lines.append(f"  {mark}{entry}  # {value + 0.0:.6g} {unit}\n")
    return lines


def _quoted(name: str) -> str:
    """Quote a name, so that YAML always reads it as text."""
    return '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
