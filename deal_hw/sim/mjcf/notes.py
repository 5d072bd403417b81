"""What of a model has no effect in a calibration, in words: a value that is found there is void."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import mujoco

from deal_hw.errors import short

_FLAGS: Final[Mapping[str, int]] = {
    name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
    for name in ("gravity", "frictionloss", "damper", "spring", "limit", "equality", "actuation")
}
"""Flags of ``<option><flag>`` without which a part of the physics is missing, by their names in an MJCF."""
BODY: Final = int(mujoco.mjtTrn.mjTRN_BODY)
"""Transmission of an actuator that holds a body, as ``<adhesion>``."""


def model_notes(model: Any) -> Iterator[str]:
    """Yield what of a model has no effect, and what to do, each as a sentence."""
    off = [name for name, bit in _FLAGS.items() if int(model.opt.disableflags) & bit]
    if off:
        yield (
            f"the model switches off {', '.join(off)} (<flag>), so it simulates none of it: values found for "
            "it are void, and what the robot has of it goes into other values. Remove the flag, unless the "
            "robot has none"
        )
    groups = int(model.opt.disableactuator)
    idle = [
        model.actuator(i).name or f"number {i}"
        for i in range(model.nu)
        # MuJoCo switches groups 0 to 30 off.
        if 0 <= model.actuator_group[i] <= 30 and groups >> int(model.actuator_group[i]) & 1
    ]
    if idle:
        yield (
            f"the model switches off actuators {short(', '.join(idle))} (actuatorgroupdisable), so commands "
            "move nothing there: values found for them are void. Remove that attribute, unless these motors "
            "were off"
        )
    held = [
        model.actuator(i).name or f"number {i}" for i in range(model.nu) if model.actuator_trntype[i] == BODY
    ]
    if held:
        yield (
            f"left out: {', '.join(held)}, which holds a body (<adhesion>) and takes no command of a joint; "
            "it is off in the simulation"
        )
    balls = [model.joint(j).name or f"joint {j}" for j in passive_balls(model)]
    if balls:
        yield (
            f"ball joints have no reading: {', '.join(balls)}. Each prediction begins with them at rest in "
            "the model's pose; where they swing, remove their <joint> from a copy of the MJCF, and compare"
        )


def passive_balls(model: Any) -> list[int]:
    """Return the ball joints that no actuator drives."""
    driven = {int(model.actuator_trnid[i, 0]) for i in range(model.nu) if model.actuator_trntype[i] != BODY}
    ball = int(mujoco.mjtJoint.mjJNT_BALL)
    return [j for j in range(model.njnt) if model.jnt_type[j] == ball and j not in driven]
