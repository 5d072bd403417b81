"""The deploy.yaml of unitree_rl_lab and unitree_rl_mjlab, which lies beside their ONNX files.

Its orders differ: ``joint_ids_map[i]`` is the motor of the policy's joint i. ``stiffness`` and ``damping``
are in the order of the motors; default_joint_pos, actions and observations are in that of the policy.
Observations keep their history term by term, from the oldest value to the present.

Read at unitree_rl_lab @ e72a072 and in PMY9527/unitree_rl_lab @ 25d7e9f and felipeosmar/unitree_rl_mjlab @
a31f350: utils/export_deploy_cfg.py and deploy/include/isaaclab.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from deal_hw.errors import ConfigurationError, shown
from deal_hw.policies.importing.manifest import (
    AXES_OF,
    ForeignAction,
    ForeignPolicy,
    ForeignTerm,
    check_history,
    joints_of,
    quantity_of,
)
from deal_hw.policies.importing.reading import flag, motor_names, row, section, span, whole
from deal_hw.policies.importing.supplement import REST, Supplement
from deal_hw.policy import Quantity
from deal_hw.reading import number, object_of, read_yaml, reading

FORMAT: Final = "unitree_rl_lab"
SLICE_TAG: Final = "tag:yaml.org,2002:python/object/apply:builtins.slice"
"""Isaac Lab writes "all joints" so."""
TERMS: Final[Mapping[str, Quantity]] = {
    "base_ang_vel": "angular_velocity",
    "projected_gravity": "gravity",
    "velocity_commands": "command",
    "keyboard_velocity_commands": "command",
    "joint_pos_rel": "position",
    "joint_vel_rel": "velocity",
    "last_action": "action",
    "gait_phase": "clock",
}
"""Observation terms of the format's own runners."""
_ACTION: Final = "JointPositionAction"
_KEYS: Final = "joint_ids_map step_dt stiffness damping default_joint_pos commands actions observations"
_ACTION_KEYS: Final = ("clip", "joint_names", "scale", "offset", "joint_ids")
_TERM_KEYS: Final = ("params", "clip", "scale", "history_length")
_SWITCHES: Final = ("scale_first", "use_gym_history")
_RANGES: Final = ("lin_vel_x", "lin_vel_y", "ang_vel_z")


def read_deploy_yaml(path: Path) -> Any:
    """Return the plain values of a deploy.yaml; no tag but that of "all joints" is known.

    Raises:
        ConfigurationError: It cannot be read.
    """
    with reading(path, "YAML", error=ConfigurationError):
        return read_yaml(path, {SLICE_TAG: _all_joints})


def is_deploy_yaml(values: Any) -> bool:
    """Return whether values are those of this format."""
    return isinstance(values, Mapping) and "joint_ids_map" in values and "observations" in values


