"""The state of a floating base whose place and orientation were recorded, by motion capture or odometry."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy

from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import to_vector
from deal_hw.sim.legged.leg_odometry import smooth_orientation
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.imu_base import ORIENTATION_SMOOTHER
from deal_hw.types import FloatArray, Trajectory


def turning_speed(orientation: FloatArray, period_s: float) -> FloatArray:
    """Return angular velocities in the body's frame, (T, 3) [rad/s], from orientations, (T, 4)."""
    T = len(orientation)
    before, after = np.maximum(np.arange(T) - 1, 0), np.minimum(np.arange(T) + 1, T - 1)
    turn = to_vector(orientation[after], orientation[before])
    return np.asarray(turn / ((after - before) * period_s)[:, None])


def with_measured_base(episode: SampledEpisode, robot: RobotModel, trajectory: Trajectory) -> SampledEpisode:
    """Return an episode of joints as one of the whole floating robot, whose pose was measured.

    An angular velocity that was not recorded comes from the smoothed orientation; a linear one, and those of
    the joints, from the positions, as in every recording.

    Args:
        episode: Joint positions, (T, J), and commands.
        robot: The robot.
        trajectory: The recording; it has the base's place and a body with its orientation.

    Raises:
        InsufficientDataError: There are fewer samples than the smoother needs.
    """
    body, base = trajectory.body, trajectory.base
    if body is None or base is None:
        raise InsufficientDataError("the recording has no place and orientation of the base")
    rows = slice(episode.first_row, episode.first_row + len(episode.sample))
    length, order = ORIENTATION_SMOOTHER
    if length > len(episode.sample):
        raise InsufficientDataError(
            f"{len(episode.sample)} samples, a base's orientation needs at least {length}; record longer"
        )
    orientation, gyro = body.orientation[rows], body.angular_velocity[rows]
    reference = smooth_orientation(orientation, scipy.signal.savgol_coeffs(length, order, use="dot"))
    if np.isnan(gyro).any():
        gyro = turning_speed(reference, episode.period_s)
    position = np.concatenate(
        [base.position[rows], to_vector(orientation, reference), episode.position], axis=1
    )
    velocity = np.concatenate([base.velocity[rows], gyro, episode.velocity], axis=1)
    C = position.shape[1]
    measured = np.zeros(2 * C, dtype=bool)
    measured[:C] = measured[C:][robot.rotation] = True
    measured[C : C + 3] = np.isfinite(base.velocity[rows]).all()
    return dataclasses.replace(
        episode, position=position, velocity=velocity, reference=reference, measured=measured
    )
