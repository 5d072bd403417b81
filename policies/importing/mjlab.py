"""The metadata that mjlab writes into its ONNX files; its lists are text with commas.

Numbers have three decimals there. Control rate, factors, history and command ranges are not in it. Read at
mujocolab/mjlab @ 0eda4e7: tasks/velocity/rl/exporter.py; a later version is in felipeosmar/unitree_rl_mjlab @
a31f350.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from deal_hw.errors import ConfigurationError, shown
from deal_hw.policies.importing.manifest import (
    AXES_OF,
    ForeignPolicy,
    ForeignTerm,
    actions_around,
    joints_of,
    quantity_of,
)
from deal_hw.policies.importing.supplement import (
    REST,
    Supplement,
    parse_history,
    parse_values,
)
from deal_hw.policy import Quantity

FORMAT: Final = "mjlab"
TERMS: Final[Mapping[str, Quantity]] = {
    "base_ang_vel": "angular_velocity",
    "projected_gravity": "gravity",
    "joint_pos": "position",
    "joint_pos_rel": "position",
    "joint_vel": "velocity",
    "joint_vel_rel": "velocity",
    "actions": "action",
    "last_action": "action",
    "command": "command",
    "velocity_commands": "command",
    "phase": "clock",
}
"""Observation terms of mjlab's velocity tasks."""
NEEDED: Final = (
    "joint_names",
    "joint_stiffness",
    "joint_damping",
    "default_joint_pos",
    "observation_names",
    "action_scale",
)
TOLERANCE: Final = 2e-3
"""Largest difference of a number with three decimals from that of a side file."""
_MOST_NAMES: Final = 256


def is_metadata(metadata: Mapping[str, str]) -> bool:
    """Return whether metadata are mjlab's."""
    return "observation_names" in metadata and "joint_names" in metadata


