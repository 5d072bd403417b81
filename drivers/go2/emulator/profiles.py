"""Profiles of an emulated Go2: differences from ideal mechanics and sensors, in three steps of realism."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.go2.descriptions.floor import FLOOR_FRICTION
from deal_hw.drivers.unitree.emulated_profile import REALISTIC, SENSOR
from deal_hw.drivers.unitree.emulated_quadruped import QuadrupedProfile

_FLOOR: Final = (FLOOR_FRICTION, FLOOR_FRICTION)
PROFILES: Final = {
    "ideal": QuadrupedProfile(name="ideal", floor_friction=_FLOOR),
    "sensor": QuadrupedProfile(name="sensor", floor_friction=_FLOOR, **SENSOR),
    "realistic": QuadrupedProfile(
        name="realistic", payload_kg=(0.0, 2.0), floor_friction=(0.5, 1.1), **REALISTIC
    ),
}
"""We know of no published figures of a real Go2's sensors: these are assumptions."""
