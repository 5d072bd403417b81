"""SportModeState: the state of the vendor's gaits, in both existing layouts.

The SDK's type ends with ten path points (516 bytes with the CDR header), unitree_ros2's does not (236
bytes); all fields before are the same. Source: IDL of unitree_sdk2 @ 21d0a3b, msg files of unitree_ros2 @
eea2719. Feet come in the order of the motors, FR, FL, RR, RL; here they are FL, FR, RL, RR.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.drivers.go2.messages.wire import FOOT
from deal_hw.drivers.unitree.cdr import CDR_HEADER, packed
from deal_hw.errors import FrameError
from deal_hw.types import FloatArray, IntArray

SHORT_BYTES: Final = 236
LONG_BYTES: Final = 516
POINTS: Final = 10
_FIELDS: Final = {
    "encapsulation": (("u1", 4), 0),
    "sec": ("<i4", 4),
    "nanosec": ("<u4", 8),
    "error_code": ("<u4", 12),
    "quaternion": (("<f4", 4), 16),
    "gyroscope": (("<f4", 3), 32),
    "accelerometer": (("<f4", 3), 44),
    "rpy": (("<f4", 3), 56),
    "imu_temperature": ("u1", 68),
    "mode": ("u1", 69),
    "progress": ("<f4", 72),
    "gait_type": ("u1", 76),
    "foot_raise_height": ("<f4", 80),
    "position": (("<f4", 3), 84),
    "body_height": ("<f4", 96),
    "velocity": (("<f4", 3), 100),
    "yaw_speed": ("<f4", 112),
    "range_obstacle": (("<f4", 4), 116),
    "foot_force": (("<i2", 4), 132),
    "foot_position_body": (("<f4", (4, 3)), 140),
    "foot_speed_body": (("<f4", (4, 3)), 188),
}
_PATH: Final = {"path_point": (("<f4", (POINTS, 7)), 236)}
SHORT: Final = packed(SHORT_BYTES, {**_FIELDS})
LONG: Final = packed(LONG_BYTES, {**_FIELDS, **_PATH})


@dataclass(frozen=True, slots=True, kw_only=True)
class SportState:
    """State of the vendor's gaits.

    Attributes:
        stamp_ns: The robot's time of day [ns].
        error_code: 0: none.
        orientation: Quaternion wxyz, (4,).
        angular_velocity: Base's frame, (3,) [rad/s].
        specific_force: Base's frame, (3,) [m/s²].
        rpy: Roll, pitch, yaw, (3,) [rad].
        imu_temperature: [°C].
        mode: Mode of the gait machine.
        progress: Progress of a movement, 0 to 1.
        gait: Number of the gait.
        foot_raise_height: [m].
        position: Odometry, (3,) [m].
        body_height: [m].
        velocity: Odometry, (3,) [m/s].
        yaw_speed: [rad/s].
        range_obstacle: Distances to obstacles, (4,) [m].
        foot_force: (4,), legs FL, FR, RL, RR.
        foot_position: Base's frame, (4, 3) [m].
        foot_velocity: Base's frame, (4, 3) [m/s].
        path: The points that the robot was commanded to follow (t, x, y, yaw, vx, vy, vyaw), (10, 7); None in
            the short layout.
    """

    stamp_ns: int
    error_code: int
    orientation: FloatArray
    angular_velocity: FloatArray
    specific_force: FloatArray
    rpy: FloatArray
    imu_temperature: int
    mode: int
    progress: float
    gait: int
    foot_raise_height: float
    position: FloatArray
    body_height: float
    velocity: FloatArray
    yaw_speed: float
    range_obstacle: FloatArray
    foot_force: IntArray
    foot_position: FloatArray
    foot_velocity: FloatArray
    path: FloatArray | None = None


_NAMES: Final = {
    "error_code": "error_code",
    "quaternion": "orientation",
    "gyroscope": "angular_velocity",
    "accelerometer": "specific_force",
    "rpy": "rpy",
    "imu_temperature": "imu_temperature",
    "mode": "mode",
    "progress": "progress",
    "gait_type": "gait",
    "foot_raise_height": "foot_raise_height",
    "position": "position",
    "body_height": "body_height",
    "velocity": "velocity",
    "yaw_speed": "yaw_speed",
    "range_obstacle": "range_obstacle",
}
_FEET: Final = {
    "foot_force": "foot_force",
    "foot_position_body": "foot_position",
    "foot_speed_body": "foot_velocity",
}


def encode_sport_state(state: SportState) -> bytes:
    """Return the state as CDR with header: 516 bytes with a path, 236 without."""
    kind = SHORT if state.path is None else LONG
    buffer = bytearray(kind.itemsize)
    buffer[:4] = CDR_HEADER
    record = np.frombuffer(buffer, kind)[0]
    record["sec"], record["nanosec"] = divmod(state.stamp_ns, 1_000_000_000)
    for wire, name in _NAMES.items():
        record[wire] = getattr(state, name)
    for wire, name in _FEET.items():
        record[wire][FOOT] = getattr(state, name)
    if state.path is not None:
        record["path_point"] = state.path
    return bytes(buffer)


def decode_sport_state(payload: bytes) -> SportState:
    """Return the state in a payload of either layout.

    Raises:
        FrameError: Wrong length or header.
    """
    if len(payload) not in (SHORT_BYTES, LONG_BYTES):
        raise FrameError(
            f"SportModeState: {len(payload)} bytes, expected {LONG_BYTES} (the SDK's layout) or "
            f"{SHORT_BYTES} (unitree_ros2's) with the CDR header"
        )
    if payload[:4] != CDR_HEADER:
        raise FrameError(
            f"SportModeState: the CDR header is {payload[:4].hex(' ')}, expected {CDR_HEADER.hex(' ')}"
        )
    record = np.frombuffer(payload, LONG if len(payload) == LONG_BYTES else SHORT)[0]
    values = {name: _plain(record[wire]) for wire, name in _NAMES.items()}
    feet = {name: _plain(record[wire][FOOT]) for wire, name in _FEET.items()}
    path = record["path_point"].astype(np.float64) if len(payload) == LONG_BYTES else None
    stamp_ns = int(record["sec"]) * 1_000_000_000 + int(record["nanosec"])
    return SportState(stamp_ns=stamp_ns, path=path, **values, **feet)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.astype(np.float64 if value.dtype.kind == "f" else np.int64)
    return value.item()
