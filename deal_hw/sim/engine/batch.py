"""Batched simulation of one robot: N members with their own parameters on one thread pool.

States are tangent coordinates (see the module of this name), (N, C): for a floating base its position,
rotation vector and then the joints, for a fixed base the joints alone. Velocities are MuJoCo's, in the same
order. Joint positions and speeds are as the robot reports them: with each member's encoder bias and scale,
and of the motor where its encoder is there.
"""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.effort import TORQUE, EffortSensors, effort_joints
from deal_hw.sim.engine.engines import Engine, MujocoEngine, State
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.engine.model import RobotModel, at_step, drop_command_laws
from deal_hw.sim.engine.step_laws import StepLaws
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_quaternion, to_vector
from deal_hw.sim.engine.transmission import check_engine, take_constant_torques
from deal_hw.sim.laws.commands import NEUTRAL, CommandLaws, Filters
from deal_hw.sim.parameters import SERVO_KINDS, apply_parameters
from deal_hw.sim.parameters.sensor import ENCODER_BIAS, ENCODER_SCALE
from deal_hw.sim.parameters.transmission import TRANSMISSION_STIFFNESS
from deal_hw.sim.parameters.values import KindValues, spread, values_by_kind
from deal_hw.types import FloatArray

COMMAND_DELAY = "command_delay"
"""Kind of parameter without a MuJoCo field: delay of an actuator's commands, in addition to the latency."""

COMMAND_KINDS = {
    "command_dead_zone": "dead_zone",
    "command_asymmetry": "asymmetry",
    "command_saturation": "saturation",
    "command_lag": "lag_s",
    "servo_play": "play",
}
"""Kinds of parameters that are laws of commands, and their fields in `CommandLaws`."""

SIZES_KEPT = 8
"""Number of simulator sizes that are kept: one iteration of a search or refinement needs up to four, each
with its copies for several windows."""


def _note(warning: str) -> None:
    logging.getLogger(__name__).debug(warning)


if mujoco.get_mju_user_warning() is None:
    # A search tries thousands of parameters that diverge. They become NaN and are counted. By default MuJoCo
    # would print a line for each, and write MUJOCO_LOG.TXT into the working directory.
    mujoco.set_mju_user_warning(_note)


def default_threads() -> int:
    """Return the number of CPUs this process may use."""
    return len(os.sched_getaffinity(0))


def make_engine(
    name: EngineName, model: mujoco.MjModel, nominal: mujoco.MjModel, count: int, threads: int
) -> Engine:
    """Return an engine; arguments are those of :class:`MujocoEngine`.

    Raises:
        ConfigurationError: MuJoCo Warp cannot simulate this model, or there is no GPU.
        MissingExtraError: MuJoCo Warp is not installed.
    """
    if name == "mujoco":
        return MujocoEngine(model, nominal, count, threads)
    from deal_hw.sim.engine.warp_engine import WarpEngine

    return WarpEngine(model, nominal, count, threads, device="cpu" if name == "warp-cpu" else "cuda")


