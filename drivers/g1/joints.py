"""The G1's joints by the vendor's motor numbers, and its versions by mode_machine.

Sources: unitree_sdk2_python @ 37116c5, g1_low_level_example.py; unitree_rl_gym @ 276801e, g1_description.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

_LEG: Final = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM: Final = (
    "shoulder_pitch",
    "shoulder_roll",
    "shoulder_yaw",
    "elbow",
    "wrist_roll",
    "wrist_pitch",
    "wrist_yaw",
)
MOTORS: Final = (
    *(f"{side}_{part}_joint" for side in ("left", "right") for part in _LEG),
    *(f"waist_{axis}_joint" for axis in ("yaw", "roll", "pitch")),
    *(f"{side}_{part}_joint" for side in ("left", "right") for part in _ARM),
)
"""Joint of each motor number, 0 to 28; the messages' other slots are unused."""
NOT_IN_23: Final = frozenset(
    (
        "waist_roll",
        "waist_pitch",
        "left_wrist_pitch",
        "left_wrist_yaw",
        "right_wrist_pitch",
        "right_wrist_yaw",
    )
)
JOINTS_29: Final = MOTORS
JOINTS_23: Final = tuple(joint for joint in MOTORS if joint.removesuffix("_joint") not in NOT_IN_23)

MACHINES: Final[Mapping[int, str]] = MappingProxyType(
    {
        1: "23 joints",
        2: "29 joints",
        3: "29 joints, waist locked",
        4: "23 joints, revision 1.0",
        5: "29 joints, revision 1.0",
        6: "29 joints, waist locked, revision 1.0",
        9: "two arms only",
    }
)
"""mode_machine -> version of the G1."""
MACHINES_29: Final = (2, 5)
MACHINES_23: Final = (1, 4)
ROBOT_OF: Final[Mapping[int, str]] = MappingProxyType(
    {**dict.fromkeys(MACHINES_29, "g1"), **dict.fromkeys(MACHINES_23, "g1_23dof")}
)
"""mode_machine -> the robot of deal-hw that describes this version."""
