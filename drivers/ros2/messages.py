"""The messages of ros2_control on the wire: CDR, as every middleware of ROS 2 carries it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from deal_hw.data.recording.schemas import (
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    RosMessageType,
)
from deal_hw.errors import FrameError, ProtocolError
from deal_hw.types import FloatArray

_LITTLE: Final = b"\x00\x01"
"""Plain CDR version 1, little-endian; two bytes of options follow, the last may count padding."""
_HEADER: Final = b"\x00\x01\x00\x00"
_SECOND: Final = 1_000_000_000


def dds_name(kind: RosMessageType) -> str:
    """Return the DDS name of a message type, such as ``sensor_msgs::msg::dds_::JointState_``."""
    package, _, name = kind.name.split("/")
    return f"{package}::msg::dds_::{name}_"


STATE_TYPE: Final = dds_name(JOINT_STATE)
ACTIVITY_TYPE: Final = "controller_manager_msgs::msg::dds_::ControllerManagerActivity_"
COMMAND_TYPES: Final[Mapping[str, str]] = MappingProxyType(
    {"position": dds_name(FLOAT64_MULTI_ARRAY), "trajectory": dds_name(JOINT_TRAJECTORY)}
)
"""Kind of command of robot.yaml -> DDS name of its messages."""
HASHES: Final[Mapping[str, str]] = MappingProxyType(
    {
        dds_name(JOINT_STATE): "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
        dds_name(FLOAT64_MULTI_ARRAY): (
            "RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f"
        ),
        dds_name(JOINT_TRAJECTORY): "RIHS01_179b33eba59d676f6d967ac71fe35e7ca2f64b2f3928f4a018cec115e213796e",
        ACTIVITY_TYPE: "RIHS01_35b7de5d611b6780e89732de325f2f765eacdb8a7adfe5821a27af4a03a7c244",
    }
)
"""DDS name of a type -> its hash since ROS 2 Iron (REP 2016); Humble has none."""


@dataclass(frozen=True, slots=True, eq=False)
class JointStates:
    """A ``sensor_msgs/JointState``.

    Attributes:
        stamp_ns: Stamp of its header, by the robot's clock [ns].
        names: The joints, N.
        position: (N,) [rad or m].
        velocity: (N,) [rad/s or m/s]; empty if the robot does not report it.
        effort: (N,) [N·m or N]; empty if the robot does not report it.
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryPoint:
    """A ``trajectory_msgs/JointTrajectory`` of one point, with positions alone.

    Attributes:
        names: The joints, N.
        position: (N,) [rad or m].
        after_s: When it is reached, from its reception on [s].
    """

    names: tuple[str, ...]
    position: FloatArray
    after_s: float


def decode_joint_states(payload: bytes) -> JointStates:
    """Return the joint states in a payload.

    Raises:
        FrameError: It is no such message, or its arrays differ in length.
    """
    sec, nanosec, _, names, position, velocity, effort = _decoded(JOINT_STATE, payload)
    for what, values in (("velocity", velocity), ("effort", effort)):
        if len(values) not in (0, len(names)):
            raise FrameError(f"JointState: {len(names)} names, but {len(values)} values of {what}")
    if len(position) != len(names):
        raise FrameError(f"JointState: {len(names)} names, but {len(position)} positions")
    return JointStates(sec * _SECOND + nanosec, names, position, velocity, effort)


def encode_joint_states(states: JointStates, frame: str = "") -> bytes:
    """Return joint states as CDR with header.

    Args:
        states: The states.
        frame: The header's frame.
    """
    sec, nanosec = divmod(states.stamp_ns, _SECOND)
    return JOINT_STATE.encode(
        sec, nanosec, frame, states.names, states.position, states.velocity, states.effort
    )


def encode_positions(position: FloatArray) -> bytes:
    """Return a ``std_msgs/Float64MultiArray`` without a layout; position (N,) [rad or m]."""
    return FLOAT64_MULTI_ARRAY.encode(0, 0, position)


