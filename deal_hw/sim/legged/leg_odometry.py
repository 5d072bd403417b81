"""Base velocity and height of a legged robot from its joints and its IMU: standing feet do not move."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.linalg import solveh_banded

from deal_hw.errors import ConfigurationError
from deal_hw.rotations import rotated
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import to_quaternion, to_vector
from deal_hw.sim.legged.velocity_filter import (
    GRAVITY,
    HEIGHT_M,
    LIFT_DRIFT,
    filtered_velocity,
    standing_feet,
)
from deal_hw.sim.parameters.fields import element_id
from deal_hw.types import FloatArray

STANCE_M = 0.008
"""Feet within this height of the lowest one count as standing [m]."""

VELOCITY_STD = 0.04
"""Standard deviation of a base velocity from the legs [m/s]: joint noise, soft contacts, a little slip."""

HEIGHT_STD = 0.004
"""Standard deviation of a base height from the legs [m]: compression of the contacts."""


@dataclass(frozen=True, slots=True, eq=False)
class Felt:
    """Further measurements of a walking robot, which show the feet's loads and the base's acceleration.

    Attributes:
        time_s: Of each sample, (T,) [s].
        acceleration: Specific force in the base's frame, (T, 3) [m/s²].
        effort: Of the joints, (T, J) [N·m].
    """

    time_s: FloatArray
    acceleration: FloatArray
    effort: FloatArray


@dataclass(frozen=True, slots=True)
class Odometry:
    """Estimate of the base from the legs.

    Attributes:
        velocity: Of the base's origin in the world, (T, 3) [m/s].
        height: Of the base's origin over the floor, (T,) [m].
    """

    velocity: FloatArray
    height: FloatArray


def leg_odometry(
    robot: RobotModel,
    feet: tuple[str, ...],
    orientation: FloatArray,
    angular_velocity: FloatArray,
    joint_position: FloatArray,
    joint_velocity: FloatArray,
    felt: Felt | None = None,
) -> Odometry:
    """Estimate base velocity and height on a level floor at height 0.

    A standing foot rolls about its contact point: the velocity of the sphere's lowest point is zero. Without
    ``felt``, the lowest feet count as standing, and the estimate is the median over them. A walking robot's
    joint efforts and accelerometer give more, see :mod:`deal_hw.sim.legged.velocity_filter`.

    Args:
        robot: A robot with a floating base.
        feet: Names of the feet's sphere geoms.
        orientation: Of the base, (T, 4).
        angular_velocity: In the base's frame, (T, 3) [rad/s].
        joint_position: (T, J).
        joint_velocity: (T, J).
        felt: Accelerometer and efforts; None if nothing reports them.

    Raises:
        ConfigurationError: The robot's base is fixed.
    """
    if robot.base is None:
        raise ConfigurationError(f"{robot.description.name}: leg odometry needs a floating base")
    model, data = robot.model, mujoco.MjData(robot.model)
    at, dof = robot.base
    geoms = [element_id(model, "geom", name) for name in feet]
    radius = np.array([model.geom_size[g, 0] for g in geoms])
    T, F = len(orientation), len(feet)
    answers, lowest, load = np.empty((T, F, 3)), np.empty((T, F)), np.zeros((T, F))
    both, jacobian, dofs = np.empty(6), np.empty((3, model.nv)), list(robot.qvel)
    for t in range(T):
        data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = 0.0, orientation[t]
        robot.place(data.qpos, joint_position[t])
        data.qvel[dof : dof + 3], data.qvel[dof + 3 : dof + 6] = 0.0, angular_velocity[t]
        data.qvel[dofs] = joint_velocity[t]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        for i, g in enumerate(geoms):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, g, both, 0)
            answers[t, i] = -both[3:] - np.cross(both[:3], (0.0, 0.0, -radius[i]))
            lowest[t, i] = data.geom_xpos[g, 2] - radius[i]
            if felt is not None:
                mujoco.mj_jacGeom(model, data, jacobian, None, g)
                pushed = np.linalg.lstsq(jacobian[:, dofs].T, -felt.effort[t], rcond=None)[0]
                load[t, i] = pushed[2]
    if felt is None:
        stands = lowest < lowest.min(axis=1, keepdims=True) + STANCE_M
        velocity = np.nanmedian(np.where(stands[..., None], answers, np.nan), axis=1)
    else:
        weight = float(np.sum(model.body_mass) * np.linalg.norm(model.opt.gravity))
        stands = standing_feet(load, weight)
        pushed = rotated(orientation, felt.acceleration)
        velocity = filtered_velocity(felt.time_s, pushed, answers, stands)
        height = np.full(T, np.nan)
        some = stands.any(axis=1)
        height[some] = -np.nanmedian(np.where(stands, lowest, np.nan)[some], axis=1)
        if some.any():
            height, velocity[:, 2] = smoothed_height(felt.time_s, pushed[:, 2], height)
            return Odometry(velocity, height)
    bears = np.where(stands.any(axis=1, keepdims=True), stands, lowest == lowest.min(axis=1, keepdims=True))
    return Odometry(velocity, -np.nanmedian(np.where(bears, lowest, np.nan), axis=1))


def smoothed_height(
    time_s: FloatArray, acceleration: FloatArray, height: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return height and vertical velocity of a base, (T,) each [m, m/s], by one fit over the recording.

    Upwards the feet's velocities mislead: the smoothed motion of a joint mixes a foot that lands with one
    that stands. The fit weighs the heights over standing feet against the accelerations, which are the second
    differences of the result.

    Args:
        time_s: (T,) [s], increasing; at least three samples.
        acceleration: Vertical specific force in the world, (T,) [m/s²].
        height: Over the standing feet, (T,) [m]; NaN where none stands.
    """
    before, after = np.diff(time_s)[:-1], np.diff(time_s)[1:]
    width = 0.5 * (before + after)
    weight = np.sqrt(width) / LIFT_DRIFT
    curve = np.stack([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after]) * (weight / width)
    seen = np.isfinite(height) / HEIGHT_M
    # The normal equations' lower diagonals; a curvature acts on three neighbours.
    normal = np.zeros((3, len(time_s)))
    normal[0], right = seen**2, seen**2 * np.nan_to_num(height)
    pushed = weight * (acceleration[1:-1] - GRAVITY[2])
    end = len(time_s) - 2
    for i in range(3):
        right[i : i + end] += curve[i] * pushed
        for k in range(3 - i):
            normal[k, i : i + end] += curve[i] * curve[i + k]
    found = np.asarray(solveh_banded(normal, right, lower=True))
    return found, np.gradient(found, time_s)


def smooth_orientation(orientation: FloatArray, weights: FloatArray) -> FloatArray:
    """Smooth orientations, (T, 4), by a moving polynomial; the ends stay unsmoothed.

    Args:
        orientation: Reported orientations.
        weights: Weights of the samples around each, (2 n + 1,), that sum to 1.
    """
    half = len(weights) // 2
    smooth = orientation.copy()
    for t in range(half, len(orientation) - half):
        near = to_vector(orientation[t - half : t + half + 1], orientation[t])
        smooth[t] = to_quaternion(weights @ near, orientation[t])
    return smooth
