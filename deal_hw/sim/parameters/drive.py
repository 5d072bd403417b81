"""What an actuator of an MJCF does at its joint, whichever way the file writes it.

MuJoCo's force is ``g u + b0 + b1 l + b2 l'`` with the length ``l = gear q``, and the joint's effort is
``gear`` times that. So ``<general>``, ``<position>``, ``<velocity>``, ``<motor>`` and ``<cylinder>`` are
three drives, each with an offset and perhaps a filter of its command::

    position    stiffness (scale u - q) - damping q'
    velocity    damping (scale u - q')
    effort      scale u - damping q'
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.parameters.kind import joint_of
from deal_hw.sim.parameters.one_drive import brakes
from deal_hw.types import FloatArray

Takes = Literal["position", "velocity", "effort"]

_NO_FILTER = int(mujoco.mjtDyn.mjDYN_NONE)
_DCMOTOR = int(mujoco.mjtDyn.mjDYN_DCMOTOR)
_FILTER, _EXACT = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
_INSTEAD = {
    int(mujoco.mjtDyn.mjDYN_INTEGRATOR): (
        "integrates its command (dyntype integrator, as <intvelocity>); record the integrated position, and "
        "write <position kp kv>"
    ),
    int(mujoco.mjtDyn.mjDYN_MUSCLE): (
        "is a <muscle>, whose force depends on its length; write a <position> or a <motor> for what drives it"
    ),
    int(mujoco.mjtDyn.mjDYN_PID): (
        "is a <pid> with an integral part; write <position kp kv>, or <motor> and record its efforts"
    ),
    int(mujoco.mjtDyn.mjDYN_USER): (
        "has dynamics of your own code (dyntype user); write a <position>, a <motor> or a filter"
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class JointDrive:
    """An actuator, seen from its hinge or slide.

    Attributes:
        takes: Its command: a position, a speed or an effort of the joint.
        gear: Its gear, with sign; lengths and speeds of the actuator over those of the joint.
        gain: Joint effort at a ``ctrl`` of 1 [N·m or N].
        stiffness: Effort an error of the position [N·m/rad or N/m]; 0 unless it takes positions.
        damping: Effort against a speed [N·m·s/rad or N·s/m].
        effort_limit: Largest effort to both sides; infinite if there is none, or if the sides differ.
        lag_s: Time constant of the command's filter, 0 without one [s].
        offset: Constant effort [N·m or N].
        ratio: Number that a scaled set-point multiplies ``ctrl`` by, gainprm over -biasprm; 1 for most.
    """

    takes: Takes
    gear: float
    gain: float
    stiffness: float
    damping: float
    effort_limit: float
    lag_s: float
    offset: float = 0.0
    ratio: float = 1.0

    @property
    def scale(self) -> float:
        """A command in the joint's unit over the model's ``ctrl``."""
        return self.gain if self.takes == "effort" else self.ratio / self.gear


def drive_of(model: Any, actuator: int, name: str) -> JointDrive:
    """Return what an actuator of a joint does.

    Args:
        model: The MjModel.
        actuator: Its number.
        name: Its name, for messages.

    Raises:
        ConfigurationError: It does something else than the drives above; the message says what to write.
    """
    gear, gain = float(model.actuator_gear[actuator, 0]), float(model.actuator_gainprm[actuator, 0])
    # A bias is only added with the type affine.
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    bias = model.actuator_biasprm[actuator, 1:3] if affine else np.zeros(2)
    if problem := _problem(model, actuator, gear * gain, bias):
        raise ConfigurationError(f"actuator {name!r} {problem} (in a copy of the MJCF)")
    # The sum with 0 makes -0.0 a 0.
    stiffness, damping = (float(-b * gear**2) + 0.0 for b in bias)
    takes: Takes = "effort"
    if stiffness > 0:
        takes = "position"
    elif damping > 0 and speed_servo(model, actuator):
        takes = "velocity"
    low, high = model.actuator_forcerange[actuator] * abs(gear)
    limited = bool(model.actuator_forcelimited[actuator]) and bool(np.isclose(-low, high))
    return JointDrive(
        takes=takes,
        gear=gear,
        gain=gear * gain,
        stiffness=stiffness,
        damping=damping,
        effort_limit=float(high) if limited else float("inf"),
        lag_s=max(float(model.actuator_dynprm[actuator, 0]), 0.0) if filtered(model, actuator) else 0.0,
        offset=gear * float(model.actuator_biasprm[actuator, 0]) if affine else 0.0,
        ratio=setpoint_ratio(model, actuator),
    )


def find_drive(model: Any, actuator: int) -> JointDrive | None:
    """Return what an actuator of a joint does; None if it drives no joint or is none of the drives above."""
    if joint_of(model, actuator) < 0:
        return None
    try:
        return drive_of(model, actuator, "")
    except ConfigurationError:
        return None


def setpoint_ratio(model: Any, actuator: int) -> float:
    """Return gainprm over -biasprm of a position servo, 1 for others."""
    bias = float(model.actuator_biasprm[actuator, 1])
    return float(model.actuator_gainprm[actuator, 0]) / -bias if bias < 0 else 1.0


def speed_servo(model: Any, actuator: int) -> bool:
    """Return whether an actuator without stiffness has a gain that is its damping: it takes speeds."""
    _, stiffness, damping = model.actuator_biasprm[actuator, :3].tolist()
    gain = float(model.actuator_gainprm[actuator, 0])
    return stiffness == 0 and math.isclose(gain, -damping, rel_tol=1e-5)


def filtered(model: Any, actuator: int) -> bool:
    """Return whether MuJoCo filters an actuator's command."""
    return int(model.actuator_dyntype[actuator]) in (_FILTER, _EXACT)