def decode_positions(payload: bytes) -> FloatArray:
    """Return the numbers of a ``std_msgs/Float64MultiArray``, (N,).

    Raises:
        FrameError: It is no such message, or has a layout.
    """
    dimensions, offset, data = _decoded(FLOAT64_MULTI_ARRAY, payload)
    if dimensions or offset:
        raise FrameError("Float64MultiArray: it has a layout, which no controller of ros2_control reads")
    found: FloatArray = data
    return found


def encode_point(point: TrajectoryPoint) -> bytes:
    """Return a trajectory of one point that starts at its reception, as CDR with header."""
    after_ns = round(point.after_s * _SECOND)
    empty: tuple[float, ...] = ()
    return JOINT_TRAJECTORY.encode(
        0, 0, "", point.names, 1, point.position, empty, empty, empty, *divmod(after_ns, _SECOND)
    )


def decode_point(payload: bytes) -> TrajectoryPoint:
    """Return the point of a ``trajectory_msgs/JointTrajectory`` of one point.

    Raises:
        FrameError: It is no such message, or has another number of points or positions.
    """
    *_, names, count, position, _, _, _, sec, nanosec = _decoded(JOINT_TRAJECTORY, payload)
    if count != 1 or len(position) != len(names):
        raise FrameError(f"JointTrajectory: {count} points, {len(names)} names, {len(position)} positions")
    return TrajectoryPoint(names, position, (sec * _SECOND + nanosec) / _SECOND)


INACTIVE, ACTIVE = 2, 3
"""States of a controller (``lifecycle_msgs/State``)."""
STATE_NAMES: Final = {0: "unknown", 1: "unconfigured", INACTIVE: "inactive", ACTIVE: "active", 4: "finalized"}
_MOST_ENTRIES: Final = 1000
_ACTIVITY: Final = "controller_manager_msgs/msg/ControllerManagerActivity"
_STAMPED: Final = (("int32", "sec"), ("uint32", "nanosec"), ("string", "frame_id"))


def _activity_type(*counts: int) -> RosMessageType:
    """Return the layout of an activity with so many controllers, and so many hardware components."""
    fields = list(_STAMPED)
    for part, count in zip(("controllers", "hardware_components"), counts, strict=False):
        fields.append(("uint32", part))
        for k in range(count):
            fields += [("string", f"{part}[{k}].name"), ("uint8", f"{part}[{k}].id")]
            fields.append(("string", f"{part}[{k}].label"))
    return RosMessageType(_ACTIVITY, (*fields, *((("uint32", "more"),) if len(counts) < 2 else ())))


def encode_activity(stamp_ns: int, controllers: Mapping[str, int]) -> bytes:
    """Return a ``ControllerManagerActivity`` without hardware components, as CDR with header.

    Args:
        stamp_ns: Stamp of its header [ns].
        controllers: Name of a controller -> its state.
    """
    entries = (value for name, state in controllers.items() for value in (name, state, STATE_NAMES[state]))
    kind = _activity_type(len(controllers), 0)
    return kind.encode(*divmod(stamp_ns, _SECOND), "", len(controllers), *entries, 0)


def decode_activity(payload: bytes) -> dict[str, int]:
    """Return the states of the controllers in a ``ControllerManagerActivity``, by name.

    Raises:
        FrameError: It is no such message.
    """
    count = int(_decoded(_activity_type(), payload, whole=False)[-1])
    if count > _MOST_ENTRIES:
        raise FrameError(f"{_ACTIVITY}: {count} controllers")
    _, _, _, _, *values = _decoded(_activity_type(count), payload, whole=False)
    return dict(zip(values[0:-1:3], map(int, values[1:-1:3]), strict=True))


def _decoded(kind: RosMessageType, payload: bytes, *, whole: bool = True) -> tuple[Any, ...]:
    if payload[:2] != _LITTLE:
        raise FrameError(
            f"{kind.name}: it begins with {payload[:4].hex(' ')!r}, expected {_LITTLE.hex(' ')} (plain CDR, "
            "little-endian)"
        )
    try:
        return kind.decode(_HEADER + payload[4:], whole=whole)
    except ProtocolError as error:
        raise FrameError(str(error)) from error
