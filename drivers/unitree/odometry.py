"""Path of a walking quadruped from its joints, its motors' efforts and its IMU; closed form, no simulator.

A foot that bears weight stands: it rolls about the point where it touches the floor.
"""

from __future__ import annotations

import numpy as np

from deal_hw.drivers.unitree.leg_geometry import LegGeometry
from deal_hw.motions.scores.velocity_error import Track
from deal_hw.rotations import heading, rotated
from deal_hw.sim.legged.velocity_filter import filtered_velocity, standing_feet
from deal_hw.types import FloatArray, Trajectory


def walked(legs: LegGeometry, trajectory: Trajectory) -> Track | None:
    """Return the robot's path by its own sensors; None if no body data were recorded.

    The position starts at the origin and drifts; the heading is the IMU's.

    Args:
        legs: The robot's legs.
        trajectory: The recording.
    """
    body = trajectory.body
    if body is None:
        return None
    parts = body.orientation, body.acceleration, trajectory.position, trajectory.velocity, trajectory.effort
    sound = np.isfinite(np.concatenate(parts, axis=1)).all(axis=1)
    if np.count_nonzero(sound) < 2:
        return None
    time_s, orientation = trajectory.device_s[sound], body.orientation[sound]
    position, effort = trajectory.position[sound], trajectory.effort[sound]
    answers = _answers(legs, orientation, body.angular_velocity[sound], position, trajectory.velocity[sound])
    loads = legs.foot_loads(position, effort)
    load = np.stack([rotated(orientation, loads[:, leg])[:, 2] for leg in range(4)], axis=1)
    velocity = filtered_velocity(
        time_s,
        rotated(orientation, body.acceleration[sound]),
        answers,
        standing_feet(load, legs.weight_n),
    )
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time_s)[:, None]
    place = np.concatenate((np.zeros((1, 2)), np.cumsum(steps[:, :2], axis=0)))
    return Track(time_s, place, heading(orientation))


def _answers(
    legs: LegGeometry, orientation: FloatArray, gyro: FloatArray, position: FloatArray, velocity: FloatArray
) -> FloatArray:
    """Return the velocity of the base in the world by each foot, as if that foot stood, (T, 4, 3) [m/s]."""
    T = len(position)
    joints, hip = velocity.reshape(T, 4, 3), position.reshape(T, 4, 3)[..., 0]
    moved = np.einsum("tlij,tlj->tli", legs.foot_jacobians(position), joints)
    moved += np.cross(gyro[:, None], legs.foot_positions(position))
    # The foot turns with the calf: about x by the hip, about the turned y axis by thigh and calf.
    knee = joints[..., 1] + joints[..., 2]
    spin = gyro[:, None] + np.stack((joints[..., 0], np.cos(hip) * knee, np.sin(hip) * knee), axis=-1)
    down = np.array([0.0, 0.0, -legs.foot_m])
    return np.stack(
        [
            -(rotated(orientation, moved[:, leg]) + np.cross(rotated(orientation, spin[:, leg]), down))
            for leg in range(4)
        ],
        axis=1,
    )
