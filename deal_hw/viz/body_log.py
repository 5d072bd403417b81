"""What a robot with legs senses of its body, as traces: IMU, feet, motors' temperatures, battery."""

from __future__ import annotations

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.types import BodyTrajectory, FloatArray, Trajectory
from deal_hw.viz import palette
from deal_hw.viz.columns import Log

AXIS_COLORS = ((240, 110, 110), (120, 210, 120), (110, 150, 250))
LEG_COLORS = (palette.REAL, palette.NOMINAL, palette.CALIBRATED, palette.OTHERS[0])
_AXES = ("x", "y", "z")


def log_body(log: Log, trajectory: Trajectory, body: BodyTrajectory, description: RobotDescription) -> None:
    """Write the traces below ``/body``; units are in their names."""
    clocks = trajectory.device_s, trajectory.receive_s

    def traces(
        group: str, names: tuple[str, ...], values: FloatArray, colors: tuple[tuple[int, int, int], ...]
    ) -> None:
        # An imported recording has of all this the IMU alone.
        for i, name in enumerate(names[: values.shape[1]]):
            if not np.isfinite(values[:, i]).any():
                continue
            path = f"/body/{group}/{name.replace(' ', '_')}"
            log.line(path, name, colors[i % len(colors)])
            log.scalars(path, *clocks, values[:, i])

    roll, pitch = roll_pitch(body.orientation)
    traces("tilt", ("roll", "pitch"), np.degrees(np.stack([roll, pitch], axis=1)), AXIS_COLORS)
    traces("gyro", _AXES, body.angular_velocity, AXIS_COLORS)
    traces("acceleration", _AXES, body.acceleration, AXIS_COLORS)
    legs = tuple(foot.removesuffix("_foot") for foot in description.feet)
    traces("feet", legs, body.foot_force, LEG_COLORS)
    traces("temperature", trajectory.joint_names, body.temperature, (palette.REAL, *LEG_COLORS[1:]))
    supply = np.stack([100.0 * body.battery, body.voltage, body.current], axis=1)
    traces("battery", ("charge %", "voltage V", "current A"), supply, LEG_COLORS)


def roll_pitch(orientation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return roll and pitch, (T,) each [rad], of quaternions wxyz, (T, 4), turned yaw first."""
    w, x, y, z = orientation.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