def _problem(model: Any, actuator: int, effort: float, bias: FloatArray) -> str:
    """Return what an actuator is instead of a drive that is known, and what to write; "" for nothing."""
    if actuator in brakes(model):
        return "is the damping of the position servo beside it; search that one's servo_damping"
    dynamics = int(model.actuator_dyntype[actuator])
    if dynamics == _DCMOTOR:
        resistance, constant = model.actuator_gainprm[actuator, :2].tolist()
        gain = constant / resistance
        return (
            f'is a <dcmotor>; write <general gainprm="{gain:.6g}" biastype="affine" biasprm="0 0 '
            f'{-constant * gain:.6g}"/> instead, which is the same motor without inductance, cogging and '
            "bristles, and search its motor_gain (K/R) and servo_damping (K²/R)"
        )
    if dynamics not in (_NO_FILTER, _FILTER, _EXACT):
        return _INSTEAD.get(dynamics, f"has dyntype number {dynamics}; write a <position> or a <motor>")
    gaintype, biastype = (
        enum(int(getattr(model, f"actuator_{name}type")[actuator])).name.removeprefix(f"mj{name.upper()}_")
        for enum, name in ((mujoco.mjtGain, "gain"), (mujoco.mjtBias, "bias"))
    )
    if gaintype != "FIXED":
        return (
            f"has a gain that depends on the motion (gaintype {gaintype.lower()}"
            f"{', as <damper>' if gaintype == 'AFFINE' else ''}); write a fixed gain, such as <position> or "
            "<motor>, and damping into the joint"
        )
    if biastype not in ("NONE", "AFFINE"):
        return f"has biastype {biastype.lower()}; write affine with three biasprm, or none"
    if effort == 0:
        return "moves nothing, its gear or gain is 0; write others"
    if bias[0] > 0 or bias[1] > 0:
        place = 1 if bias[0] > 0 else 2
        return (
            f"pushes its joint away (biasprm[{place}] is {bias[place - 1]:g}, above 0); a servo has -kp and "
            "-kv there, write them with a minus"
        )
    if filtered(model, actuator) and model.actuator_actlimited[actuator]:
        return "limits its filtered command (actrange); write ctrlrange instead"
    return ""
