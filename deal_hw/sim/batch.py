"""Batched simulation of a servo-driven robot: N members with their own parameters on one thread pool."""

from __future__ import annotations

import os

import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from deal_hw.parameters import ParameterSpace
from deal_hw.sim.fields import BatchFields
from deal_hw.sim.model import RobotModel
from deal_hw.sim.parameters import SERVO_KINDS, apply_parameters
from deal_hw.types import FloatArray


def default_threads() -> int:
    """Return the number of CPUs this process may use."""
    return len(os.sched_getaffinity(0))


class ServoBatch:
    """N simulations of one robot; the one place where the calibrator and the trainer meet the engine.

    Args:
        robot: The robot's model.
        space: The parameters that members differ in.
        count: Members N.
        threads: Threads; None for all CPUs.
    """

    def __init__(
        self, robot: RobotModel, space: ParameterSpace, count: int, threads: int | None = None
    ) -> None:
        self.robot = robot
        self.space = space
        self.count = count
        self.batch = Batch(robot.model, nsim=count, nthread=threads or default_threads())
        self._fields = BatchFields(self.batch, robot.model)
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._warmstart = self.batch.bind("qacc_warmstart")
        self._nominal = np.array([p.nominal for p in space.parameters])
        self.speed_limit = np.zeros((count, len(robot.actuator)))
        self.steps = 0
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
        self._servo: dict[str, FloatArray] = {}
        description = self.robot.description
        defaults = {
            "servo_stiffness": description.stiffness,
            "servo_damping": description.damping,
            "servo_effort_limit": description.effort_limit,
            "servo_speed_limit": description.speed_limit,
        }
        for kind in SERVO_KINDS:
            factor = np.ones((self.count, len(description.actuated)))
            for p in self.space.parameters:
                if p.kind != kind:
                    continue
                values = columns.get(p.name, np.full(self.count, p.nominal))
                for name in p.elements:
                    a = description.actuated.index(name)
                    factor[:, a] = values / defaults[kind][a]
            self._servo[kind] = factor
        self.set_sent(
            np.array(description.stiffness), np.array(description.damping), np.array(description.effort_limit)
        )

    def servo_factor(self, kind: str) -> FloatArray:
        """Return what the device makes of a sent gain or limit: acting value = factor * sent, (N, A)."""
        return self._servo[kind]

    def set_sent(self, stiffness: FloatArray, damping: FloatArray, effort_limit: FloatArray) -> None:
        """Set the gains and limits that the host sends from now on, (A,) each."""
        gain, bias = self._fields.get("actuator_gainprm"), self._fields.get("actuator_biasprm")
        force = self._fields.get("actuator_forcerange")
        for a, actuator in enumerate(self.robot.actuator):
            kp = self._servo["servo_stiffness"][:, a] * stiffness[a]
            gain[:, actuator, 0] = kp
            bias[:, actuator, 1] = -kp
            bias[:, actuator, 2] = -self._servo["servo_damping"][:, a] * damping[a]
            limit = self._servo["servo_effort_limit"][:, a] * effort_limit[a]
            force[:, actuator, 0] = -limit
            force[:, actuator, 1] = limit

    def set_state(
        self, position: FloatArray, velocity: FloatArray, where: npt.NDArray[np.intp] | slice = slice(None)
    ) -> None:
        """Set joint positions and velocities, (N, J) or (J,) each, of the members in ``where``."""
        rows = np.arange(self.count)[where][:, None]
        self._qpos[rows, list(self.robot.qpos)] = position
        self._qvel[rows, list(self.robot.qvel)] = velocity
        # A warm start left by another episode would make results depend on history in the last digits.
        self._warmstart[rows[:, 0]] = 0.0

    @property
    def position(self) -> FloatArray:
        """Joint positions now, (N, J)."""
        return np.asarray(self._qpos[:, list(self.robot.qpos)])

    @property
    def velocity(self) -> FloatArray:
        """Joint velocities now, (N, J)."""
        return np.asarray(self._qvel[:, list(self.robot.qvel)])

    def advance(self, setpoint: FloatArray, every: int = 0) -> tuple[FloatArray, FloatArray]:
        """Advance all members in open loop.

        Args:
            setpoint: Set-point in force at each step, (N, S, A).
            every: Record each ``every``-th step; 0 records only the last.

        Returns:
            Positions and velocities after steps every, 2 every, ..., (N, S // every, J) each. A member that
            diverged (MuJoCo's warning counters rose) is NaN from there on.
        """
        count, steps, _ = setpoint.shape
        nu = self.robot.model.nu
        if nu != setpoint.shape[2] or list(self.robot.actuator) != list(range(nu)):
            control = np.zeros((count, steps, nu))
            control[:, :, list(self.robot.actuator)] = setpoint
        else:
            control = setpoint
        before = self._warnings()
        self.steps += count * steps
        if not every:
            # Stepping by rollout with a record of one field costs nothing over bare stepping.
            every = steps
        record = self.batch.rollout(steps, control=control, record=("qpos", "qvel"))
        position = record["qpos"][:, every - 1 :: every][..., list(self.robot.qpos)]
        velocity = record["qvel"][:, every - 1 :: every][..., list(self.robot.qvel)]
        bad = self._warnings() > before
        if bad.any():
            position, velocity = position.copy(), velocity.copy()
            position[bad], velocity[bad] = np.nan, np.nan
        return position, velocity

    def _warnings(self) -> npt.NDArray[np.int64]:
        # Counters of (bad qpos, bad qvel, bad qacc, bad ctrl): a rise is a divergence, which MuJoCo answers
        # by a reset.
        return np.asarray(self.batch.warning[..., 1].sum(axis=-1), dtype=np.int64)


def bare_steps_per_second(robot: RobotModel, count: int, steps: int, threads: int | None = None) -> float:
    """Measure the engine alone: physics steps a second of ``count`` members, open loop."""
    import time

    batch = Batch(robot.model, nsim=count, nthread=threads or default_threads())
    batch.bind("qpos")[:, list(robot.qpos)] = 0.05
    start = time.perf_counter()
    batch.step(nstep=steps)
    return count * steps / (time.perf_counter() - start)
