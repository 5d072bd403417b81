"""Joints of an MJCF that stay where they are, such as a gripper's: the file without them.

What moves only them goes with them: their actuators, tendons, equalities and sensors, and their numbers in
key frames.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError, short
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.parameters.fields import element_id
from deal_hw.sim.parameters.kind import HINGE, SLIDE
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True)
class LockedMjcf:
    """An MJCF without some of its joints.

    Attributes:
        xml: The file's text; files that it names are found from where it was made for.
        removed: What went with the joints, such as "actuator 'grip'".
    """

    xml: str
    removed: tuple[str, ...]


def lock_joints(mjcf: Path, at: Mapping[str, float | None], out: Path) -> LockedMjcf:
    """Return an MJCF whose named joints are fixed.

    Args:
        mjcf: The file.
        at: Where each joint stays [rad or m]; None: in the pose of the file.
        out: Where the text will stand: paths of meshes and textures in it are relative to that folder.

    Raises:
        ConfigurationError: The file cannot be used, a joint cannot be locked there, or what it moves moves
            another joint, too.
        UnknownNameError: There is no such joint.
    """
    model = compile_mjcf(mjcf)
    spec = mujoco.MjSpec.from_file(str(mjcf))
    index = {name: element_id(model, "joint", name) for name in at}
    for name, j in index.items():
        if model.jnt_type[j] not in (HINGE, SLIDE):
            raise ConfigurationError(f"joint {name!r} is a free or ball joint; only hinges and slides lock")
    for name in sorted(at, key=lambda each: index[each]):
        value = at[name]
        if value is not None:
            _move_body(spec, model, index[name], value, frozenset(index.values()))
    removed: list[str] = []
    _remove(removed, "tendon", spec, spec.tendons, _only_of(spec, at))
    gone = {model.tendon(i).name for i in range(model.ntendon)} - {t.name for t in spec.tendons}
    _remove(removed, "equality", spec, spec.equalities, lambda e: _equality_goes(e, at, gone))
    actuators = [a for a in spec.actuators if _drives(a, at, gone)]
    numbers = {a.id for a in actuators}
    names = {a.name for a in actuators} - {""}
    _remove(removed, "actuator", spec, spec.actuators, lambda a: a.id in numbers)
    _remove(
        removed,
        "sensor",
        spec,
        spec.sensors,
        lambda s: s.objname in _named(s.objtype, set(at), gone, names),
    )
    _shorten_keys(spec, model, list(index.values()), numbers)
    for name in at:
        spec.delete(spec.joint(name))
    for kind in ("meshdir", "texturedir"):
        folder = mjcf.resolve().parent / getattr(spec, kind)
        if getattr(spec, kind) or folder != out.resolve().parent:
            setattr(spec, kind, os.path.relpath(folder, out.resolve().parent))
    try:
        spec.modelfiledir = str(out.resolve().parent)
        spec.compile()
        return LockedMjcf(spec.to_xml(), tuple(removed))
    except (ValueError, mujoco.FatalError) as err:
        raise ConfigurationError(
            f"{mjcf} without {', '.join(at)} does not compile: {short(str(err))}; what is named there needs "
            "a joint that was to be locked"
        ) from err


def _move_body(spec: Any, model: Any, j: int, value: float, locked: frozenset[int]) -> None:
    """Put a joint's body where it is with the joint at a value: MuJoCo's own kinematics, joint by joint."""
    by = value - float(model.qpos0[model.jnt_qposadr[j]])
    first = int(model.body_jntadr[model.jnt_bodyid[j]])
    if by and not locked.issuperset(range(first, j)):
        raise ConfigurationError(
            f"joint {model.joint(j).name!r} follows a free joint in one body; lock it in the file's pose "
            "(without a value)"
        )
    low, high = model.jnt_range[j]
    if model.jnt_limited[j] and not low - 1e-9 <= value <= high + 1e-9:
        raise ConfigurationError(
            f"joint {model.joint(j).name!r} cannot stay at {value:g}: its range is {low:g} to {high:g}"
        )
    body = spec.joint(model.joint(j).name).parent
    turned = _quaternion(spec, body)
    axis, anchor = model.jnt_axis[j], model.jnt_pos[j]
    if model.jnt_type[j] == SLIDE:
        body.pos = np.asarray(body.pos) + by * _rotated(turned, axis)
        return
    after = np.zeros(4)
    mujoco.mju_mulQuat(after, turned, np.append(np.cos(by / 2), np.sin(by / 2) * axis))
    body.pos = np.asarray(body.pos) + _rotated(turned, anchor) - _rotated(after, anchor)
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.quat = after


def _rotated(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, vector, quaternion)
    return result


def _quaternion(spec: Any, body: Any) -> FloatArray:
    if body.alt.type == mujoco.mjtOrientation.mjORIENTATION_QUAT:
        return np.asarray(body.quat / np.linalg.norm(body.quat))
    return np.asarray(
        spec.resolve_orientation(
            degree=spec.compiler.degree, sequence=spec.compiler.eulerseq, orientation=body.alt
        )
    )


def _only_of(spec: Any, at: Mapping[str, float | None]) -> Callable[[Any], bool]:
    """Return whether a tendon is one of locked joints alone."""

    def only(tendon: Any) -> bool:
        steps = [tendon.path[k] for k in range(len(tendon.path))]
        joints = [s.target.name for s in steps if s.type == mujoco.mjtWrap.mjWRAP_JOINT]
        return bool(joints) and _all_or_none(f"tendon {tendon.name!r}", joints, at)

    return only


def _equality_goes(equality: Any, at: Mapping[str, float | None], tendons: set[str]) -> bool:
    if equality.type == mujoco.mjtEq.mjEQ_JOINT:
        names = [name for name in (equality.name1, equality.name2) if name]
        return _all_or_none("an equality of joints", names, at)
    if equality.type == mujoco.mjtEq.mjEQ_TENDON:
        return bool({equality.name1, equality.name2} & tendons)
    return False


def _all_or_none(what: str, joints: Iterable[str], at: Mapping[str, float | None]) -> bool:
    """Return whether all these joints are locked.

    Raises:
        ConfigurationError: Some are, and some are not.
    """
    others = [name for name in joints if name not in at]
    here = [name for name in joints if name in at]
    if others and here:
        raise ConfigurationError(
            f"{what} joins {', '.join(here)} with {', '.join(others)}; lock all of them, or none"
        )
    return bool(here)


def _drives(actuator: Any, at: Mapping[str, float | None], tendons: set[str]) -> bool:
    kinds = mujoco.mjtTrn
    if actuator.trntype in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
        return actuator.target in at
    return actuator.trntype == kinds.mjTRN_TENDON and actuator.target in tendons


def _named(kind: Any, joints: set[str], tendons: set[str], actuators: set[str]) -> set[str]:
    """Return the names that vanish of a kind of object."""
    objects = mujoco.mjtObj
    return {
        objects.mjOBJ_JOINT: joints,
        objects.mjOBJ_TENDON: tendons,
        objects.mjOBJ_ACTUATOR: actuators,
    }.get(kind, set())


def _remove(removed: list[str], kind: str, spec: Any, have: Any, goes: Callable[[Any], bool]) -> None:
    for element in [one for one in have if goes(one)]:
        removed.append(f"{kind} {element.name!r}" if element.name else f"an unnamed {kind}")
        spec.delete(element)


def _shorten_keys(spec: Any, model: Any, joints: list[int], actuators: set[int]) -> None:
    """Leave the locked joints' and removed actuators' numbers out of each key frame."""
    gone = {
        "qpos": [int(model.jnt_qposadr[j]) for j in joints],
        "qvel": [int(model.jnt_dofadr[j]) for j in joints],
        "ctrl": sorted(actuators),
        "act": [
            int(model.actuator_actadr[a]) + k for a in actuators for k in range(int(model.actuator_actnum[a]))
        ],
    }
    for key in spec.keys:
        for name, places in gone.items():
            values = np.asarray(getattr(key, name), dtype=float)
            if len(values) and places:
                setattr(key, name, np.delete(values, places))
