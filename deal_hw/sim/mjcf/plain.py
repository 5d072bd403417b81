"""A calibrated MJCF for MuJoCo alone: laws that stand in ``<custom>`` become MuJoCo's own elements.

MuJoCo reads ``<custom>`` and does nothing with it, so a viewer or a training of one's own lacks the laws.
Some of them MuJoCo can express:

==========================  ==============================================================================
latency, ``command_delay``  ``delay`` of the actuator, linear between physics steps
``command_lag``             ``dyntype="filterexact"`` of the actuator
friction by speed           a passive ``<dcmotor>`` with LuGre friction beside ``frictionloss``
==========================  ==============================================================================

LuGre friction (MuJoCo documentation, Computation: DC motor) is that of bristles. Their steady force at the
speed w is ``tau_c + (tau_s - tau_c) exp(-(w / ws)²)``, as in :mod:`deal_hw.sim.laws.friction`. MuJoCo takes
the bristles as they were at the beginning of a step. So the part that is there at all speeds stays
``frictionloss``, a constraint, and only the rest is LuGre. At rest the bristles bend by up to :data:`BEND`.
They have no damping of their own: it would act as a drag wherever the force changes with speed. All other
laws are left out, and a joint whose friction depends on load keeps its constant dry friction. A limit of a
control acts before the delay and the filter, that of the laws after them.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.mjcf.calibrated import (
    compiled,
    custom_latency_s,
    custom_name,
    custom_values,
    require_other,
)
from deal_hw.sim.mjcf.changes import MjcfChanges, number, numbers
from deal_hw.sim.mjcf.paths import Relocation
from deal_hw.sim.mjcf.text import Element, SourceFile, new_element, read_files
from deal_hw.sim.parameters import DEVICE_KINDS
from deal_hw.sim.parameters.fields import element_id, element_names
from deal_hw.sim.parameters.laws import FRICTION_KINDS, STRIBECK_SPEED
from deal_hw.types import FloatArray

PLAIN_TEXT = "deal_hw.plain"
"""Name of the ``<text>`` that marks such a file: its laws must not be applied a second time."""

BEND = {mujoco.mjtJoint.mjJNT_HINGE: 3e-4, mujoco.mjtJoint.mjJNT_SLIDE: 1e-4}
"""Most that bristles bend before they slip [rad or m]: below a count of an encoder of 12 bits."""

STIFFEST = 0.5
"""Most stiffness of bristles, as their angular frequency times the physics step [-]. An explicit force is
stable up to 2; the joint's inertia may be a part of what it is in the model's own pose."""

BRISTLES = "deal_hw.bristles"
"""Default class of these elements."""

BY_SPEED = ("dof_friction_stribeck", "dof_stribeck_speed")

Values = Mapping[str, Mapping[str, float]]
"""Values without a MuJoCo field, by kind and element."""


@dataclass(frozen=True, slots=True)
class PlainModel:
    """What an MJCF for MuJoCo alone has of a calibrated one.

    Attributes:
        files: The files written, the main one first.
        has: Laws that it has, in words.
        lacks: Laws that it lacks, in words.
        bristles: Whether a joint has friction by speed.
    """

    files: tuple[Path, ...]
    has: tuple[str, ...]
    lacks: tuple[str, ...]
    bristles: bool


def write_plain_mjcf(
    path: Path, target: Path, *, bristles: bool = True, remarks: Sequence[str] = ()
) -> PlainModel:
    """Write a calibrated MJCF for MuJoCo alone.

    Args:
        path: A file of :func:`deal_hw.sim.mjcf.calibrated.write_calibrated_mjcf`.
        target: The file to write.
        bristles: Express friction by speed. On light joints, and with long steps, bristles may be farther
            from the law than constant friction: compare the motions.
        remarks: More lines for the comment at the top.

    Raises:
        ConfigurationError: An element of the file cannot be changed, or the result does not compile.
    """
    require_other(target, path)
    top = read_files(path)
    spec = mujoco.MjSpec.from_file(str(top.path))
    have = spec.compile()
    values: Values = {
        kind: found for kind in DEVICE_KINDS if (found := custom_values(have, custom_name(kind)))
    }
    friction = _friction_by_speed(have, values) if bristles else {}
    late = _late(have, values)
    lags = values.get("command_lag", {})
    want = copy.copy(have)
    for dof, least, _ in friction.values():
        want.dof_frictionloss[dof] = least
    lagging = {element_id(have, "actuator", name): lag_s for name, lag_s in lags.items() if lag_s > 0}
    for actuator, lag_s in lagging.items():
        want.actuator_dyntype[actuator] = mujoco.mjtDyn.mjDYN_FILTEREXACT
        want.actuator_dynprm[actuator, 0] = lag_s
    relocation, changes = Relocation(top, target), MjcfChanges(top.root, have, bool(spec.compiler.degree))
    relocation.adapt()
    changes.apply(have, want)
    for actuator in lagging:
        # Without it, what acts is the activation a step before.
        changes.find("actuator", actuator).set("actearly", "true")
    for name, late_s in late.items():
        _delay(changes.find("actuator", element_id(have, "actuator", name)), late_s, have.opt.timestep)
    has = []
    if late:
        has.append(f"latency: a delay of {_milliseconds(late)}")
    if lagging:
        acting = {name: lag_s for name, lag_s in lags.items() if lag_s > 0}
        has.append(f"lag of {', '.join(acting)}: a filter of {_milliseconds(acting)}")
    if friction:
        has.append(f"friction by speed of {', '.join(friction)}: passive <dcmotor> elements, LuGre")
    expressed = {("command_lag", n) for n in lags} | {("command_delay", n) for n in late}
    expressed |= {(kind, joint) for kind in BY_SPEED for joint in friction}
    lacks = [
        f"{custom_name(kind).removeprefix('deal_hw.')} of {name} ({value:.3g})"
        for kind, found in values.items()
        for name, value in found.items()
        # A value of 0 is no law, and a Stribeck speed alone shapes none.
        if (kind, name) not in expressed and value and kind != BY_SPEED[1]
    ]
    if friction:
        elements = [element for _, _, element in friction.values()]
        # What the model's own default class sets for actuators would hold for these, too.
        usual = new_element("general", forcelimited="false", gear="1", delay="0", nsample="0", damping="0")
        usual.set("armature", "0")
        of_class = new_element("default", inside=[usual])
        of_class.set("class", BRISTLES)
        top.root.last.append(new_element("default", inside=[of_class]))
        top.root.last.append(new_element("actuator", inside=elements))
    mark = new_element("text", name=PLAIN_TEXT, data="; ".join(has) or "none")
    top.root.last.append(new_element("custom", inside=[mark]))
    lines = [*has, *(f"left out: {line}" for line in lacks), *remarks]
    top.header = "\n".join([f"{path.name} for MuJoCo alone:", *(f"  {line}" for line in lines), ""])
    return PlainModel(_write(relocation.files(), target), tuple(has), tuple(lacks), bool(friction))


def _friction_by_speed(model: Any, values: Values) -> dict[str, tuple[int, float, Element]]:
    """Return the degree of freedom of each joint whose friction depends on speed alone, and what it becomes.

    That is dry friction at all speeds [N·m or N], and an element with the rest.
    """
    found: dict[str, tuple[int, float, Element]] = {}
    by_load = [values.get(kind, {}) for kind in FRICTION_KINDS if kind not in BY_SPEED]
    rest, speeds = (values.get(kind, {}) for kind in BY_SPEED)
    for joint, extra in rest.items():
        if extra == 0 or any(load.get(joint, 0.0) for load in by_load):
            continue
        index = element_id(model, "joint", joint)
        dof = int(model.jnt_dofadr[index])
        moving = float(model.dof_frictionloss[dof])
        at_rest = max(moving + extra, 0.0)
        least = min(moving, at_rest)
        if moving == at_rest:
            continue
        bend = BEND[mujoco.mjtJoint(int(model.jnt_type[index]))]
        inertia = 1 / float(model.dof_invweight0[dof])
        stiffest = inertia * (STIFFEST / float(model.opt.timestep)) ** 2
        stiffness = min(abs(moving - at_rest) / bend, stiffest)
        speed = speeds.get(joint, STRIBECK_SPEED)
        bristles = new_element(
            "dcmotor",
            name=f"{joint}.friction",
            joint=joint,
            input="none",
            # MuJoCo refuses a constant of 0. So small a one brakes with 1e-12 N·m·s/rad.
            motorconst="1e-6",
            resistance="1",
            lugre=numbers([stiffness, 0.0, moving - least, at_rest - least, speed]),
        )
        bristles.set("class", BRISTLES)
        found[joint] = dof, least, bristles
    return found


def _late(model: Any, values: Values) -> dict[str, float]:
    """Return how late each actuator's command acts, where it does [s]."""
    own, latency_s = values.get("command_delay", {}), custom_latency_s(model)
    # Passive elements take no command.
    names = np.array(element_names(model, "actuator"))[np.asarray(model.actuator_ctrlnum) > 0]
    every = {str(name): latency_s + own.get(name, 0.0) for name in names}
    # MuJoCo's least delay is one step.
    return {name: late_s for name, late_s in every.items() if late_s >= model.opt.timestep / 2}


