"""Drawn poses of a legged robot from its sensors: orientation, and a floor under the lowest foot."""

from __future__ import annotations

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import to_quaternion
from deal_hw.sim.legged.leg_odometry import Felt
from deal_hw.sim.parameters.fields import element_id
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.imu_base import with_base
from deal_hw.types import FloatArray, Trajectory


def sensed_base(robot: RobotModel, trajectory: Trajectory) -> FloatArray | None:
    """Return poses of the base, (T, 7), position and quaternion wxyz; None if nothing measures them.

    The place on the floor is not measured: the robot stays at the origin, with its lowest foot on the floor.
    """
    body = trajectory.body
    if body is None or robot.base is None:
        return None
    feet = [element_id(robot.model, "geom", name) for name in robot.description.feet]
    data = mujoco.MjData(robot.model)
    at = robot.base[0]
    poses = np.zeros((len(trajectory.device_s), 7))
    poses[:, 3:] = body.orientation
    for t, q in enumerate(trajectory.position):
        data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = 0.0, poses[t, 3:]
        robot.place(data.qpos, q)
        mujoco.mj_kinematics(robot.model, data)
        if feet:
            poses[t, 2] = np.max(robot.model.geom_size[feet, 0] - data.geom_xpos[feet, 2])
    return poses


def with_sensed_base(
    episode: SampledEpisode, robot: RobotModel, trajectory: Trajectory, feet: tuple[str, ...]
) -> SampledEpisode:
    """Return an episode of joints with the base from the body's sensors; see ``imu_base``.

    Args:
        episode: The recording, from :func:`deal_hw.sim.recordings.episode.align`.
        robot: The robot.
        trajectory: The recording; it has a body.
        feet: Sphere geoms of the feet.
    """
    body = trajectory.body
    if body is None:
        raise ConfigurationError("the recording has no body's sensors")
    felt = Felt(trajectory.device_s, body.acceleration, trajectory.effort)
    # Efforts that are all zero are missing: some sources have the column and never fill it.
    whole = (
        all(np.isfinite(values).all() for values in (felt.acceleration, felt.effort)) and felt.effort.any()
    )
    return with_base(episode, robot, feet, body.orientation, body.angular_velocity, felt if whole else None)


def tangent_base(position: FloatArray, reference: FloatArray) -> FloatArray:
    """Return base poses, (..., 7), of tangent coordinates, (..., >= 6), around references, (..., 4)."""
    quaternion = to_quaternion(position[..., 3:6], reference)
    return np.concatenate([position[..., :3], quaternion], axis=-1)
