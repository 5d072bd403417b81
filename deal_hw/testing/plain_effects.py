"""What the fault of a robot in plain MuJoCo does to its commands, its forces and its readings.

These few lines of numpy are written for the robots alone. None of the laws that a calibration has is used, or
it would be tested with itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np

from deal_hw.testing.plain_faults import (
    ASYMMETRY,
    BLIND,
    CONTROL_S,
    COUNTS,
    ENCODER_SCALE,
    FREE_SPEED,
    LOAD_FRICTION,
    MOST_ZERO,
    MOTOR_DEAD_ZONE,
    PLAY,
    RISE,
    SERVO_DEAD_ZONE,
    STRIBECK_EXTRA,
    STRIBECK_SPEED,
)
from deal_hw.types import FloatArray

LEAST_FRICTION = 1e-9
"""MuJoCo has no friction constraint at 0, and the number of constraints has to stay [N·m or N]."""

TURN = 1e-3
"""Angle to either side over which the rise of gravity's torque is taken [rad or m]."""


class Plant:
    """A robot that takes commands and reports positions, with the effect of its fault.

    Args:
        mjcf: MJCF of the robot. A fault may give it more joints than it reports.
        joints: Names of the joints that it reports, J of them.
        fault: Its fault, or None.
        truth: Stiffness and damping by ``<joint>.servo_stiffness`` and ``<joint>.damping``, for a PD.
        effort: Largest command of each motor, (A,) [N·m or N]; 0 for servos.
        zero: Readings of the joints at a position of 0, as shares of :func:`largest_zeros`, (J,) [-].
    """

    def __init__(
        self,
        mjcf: str,
        joints: Sequence[str],
        fault: str | None,
        truth: Mapping[str, float],
        effort: Sequence[float] = (),
        zero: FloatArray | float = 0.0,
    ) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf)
        self.data = mujoco.MjData(self.model)
        model = self.model
        driven = model.actuator_trnid[:, 0]
        self.moved = [model.joint(int(i)).name for i in driven]
        self.dof, self.place = model.jnt_dofadr[driven], model.jnt_qposadr[driven]
        self.seen = np.array([int(model.joint(name).qposadr[0]) for name in joints])
        slides = [int(model.joint(name).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for name in joints]
        self.count = np.array([COUNTS["slide" if slide else "hinge"] for slide in slides])
        self.at = [joints.index(name) for name in self.moved]
        self.stiffness = np.array([truth.get(f"{name}.servo_stiffness", 0.0) for name in self.moved])
        self.damping = np.array([truth.get(f"{name}.damping", 0.0) for name in self.moved])
        self.coulomb = model.dof_frictionloss[self.dof].copy()
        self.stall = model.actuator_forcerange[:, 1].copy()
        self.effort = np.array(effort)
        self.zero = zero * largest_zeros(model, joints) if fault == "zeros" else np.zeros(len(joints))
        # Incremental encoders count from where the robot was when it was switched on.
        self.data.qpos[self.seen] -= self.zero
        self.engaged: FloatArray = self.data.qpos[self.place].copy()
        self.steps, self.last = 0, float(self.data.qpos[self.seen[-1]])
        self.fault = fault or ""

    def read(self) -> FloatArray:
        """Return the positions of the joints as their encoders report them, (J,) [rad or m]."""
        position = np.array(self.data.qpos[self.seen])
        reading = READINGS.get(self.fault)
        return position if reading is None else reading(self, position)

    def step(self, wanted: FloatArray) -> None:
        """Advance by one physics step with the command that has arrived, (A,)."""
        acting, force = COMMANDS.get(self.fault), FORCES.get(self.fault)
        self.data.ctrl[:] = wanted if acting is None else acting(self, wanted.copy())
        if force is not None:
            force(self)
        mujoco.mj_step(self.model, self.data)
        self.steps += 1
        angle = float(self.data.qpos[self.seen[-1]])
        if not BLIND[0] < angle < BLIND[1]:
            self.last = angle

    @property
    def position(self) -> FloatArray:
        """True positions of the driven joints, (A,) [rad or m]."""
        return np.asarray(self.data.qpos[self.place])

    @property
    def speed(self) -> FloatArray:
        """Speeds of the driven joints, (A,) [rad/s or m/s]."""
        return np.asarray(self.data.qvel[self.dof])


def largest_zeros(model: mujoco.MjModel, joints: Sequence[str]) -> FloatArray:
    """Return how far friction holds each joint off its rest, up to :data:`MOST_ZERO`, (J,) [rad or m].

    That is where gravity, which rises with the angle, is as large as the friction.
    """
    data, found = mujoco.MjData(model), []
    for name in joints:
        place, dof = int(model.joint(name).qposadr[0]), int(model.joint(name).dofadr[0])
        torque = []
        for angle in (-TURN, TURN):
            data.qpos[place] = angle
            mujoco.mj_forward(model, data)
            torque.append(float(data.qfrc_bias[dof]))
        data.qpos[place] = 0.0
        rise = abs(torque[1] - torque[0]) / (2 * TURN)
        found.append(min(float(model.dof_frictionloss[dof]) / max(rise, 1e-9), MOST_ZERO))
    return np.array(found)


def _play(plant: Plant, wanted: FloatArray) -> FloatArray:
    # The servo's side of the gear: it drives the joint only where the play is used up.
    plant.engaged = np.clip(plant.engaged, wanted - PLAY / 2, wanted + PLAY / 2)
    return plant.engaged


def _reversed(plant: Plant, wanted: FloatArray) -> FloatArray:
    del plant
    wanted[-1] = -wanted[-1]
    return wanted


def _held_pd(plant: Plant, wanted: FloatArray) -> FloatArray:
    """Return the torques of a PD on encoder counts, which it holds for its period."""
    if plant.steps % round(CONTROL_S / plant.model.opt.timestep):
        return np.asarray(plant.data.ctrl)
    count = plant.count[plant.at]
    read = np.round(plant.position / count) * count
    return np.asarray(plant.stiffness * (wanted - read) - plant.damping * plant.speed)


def _servo_dead_zone(plant: Plant, wanted: FloatArray) -> FloatArray:
    # The set-point that gives a servo without a dead zone the same torque.
    return np.asarray(plant.position + beyond(wanted - plant.position, SERVO_DEAD_ZONE))


def _motor_dead_zone(plant: Plant, wanted: FloatArray) -> FloatArray:
    return beyond(wanted, MOTOR_DEAD_ZONE * plant.effort)


def _to_one_side(plant: Plant, wanted: FloatArray) -> FloatArray:
    del plant
    return np.asarray(wanted * (1 + ASYMMETRY * np.sign(wanted)))


def _by_its_zero(plant: Plant, wanted: FloatArray) -> FloatArray:
    # A servo closes its loop on what its encoder reports.
    return np.asarray(wanted - plant.zero[plant.at])


def beyond(values: FloatArray, zone: FloatArray | float) -> FloatArray:
    """Return what exceeds a dead zone to either side."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - zone, 0.0))


def _stribeck(plant: Plant) -> None:
    speed, dof = plant.speed, plant.dof
    extra = STRIBECK_EXTRA * plant.coulomb * np.exp(-np.abs(speed) / STRIBECK_SPEED)
    plant.data.qfrc_applied[dof] = -extra * np.tanh(speed / 0.01)


def _load_friction(plant: Plant) -> None:
    # The motors' torques are those of the step before.
    torque = np.abs(plant.data.qfrc_actuator[plant.dof])
    plant.model.dof_frictionloss[plant.dof] = plant.coulomb + LOAD_FRICTION * torque


def _friction_rise(plant: Plant) -> None:
    rising = plant.coulomb * np.abs(np.tanh(RISE * plant.speed))
    plant.model.dof_frictionloss[plant.dof] = np.maximum(rising, LEAST_FRICTION)


def _free_speed(plant: Plant) -> None:
    """Limit torques as a DC motor on a limited voltage does, whose back-EMF grows with speed."""
    lost = plant.speed / FREE_SPEED
    plant.model.actuator_forcerange[:] = np.stack([-1 - lost, 1 - lost], axis=1) * plant.stall[:, None]


def _scaled(plant: Plant, position: FloatArray) -> FloatArray:
    del plant
    position[-1] *= ENCODER_SCALE
    return position


def _blind(plant: Plant, position: FloatArray) -> FloatArray:
    position[-1] = plant.last
    return position


def _shifted(plant: Plant, position: FloatArray) -> FloatArray:
    return np.asarray(position + plant.zero)


COMMANDS: Mapping[str, Callable[[Plant, FloatArray], FloatArray]] = {
    "backlash": _play,
    "sign": _reversed,
    "encoders": _held_pd,
    "motor-play": _held_pd,
    "servo-dead-zone": _servo_dead_zone,
    "motor-dead-zone": _motor_dead_zone,
    "motor-asymmetry": _to_one_side,
    "zeros": _by_its_zero,
}
"""What acts of a command that has arrived, (A,), by fault."""

FORCES: Mapping[str, Callable[[Plant], None]] = {
    "friction": _stribeck,
    "load-friction": _load_friction,
    "friction-rise": _friction_rise,
    "free-speed": _free_speed,
}
"""What changes forces before each physics step, by fault."""

READINGS: Mapping[str, Callable[[Plant, FloatArray], FloatArray]] = {
    "encoder-scale": _scaled,
    "blind-encoder": _blind,
    "zeros": _shifted,
}
"""What encoders report of true positions, (J,), by fault."""


def in_file(
    fault: str | None, time: FloatArray, measured: FloatArray, commands: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a recording with a fault that commands and measurements share; a free last joint has no command.

    Args:
        fault: The fault; others change nothing.
        time: Times, (T,) [s].
        measured: Positions, (T, J) [rad or m].
        commands: Commands, (T, A).
    """
    time, measured, commands = time.copy(), measured.copy(), commands.copy()
    last = [measured[:, -1], *([commands[:, -1]] if commands.shape == measured.shape else [])]
    factors = {"mirrored": -1.0, "degrees": 180 / np.pi, "doubled-joint": 2.0}
    for values in last:
        values *= factors.get(fault or "", 1.0)
    if fault == "swapped":
        measured[:, -2:], commands[:, -2:] = measured[:, :-3:-1].copy(), commands[:, :-3:-1].copy()
    if fault == "doubled":
        measured, commands = 2 * measured, 2 * commands
    return time * {"fast-clock": 2.0, "slow-clock": 0.5}.get(fault or "", 1.0), measured, commands
