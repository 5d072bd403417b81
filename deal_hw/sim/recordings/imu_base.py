"""The state of a floating base from a legged robot's IMU, joint encoders and standing feet."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
import scipy

from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import to_vector
from deal_hw.sim.legged.leg_odometry import HEIGHT_STD, VELOCITY_STD, Felt, leg_odometry, smooth_orientation
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

ORIENTATION_SMOOTHER: Final = (7, 3)
"""Samples and order of the polynomial through reported orientations."""

PLACE_STD: Final = 1e-6
"""Standard deviation of the place on the floor [m]: nobody measures it, and no motion depends on it."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BaseStates:
    """T states of a floating robot; the base's place, height and linear velocity are estimates.

    Attributes:
        position: Tangent coordinates, (T, C).
        velocity: (T, C); joints as given.
        reference: Reference orientation of each sample, (T, 4).
        estimate_std: Standard deviation of the estimated entries of (position, velocity), infinite for
            measured or smoothed ones, (2 C,).
    """

    position: FloatArray
    velocity: FloatArray
    reference: FloatArray
    estimate_std: FloatArray


def base_states(
    robot: RobotModel,
    feet: tuple[str, ...],
    orientation: FloatArray,
    gyro: FloatArray,
    joints: FloatArray,
    joint_velocity: FloatArray,
    period_s: float,
    felt: Felt | None = None,
) -> BaseStates:
    """Combine joints, IMU and leg odometry.

    Args:
        robot: A robot with a floating base on a level floor at height 0.
        feet: Sphere geoms of the feet.
        orientation: Reported orientations of the base, (T, 4).
        gyro: Reported angular velocities in the base's frame, (T, 3) [rad/s].
        joints: Reported joint positions, (T, J).
        joint_velocity: Reported joint velocities, (T, J); NaN for none.
        period_s: Sampling period [s].
        felt: Accelerometer and efforts; None if nothing reports them.

    Raises:
        InsufficientDataError: There are fewer samples than the smoother needs.
    """
    length, order = ORIENTATION_SMOOTHER
    T, J = joints.shape
    if length > T:
        raise InsufficientDataError(
            f"{T} samples, a base's orientation needs at least {length}; record longer"
        )
    reference = smooth_orientation(orientation, scipy.signal.savgol_coeffs(length, order, use="dot"))
    speed = np.gradient(joints, period_s, axis=0)
    slope = scipy.signal.savgol_coeffs(length, order, deriv=1, delta=period_s, use="dot")
    for j in range(J):
        speed[length // 2 : T - length // 2, j] = np.convolve(joints[:, j], slope[::-1], mode="valid")
    legs = leg_odometry(robot, feet, reference, gyro, joints, speed, felt)
    C = 6 + J
    position, velocity = np.zeros((T, C)), np.zeros((T, C))
    position[:, 2], position[:, robot.joints] = legs.height, joints
    position[:, robot.rotation] = to_vector(orientation, reference)
    velocity[:, :3], velocity[:, robot.rotation] = legs.velocity, gyro
    velocity[:, robot.joints] = joint_velocity
    spread = np.full(2 * C, np.inf)
    spread[:2], spread[2], spread[C : C + 3] = PLACE_STD, HEIGHT_STD, VELOCITY_STD
    return BaseStates(position, velocity, reference, spread)


def with_base(
    episode: SampledEpisode,
    robot: RobotModel,
    feet: tuple[str, ...],
    orientation: FloatArray,
    gyro: FloatArray,
    felt: Felt | None = None,
) -> SampledEpisode:
    """Return an episode of joints as one of the whole floating robot: joints, orientation and gyro measured.

    Args:
        episode: Joint positions, (T, J), and commands.
        robot: The robot.
        feet: Sphere geoms of the feet.
        orientation: Reported orientations of the base at all samples of the recording, (>= T, 4).
        gyro: Reported angular velocities there, (>= T, 3) [rad/s].
        felt: Accelerometer and efforts there; None if nothing reports them.
    """
    rows = slice(episode.first_row, episode.first_row + len(episode.sample))
    unknown = np.full_like(episode.velocity, np.nan)
    if felt is not None:
        felt = Felt(felt.time_s[rows], felt.acceleration[rows], felt.effort[rows])
    states = base_states(
        robot, feet, orientation[rows], gyro[rows], episode.position, unknown, episode.period_s, felt
    )
    C = states.position.shape[1]
    measured = np.zeros(2 * C, dtype=bool)
    measured[:C][robot.joints] = True
    measured[:C][robot.rotation] = measured[C:][robot.rotation] = True
    return dataclasses.replace(
        episode,
        position=states.position,
        velocity=states.velocity,
        reference=states.reference,
        measured=measured,
        estimate_std=states.estimate_std,
    )
