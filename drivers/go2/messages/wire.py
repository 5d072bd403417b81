"""Joints and feet of a Go2 in its messages."""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.drivers.go2.descriptions.floor import JOINTS, LEGS, PARTS
from deal_hw.drivers.unitree.go_messages.layout import WireOrder

WIRE_LEGS: Final = ("FR", "FL", "RR", "RL")
WIRE_JOINTS: Final = tuple(f"{leg}_{part}_joint" for leg in WIRE_LEGS for part in PARTS)
SLOT: Final = np.array([WIRE_JOINTS.index(joint) for joint in JOINTS])
"""Motor slot of each joint in model order, (12,)."""
FOOT: Final = np.array([WIRE_LEGS.index(leg) for leg in LEGS])
"""Foot slot of each leg in model order, (4,)."""
ORDER: Final = WireOrder(motors=SLOT, feet=FOOT)
