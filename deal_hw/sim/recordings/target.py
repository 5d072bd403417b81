"""Simulated targets: a robot with hidden parameters, recorded as a sensor would see it.

It replaces a real robot in benches of robots without an emulator. It gives an
:class:`~deal_hw.sim.recordings.episode.SampledEpisode` on the device's grid, like an aligned recording, and
the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from deal_hw.errors import CalibrationError, ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import ClosedLoop, reported
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_quaternion, to_vector
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.imu_base import base_states
from deal_hw.types import FloatArray

Behaviour = Callable[[FloatArray, FloatArray, float], FloatArray]
"""Command of the next control period, (A,), from reported position (C,), velocity (C,) and time [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetSensing:
    """Sensors of a target.

    Attributes:
        joint_std: Noise of joint positions, (J,) [m or rad]; None: the whole state is reported exactly.
        joint_resolution: Quantisation of joint positions, (J,).
        orientation_std: Noise of the IMU's orientation [rad].
        gyro_std: Noise of the IMU's angular velocity [rad/s].
        feet: Sphere geoms of the feet, from which base velocity and height are estimated.
    """

    joint_std: tuple[float, ...] | None = None
    joint_resolution: tuple[float, ...] = ()
    orientation_std: float = 0.0
    gyro_std: float = 0.0
    feet: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TargetRecording:
    """A recording of a target, and the truth.

    Attributes:
        episode: The measurements.
        position: True positions at the samples, in the episode's tangent coordinates, (T, C).
        velocity: True velocities at the samples, (T, C).
    """

    episode: SampledEpisode
    position: FloatArray
    velocity: FloatArray


def record_target(
    robot: RobotModel,
    space: ParameterSpace,
    theta: FloatArray,
    behaviour: Behaviour,
    *,
    seconds: float,
    latency_s: float = 0.0,
    sensing: TargetSensing | None = None,
    rng: np.random.Generator,
    start: FloatArray | None = None,
    settle_s: float = 1.0,
) -> TargetRecording:
    """Run a behaviour on a target and record it.

    Args:
        robot: The nominal model.
        space: The hidden parameters.
        theta: Their true values, (K,).
        behaviour: Source of the commands.
        seconds: Length of the recording [s].
        latency_s: Total latency; like command delays a whole number of physics steps [s].
        sensing: The sensors; exact and complete by default.
        rng: Draws the noise.
        start: Start positions of the joints, (J,); the default pose by default. The base starts at its place
            in the model.
        settle_s: Time for which the start pose is held before the recording [s].

    Raises:
        CalibrationError: The target diverged.
    """
    description, step_s = robot.description, robot.step_s
    period = round(1.0 / (description.control_rate_hz * step_s))
    stride = round(1.0 / (description.state_rate_hz * step_s))
    if period % stride:
        raise ConfigurationError(
            f"{description.name}: states every {stride} steps do not divide control periods of {period}"
        )
    batch = ServoBatch(robot, space, 1, threads=1)
    batch.set_parameters(np.asarray(theta, dtype=float)[None])
    rest = _settle(robot, batch, start, settle_s)
    ticks = math.ceil(seconds * description.control_rate_hz)
    sensor = _Sensor(robot, sensing or TargetSensing(), rng)
    samples = [batch.position[0]], [batch.velocity[0]]
    loop = ClosedLoop(batch, period, whole=True)
    loop.restart(rest[None], np.array([latency_s]))
    targets = np.empty((ticks, len(rest)))
    for tick in range(ticks):
        seen = sensor.joints(samples[0][-1])
        targets[tick] = behaviour(seen, samples[1][-1], tick / description.control_rate_hz)
        position, velocity = loop.advance(targets[tick : tick + 1], every=stride)
        if not np.isfinite(position).all():
            raise CalibrationError(
                f"the target {description.name} diverged after {tick / description.control_rate_hz:.2f} s"
            )
        samples[0].extend(position[0])
        samples[1].extend(velocity[0])
    true_x, true_v = np.array(samples[0]), np.array(samples[1])
    return sensor.report(true_x, true_v, np.repeat(targets, period, axis=0), rest, stride)


def _settle(robot: RobotModel, batch: ServoBatch, start: FloatArray | None, seconds: float) -> FloatArray:
    """Bring the target to rest in its start pose; return the command that holds it, (A,)."""
    description = robot.description
    joints = np.array(description.default_position if start is None else start, dtype=float)
    position = np.concatenate([batch.position[0][: robot.joints.start], joints])
    batch.set_state(position, np.zeros_like(position))
    rest = description.held(joints)
    if seconds > 0:
        batch.advance(np.repeat(rest[None, None], round(seconds / robot.step_s), axis=1))
    return rest


class _Sensor:
    def __init__(self, robot: RobotModel, sensing: TargetSensing, rng: np.random.Generator) -> None:
        self._robot, self._sensing, self._rng = robot, sensing, rng

    def joints(self, position: FloatArray) -> FloatArray:
        """Return a state with its joints as reported, (C,)."""
        noise, joints = self._sensing.joint_std, self._robot.joints
        if noise is None:
            return position
        seen = position.copy()
        seen[..., joints] = reported(position[..., joints], noise, self._sensing.joint_resolution, self._rng)
        return seen

    def report(
        self, true_x: FloatArray, true_v: FloatArray, target: FloatArray, rest: FloatArray, stride: int
    ) -> TargetRecording:
        """Return the recording of a true trajectory, (T, C), in tangent coordinates of the identity."""
        robot, T = self._robot, len(true_x)
        C = true_x.shape[1]
        orientation = None
        position, velocity = self.joints(true_x), true_v.copy()
        measured = estimate = reference = None
        if robot.base is not None:
            orientation = to_quaternion(true_x[:, robot.rotation], IDENTITY)
        if self._sensing.joint_std is not None:
            velocity[:, robot.joints] = np.nan
            measured = np.zeros(2 * C, dtype=bool)
            measured[:C][robot.joints] = True
            measured[:C][robot.rotation] = measured[C:][robot.rotation] = True
        if orientation is not None and measured is not None:
            position, velocity, reference, estimate = self._base(position, velocity, orientation, stride)
        elif orientation is not None:
            reference = orientation
            position = true_x.copy()
            position[:, robot.rotation] = 0.0
        truth = true_x.copy()
        if orientation is not None and reference is not None:
            truth[:, robot.rotation] = to_vector(orientation, reference)
        as_rows = np.ones((len(target), 1))
        description = robot.description
        episode = SampledEpisode(
            step_s=robot.step_s,
            sample=np.arange(T) * stride,
            position=position,
            velocity=velocity,
            target=target,
            stiffness=as_rows * description.stiffness,
            damping=as_rows * description.damping,
            effort_limit=as_rows * description.effort_limit,
            speed_limit=as_rows * description.speed_limit,
            usable=np.ones(T, dtype=bool),
            start_setpoint=rest,
            reference=reference,
            measured=measured,
            estimate_std=estimate,
            noise_free=self._sensing.joint_std is None,
        )
        return TargetRecording(episode, truth, true_v)

    def _base(
        self, position: FloatArray, velocity: FloatArray, orientation: FloatArray, stride: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return position, velocity, reference and spread with the base from IMU and legs."""
        robot, sensing, rng = self._robot, self._sensing, self._rng
        T = len(position)
        reported = to_quaternion(rng.standard_normal((T, 3)) * sensing.orientation_std, orientation)
        gyro = velocity[:, robot.rotation] + rng.standard_normal((T, 3)) * sensing.gyro_std
        joints, speed = position[:, robot.joints], velocity[:, robot.joints]
        found = base_states(robot, sensing.feet, reported, gyro, joints, speed, stride * robot.step_s)
        return found.position, found.velocity, found.reference, found.estimate_std
