"""Profiles of an emulated G1: differences from ideal mechanics and sensors, in three steps of realism."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.emulated_profile import SENSOR, SensorProfile
from deal_hw.errors import UnknownNameError

PROFILES: Final = {
    "ideal": SensorProfile(name="ideal"),
    "sensor": SensorProfile(name="sensor", latency_ms=(2, 10), **SENSOR),
    "realistic": SensorProfile(
        name="realistic",
        latency_ms=(2, 10),
        jitter_ms=2,
        encoder_bias_rad=0.02,
        stribeck_ratio=0.4,
        knee=0.6,
        drop=0.002,
        **SENSOR,
    ),
}
"""Assumptions, as for the Go2."""


def profile(name: str) -> SensorProfile:
    """Return a profile by name.

    Raises:
        UnknownNameError: There is no such profile.
    """
    if name not in PROFILES:
        raise UnknownNameError("profile", name, PROFILES)
    return PROFILES[name]