def command_laws(
    values: KindValues, actuators: Sequence[str], count: int, filters: Filters | None = None
) -> CommandLaws:
    """Return what the drives of N members make of their commands.

    Args:
        values: Values by kind.
        actuators: Names of the actuators, A of them.
        count: Members N.
        filters: Filters of the MJCF; a parameter sets their time constants.
    """
    laws = {law: spread(values, kind, actuators, NEUTRAL[law], count) for kind, law in COMMAND_KINDS.items()}
    if filters is not None:
        own = np.repeat(filters.lag_s[None], count, axis=0)
        searched = {name for name, _ in values.get("command_lag", ())}
        given = np.array([name in searched for name in actuators])
        laws["lag_s"] = own if laws["lag_s"] is None else np.where(given, laws["lag_s"], own)
    return CommandLaws(**laws, filters=filters)


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
        engine: What simulates.

    Attributes:
        commands: What the drives make of commands; set-points given to :meth:`advance` have passed it.
        effort_joints: Columns of the joints whose effort the parameters describe, (E,).
        effort: Efforts of these joints at the samples of the last :meth:`advance`, as the robot would report
            them, (N, S // every, E).
    """

    def __init__(
        self,
        robot: RobotModel,
        space: ParameterSpace,
        count: int,
        threads: int | None = None,
        counted: StepCount | None = None,
        engine: EngineName = "mujoco",
    ) -> None:
        self.robot = robot
        self.space = space
        self._here = robot.acting(space)
        self.effort_joints = effort_joints(robot.description, space)
        self.count = count
        self._filters, model = robot.filters, robot.model
        if self._filters is not None or model.actuator_delay.any():
            # Windows begin with positions and velocities: the filters' states follow from the commands.
            model = copy.copy(model)
            drop_command_laws(model)
        sprung = [e for p in self._here.parameters if p.kind == TRANSMISSION_STIFFNESS for e in p.elements]
        if sprung:
            check_engine(space, engine)
            model = copy.copy(model)
            take_constant_torques(model, sprung)
        self.engine = make_engine(engine, model, robot.model, count, threads or default_threads())
        self.batch = self.engine.batch
        self._fields = self.engine.fields
        bind = self.engine.bind
        self._qpos, self._qvel = bind("qpos"), bind("qvel")
        self._warmstart, self._applied = bind("qacc_warmstart"), bind("qfrc_applied")
        self._nominal = np.array([p.nominal for p in space.parameters])
        self._dof = list(robot.qvel)
        if robot.base is not None:
            self._dof = [*range(robot.base[1], robot.base[1] + 6), *self._dof]
        description = robot.description
        self._per_ctrl = robot.command_scale
        self._scaled = bool(np.any(self._per_ctrl != 1.0))
        self._ratio = np.array([1.0 if drive is None else drive.ratio for drive in robot.drives])
        self._gear = robot.model.actuator_gear[list(robot.actuator), 0]
        self._servos = np.array(robot.description.servos, dtype=bool)
        self._default = {
            "servo_stiffness": np.array(description.stiffness),
            "servo_damping": np.array(description.damping),
            "servo_effort_limit": np.array(description.effort_limit),
            "servo_speed_limit": np.array(description.speed_limit),
        }
        self._counted = counted or StepCount()
        self._steps: StepLaws | None = None
        self.effort = np.zeros((count, 0, len(self.effort_joints)))
        self.set_parameters(np.repeat(space.nominal[None], count, axis=0))

    def set_parameters(self, theta: FloatArray, where: npt.NDArray[np.intp] | None = None) -> None:
        """Set the free parameters of all members, or of those in ``where``.

        Args:
            theta: Physical values, (N, K), for all members even where only some are set.
            where: Indices of the members whose derived constants change; None for all.
        """
        self._theta = np.array(theta, dtype=float)
        if self._steps is not None:
            self._steps.restore()
        apply_parameters(self._fields, self._here, self._theta)
        self.engine.set_const(where)
        values, count = values_by_kind(self._here, self._theta), self.count
        joints, actuators = self.robot.description.joint_names, self.robot.actuator_names
        self._acting = {kind: np.repeat(self._default[kind][None], count, axis=0) for kind in SERVO_KINDS}
        for kind in SERVO_KINDS:
            for name, value in values.get(kind, ()):
                self._acting[kind][:, actuators.index(name)] = value
        bias = spread(values, ENCODER_BIAS, joints, 0.0, count)
        self._bias = np.zeros((count, len(joints))) if bias is None else bias
        self._scale = spread(values, ENCODER_SCALE, joints, 1.0, count)
        self._delay_s = spread(values, COMMAND_DELAY, actuators, 0.0, count)
        if (own := self.robot.command_delay_s).any():
            searched = np.isin(actuators, [name for name, _ in values.get(COMMAND_DELAY, ())])
            self._delay_s = np.where(searched, 0.0 if self._delay_s is None else self._delay_s, own)
            self._delay_s = np.broadcast_to(self._delay_s, (count, len(actuators)))
        self.commands = command_laws(values, actuators, count, self._filters)
        self._steps = StepLaws.of(self._fields, self.engine.bind, values)
        self._efforts: EffortSensors | None = None
        if self.effort_joints:
            names = [joints[j] for j in self.effort_joints]
            dofs = [self.robot.qvel[j] for j in self.effort_joints]
            self._efforts = EffortSensors(names, dofs, values, count)
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
        """Each member's encoder biases, (N, J): reported joint positions at true ones of 0."""
        return self._bias

    def true_joints(self, position: FloatArray) -> FloatArray:
        """Return the true joint positions of reported ones, (N, J)."""
        return self._true(position, slice(None))

    def _true(self, position: FloatArray, rows: npt.NDArray[np.intp] | slice) -> FloatArray:
        """Return the true joint positions of reported ones, (M, J) or (M, G, J), of members."""
        bias, scale = self._bias[rows], self._scale
        shape = (len(bias), *(1,) * (position.ndim - 2), bias.shape[1])
        true = position - bias.reshape(shape) if self._biased else position
        return true if scale is None else true / scale[rows].reshape(shape)

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
        if not self._servos.any():
            return
        if self._steps is not None:
            self._steps.restore_sent()
        gain, bias = self._fields.get("actuator_gainprm"), self._fields.get("actuator_biasprm")
        force = self._fields.get("actuator_forcerange")
        kp, kd = self._act("servo_stiffness", stiffness), self._act("servo_damping", damping)
        if self._scale is not None:
            # The servo's error and speed are those of the reading.
            scale = self._scale[:, list(self.robot.description.actuated_index)]
            kp, kd = kp * scale, kd * scale
        limit = self._act("servo_effort_limit", effort_limit)
        actuator = np.array(self.robot.actuator)
        # The model's numbers are those before the gear, and a scaled set-point stays scaled.
        on, gear = self._servos, self._gear[self._servos]
        kp, kd = kp[:, on] / gear**2, kd[:, on] / gear**2
        gain[:, actuator[on], 0] = kp * self._ratio[on]
        bias[:, actuator[on], 1] = -kp
        bias[:, actuator[on], 2] = -kd
        limited = on & np.isfinite(limit).all(axis=0)
        limit = limit / np.abs(self._gear)
        force[:, actuator[limited], 0] = -limit[:, limited]
        force[:, actuator[limited], 1] = limit[:, limited]
        if self._steps is not None:
            self._steps.read_sent()

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
        rows = np.arange(self.count)[where]
        qpos, qvel = self._qpos[rows][:, None], self._qvel[rows][:, None]
        # One window; a reference is (4,), or one of each member.
        position, velocity = (
            np.broadcast_to(x, (len(rows), x.shape[-1]))[:, None] for x in (position, velocity)
        )
        if reference is not None and reference.ndim == 2:
            reference = reference[:, None]
        self._put_state(qpos, qvel, position, velocity, rows, reference)
        self._qpos[rows], self._qvel[rows] = qpos[:, 0], qvel[:, 0]
        # A warm start from another episode would make results depend on history in the last digits.
        self._warmstart[rows] = 0.0
        if self._steps is not None:
            self._steps.restart(rows)

    @property
    def position(self) -> FloatArray:
        """Present tangent coordinates, (N, C), around the identity."""
        return self._tangent_coordinates(self._measured("qpos", self._qpos), None)

    @property
    def velocity(self) -> FloatArray:
        """Present velocities, (N, C)."""
        return self._reported_speed(np.asarray(self._measured("qvel", self._qvel)[:, self._dof]))

    def _measured(self, name: str, values: FloatArray) -> FloatArray:
        """Return a field of the state, (N, ...), with rotors where encoders measure these."""
        if self._steps is None:
            return values
        found = values.copy()
        self._steps.report(name, found)
        return found

    def _reported_speed(self, velocity: FloatArray) -> FloatArray:
        """Return velocities, (N, ..., C), as the encoders report them."""
        if self._scale is None:
            return velocity
        factor = np.ones((self.count, *(1,) * (velocity.ndim - 2), velocity.shape[-1]))
        factor[..., self.robot.joints] = self._scale.reshape(self.count, *(1,) * (velocity.ndim - 2), -1)
        return velocity * factor

    def _tangent_coordinates(self, qpos: FloatArray, reference: FloatArray | None) -> FloatArray:
        """Return qpos, (N, ..., nq), as reported tangent coordinates, (N, ..., C)."""
        joints = qpos[..., list(self.robot.qpos)]
        if self._scale is not None:
            joints = joints * self._scale.reshape(self.count, *(1,) * (qpos.ndim - 2), -1)
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
        pushed = None if force is None else force[:, None]
        position, velocity = self._roll(setpoint[:, None], every, reference, pushed, None)
        if self._efforts is not None:
            self.effort = self.effort[:, 0]
        return position[:, 0], velocity[:, 0]

    def advance_windows(
        self,
        start: State,
        setpoint: FloatArray,
        every: int,
        start_reference: FloatArray | None = None,
        reference: FloatArray | None = None,
        force: FloatArray | None = None,
    ) -> State:
        """Simulate G windows with all members, from start states of their own.

        Args:
            start: Tangent coordinates and velocities, (N, G, C) each.
            setpoint: Set-point (or motor command) in force at each step, (N, G, S, A).
            every: Record each ``every``-th step.
            start_reference: Reference orientations of the starts, (G, 4); the identity by default.
            reference: Those at the recorded steps, (G, S // every, 4).
            force: Forces on the coordinates, (N, G, S, C); none by default.

        Returns:
            Positions and velocities as :meth:`advance`, (N, G, S // every, C) each.
        """
        position, velocity = start
        count, windows = position.shape[:2]
        qpos, qvel = (np.repeat(now[:, None], windows, axis=1) for now in (self._qpos, self._qvel))
        self._put_state(qpos, qvel, position, velocity, np.arange(count), start_reference)
        return self._roll(setpoint, every, reference, force, (qpos, qvel))

    def _put_state(
        self,
        qpos: FloatArray,
        qvel: FloatArray,
        position: FloatArray,
        velocity: FloatArray,
        rows: npt.NDArray[np.intp],
        reference: FloatArray | None,
    ) -> None:
        """Put tangent coordinates, (M, G, C), of the members in ``rows`` into (M, G, nq) and (M, G, nv)."""
        if self.robot.base is not None:
            at = self.robot.base[0]
            qpos[..., at : at + 3] = position[..., :3]
            orientation = to_quaternion(position[..., 3:6], IDENTITY if reference is None else reference)
            qpos[..., at + 3 : at + 7] = orientation
        qvel[..., self._dof] = velocity
        speed = velocity[..., self.robot.joints]
        if self._scale is not None:
            speed = speed / self._scale[rows][:, None]
        self.robot.place(qpos, self._true(position[..., self.robot.joints], rows), qvel, speed)

    def _roll(
        self,
        setpoint: FloatArray,
        every: int,
        reference: FloatArray | None,
        force: FloatArray | None,
        start: State | None,
    ) -> State:
        """Return positions and velocities in windows, (N, G, S // every, C), and keep the efforts there."""
        control, spec = self._control(setpoint, force)
        count, windows, steps = control.shape[:3]
        self._counted.steps += count * windows * steps
        every = every or steps
        recorded = {name: 1 if name == TORQUE else every for name in self.recorded}
        try:
            record, bad = self.engine.rollout(control, spec, recorded, self._steps, start)
        finally:
            if force is not None:
                # Otherwise the engine would keep the last forces.
                self._applied[:] = 0.0
        position = np.asarray(self._tangent_coordinates(record["qpos"], reference), dtype=float)
        velocity = np.asarray(self._reported_speed(record["qvel"][..., self._dof]), dtype=float)
        if bad.any():
            position, velocity = position.copy(), velocity.copy()
            position[bad], velocity[bad] = np.nan, np.nan
        if self._efforts is not None:
            torque, step_s = np.asarray(record[TORQUE], dtype=float), self.robot.step_s
            report = [self._efforts.report(torque[:, g], every, step_s) for g in range(windows)]
            self.effort = np.stack(report, axis=1)
            self.effort[bad] = np.nan
        return position, velocity

    def discount(self, steps: int) -> None:
        """Take physics steps whose result nobody uses from the count."""
        self._counted.steps -= steps

    @property
    def stepwise(self) -> bool:
        """Whether laws act between the physics steps, by array code."""
        return self._steps is not None

    @property
    def recorded(self) -> tuple[str, ...]:
        """Fields of MjData that a rollout records."""
        return ("qpos", "qvel") if self._efforts is None else ("qpos", "qvel", TORQUE)

    def _control(self, setpoint: FloatArray, force: FloatArray | None) -> tuple[FloatArray, int]:
        """Return what the engine sets at each step, (N, G, S, U), and the components of the state it is."""
        if self._servos.any():
            # The servo compares the set-point with the reading.
            actuated = list(self.robot.description.actuated_index)
            if self._biased:
                setpoint = setpoint - np.where(self._servos, self._bias[:, None, None, actuated], 0.0)
            if self._scale is not None:
                setpoint = setpoint / np.where(self._servos, self._scale[:, None, None, actuated], 1.0)
            if self._scaled:
                setpoint = setpoint / self._per_ctrl
        nu, actuator = self.robot.model.nu, list(self.robot.actuator)
        if actuator == list(range(nu)):
            control = setpoint
        elif sorted(actuator) == list(range(nu)):
            control = np.take(setpoint, np.argsort(actuator), axis=-1)
        else:
            control = np.zeros((*setpoint.shape[:-1], nu))
            control[..., actuator] = setpoint
        spec = mujoco.mjtState.mjSTATE_CTRL
        if force is not None:
            applied = np.zeros((*setpoint.shape[:-1], self.robot.model.nv))
            applied[..., self._dof] = force
            control = np.concatenate([control, applied], axis=-1)
            spec |= mujoco.mjtState.mjSTATE_QFRC_APPLIED
        return control, int(spec)


class BatchPool:
    """The last used simulators of one robot and space, by number of members and physics step.

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
        self.threads = threads or default_threads()
        self._kept: dict[tuple[int, int, str, EngineName, float], list[ServoBatch]] = {}
        self._most *= 1 + len(robot.setups)
        self.counted = counted or StepCount()

    def __len__(self) -> int:
        return len(self._kept)

    def __reduce__(self) -> tuple[type[BatchPool], tuple[RobotModel, ParameterSpace, int]]:
        """Pickle without the simulators, which cannot be, and with a count of steps of its own."""
        return BatchPool, (self._robot, self._space, self.threads)

    @property
    def steps(self) -> int:
        """Physics steps of all simulators so far, including dropped ones and those with the same count."""
        return self.counted.steps

    def get(
        self, count: int, setup: str = "", engine: EngineName = "mujoco", step_s: float | None = None
    ) -> ServoBatch:
        """Return the simulator of ``count`` members in a set-up, with parameters and state of its last user.

        Args:
            count: Members.
            setup: Name of the set-up; "" for the model itself.
            engine: What simulates.
            step_s: Physics step; None for the model's [s].
        """
        return self._take(count, 1, setup, engine, step_s)[0]

    def parts(self, count: int, setup: str = "", step_s: float | None = None) -> list[ServoBatch]:
        """Return simulators with ``count`` members in all: one of one thread for each thread.

        Arguments are those of :meth:`get`.
        So the work between two steps of a closed loop is divided among the threads, too. The result does not
        depend on their number.
        """
        return self._take(count, min(self.threads, count), setup, "mujoco", step_s)

    def _take(
        self, count: int, parts: int, setup: str, engine: EngineName, step_s: float | None
    ) -> list[ServoBatch]:
        robot = self._robot.in_setup(setup)
        if step_s is not None and step_s != robot.step_s:
            robot = at_step(robot, step_s)
        key = count, parts, setup, engine, robot.step_s
        sizes = [count // parts + (i < count % parts) for i in range(parts)]
        threads = max(self.threads // parts, 1)
        kept = self._kept.pop(key, None) or [
            ServoBatch(robot, self._space, n, threads, self.counted, engine) for n in sizes
        ]
        # Last in order is last used.
        self._kept[key] = kept
        if len(self._kept) > self._most * len({step_s for *_, step_s in self._kept}):
            self._kept.pop(next(iter(self._kept)))
        return kept