def parse(values: Any, answers: Supplement, robot: str, names: Sequence[str] = ()) -> ForeignPolicy:
    """Return the policy that a deploy.yaml describes.

    Args:
        values: Its values.
        answers: What the operator says.
        robot: The robot's name.
        names: The terms of the network's own metadata, if it has any: one of mjlab reads its clock as zero
            at rest.

    Raises:
        ConfigurationError: A value is wrong or missing; the message names it.
        PolicyMismatchError: A term is not measured.
    """
    keys = _KEYS.split()
    found = section(values, "deploy.yaml", keys, [key for key in keys if key != "commands"])
    joints = motor_names(found["joint_ids_map"], "joint_ids_map", answers.get("motors") or (), robot)
    if answers.get("joints") and tuple(answers.joints) != joints:
        raise ConfigurationError(
            f"--joints has {', '.join(answers.joints)}, joint_ids_map has {', '.join(joints)}; one is wrong"
        )
    slots = [int(slot) for slot in found["joint_ids_map"]]
    motors = max(
        len(found[name]) if isinstance(found[name], list) else 0 for name in ("stiffness", "damping")
    )
    stiffness, damping = (
        row(found[name], name, max(motors, len(slots))) for name in ("stiffness", "damping")
    )
    if max(slots) >= len(stiffness):
        raise ConfigurationError(
            f"stiffness and damping have {len(stiffness)} numbers, in the order of the motors; joint_ids_map "
            f"names motor {max(slots)}"
        )
    default = row(found["default_joint_pos"], "default_joint_pos", len(joints))
    actions = _actions(found["actions"], joints)
    terms, frames, clock_hz = _terms(found["observations"], joints, actions, robot)
    notes, rest = [], 0.0
    if clock_hz:
        rest, note = _rest(answers, names)
        notes.append(note)
    return ForeignPolicy(
        format=FORMAT,
        joints=joints_of(
            joints, default, [stiffness[slot] for slot in slots], [damping[slot] for slot in slots]
        ),
        actions=actions,
        terms=terms,
        frames=frames,
        control_rate_hz=1.0 / number(found["step_dt"], "step_dt", 1e-4, 10.0),
        command_range=_ranges(found.get("commands"), terms, answers),
        clock_hz=clock_hz,
        clock_rest=rest,
        notes=tuple(notes),
    )


def _all_joints(node: Any) -> None:
    parts = node.value
    if not isinstance(parts, list) or [getattr(p, "value", None) for p in parts] not in (
        ["null"] * 3,
        ["~"] * 3,
        [""] * 3,
    ):
        raise ConfigurationError("a slice of joints that is not [null, null, null]; list the joints' numbers")


def _actions(values: Any, joints: Sequence[str]) -> tuple[ForeignAction, ...]:
    kinds = object_of(values, "actions")
    if list(kinds) != [_ACTION]:
        raise ConfigurationError(
            f"actions: {shown(', '.join(map(str, kinds)))}; one action term is known, {_ACTION}, position "
            "targets of joints"
        )
    term = section(kinds[_ACTION], f"actions.{_ACTION}", _ACTION_KEYS)
    driven = _joints(term.get("joint_ids"), "joint_ids", joints)
    scale, offset = (
        (usual,) * len(driven) if term.get(name) is None else row(term[name], f"actions.{name}", len(driven))
        for name, usual in (("scale", 1.0), ("offset", 0.0))
    )
    clip = term.get("clip")
    if clip is not None and (not isinstance(clip, list) or len(clip) != len(driven)):
        raise ConfigurationError(f"actions.clip must be null or {len(driven)} pairs, got {shown(clip)}")
    spans = [
        None if clip is None else span(pair, f"actions.clip[{i}]") for i, pair in enumerate(clip or driven)
    ]
    return tuple(
        ForeignAction(joint=name, scale=s, offset=o, range=ends)
        for name, s, o, ends in zip(driven, scale, offset, spans, strict=True)
    )


