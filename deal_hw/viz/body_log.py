"""Traces of the body of a robot with legs: IMU, feet, motors' temperatures, battery."""

from __future__ import annotations

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.types import BodyTrajectory, FloatArray, Trajectory
from deal_hw.viz import palette
from deal_hw.viz.columns import Log

AXIS_COLORS = (palette.ALARM, palette.CALIBRATED, palette.REAL)
LEG_COLORS = (palette.REAL, palette.NOMINAL, palette.CALIBRATED, palette.OTHERS[0])
SUPPLY = (("Charge", "%"), ("Voltage", "V"), ("Current", "A"))
_AXES = ("x", "y", "z")


def log_body(log: Log, trajectory: Trajectory, body: BodyTrajectory, description: RobotDescription) -> None:
    """Write the traces below ``/body``; units are in their names."""
    clocks = trajectory.device_s, trajectory.receive_s

    def traces(
        group: str, names: tuple[str, ...], values: FloatArray, colors: tuple[tuple[int, int, int], ...]
    ) -> None:
        # An imported recording has the IMU alone.
        for i, name in enumerate(names[: values.shape[1]]):
            if not np.isfinite(values[:, i]).any():
                continue
            path = f"/body/{group}/{name.replace(' ', '_')}"
            log.line(path, name, colors[i % len(colors)])
            log.scalars(path, *clocks, values[:, i])

    traces("tilt", ("roll", "pitch"), tilt(body), AXIS_COLORS)
    traces("gyro", _AXES, body.angular_velocity, AXIS_COLORS)
    traces("acceleration", _AXES, body.acceleration, AXIS_COLORS)
    legs = tuple(foot.removesuffix("_foot") for foot in description.feet)
    traces("feet", legs, body.foot_force, LEG_COLORS)
    # The joints of a leg are in one plot.
    traces("temperature", trajectory.joint_names, body.temperature, LEG_COLORS[:3])
    traces("battery", tuple(f"{word.lower()} {unit}" for word, unit in SUPPLY), supply(body), LEG_COLORS)


def tilt(body: BodyTrajectory) -> FloatArray:
    """Return roll and pitch, (T, 2) [deg]."""
    return np.degrees(np.stack(roll_pitch(body.orientation), axis=1))


def supply(body: BodyTrajectory) -> FloatArray:
    """Return charge, voltage and current in the units of `SUPPLY`, (T, 3)."""
    return np.stack([100.0 * body.battery, body.voltage, body.current], axis=1)


def roll_pitch(orientation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return roll and pitch, (T,) each [rad], of quaternions wxyz, (T, 4), turned yaw first."""
    w, x, y, z = orientation.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
