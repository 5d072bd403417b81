"""Static layouts of unitree_go's two low-level messages on the wire: CDR with its 4-byte header.

Every offset is written out, because a wrong one would move a joint. Source: IDL of unitree_sdk2 @ 21d0a3b and
unitree_ros2 @ eea2719, compared byte for byte with two CDR libraries. The first motor's mode byte follows its
predecessor without padding, so the other motors' stride of 36 or 48 bytes does not apply to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.drivers.unitree.cdr import packed
from deal_hw.types import IntArray

SLOTS: Final = 20
"""Motor slots of the messages; a Go2 uses the first 12, an H1 all but one."""
LOW_COMMAND_BYTES: Final = 812
LOW_STATE_BYTES: Final = 1180

# The beginning of both messages, after the encapsulation.
_FRAME: Final = {
    "encapsulation": (("u1", 4), 0),
    "head": (("u1", 2), 4),
    "level_flag": ("u1", 6),
    "frame_reserve": ("u1", 7),
    "sn": (("<u4", 2), 8),
    "version": (("<u4", 2), 16),
    "bandwidth": ("<u2", 24),
}
_MOTOR_COMMAND: Final = packed(
    36,
    {
        "q": ("<f4", 0),
        "dq": ("<f4", 4),
        "tau": ("<f4", 8),
        "kp": ("<f4", 12),
        "kd": ("<f4", 16),
        "reserve": (("<u4", 3), 20),
    },
)
LOW_COMMAND: Final = packed(
    LOW_COMMAND_BYTES,
    {
        **_FRAME,
        # A motor's numbers without its mode byte, which comes before their padding.
        "motor": ((_MOTOR_COMMAND, SLOTS), 28),
        "bms_off": ("u1", 744),
        "bms_reserve": (("u1", 3), 745),
        "wireless_remote": (("u1", 40), 748),
        "led": (("u1", 12), 788),
        "fan": (("u1", 2), 800),
        "gpio": ("u1", 802),
        "reserve": ("<u4", 804),
        "crc": ("<u4", 808),
    },
)
COMMAND_MODE_AT: Final = np.array([26, *range(60, 60 + 36 * (SLOTS - 1), 36)])
"""Offset of each motor's mode byte in a LowCmd, (20,)."""

_MOTOR_STATE: Final = packed(
    48,
    {
        "q": ("<f4", 0),
        "dq": ("<f4", 4),
        "ddq": ("<f4", 8),
        "tau_est": ("<f4", 12),
        "q_raw": ("<f4", 16),
        "dq_raw": ("<f4", 20),
        "ddq_raw": ("<f4", 24),
        "temperature": ("u1", 28),
        "lost": ("<u4", 32),
        "reserve": (("<u4", 2), 36),
    },
)
LOW_STATE: Final = packed(
    LOW_STATE_BYTES,
    {
        **_FRAME,
        "quaternion": (("<f4", 4), 28),
        "gyroscope": (("<f4", 3), 44),
        "accelerometer": (("<f4", 3), 56),
        "rpy": (("<f4", 3), 68),
        "imu_temperature": ("u1", 80),
        "motor": ((_MOTOR_STATE, SLOTS), 84),
        "bms_version": (("u1", 2), 1040),
        "bms_status": ("u1", 1042),
        "soc": ("u1", 1043),
        "bms_current": ("<i4", 1044),
        "bms_cycle": ("<u2", 1048),
        "bq_ntc": (("u1", 2), 1050),
        "mcu_ntc": (("u1", 2), 1052),
        "cell_vol": (("<u2", 15), 1054),
        "foot_force": (("<i2", 4), 1084),
        "foot_force_est": (("<i2", 4), 1092),
        "tick": ("<u4", 1100),
        "wireless_remote": (("u1", 40), 1104),
        "bit_flag": ("u1", 1144),
        "adc_reel": ("<f4", 1148),
        "temperature_ntc": (("u1", 2), 1152),
        "power_v": ("<f4", 1156),
        "power_a": ("<f4", 1160),
        "fan_frequency": (("<u2", 4), 1164),
        "reserve": ("<u4", 1172),
        "crc": ("<u4", 1176),
    },
)
STATE_MODE_AT: Final = np.array([81, *range(128, 128 + 48 * (SLOTS - 1), 48)])
"""Offset of each motor's mode byte in a LowState, (20,)."""


@dataclass(frozen=True, slots=True)
class WireOrder:
    """Where a robot's joints and feet are in the messages.

    Attributes:
        motors: Motor slot of each joint, (J,).
        feet: Place of each foot's force, (4,).
    """

    motors: IntArray
    feet: IntArray
