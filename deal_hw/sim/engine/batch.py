"""Batched simulation of one robot: N members with their own parameters on one thread pool.

States are tangent coordinates (see the module of this name), (N, C): for a floating base its position,
rotation vector and then the joints, for a fixed base the joints alone. Velocities are MuJoCo's, in the same
order. Joint positions are as the robot reports them: each member's encoder bias is added to outputs and
subtracted from inputs.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from deal_hw.errors import CalibrationError, short
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_quaternion, to_vector
from deal_hw.sim.parameters import SERVO_KINDS, apply_parameters
from deal_hw.sim.parameters.fields import BatchFields
from deal_hw.types import FloatArray

ENCODER_BIAS = "encoder_bias"
"""Kind of parameter without a MuJoCo field: reported minus true joint position."""

COMMAND_DELAY = "command_delay"
"""Kind of parameter without a MuJoCo field: delay of an actuator's commands, in addition to the latency."""

SERVO_PLAY = "servo_play"
"""Kind of parameter without a MuJoCo field: width of the gear play between an actuator and its joint."""

SIZES_KEPT = 6
"""Number of simulator sizes that are kept: one iteration of a search or refinement needs up to four."""


def _note(warning: str) -> None:
    logging.getLogger(__name__).debug(warning)


if mujoco.get_mju_user_warning() is None:
    # A search tries thousands of parameters that diverge. They become NaN and are counted. By default MuJoCo
    # would print a line for each, and write MUJOCO_LOG.TXT into the working directory.
    mujoco.set_mju_user_warning(_note)


def default_threads() -> int:
    """Return the number of CPUs this process may use."""
    return len(os.sched_getaffinity(0))


@dataclass(slots=True)
class StepCount:
    """Number of simulated physics steps, which several simulators may share."""

    steps: int = 0


