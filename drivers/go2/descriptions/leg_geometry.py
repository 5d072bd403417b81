"""The Go2's legs, as in ``assets/go2.xml``, and the limits between floor and stand."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.go2.descriptions.driver import HELD_TILT_RAD
from deal_hw.drivers.unitree.leg_geometry import LegGeometry
from deal_hw.drivers.unitree.support import SupportConfig

GEOMETRY: Final = LegGeometry(
    link_m=0.213, side_m=0.0955, foot_m=0.022, hip_m=(0.1934, 0.0465), weight_n=149.0
)
"""The weight is that of 15.2 kg, the mass of ``go2.xml``."""
SUPPORT: Final = SupportConfig(legs=GEOMETRY, level_rad=HELD_TILT_RAD, held_reach_m=0.16, lying_reach_m=0.125)
"""At 0.35 rad of tilt the trunk's lowest point is 0.12 m below the base; the feet of a robot that lies in the
vendor's rest pose reach 0.10 m."""
