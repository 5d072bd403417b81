"""Causes of a residual as findings: how each looks, what it means, and what to do about it.

What to do depends on the calibration: a parameter that is searched already is not advised, and one that ended
at the bound of its range has too narrow a range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import ended_at_bound
from deal_hw.calib.hypotheses.signatures import Cause
from deal_hw.calibration import listed
from deal_hw.findings import Finding
from deal_hw.sim.parameters import KIND_TABLE
from deal_hw.sim.parameters.kind import joint_of
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Diagnosis(Finding):
    """One cause of the residual: its code is the cause, its subject the joints or bodies that show it.

    Attributes:
        share: Share of the held-out squared residual that it explains.
        deviance: Gain in held-out deviance.
        shift: Change of the estimates where the fit may have this effect, too: of each parameter in its own
            scale, then of the latency [s], (K + 1,); empty where it was not estimated.
    """

    share: float
    deviance: float
    shift: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(
        cls,
        cause: Cause,
        share: float,
        deviance: float,
        joints: Sequence[str],
        alarm: Finding,
        shift: FloatArray | None = None,
    ) -> Diagnosis:
        """Return the cause that an alarm describes."""
        return cls(
            cause,
            alarm.severity,
            alarm.seen,
            alarm.do,
            alarm.means,
            tuple(joints),
            share=float(share),
            deviance=float(deviance),
            shift=np.zeros(0) if shift is None else shift,
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "cause": self.code,
            "share": self.share,
            "deviance": self.deviance,
            "joints": list(self.subject),
            "alarm": {"seen": self.seen, "means": self.means, "do": self.do},
            "shift": self.shift.tolist(),
        }


LOOKS: Mapping[Cause, tuple[str, str, str]] = {
    "friction": (
        "a force against slow motion",
        "Friction depends on speed (Stribeck), or creeps where it should hold.",
        "Free dof_friction_creep, dof_frictionloss and dof_damping of {} (--parameters).",
    ),
    "backlash": (
        "play in the gear",
        "Motor and joint do not move as one where the motion or the load turns round. The encoder may be on "
        "either side.",
        "Repair the gear of {}, or free servo_play there (--parameters).",
    ),
    "delay": (
        "a timing error that changes",
        "The delay of commands or sensors varies; the model's is constant.",
        "End other programs on the computer that sends, send at an even pace, or time-stamp commands where "
        "they are received{}.",
    ),
    "damping": (
        "a force that grows with speed",
        "Damping was not free, or follows another law (the square of speed).",
        "Free dof_damping or servo_damping of {} (--parameters); if they are free already, check the law.",
    ),
    "inertia": (
        "a force in proportion to acceleration",
        "An inertia or a gain was not free, or its range is too narrow.",
        "Free dof_armature, body_mass or the actuator's gain of {} (--parameters).",
    ),
    "lag": (
        "a servo whose damping acts late",
        "The servo's speed is a difference of positions or filtered, so it is some milliseconds old; the "
        "model's is not. Without saturation this acts like less inertia.",
        "Filter the speed of {} less in the servo, or command less damping; trust predictions more than the "
        "inertia and the effort limit.",
    ),
    "load": (
        "a constant force",
        "A mass, its centre or an encoder's zero was not free.",
        "Free encoder_bias, body_mass or body_ipos of {} (--parameters).",
    ),
    "zero": (
        "an encoder whose zero is another one in each recording",
        "The zeros were not the model's or not the same in all recordings, as after a start where friction "
        "held the robot off its rest.",
        "Set the zero of {} in the model's pose before each recording. Or give each recording a set-up with "
        "`encoder_bias` of its own, which is searched (--setups).",
    ),
    "mass": (
        "another mass",
        "The ratio of the bodies' masses is not the model's.",
        "Weigh {}, correct the model, or free body_mass there (--parameters).",
    ),
    "contact": (
        "bursts",
        "The robot may touch something that the model does not have.",
        "Look at {}. If it touched something, record without that. Recordings in files (--data) can leave it "
        "out (--leave-out).",
    ),
}
"""For each cause: how the residual looks, what it means, and what to do, with {} for the place."""

FREES: Mapping[Cause, tuple[str, ...]] = {
    "friction": ("dof_friction_creep", "dof_frictionloss", "dof_damping"),
    "damping": ("dof_damping", "servo_damping"),
    "inertia": ("dof_armature", "body_mass", "servo_stiffness", "motor_gain"),
    "load": ("encoder_bias", "body_mass", "body_ipos_x", "body_ipos_y", "body_ipos_z"),
}
"""Kinds of parameters that have the effect of a cause."""

FREE_ALREADY: Mapping[Cause, str] = {
    "friction": "The parameters of friction are searched already: MuJoCo has no friction law that fits. "
    "Trust predictions more than single values.",
    "damping": "The damping is searched already: check its law, such as the square of speed.",
    "inertia": "Armature, mass and gain are searched already: look for a mass that moves on its own, such as "
    "a load, a belt or a cable.",
    "load": "Mass, its centre and the encoder's zero are searched already: look for a spring, a cable or a "
    "contact.",
}
"""What to do where all of these kinds are searched."""


@dataclass(frozen=True, slots=True)
class SearchedKinds:
    """What a calibration searched.

    Attributes:
        free: Kind and joint of each searched parameter.
        ended: Name, kind and joint of those that ended at a bound of their range.
    """

    free: frozenset[tuple[str, str]] = frozenset()
    ended: tuple[tuple[str, str, str], ...] = ()

    @classmethod
    def of(cls, problem: Problem, theta: FloatArray) -> SearchedKinds:
        """Return what was searched and where it ended, theta (K,)."""
        space, model = problem.space, problem.robot.model
        each = [
            [(p.kind, joint) for element in p.elements for joint in _joints(model, p.kind, element)]
            for p in space
        ]
        ended = [
            (p.name, kind, joint)
            for p, places, end in zip(space, each, ended_at_bound(space, theta), strict=True)
            for kind, joint in places
            if end
        ]
        return cls(frozenset(place for places in each for place in places), tuple(ended))


def advice(cause: Cause, joints: Sequence[str], where: str, searched: SearchedKinds) -> tuple[str, str]:
    """Return what a cause means and what to do about it, for joints or bodies and their description."""
    _, means, do = LOOKS[cause]
    kinds = FREES.get(cause, ())
    ended = dict.fromkeys(name for name, kind, joint in searched.ended if kind in kinds and joint in joints)
    if ended:
        return (
            f"{listed(list(ended))} ended at the bound of the search range, so it cannot explain more.",
            "Widen that range (--range NAME LOW HIGH) if such a value is possible, or check the model.",
        )
    missing = [k for k in kinds if not all((k, joint) in searched.free for joint in joints)]
    if kinds and not missing:
        return means, FREE_ALREADY[cause]
    if kinds and len(missing) < len(kinds) and cause in ("friction", "damping"):
        do = f"Free {' or '.join(missing)} of {{}} (--parameters)."
    return means, do.replace("{}", where)


def _joints(model: Any, kind: str, element: str) -> list[str]:
    """Return the joints that a parameter's element moves."""
    of = KIND_TABLE[kind].element
    if of == "joint":
        return [element]
    if of == "actuator":
        joint = joint_of(model, model.actuator(element).id)
        return [model.joint(joint).name] if joint >= 0 else []
    if of == "body":
        body = model.body(element)
        first, count = int(body.jntadr[0]), int(body.jntnum[0])
        return [model.joint(j).name for j in range(first, first + count)]
    return []


def stretch_words(numbers: Sequence[int], unit_s: float) -> list[str]:
    """Return stretches of time as text, from the numbers of the units of time that they cover, in order."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number <= found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return [f"{max(a - 0.5, 0.0) * unit_s:.2f} to {(b + 0.5) * unit_s:.2f} s" for a, b in found]