def _joints(values: Any, what: str, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the joints of a list of the policy's joint numbers; null stands for all."""
    if values is None:
        return tuple(joints)
    if not isinstance(values, list) or not values:
        raise ConfigurationError(f"{what} must be null or a list of joint numbers, got {shown(values)}")
    found = [whole(v, f"{what}[{i}]", 0, len(joints) - 1) for i, v in enumerate(values)]
    if len(set(found)) < len(found):
        raise ConfigurationError(f"{what} names a joint twice: {shown(values)}")
    return tuple(joints[n] for n in found)


def _terms(
    values: Any, joints: Sequence[str], actions: Sequence[ForeignAction], robot: str
) -> tuple[tuple[ForeignTerm, ...], bool, float]:
    """Return the terms, whether the history is one of whole frames, and the clock's turns per second."""
    found = dict(object_of(values, "observations"))
    if found and all(_is_group(value) for value in found.values()):
        if len(found) > 1:
            raise ConfigurationError(
                f"observations has the groups {shown(', '.join(map(str, found)))}; a network with one input "
                "has one"
            )
        found = dict(next(iter(found.values())))
    scale_first, frames = (flag(found.pop(name, False), f"observations.{name}") for name in _SWITCHES)
    terms, clock_hz = [], 0.0
    for name, value in found.items():
        what, quantity = f"observations.{name}", quantity_of(str(name), TERMS, FORMAT, robot)
        term = section(value, what, _TERM_KEYS)
        params = object_of(term.get("params") or {}, f"{what}.params")
        if quantity == "clock":
            if clock_hz:
                raise ConfigurationError("observations: a second clock; a spec has one")
            clock_hz = 1.0 / number(params.get("period"), f"{what}.params.period", 1e-3, 1e3)
        elements = _elements(quantity, params, what, joints, actions)
        scale, clip = term.get("scale"), term.get("clip")
        terms.append(
            ForeignTerm(
                name=name,
                quantity=quantity,
                elements=elements,
                scale=(1.0,) * len(elements) if scale is None else row(scale, f"{what}.scale", len(elements)),
                clip=None if clip is None else span(clip, f"{what}.clip"),
                scale_first=scale_first,
                history=_history(term.get("history_length"), name),
            )
        )
    if not terms:
        raise ConfigurationError("observations: there is no term")
    return tuple(terms), frames, clock_hz


def _is_group(value: Any) -> bool:
    """Return whether a value under ``observations`` is a group of terms."""
    return (
        isinstance(value, Mapping)
        and not set(_TERM_KEYS) & set(value)
        and any(isinstance(inner, Mapping) for inner in value.values())
    )


def _elements(
    quantity: Quantity,
    params: Mapping[str, Any],
    what: str,
    joints: Sequence[str],
    actions: Sequence[ForeignAction],
) -> tuple[str, ...]:
    if quantity in AXES_OF:
        return AXES_OF[quantity]
    if quantity == "action":
        return tuple(action.joint for action in actions)
    chosen = params.get("asset_cfg")
    ids = object_of(chosen, f"{what}.params.asset_cfg").get("joint_ids") if chosen is not None else None
    return _joints(ids or None, f"{what}.params.asset_cfg.joint_ids", joints)


def _history(value: Any, name: str) -> int:
    # Isaac Lab's 0 is no history: the present value alone.
    return check_history(name, 1 if value in (None, 0) else whole(value, f"{name}.history_length", 1, 10_000))


def _rest(answers: Supplement, names: Sequence[str]) -> tuple[float, str]:
    """Return the length of a command below which the clock is zero, and a sentence about it."""
    if "phase" in names:
        return (
            REST,
            f"the clock reads zero for commands below {REST:g}, as the network comes from unitree_rl_mjlab",
        )
    chosen = answers.need(
        "clock_at_rest",
        "deploy.yaml does not say what gait_phase reads while the command is to stand: in unitree_rl_lab it "
        "runs on, in unitree_rl_mjlab it is zero",
        "runs (or zero)",
    )
    if chosen == "runs":
        return 0.0, "the clock runs on while the command is to stand"
    return REST, f"the clock reads zero for commands below {REST:g}"


def _ranges(
    values: Any, terms: Sequence[ForeignTerm], answers: Supplement
) -> tuple[tuple[float, float], ...]:
    if not any(term.quantity == "command" for term in terms):
        return ()
    commands = object_of(values or {}, "commands")
    if "base_velocity" not in commands:
        return answers.need_command_range(
            "deploy.yaml has no commands.base_velocity, the range of the velocity commands"
        )
    base = section(commands["base_velocity"], "commands.base_velocity", ("ranges",), ("ranges",))
    what = "commands.base_velocity.ranges"
    ranges = section(base["ranges"], what, (*_RANGES, "heading"), _RANGES)
    return tuple(span(ranges[name], f"{what}.{name}") for name in _RANGES)
