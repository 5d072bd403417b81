"""Names, units and limits of the joints of any MJCF, for checks of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.mjcf.notes import model_notes
from deal_hw.sim.parameters.drive import find_drive
from deal_hw.sim.parameters.followers import natural_followers
from deal_hw.sim.parameters.kind import joint_of
from deal_hw.sim.parameters.one_drive import brakes
from deal_hw.types import FloatArray

Flags = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True, slots=True, eq=False)
class JointFacts:
    """The joints of a model with one coordinate each, in the model's order.

    Attributes:
        names: (J,).
        units: "rad" or "m", (J,).
        limits: Lowest and highest position, (J, 2) [rad or m]; infinite for none.
        left_out: Free and ball joints, which have no single position.
        servo: Whether an actuator of each joint takes positions, (J,).
        motor: Whether one takes efforts, (J,).
        command: Lowest and highest command by the actuator's ctrlrange, as in recordings (positions, or
            efforts at the joint), (J, 2); infinite for none.
        full_effort: Effort of each joint's motor at its highest command, or at 1 without a ctrlrange, (J,)
            [N or N·m]; NaN without a motor.
        gain: A command in a recording over the model's ctrl, (J,): a motor's effort at 1; for a servo 1,
            or what its gear or a scaled set-point makes of it.
        speed_gain: Effort an error of the speed of each joint whose actuator takes speeds, (J,)
            [N·m·s/rad or N·s/m]; NaN for others. Recordings hold efforts, this times the speed.
        followers: Joints that need no reading, as an equality of the model moves them with others.
        notes: What of the model has no effect in a calibration, as sentences.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    limits: FloatArray
    left_out: tuple[str, ...]
    servo: Flags
    motor: Flags
    command: FloatArray
    full_effort: FloatArray
    gain: FloatArray
    speed_gain: FloatArray
    followers: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()

    @property
    def motors(self) -> frozenset[str]:
        """Joints whose actuator takes efforts or speeds; what an unknown actuator takes, nobody knows."""
        known = self.motor & ~self.servo & np.isfinite(self.full_effort)
        return frozenset(name for name, on in zip(self.names, known, strict=True) if on)


def joint_facts(mjcf: Path, model: mujoco.MjModel | None = None) -> JointFacts:
    """Read the joints of a model.

    Args:
        mjcf: Its file.
        model: The compiled model; None to compile it.

    Raises:
        ConfigurationError: The file does not exist or does not compile, or has no hinge or slide.
    """
    model = compile_mjcf(mjcf) if model is None else model
    names: list[str] = []
    units, limits, left_out = [], [], []
    index_of: dict[int, int] = {}
    for index in range(model.njnt):
        joint = model.joint(index)
        kind = mujoco.mjtJoint(int(joint.type[0]))
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            left_out.append(joint.name or f"joint {index}")
            continue
        if not joint.name:
            raise ConfigurationError(
                f"model {mjcf}: joint {index} has no name; name it, recordings need names"
            )
        index_of[index] = len(names)
        names.append(joint.name)
        units.append("m" if kind == mujoco.mjtJoint.mjJNT_SLIDE else "rad")
        limits.append(joint.range if bool(joint.limited[0]) else (-np.inf, np.inf))
    if not names:
        raise ConfigurationError(f"model {mjcf} has no hinge or slide joint")
    return JointFacts(
        tuple(names),
        tuple(units),
        np.array(limits, dtype=np.float64),
        tuple(left_out),
        *_actuation(model, index_of),
        frozenset(model.joint(follower.joint).name for follower in natural_followers(model)),
        tuple(model_notes(model)),
    )


def _actuation(
    model: mujoco.MjModel, column: Mapping[int, int]
) -> tuple[Flags, Flags, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return servos, motors, command ranges, full efforts, gains, and gains of speeds, by column."""
    servo, motor = np.zeros(len(column), dtype=bool), np.zeros(len(column), dtype=bool)
    command, full_effort = np.tile([-np.inf, np.inf], (len(column), 1)), np.full(len(column), np.nan)
    gain, speed_gain = np.ones(len(column)), np.full(len(column), np.nan)
    idle = brakes(model)
    for actuator in range(model.nu):
        joint = joint_of(model, actuator)
        if joint not in column or actuator in idle:
            continue
        at, drive = column[joint], find_drive(model, actuator)
        closes = drive is not None and drive.takes == "position"
        servo[at], motor[at] = servo[at] or closes, motor[at] or not closes
        if drive is None:
            continue
        limited = bool(model.actuator_ctrllimited[actuator])
        gain[at] = drive.scale if closes else drive.gain
        if not closes:
            most = np.max(np.abs(model.actuator_ctrlrange[actuator])) if limited else 1.0
            full_effort[at] = abs(drive.gain) * most
        if drive.takes == "velocity":
            speed_gain[at] = drive.damping
        if limited:
            command[at] = np.sort(model.actuator_ctrlrange[actuator] * gain[at])
    return servo, motor, command, full_effort, gain, speed_gain
