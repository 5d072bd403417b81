"""Profiles of an emulated Go2: differences from ideal mechanics and sensors, in three steps of realism."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from deal_hw.drivers.go2.descriptions.floor import FLOOR_FRICTION
from deal_hw.drivers.unitree.emulated_profile import REALISTIC, SENSOR, SensorProfile, find_profile


@dataclass(frozen=True, slots=True, kw_only=True)
class Go2Profile(SensorProfile):
    """Differences of an emulated Go2 from its equations.

    Attributes:
        payload_kg: Lowest and highest hidden mass that is strapped to the trunk [kg].
        floor_friction: Lowest and highest hidden sliding friction of the floor.
    """

    payload_kg: tuple[float, float] = (0.0, 0.0)
    floor_friction: tuple[float, float] = (FLOOR_FRICTION, FLOOR_FRICTION)


PROFILES: Final = {
    "ideal": Go2Profile(name="ideal"),
    "sensor": Go2Profile(name="sensor", **SENSOR),
    "realistic": Go2Profile(name="realistic", payload_kg=(0.0, 2.0), floor_friction=(0.5, 1.1), **REALISTIC),
}
"""We know of no published figures of a real Go2's sensors: these are assumptions."""


def profile(name: str) -> Go2Profile:
    """Return a profile by name.

    Raises:
        UnknownNameError: There is no such profile.
    """
    return find_profile(name, PROFILES)