def _milliseconds(times_s: Mapping[str, float]) -> str:
    """Return times [s] in words, or their range."""
    least, most = (f"{1e3 * end(times_s.values()):.3g}" for end in (min, max))
    return f"{least if least == most else f'{least} to {most}'} ms"


def _delay(element: Element, late_s: float, step_s: float) -> None:
    element.set("delay", number(max(late_s, step_s)))
    element.set("nsample", str(int(np.ceil(late_s / step_s)) + 2))
    element.set("interp", "linear")


def hold(model: Any, data: Any, command: FloatArray) -> None:
    """Let a command have acted for long, (nu,): it fills the delays and the filters of the actuators.

    After a reset of MuJoCo they begin at 0.
    """
    for actuator in np.flatnonzero(model.actuator_ctrlnum).tolist():
        now, count = command[model.actuator_ctrladr[actuator]], int(model.actuator_history[actuator, 0])
        if count:
            mujoco.mj_initCtrlHistory(model, data, actuator, None, np.full((count, 1), now))
        if model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_FILTEREXACT:
            data.act[model.actuator_actadr[actuator]] = now


def _write(files: Mapping[Path, SourceFile], target: Path) -> tuple[Path, ...]:
    """Write the files; return them, ``target`` first. What does not compile is taken away again."""
    try:
        for file, content in files.items():
            file.write_bytes(content.render())
        compiled(target)
    except (ConfigurationError, OSError):
        for file in files:
            file.unlink(missing_ok=True)
        raise
    return tuple(sorted(files, key=lambda file: file.name != target.name))