def term_names(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """Return the names of the observation's terms; () if there are none."""
    return _names(metadata, "observation_names") if is_metadata(metadata) else ()


def parse(metadata: Mapping[str, str], answers: Supplement, robot: str) -> ForeignPolicy:
    """Return the policy that metadata describe.

    Raises:
        ConfigurationError: A value is wrong or missing; the message names it.
        PolicyMismatchError: A term is not measured.
    """
    for name in NEEDED:
        if not metadata.get(name, "").strip():
            raise ConfigurationError(f"mjlab's metadata: {name} is missing")
    joints = _names(metadata, "joint_names")
    terms = term_names(metadata)
    for name in terms:
        quantity_of(name, TERMS, FORMAT, robot)
    if answers.get("joints"):
        joints = _renamed(joints, answers.joints)
    stiffness, damping, default, scale = (
        _numbers(metadata, name, len(joints))
        for name in ("joint_stiffness", "joint_damping", "default_joint_pos", "action_scale")
    )
    rate = answers.need("control_rate", "mjlab's metadata do not say the control rate", "50")
    scales = parse_values(
        answers.need(
            "observation_scales",
            "mjlab's metadata do not say the factors of the observation's terms",
            "1 (no factors; or base_ang_vel=0.2,joint_vel=0.05)",
        ),
        "--observation-scales",
        terms,
    )
    history = parse_history(
        answers.need(
            "history",
            "mjlab's metadata do not say how many values of each term the observation has",
            "1 (the present alone; or joint_pos=5)",
        ),
        terms,
    )
    clip = answers.get("observation_clip")
    commanded = any(TERMS[name] == "command" for name in terms)
    clocked = any(TERMS[name] == "clock" for name in terms)
    return ForeignPolicy(
        format=FORMAT,
        joints=joints_of(joints, default, stiffness, damping),
        actions=actions_around(joints, default, scale),
        terms=tuple(_term(name, joints, scales[name], history[name], clip) for name in terms),
        control_rate_hz=rate,
        command_range=_range(answers) if commanded else (),
        clock_hz=_clock(answers) if clocked else 0.0,
        clock_rest=_rest(answers) if clocked else 0.0,
        notes=_notes(stiffness, damping),
    )


def check_agrees(metadata: Mapping[str, str], policy: ForeignPolicy) -> None:
    """Check that metadata do not contradict a side file.

    Raises:
        ConfigurationError: They do; the message names what differs.
    """
    joints = tuple(joint.name for joint in policy.joints)
    named = _names(metadata, "joint_names")
    _compare("joint_names", named, joints)
    of_terms = [TERMS[name] for name in term_names(metadata) if name in TERMS]
    if len(of_terms) == len(term_names(metadata)):
        _compare("observation_names", of_terms, [term.quantity for term in policy.terms])
    for name, values in (
        ("default_joint_pos", [joint.default for joint in policy.joints]),
        ("joint_stiffness", [joint.stiffness for joint in policy.joints]),
        ("joint_damping", [joint.damping for joint in policy.joints]),
        ("action_scale", [action.scale for action in policy.actions]),
    ):
        if not metadata.get(name):
            continue
        noted = _numbers(metadata, name, len(values))
        # Three decimals here, three digits there.
        if any(abs(a - b) > TOLERANCE + 5e-3 * abs(b) for a, b in zip(noted, values, strict=True)):
            _compare(name, noted, values)


def _compare(name: str, noted: Sequence[object], given: Sequence[object]) -> None:
    if list(noted) != list(given):
        raise ConfigurationError(
            f"{name} of the network's own metadata is {shown(', '.join(map(str, noted)))}, by the side file "
            f"it is {shown(', '.join(map(str, given)))}; they belong to different policies, or an order is "
            "wrong"
        )


def _names(metadata: Mapping[str, str], key: str) -> tuple[str, ...]:
    names = tuple(part.strip() for part in metadata[key].split(","))
    if not 1 <= len(names) <= _MOST_NAMES or not all(names) or len(set(names)) < len(names):
        raise ConfigurationError(
            f"mjlab's metadata: {key} is {shown(metadata[key])}; allowed are 1 to {_MOST_NAMES} names with "
            "commas between, none twice"
        )
    return names


def _numbers(metadata: Mapping[str, str], key: str, length: int) -> tuple[float, ...]:
    try:
        found = [float(part) for part in metadata[key].split(",")]
    except ValueError:
        found = []
    if key == "action_scale" and len(found) == 1:
        found *= length
    # Written so that NaN is refused, too.
    if len(found) != length or not all(-1e9 <= value <= 1e9 for value in found):
        raise ConfigurationError(
            f"mjlab's metadata: {key} is {shown(metadata[key])}; allowed are {length} finite numbers with "
            "commas between, one for each of joint_names"
        )
    return tuple(found)


def _renamed(names: Sequence[str], given: Sequence[str]) -> tuple[str, ...]:
    if len(given) != len(names):
        raise ConfigurationError(
            f"--joints has {len(given)} names, the policy has {len(names)} joints: {', '.join(names)}"
        )
    if set(given) == set(names) and tuple(given) != tuple(names):
        raise ConfigurationError(
            "--joints has the names of the policy's metadata in another order, which would exchange joints; "
            "leave it out"
        )
    return tuple(given)


def _term(name: str, joints: Sequence[str], scale: float, history: int, clip: float | None) -> ForeignTerm:
    quantity = TERMS[name]
    elements = AXES_OF.get(quantity, tuple(joints))
    return ForeignTerm(
        name=name,
        quantity=quantity,
        elements=elements,
        scale=(scale,) * len(elements),
        clip=None if clip is None else (-clip, clip),
        history=history,
    )


def _range(answers: Supplement) -> tuple[tuple[float, float], ...]:
    return answers.need_command_range("mjlab's metadata do not say the range of the velocity commands")


def _clock(answers: Supplement) -> float:
    why = "mjlab's metadata do not say how often the clock (phase) turns"
    return float(answers.need("clock", why, "1.667 (turns per second, 1/period)"))


def _rest(answers: Supplement) -> float:
    why = "mjlab's metadata do not say what the clock (phase) reads while the command is to stand"
    return REST if answers.need("clock_at_rest", why, "zero (or runs)") == "zero" else 0.0


def _notes(stiffness: Sequence[float], damping: Sequence[float]) -> tuple[str, ...]:
    notes = [
        "mjlab's metadata have three decimals: gains and scales may be off by 0.0005",
        "targets are taken to be around the default pose (use_default_offset), which the metadata do not say",
    ]
    if len(set(stiffness)) > 1 or len(set(damping)) > 1:
        notes.append(
            "early versions of mjlab list gains by actuator, not by joint: compare them with those of the "
            "training"
        )
    return tuple(notes)
