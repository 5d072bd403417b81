"""The yaml of unitree_rl_gym's deploy_real and deploy_mujoco, beside a TorchScript policy.

The file has factors but no terms: these are in the program that reads it, and follow from ``num_obs`` for its
own policies. Read at unitreerobotics/unitree_rl_gym @ 276801e: deploy/deploy_real/deploy_real.py and
config.py; for deploy_mujoco also @ a1a6e8d.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from deal_hw.errors import ConfigurationError, shown
from deal_hw.policies.importing.manifest import (
    AXES_OF,
    ForeignJoint,
    ForeignPolicy,
    ForeignTerm,
    actions_around,
    joints_of,
    quantity_of,
    unmeasured,
)
from deal_hw.policies.importing.reading import motor_names, row, section, whole
from deal_hw.policies.importing.supplement import Supplement, parse_history
from deal_hw.policy import Quantity
from deal_hw.reading import number

FORMAT: Final = "unitree_rl_gym"
TERMS: Final[Mapping[str, Quantity]] = {
    "base_ang_vel": "angular_velocity",
    "projected_gravity": "gravity",
    "commands": "command",
    "joint_pos": "position",
    "joint_vel": "velocity",
    "actions": "action",
    "phase": "clock",
}
"""Names for ``--observations``; the format itself has none."""
TORSO_SENSORS: Final[Mapping[str, str]] = {"h1": "torso_joint"}
"""Robots with their inertial sensor in the torso, and the joint by which it turns on the pelvis. The driver
turns its values to the pelvis by that joint, as transform_imu_data of rotation_helper.py does."""
CLOCK_HZ: Final = 1.0 / 0.8
"""Turns of the clock per second in deploy_real.py."""
_WALK: Final = ("base_ang_vel", "projected_gravity", "commands", "joint_pos", "joint_vel", "actions", "phase")
"""The terms of deploy_real.py, in order."""
_SCALES: Final = {"base_ang_vel": "ang_vel_scale", "joint_pos": "dof_pos_scale", "joint_vel": "dof_vel_scale"}
_KEYS: Final = (
    "control_dt simulation_dt control_decimation simulation_duration msg_type imu_type lowcmd_topic "
    "lowstate_topic policy_path xml_path leg_joint2motor_idx joint2motor_idx kps kds default_angles "
    "arm_waist_joint2motor_idx arm_waist_kps arm_waist_kds arm_waist_target lin_vel_scale ang_vel_scale "
    "dof_pos_scale dof_vel_scale action_scale cmd_scale num_actions num_obs max_cmd cmd_init weak_motor"
)
_NEEDED: Final = (
    "kps kds default_angles ang_vel_scale dof_pos_scale dof_vel_scale action_scale cmd_scale num_actions "
    "num_obs"
)


def is_deploy_yaml(values: Any) -> bool:
    """Return whether values are those of this format."""
    return isinstance(values, Mapping) and "num_obs" in values and "num_actions" in values


def parse(values: Any, answers: Supplement, robot: str) -> ForeignPolicy:
    """Return the policy that a yaml describes.

    Raises:
        ConfigurationError: A value is wrong or missing; the message names it.
        PolicyMismatchError: A term is not measured.
    """
    found = section(values, "the yaml", _KEYS.split(), _NEEDED.split())
    count = whole(found["num_actions"], "num_actions", 1, 256)
    joints = _joints(found, count, answers, robot)
    names = _names(found, count, answers, robot)
    factors = {
        **{name: (number(found[key], key),) for name, key in _SCALES.items()},
        "commands": row(found["cmd_scale"], "cmd_scale", 3),
    }
    history = parse_history(answers.get("history") or "1", names)
    terms = tuple(_term(name, joints, factors.get(name, (1.0,)), history[name]) for name in names)
    kps, kds, default, scale = (
        row(found[name], name, count) for name in ("kps", "kds", "default_angles", "action_scale")
    )
    held = _held(found, answers, robot)
    _check_sensor(found, held, robot)
    clock = answers.get("clock") if "phase" in names else None
    return ForeignPolicy(
        format=FORMAT,
        joints=(*joints_of(joints, default, kps, kds), *held),
        actions=actions_around(joints, default, scale),
        terms=terms,
        control_rate_hz=1.0 / _period_s(found),
        command_range=_range(found, answers) if "commands" in names else (),
        clock_hz=(clock or CLOCK_HZ) if "phase" in names else 0.0,
        notes=_notes(names, clock, held),
    )


def _joints(found: Mapping[str, Any], count: int, answers: Supplement, robot: str) -> tuple[str, ...]:
    key = next((k for k in ("leg_joint2motor_idx", "joint2motor_idx") if found.get(k) is not None), None)
    if key is not None:
        names = motor_names(found[key], key, answers.get("motors") or (), robot)
        if answers.get("joints") and tuple(answers.joints) != names:
            raise ConfigurationError(
                f"--joints has {', '.join(answers.joints)}, {key} has {', '.join(names)}; one is wrong"
            )
    else:
        names = tuple(
            answers.need(
                "joints",
                "the yaml has no leg_joint2motor_idx, so it does not say the order of the joints",
                "FL_hip_joint,FL_thigh_joint,... (in the policy's order)",
            )
        )
    if len(names) != count:
        raise ConfigurationError(
            f"num_actions is {count}, but there are {len(names)} joints: {', '.join(names)}"
        )
    return names


def _names(found: Mapping[str, Any], count: int, answers: Supplement, robot: str) -> tuple[str, ...]:
    """Return the terms of the observation."""
    length = whole(found["num_obs"], "num_obs", 1, 1_000_000)
    if length == 3 * count + 12 and not answers.observations:
        raise unmeasured("base_lin_vel", robot)
    if length == 3 * count + 11 and not answers.observations:
        return _WALK
    names = tuple(
        answers.need(
            "observations",
            f"the yaml has num_obs {length} and no names of terms; deploy_real.py has {3 * count + 11}",
            "base_ang_vel,projected_gravity,commands,joint_pos,joint_vel,actions (in the policy's order)",
        )
    )
    for name in names:
        quantity_of(name, TERMS, FORMAT, robot)
    if len(set(names)) < len(names):
        raise ConfigurationError(f"--observations names a term twice: {shown(', '.join(names))}")
    return names


def _term(name: str, joints: Sequence[str], scale: Sequence[float], history: int) -> ForeignTerm:
    elements = AXES_OF.get(TERMS[name], tuple(joints))
    factors = tuple(scale) if len(scale) == len(elements) else (scale[0],) * len(elements)
    return ForeignTerm(name=name, quantity=TERMS[name], elements=elements, scale=factors, history=history)


def _held(found: Mapping[str, Any], answers: Supplement, robot: str) -> tuple[ForeignJoint, ...]:
    """Return the joints that are no part of the policy and are held at a pose."""
    ids = found.get("arm_waist_joint2motor_idx")
    if not ids:
        return ()
    names = motor_names(ids, "arm_waist_joint2motor_idx", answers.get("motors") or (), robot)
    kps, kds, pose = (
        row(found.get(f"arm_waist_{n}"), f"arm_waist_{n}", len(names)) for n in ("kps", "kds", "target")
    )
    return joints_of(names, pose, kps, kds)


def _check_sensor(found: Mapping[str, Any], held: Sequence[ForeignJoint], robot: str) -> None:
    """Refuse a sensor in the torso unless the driver turns its values to the pelvis as the runner does.

    The network observes the pelvis in either case. Motor numbers do not show a wrong robot: those of an H1-2
    are all in a G1, at other joints.
    """
    if found.get("imu_type") != "torso":
        return
    if robot not in TORSO_SENSORS:
        raise ConfigurationError(
            "imu_type is torso: the policy is for a robot whose inertial sensor is in the torso, and "
            f"{robot!r} is not known as one; if it is for another robot, name that (--robot; known with such "
            f"a sensor: {', '.join(TORSO_SENSORS)}); if it is for {robot!r}, whose states must have the "
            "orientation of its pelvis, write imu_type: pelvis"
        )
    first = held[0].name if held else "none"
    if first != TORSO_SENSORS[robot]:
        raise ConfigurationError(
            "imu_type is torso: the runner turns the sensor's values by the first joint of "
            f"arm_waist_joint2motor_idx, which is {first}, but the sensor of {robot!r} turns with "
            f"{TORSO_SENSORS[robot]}; put that joint's motor first"
        )


def _period_s(found: Mapping[str, Any]) -> float:
    if found.get("control_dt") is not None:
        return number(found["control_dt"], "control_dt", 1e-4, 10.0)
    if found.get("simulation_dt") is None or found.get("control_decimation") is None:
        raise ConfigurationError("the yaml: control_dt is missing (or simulation_dt and control_decimation)")
    step_s = number(found["simulation_dt"], "simulation_dt", 1e-5, 1.0)
    return step_s * whole(found["control_decimation"], "control_decimation", 1, 10_000)


def _range(found: Mapping[str, Any], answers: Supplement) -> tuple[tuple[float, float], ...]:
    if found.get("max_cmd") is None:
        return answers.need_command_range(
            "the yaml has no max_cmd, so it does not say the range of the velocity commands"
        )
    return tuple((-abs(most), abs(most)) for most in row(found["max_cmd"], "max_cmd", 3))


def _notes(names: Sequence[str], clock: float | None, held: Sequence[ForeignJoint]) -> tuple[str, ...]:
    notes = []
    if "phase" in names and clock is None:
        notes.append(f"the clock turns {CLOCK_HZ:g} times a second, as in deploy_real.py; --clock changes it")
    if held:
        notes.append(f"{len(held)} joints are no part of the policy and keep their pose")
    return tuple(notes)