class ServoBatch:
    """N simulations of one robot; calibrator and trainer use the engine only through this class.

    Args:
        robot: The robot's model.
        space: The parameters in which members differ.
        count: Members N.
        threads: Threads; None for all CPUs.
        counted: Counts the physics steps; None for a count of its own.

    Attributes:
        play: Width of the play before each joint, (N, A) [rad or m]; None if no parameter is a play.
    """

    def __init__(
        self,
        robot: RobotModel,
        space: ParameterSpace,
        count: int,
        threads: int | None = None,
        counted: StepCount | None = None,
    ) -> None:
        self.robot = robot
        self.space = space
        self.count = count
        self.batch = Batch(robot.model, nsim=count, nthread=threads or default_threads())
        self._fields = BatchFields(self.batch, robot.model)
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._warmstart, self._applied = self.batch.bind("qacc_warmstart"), self.batch.bind("qfrc_applied")
        self._nominal = np.array([p.nominal for p in space.parameters])
        self._dof = list(robot.qvel)
        if robot.base is not None:
            self._dof = [*range(robot.base[1], robot.base[1] + 6), *self._dof]
        description = robot.description
        self._default = {
            "servo_stiffness": np.array(description.stiffness),
            "servo_damping": np.array(description.damping),
            "servo_effort_limit": np.array(description.effort_limit),
            "servo_speed_limit": np.array(description.speed_limit),
        }
        self._counted = counted or StepCount()
        self.set_parameters(np.repeat(space.nominal[None], count, axis=0))

    def set_parameters(self, theta: FloatArray, where: npt.NDArray[np.intp] | None = None) -> None:
        """Set the free parameters of all members, or of those in ``where``.

        Args:
            theta: Physical values, (N, K), for all members even where only some are set.
            where: Indices of the members whose derived constants change; None for all.
        """
        self._theta = np.array(theta, dtype=float)
        apply_parameters(self._fields, self.space, self._theta)
        self.batch.set_const(ids=where)
        columns = {name: self._theta[:, k] for k, name in enumerate(self.space.names)}
        description = self.robot.description
        self._acting = {
            kind: np.repeat(self._default[kind][None], self.count, axis=0) for kind in SERVO_KINDS
        }
        self._bias = np.zeros((self.count, len(description.joint_names)))
        self._delay_s: FloatArray | None = None
        self.play: FloatArray | None = None
        for p in self.space.parameters:
            values = columns.get(p.name, np.full(self.count, p.nominal))
            for name in p.elements:
                if p.kind in SERVO_KINDS:
                    self._acting[p.kind][:, self.robot.actuator_names.index(name)] = values
                elif p.kind == ENCODER_BIAS:
                    self._bias[:, description.joint_names.index(name)] = values
                elif p.kind == COMMAND_DELAY:
                    if self._delay_s is None:
                        self._delay_s = np.zeros((self.count, len(self.robot.actuator_names)))
                    self._delay_s[:, self.robot.actuator_names.index(name)] = values
                elif p.kind == SERVO_PLAY:
                    if self.play is None:
                        self.play = np.zeros((self.count, len(self.robot.actuator_names)))
                    self.play[:, self.robot.actuator_names.index(name)] = values
        self._biased = bool(np.any(self._bias))
        self.set_sent(
            self._default["servo_stiffness"],
            self._default["servo_damping"],
            self._default["servo_effort_limit"],
        )

    def servo_factor(self, kind: str) -> FloatArray:
        """Return the device's factor on a sent gain or limit: acting value = factor * sent, (N, A)."""
        default = self._default[kind]
        # A gain of zero or an infinite limit has no factor; the sent value then acts unchanged.
        scalable = np.isfinite(default) & (default != 0)
        factor = self._acting[kind] / np.where(scalable, default, 1.0)
        return np.where(scalable, factor, 1.0)

    @property
    def bias(self) -> FloatArray:
        """Each member's encoder biases, (N, J): reported minus true joint positions."""
        return self._bias

    def lag_s(self, latency_s: FloatArray) -> FloatArray:
        """Return the delay of commands: the latency, plus each actuator's command delay.

        Args:
            latency_s: Total latency of each member, (N,) [s].

        Returns:
            (N,) if no parameter is a command delay, else (N, A) [s].
        """
        latency = np.asarray(latency_s, dtype=float)
        return latency if self._delay_s is None else latency[:, None] + self._delay_s

    def _act(self, kind: str, sent: FloatArray) -> FloatArray:
        default = self._default[kind]
        scalable = np.isfinite(default) & (default != 0)
        ratio = np.where(scalable, sent / np.where(scalable, default, 1.0), 1.0)
        return np.asarray(self._acting[kind] * ratio)

    def set_sent(self, stiffness: FloatArray, damping: FloatArray, effort_limit: FloatArray) -> None:
        """Set the gains and limits that the host sends from now on, (A,) each; without effect on motors."""
        if self.robot.description.actuation != "position":
            return
        gain, bias = self._fields.get("actuator_gainprm"), self._fields.get("actuator_biasprm")
        force = self._fields.get("actuator_forcerange")
        kp, kd = self._act("servo_stiffness", stiffness), self._act("servo_damping", damping)
        limit = self._act("servo_effort_limit", effort_limit)
        actuator = np.array(self.robot.actuator)
        gain[:, actuator, 0] = kp
        bias[:, actuator, 1] = -kp
        bias[:, actuator, 2] = -kd
        limited = np.isfinite(limit).all(axis=0)
        force[:, actuator[limited], 0] = -limit[:, limited]
        force[:, actuator[limited], 1] = limit[:, limited]

    def set_state(
        self,
        position: FloatArray,
        velocity: FloatArray,
        where: npt.NDArray[np.intp] | slice = slice(None),
        reference: FloatArray | None = None,
    ) -> None:
        """Set the state, (N, C) or (C,) each, of the members in ``where``.

        Args:
            position: Tangent coordinates.
            velocity: Their velocities: linear in the world, angular in the base's frame, joints.
            where: The members.
            reference: Reference orientation, (4,) or (N, 4); the identity by default.
        """
        rows = np.arange(self.count)[where][:, None]
        joints = position[..., self.robot.joints]
        self._qpos[rows, list(self.robot.qpos)] = joints - self._bias[rows[:, 0]] if self._biased else joints
        if self.robot.base is not None:
            at = self.robot.base[0]
            self._qpos[rows, [at, at + 1, at + 2]] = position[..., :3]
            orientation = to_quaternion(position[..., 3:6], IDENTITY if reference is None else reference)
            self._qpos[rows, [at + 3, at + 4, at + 5, at + 6]] = orientation
        self._qvel[rows, self._dof] = velocity
        # A warm start from another episode would make results depend on history in the last digits.
        self._warmstart[rows[:, 0]] = 0.0

    @property
    def position(self) -> FloatArray:
        """Present tangent coordinates, (N, C), around the identity."""
        return self._tangent_coordinates(self._qpos, None)

    @property
    def velocity(self) -> FloatArray:
        """Present velocities, (N, C)."""
        return np.asarray(self._qvel[:, self._dof])

    def _tangent_coordinates(self, qpos: FloatArray, reference: FloatArray | None) -> FloatArray:
        """Return qpos, (N, ..., nq), as reported tangent coordinates, (N, ..., C)."""
        joints = qpos[..., list(self.robot.qpos)]
        if self._biased:
            joints = joints + self._bias.reshape(self.count, *(1,) * (qpos.ndim - 2), -1)
        if self.robot.base is None:
            return np.asarray(joints)
        at = self.robot.base[0]
        turned = to_vector(qpos[..., at + 3 : at + 7], IDENTITY if reference is None else reference)
        return np.concatenate([qpos[..., at : at + 3], turned, joints], axis=-1)

    def advance(
        self,
        setpoint: FloatArray,
        every: int = 0,
        reference: FloatArray | None = None,
        force: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Advance all members in open loop.

        Args:
            setpoint: Set-point (or motor command) in force at each step, (N, S, A).
            every: Record each ``every``-th step; 0 records only the last.
            reference: Reference orientations at the recorded steps, (S // every, 4); the identity by default.
            force: Forces and torques on the coordinates at each step, (N, S, C) [N or N·m]; none by default.

        Returns:
            Positions and velocities after steps every, 2 every, ..., (N, S // every, C) each. A member that
            diverged (MuJoCo's warning counters increased) is NaN.
        """
        if self._biased and self.robot.description.actuation == "position":
            # The servo compares the set-point with the biased reading.
            setpoint = setpoint - self._bias[:, None, list(self.robot.description.actuated_index)]
        count, steps, _ = setpoint.shape
        nu = self.robot.model.nu
        if nu != setpoint.shape[2] or list(self.robot.actuator) != list(range(nu)):
            control = np.zeros((count, steps, nu))
            control[:, :, list(self.robot.actuator)] = setpoint
        else:
            control = setpoint
        spec = mujoco.mjtState.mjSTATE_CTRL
        if force is not None:
            applied = np.zeros((count, steps, self.robot.model.nv))
            applied[:, :, self._dof] = force
            control = np.concatenate([control, applied], axis=2)
            spec |= mujoco.mjtState.mjSTATE_QFRC_APPLIED
        before = self._warnings()
        self._counted.steps += count * steps
        if not every:
            # Stepping by rollout with a record of one field costs no more than bare stepping.
            every = steps
        try:
            record = self.batch.rollout(
                steps, control=control, control_spec=int(spec), record=("qpos", "qvel")
            )
        except mujoco.FatalError as err:
            raise CalibrationError(f"the model cannot be simulated: {short(str(err))}") from err
        finally:
            if force is not None:
                # Otherwise the engine would keep the last forces.
                self._applied[:] = 0.0
        position = self._tangent_coordinates(record["qpos"][:, every - 1 :: every], reference)
        velocity = record["qvel"][:, every - 1 :: every][..., self._dof]
        bad = self._warnings() > before
        if bad.any():
            position, velocity = position.copy(), velocity.copy()
            position[bad], velocity[bad] = np.nan, np.nan
        return position, velocity

    def _warnings(self) -> npt.NDArray[np.int64]:
        # Counters of (bad qpos, bad qvel, bad qacc, bad ctrl): an increase is a divergence, after which
        # MuJoCo resets the state.
        return np.asarray(self.batch.warning[..., 1].sum(axis=-1), dtype=np.int64)


class BatchPool:
    """The last used simulators of one robot and space, by number of members.

    A simulator holds one MjData per thread: tens of megabytes of address space, up to some megabytes in use.
    Without a limit, searches with stages of different sizes would keep one for every size.

    Args:
        robot: The robot's model.
        space: The parameters in which members differ.
        threads: Threads of all simulators; None for all CPUs.
        most: Most sizes that are kept.
        counted: Counts the steps; None for a count of its own.
    """

    def __init__(
        self,
        robot: RobotModel,
        space: ParameterSpace,
        threads: int | None = None,
        most: int = SIZES_KEPT,
        counted: StepCount | None = None,
    ) -> None:
        self._robot, self._space, self._most = robot, space, most
        self._threads = threads or default_threads()
        self._kept: dict[tuple[int, int], list[ServoBatch]] = {}
        self.counted = counted or StepCount()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def steps(self) -> int:
        """Physics steps of all simulators so far, including dropped ones and those with the same count."""
        return self.counted.steps

    def get(self, count: int) -> ServoBatch:
        """Return the simulator of ``count`` members; parameters and state are those of its last user."""
        return self._take(count, 1)[0]

    def parts(self, count: int) -> list[ServoBatch]:
        """Return simulators with ``count`` members in all: one of one thread for each thread.

        So the work between two steps of a closed loop is divided among the threads, too. The result does not
        depend on their number.
        """
        return self._take(count, min(self._threads, count))

    def _take(self, count: int, parts: int) -> list[ServoBatch]:
        key = count, parts
        sizes = [count // parts + (i < count % parts) for i in range(parts)]
        threads = max(self._threads // parts, 1)
        kept = self._kept.pop(key, None) or [
            ServoBatch(self._robot, self._space, n, threads, self.counted) for n in sizes
        ]
        # Last in order is last used.
        self._kept[key] = kept
        if len(self._kept) > self._most:
            self._kept.pop(next(iter(self._kept)))
        return kept
