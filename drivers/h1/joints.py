"""The H1's joints, and their motors in the messages.

Source: unitree_sdk2_python @ 37116c5, h1_low_level_example.py: motor numbers, the empty one, the weak motors.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.drivers.unitree.go_messages.layout import SLOTS, WireOrder

_LEG: Final = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")
_ARM: Final = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
JOINTS: Final = (
    *(f"{side}_{part}_joint" for side in ("left", "right") for part in _LEG),
    "torso_joint",
    *(f"{side}_{part}_joint" for side in ("left", "right") for part in _ARM),
)
"""Joint order in the model and in every array."""
UNUSED: Final = "unused"
MOTORS: Final = (
    *(f"right_{part}_joint" for part in ("hip_roll", "hip_pitch", "knee")),
    *(f"left_{part}_joint" for part in ("hip_roll", "hip_pitch", "knee")),
    "torso_joint",
    "left_hip_yaw_joint",
    "right_hip_yaw_joint",
    UNUSED,
    "left_ankle_joint",
    "right_ankle_joint",
    *(f"{side}_{part}_joint" for side in ("right", "left") for part in _ARM),
)
"""Joint of each motor number, 0 to 19; no motor has number 9."""
WEAK: Final = tuple(range(10, SLOTS))
"""Motor numbers of ankles and arms."""
STRONG_MODE: Final = 0x0A
WEAK_MODE: Final = 0x01
MODES: Final = np.array([WEAK_MODE if motor in WEAK else STRONG_MODE for motor in range(SLOTS)])
"""Mode in which the motor of each slot follows commands, (20,)."""
ORDER: Final = WireOrder(motors=np.array([MOTORS.index(joint) for joint in JOINTS]), feet=np.arange(4))
SERVO_MODE: Final = MODES[ORDER.motors]
"""The same for each joint, (19,)."""
TORSO: Final = JOINTS.index("torso_joint")
