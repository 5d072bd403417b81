"""The messages inside an episode file: ROS 2 message definitions and their CDR encoding.

Each type is a list of fields. Both the ros2msg text in the file and the bytes of a message are made from this
list, so they always agree. rerun, Foxglove and mcap_ros2 need only that text to decode the messages.

Messages of ROS 2 and Foxglove are included, so that other programs can plot an episode. Their nested fields
are listed one after another here, because CDR writes nested messages without anything in between.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from deal_hw.errors import ProtocolError, UnknownNameError

METADATA_NAME = "deal-hw"
"""Name of the metadata of an episode."""
_HEADER = b"\x00\x01\x00\x00"
"""CDR header, little-endian; alignment counts from its end."""
_SCALARS = {
    "int64": struct.Struct("<q"),
    "int32": struct.Struct("<i"),
    "uint32": struct.Struct("<I"),
    "uint8": struct.Struct("<B"),
    "bool": struct.Struct("<?"),
    "float64": struct.Struct("<d"),
}
_LENGTH = _SCALARS["uint32"]
_ALIKE = "alike: "
"""Prefix of a field's name in :meth:`RosMessageType.decode_all`: the field is a vector's length."""


@dataclass(frozen=True, slots=True)
class RosMessageType:
    """One message type.

    Attributes:
        name: ROS 2 name.
        fields: Pairs of ros2msg type (int64, int32, uint32, uint8, bool, float64, string, string[], uint8[],
            float64[]) and name.
        text: The ros2msg text if messages are nested; "" if it follows from the fields.
    """

    name: str
    fields: tuple[tuple[str, str], ...]
    text: str = ""

    @property
    def definition(self) -> str:
        """The ros2msg text."""
        if self.text:
            return self.text
        return "\n".join(f"{kind} {name}" for kind, name in self.fields) + "\n"

    def encode(self, *values: Any) -> bytes:
        """Return the CDR bytes of one message; values in the order of the fields."""
        out = bytearray()
        for (kind, _), value in zip(self.fields, values, strict=True):
            if kind in _SCALARS:
                layout = _SCALARS[kind]
                _pad(out, layout.size)
                out += layout.pack(value)
            elif kind == "string[]":
                _put_length(out, len(value))
                for text in value:
                    _put_text(out, text)
            elif kind == "string":
                _put_text(out, value)
            else:
                _put_length(out, len(value))
                if kind == "float64[]":
                    _put_floats(out, value)
                else:
                    out += value
        return _HEADER + out

    def decode(self, data: bytes, *, whole: bool = False) -> tuple[Any, ...]:
        """Return the values of one message in the order of the fields; float64[] as read-only arrays.

        Args:
            data: The bytes with their 4-byte header.
            whole: Whether nothing but padding may follow the message.

        Raises:
            ProtocolError: The bytes are not such a message.
        """
        if data[:4] != _HEADER:
            raise ProtocolError(f"{self.name}: not little-endian CDR, it starts with {data[:4]!r}")
        cursor = _Reader(data[4:])
        try:
            values = tuple(cursor.value(kind) for kind, _ in self.fields)
            if whole:
                cursor.check_end()
            return values
        except (struct.error, ValueError) as error:
            raise ProtocolError(
                f"{self.name}: {len(data)} bytes do not contain the message: {error}"
            ) from error

    def decode_all(self, messages: Sequence[bytes]) -> npt.NDArray[np.void]:
        """Return messages without text as records with the fields' names, (N,); all have the same layout.

        Raises:
            ProtocolError: The bytes are not such messages, or they or their vectors differ in length.
        """
        layout = self._layout(messages[0])
        if any(len(data) != layout.itemsize for data in messages):
            raise ProtocolError(f"{self.name}: the messages have different lengths")
        found = np.frombuffer(b"".join(messages), dtype=layout)
        for name in layout.names or ():
            if name.startswith(_ALIKE) and np.any(found[name] != found[name][0]):
                what = name.removeprefix(_ALIKE)
                raise ProtocolError(f"{self.name}: {what} has not the same layout in all messages")
        return found

    def _layout(self, data: bytes) -> np.dtype[np.void]:
        """Return the place of each field in messages like this one, with the lengths to compare."""
        fields: list[tuple[str, Any, int]] = [(f"{_ALIKE}encapsulation", _LENGTH.format, 0)]
        at = len(_HEADER)
        for (kind, name), value in zip(self.fields, self.decode(data), strict=True):
            vector = kind == "float64[]"
            layout = _LENGTH if vector else _SCALARS[kind]
            at += (len(_HEADER) - at) % layout.size
            fields.append((_ALIKE * vector + name, layout.format, at))
            at += layout.size
            if vector:
                at += (len(_HEADER) - at) % 8 if len(value) else 0
                fields.append((name, ("<f8", value.shape), at))
                at += 8 * len(value)
        names, formats, offsets = zip(*fields, strict=True)
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": len(data)})


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self._offset = 0

    def value(self, kind: str) -> Any:
        if kind in _SCALARS:
            return self._scalar(_SCALARS[kind])
        if kind == "string":
            return self._text()
        count = self._scalar(_LENGTH)
        if kind == "string[]":
            return tuple(self._text() for _ in range(count))
        if kind == "uint8[]":
            return self._take(count)
        if count:
            self._offset += -self._offset % 8
        return np.frombuffer(self._take(8 * count), dtype="<f8")

    def check_end(self) -> None:
        """Check that at most padding to whole words is left."""
        if (left := len(self._data) - self._offset) > 3:
            raise ValueError(f"{left} bytes are left at its end")

    def _scalar(self, layout: struct.Struct) -> Any:
        self._offset += -self._offset % layout.size
        (value,) = layout.unpack_from(self._data, self._offset)
        self._offset += layout.size
        return value

    def _text(self) -> str:
        return self._take(self._scalar(_LENGTH))[:-1].decode()

    def _take(self, size: int) -> bytes:
        part = self._data[self._offset : self._offset + size]
        if len(part) != size:
            raise ValueError(f"{size} bytes wanted at {self._offset} of {len(self._data)}")
        self._offset += size
        return part


def _pad(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


def _put_length(out: bytearray, length: int) -> None:
    _pad(out, 4)
    out += _LENGTH.pack(length)


def _put_text(out: bytearray, text: str) -> None:
    data = text.encode("utf-8", "backslashreplace") + b"\0"
    _put_length(out, len(data))
    out += data


def _put_floats(out: bytearray, values: Any) -> None:
    if len(values):
        _pad(out, 8)
        out += np.asarray(values, dtype="<f8").tobytes()


def _of(kind: str, names: str) -> tuple[tuple[str, str], ...]:
    """Return fields of one type, in their order."""
    return tuple((kind, name) for name in names.split())


ROBOT = RosMessageType(
    "deal_hw_msgs/msg/Robot", (("string", "description_json"), *_of("string[]", "joint_names actuated"))
)
STATE = RosMessageType(
    "deal_hw_msgs/msg/State",
    (
        *_of("int64", "receive_ns device_ns sequence command_sequence command_age_ns"),
        ("uint32", "status"),
        *_of("float64[]", "position velocity effort"),
    ),
)
COMMAND = RosMessageType(
    "deal_hw_msgs/msg/Command",
    (
        *_of("int64", "stamp_ns cycle sequence"),
        *_of(
            "float64[]", "position_target velocity_target stiffness damping effort effort_limit speed_limit"
        ),
    ),
)
CYCLE = RosMessageType(
    "deal_hw_msgs/msg/Cycle",
    (
        *_of("int64", "cycle deadline_ns start_ns state_age_ns lost"),
        ("uint32", "flags"),
        ("bool", "has_action"),
        ("float64[]", "action"),
        ("string", "safety_state"),
    ),
)
EVENT = RosMessageType(
    "deal_hw_msgs/msg/Event", (("int64", "stamp_ns"), *_of("string", "kind message data_json"))
)
BODY = RosMessageType(
    "deal_hw_msgs/msg/Body",
    (
        *_of("int64", "receive_ns sequence"),
        *_of("float64[]", "orientation angular_velocity acceleration foot_force temperature lost"),
        *_of("float64", "battery voltage current"),
        ("float64[]", "sticks"),
        ("int64", "buttons"),
    ),
)
WIRE = RosMessageType("deal_hw_msgs/msg/Wire", (("int64", "stamp_ns"), ("uint8[]", "payload")))

_SECTION = "=" * 80 + "\nMSG: "
_TIME = f"{_SECTION}builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER_TEXT = f"{_SECTION}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
_STAMP = (("int32", "sec"), ("uint32", "nanosec"))

JOINT_STATE = RosMessageType(
    "sensor_msgs/msg/JointState",
    (
        *_STAMP,
        ("string", "frame_id"),
        ("string[]", "name"),
        *_of("float64[]", "position velocity effort"),
    ),
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + _HEADER_TEXT,
)
FLOAT64_MULTI_ARRAY = RosMessageType(
    "std_msgs/msg/Float64MultiArray",
    (*_of("uint32", "dimensions data_offset"), ("float64[]", "data")),
    "std_msgs/MultiArrayLayout layout\nfloat64[] data\n"
    f"{_SECTION}std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n"
    f"{_SECTION}std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n",
)
"""An array without a layout: ``dimensions``, the length of that list, is 0."""
JOINT_TRAJECTORY = RosMessageType(
    "trajectory_msgs/msg/JointTrajectory",
    (
        *_STAMP,
        ("string", "frame_id"),
        ("string[]", "joint_names"),
        ("uint32", "points"),
        *_of("float64[]", "positions velocities accelerations effort"),
        *_STAMP,
    ),
    "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points\n"
    f"{_SECTION}trajectory_msgs/JointTrajectoryPoint\nfloat64[] positions\nfloat64[] velocities\n"
    "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start\n"
    f"{_SECTION}builtin_interfaces/Duration\nint32 sec\nuint32 nanosec\n" + _HEADER_TEXT,
)
"""A trajectory of one point: ``points``, the length of that list, is 1."""
LOG = RosMessageType(
    "foxglove_msgs/msg/Log",
    (
        *_STAMP,
        ("uint8", "level"),
        *_of("string", "message name file"),
        ("uint32", "line"),
    ),
    "builtin_interfaces/Time timestamp\nuint8 level\nstring message\nstring name\nstring file\n"
    "uint32 line\n" + _TIME,
)
TRANSFORM = RosMessageType(
    "tf2_msgs/msg/TFMessage",
    (
        ("uint32", "count"),
        *_STAMP,
        *_of("string", "frame_id child_frame_id"),
        *_of("float64", "x y z qx qy qz qw"),
    ),
    "geometry_msgs/TransformStamped[] transforms\n"
    f"{_SECTION}geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform\n"
    f"{_SECTION}geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation\n"
    f"{_SECTION}geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{_SECTION}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n" + _HEADER_TEXT,
)
"""The transforms of one moment: a list with one entry."""

STANDARD: Mapping[str, RosMessageType] = {
    "/joint_states": JOINT_STATE,
    "/joint_commands": JOINT_STATE,
    "/joint_commands/requested": JOINT_STATE,
    "/log": LOG,
    "/tf": TRANSFORM,
}
"""Topics for other programs; deal-hw reads the other topics, which contain more."""

CHANNELS: Mapping[str, RosMessageType] = {
    "/robot": ROBOT,
    "/state": STATE,
    "/command": COMMAND,
    "/command/requested": COMMAND,
    "/cycle": CYCLE,
    "/events": EVENT,
    "/wire/rx": WIRE,
    "/wire/tx": WIRE,
    "/body": BODY,
    **STANDARD,
}
"""Topic -> type, in the order in which a recorder registers them: the n-th has channel id n, from 1.

Repair relies on that order if the part of a file that names the channels is damaged. So append, and never
change the order.
"""

FIRST_CHANNELS = 9
"""Number of these topics in recordings of format version 1."""

OLD_TOPICS: Mapping[str, str] = {"/command/asked": "/command/requested"}
"""Topic names in recordings of November 2026 -> present names."""


def message_type(topic: str) -> RosMessageType:
    """Return the type of the messages on a topic.

    Raises:
        UnknownNameError: No such topic.
    """
    if topic.startswith("/wire/"):
        return WIRE
    if topic not in CHANNELS:
        raise UnknownNameError("topic", topic, CHANNELS)
    return CHANNELS[topic]
