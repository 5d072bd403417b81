"""Differences of an emulated robot's sensors and motors from ideal ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from deal_hw.errors import UnknownNameError


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorProfile:
    """Differences of an emulated robot from its equations. Noise is white; values are standard deviations.

    Attributes:
        name: The profile's name, as on the command line.
        position_noise: Of joint positions [rad].
        position_resolution: Quantisation step of joint positions [rad]; 0 for none.
        velocity_noise: Of joint velocities [rad/s].
        acceleration_noise: Of joint accelerations [rad/s²].
        effort_noise: Of estimated efforts [N·m].
        orientation_noise: Of the estimated orientation, each axis [rad].
        gyro_noise: Of angular velocities [rad/s].
        specific_force_noise: Of the accelerometer [m/s²].
        encoder_bias_rad: Largest hidden zero error of a joint, to both sides [rad].
        latency_ms: Lowest and highest hidden time between a command's reception and its use [ms].
        jitter_ms: A command acts up to this much later, uniformly [ms].
        stribeck_ratio: Gear friction at standstill over friction in motion, less 1.
        stribeck_rad_s: Speed at which that excess has fallen to 1/e [rad/s].
        knee: Share of the no-load speed up to which a motor gives full torque; from there it falls linearly.
            1: full torque at any speed.
        drop: Share of lost states.
    """

    name: str
    position_noise: float = 0.0
    position_resolution: float = 0.0
    velocity_noise: float = 0.0
    acceleration_noise: float = 0.0
    effort_noise: float = 0.0
    orientation_noise: float = 0.0
    gyro_noise: float = 0.0
    specific_force_noise: float = 0.0
    encoder_bias_rad: float = 0.0
    latency_ms: tuple[int, int] = (0, 0)
    jitter_ms: int = 0
    stribeck_ratio: float = 0.0
    stribeck_rad_s: float = 0.1
    knee: float = 1.0
    drop: float = 0.0


ProfileT = TypeVar("ProfileT", bound=SensorProfile)


def find_profile(name: str, table: Mapping[str, ProfileT]) -> ProfileT:
    """Return a profile of a robot by name.

    Raises:
        UnknownNameError: There is no such profile.
    """
    if name not in table:
        raise UnknownNameError("profile", name, table)
    return table[name]


SENSOR: Final[Mapping[str, Any]] = {
    "position_noise": 5e-4,
    "position_resolution": 2 * math.pi / 32768,
    "velocity_noise": 0.02,
    "acceleration_noise": 2.0,
    "effort_noise": 0.05,
    "orientation_noise": 2e-3,
    "gyro_noise": 0.01,
    "specific_force_noise": 0.05,
    "latency_ms": (2, 10),
}
"""The profile sensor. We know of no published figures of a real robot's sensors: these are assumptions."""
REALISTIC: Final[Mapping[str, Any]] = {
    **SENSOR,
    "jitter_ms": 2,
    "encoder_bias_rad": 0.02,
    "stribeck_ratio": 0.4,
    "knee": 0.6,
    "drop": 0.002,
}
"""What the profile realistic has beside what is a robot's own."""
