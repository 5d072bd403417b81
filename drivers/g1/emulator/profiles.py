"""Profiles of an emulated G1: differences from ideal mechanics and sensors, in three steps of realism."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.emulated_profile import REALISTIC, SENSOR, SensorProfile, find_profile

PROFILES: Final = {
    "ideal": SensorProfile(name="ideal"),
    "sensor": SensorProfile(name="sensor", **SENSOR),
    "realistic": SensorProfile(name="realistic", **REALISTIC),
}
"""Assumptions, as for the Go2."""


def profile(name: str) -> SensorProfile:
    """Return a profile by name.

    Raises:
        UnknownNameError: There is no such profile.
    """
    return find_profile(name, PROFILES)
