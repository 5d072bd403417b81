"""Writes a copy of an episode with the robot in 3D for Foxglove: transforms of its links and their shapes.

Shapes are ``foxglove.SceneUpdate``, one message a shape, written once and fixed to the frame of its link.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.records import Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer

from deal_hw.data.files import EpisodeFile, opened_episode
from deal_hw.data.recording.mcap_scan import FoundRecord, messages, scan
from deal_hw.data.recording.recorder import LIBRARY
from deal_hw.data.recording.schemas import METADATA_NAME, TRANSFORM, RosMessageType
from deal_hw.errors import DatasetError
from deal_hw.types import FloatArray, IntArray

if TYPE_CHECKING:
    from deal_hw.sim.engine.scene import Shape

_SECTION = "=" * 80 + "\nMSG: "
_POSE = "geometry_msgs/Pose pose\n"
_COLOR = "foxglove_msgs/Color color\n"
_DEFINITIONS = {
    "foxglove_msgs/SceneEntityDeletion": "builtin_interfaces/Time timestamp\nuint8 type\nstring id\n",
    "foxglove_msgs/SceneEntity": "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\n"
    "builtin_interfaces/Duration lifetime\nbool frame_locked\nfoxglove_msgs/KeyValuePair[] metadata\n"
    "foxglove_msgs/ArrowPrimitive[] arrows\nfoxglove_msgs/CubePrimitive[] cubes\n"
    "foxglove_msgs/SpherePrimitive[] spheres\nfoxglove_msgs/CylinderPrimitive[] cylinders\n"
    "foxglove_msgs/LinePrimitive[] lines\nfoxglove_msgs/TriangleListPrimitive[] triangles\n"
    "foxglove_msgs/TextPrimitive[] texts\nfoxglove_msgs/ModelPrimitive[] models\n",
    "foxglove_msgs/KeyValuePair": "string key\nstring value\n",
    "foxglove_msgs/ArrowPrimitive": f"{_POSE}float64 shaft_length\nfloat64 shaft_diameter\n"
    f"float64 head_length\nfloat64 head_diameter\n{_COLOR}",
    "foxglove_msgs/CubePrimitive": f"{_POSE}geometry_msgs/Vector3 size\n{_COLOR}",
    "foxglove_msgs/SpherePrimitive": f"{_POSE}geometry_msgs/Vector3 size\n{_COLOR}",
    "foxglove_msgs/CylinderPrimitive": f"{_POSE}geometry_msgs/Vector3 size\nfloat64 bottom_scale\n"
    f"float64 top_scale\n{_COLOR}",
    "foxglove_msgs/LinePrimitive": f"uint8 type\n{_POSE}float64 thickness\nbool scale_invariant\n"
    f"geometry_msgs/Point[] points\n{_COLOR}foxglove_msgs/Color[] colors\nuint32[] indices\n",
    "foxglove_msgs/TriangleListPrimitive": f"{_POSE}geometry_msgs/Point[] points\n{_COLOR}"
    "foxglove_msgs/Color[] colors\nuint32[] indices\n",
    "foxglove_msgs/TextPrimitive": f"{_POSE}bool billboard\nfloat64 font_size\nbool scale_invariant\n"
    f"{_COLOR}string text\n",
    "foxglove_msgs/ModelPrimitive": f"{_POSE}geometry_msgs/Vector3 scale\n{_COLOR}bool override_color\n"
    "string url\nstring media_type\nuint8[] data\n",
    "foxglove_msgs/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
}
SCENE_NAME = "foxglove_msgs/msg/SceneUpdate"
SCENE_TEXT = (
    "foxglove_msgs/SceneEntityDeletion[] deletions\nfoxglove_msgs/SceneEntity[] entities\n"
    + "".join(f"{_SECTION}{name}\n{text}" for name, text in _DEFINITIONS.items())
)
_LISTS = ("metadata", "arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
_TOPICS = ("/tf", "/scene")


def export_foxglove(
    episode: Path,
    target: Path,
    links: Sequence[str],
    stamps_ns: IntArray,
    poses: tuple[FloatArray, FloatArray],
    shapes: Sequence[Shape],
    rate_hz: float = 50.0,
) -> int:
    """Write an episode with the robot in 3D; return the number of moments.

    The file stays an episode of deal-hw. Its log times are on the wall clock, even if those of the original
    are on the monotonic one.

    Args:
        episode: A sound episode.
        target: The file to write.
        links: Names of the B links, the world first.
        stamps_ns: Host clock of the T moments [ns].
        poses: Positions (T, B, 3) [m] and quaternions w x y z (T, B, 4) in the world; NaN where unknown.
        shapes: The shapes to draw.
        rate_hz: Most moments per second.

    Raises:
        DatasetError: The target exists already or cannot be written.
    """
    try:
        with opened_episode(episode) as data, open(target, "xb") as file:
            writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
            writer.start(profile="ros2", library=LIBRARY)
            shift_ns = _copy(data, writer)
            moments = _moments(stamps_ns, rate_hz)
            _write_transforms(writer, links[1:], stamps_ns, moments, poses, shift_ns)
            _write_shapes(writer, links, shapes, int(stamps_ns[0]) + shift_ns)
            writer.finish()
    except OSError as error:
        raise DatasetError(f"{target} cannot be written: {error.strerror}; name another file") from error
    return len(moments)


def _copy(data: EpisodeFile, writer: Writer) -> int:
    """Copy all but the base's transforms; return wall clock minus host clock [ns]."""
    schemas: dict[int, int] = {}
    channels: dict[int, int | None] = {}
    shift_ns = late_ns = 0
    for item in scan(data):
        if not isinstance(item, FoundRecord):
            continue
        if isinstance(item.record, Metadata):
            writer.add_metadata(item.record.name, item.record.metadata)
            if item.record.name == METADATA_NAME:
                wall = datetime.datetime.fromisoformat(item.record.metadata["wall_utc"])
                since = wall - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
                shift_ns = since // datetime.timedelta(microseconds=1) * 1000 - int(
                    item.record.metadata["host_ns"]
                )
                late_ns = shift_ns if item.record.metadata.get("format_version") == "1" else 0
        for record in item.contents:
            if isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                channels[record.id] = (
                    None
                    if record.topic in _TOPICS
                    else writer.register_channel(
                        record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                    )
                )
        for message in messages(item):
            channel = channels.get(message.channel_id)
            if channel is not None:
                at_ns = message.log_time + late_ns
                writer.add_message(channel, at_ns, message.data, at_ns, message.sequence)
    return shift_ns


def _moments(stamps_ns: IntArray, rate_hz: float) -> list[int]:
    """Return the moments to write, at most ``rate_hz`` per second."""
    chosen: list[int] = []
    for index, stamp_ns in enumerate(stamps_ns):
        # A moment that is slightly early by jitter still counts.
        if not chosen or (stamp_ns - stamps_ns[chosen[-1]]) * 1e-9 >= 0.9 / rate_hz:
            chosen.append(index)
    return chosen


def _write_transforms(
    writer: Writer,
    links: Sequence[str],
    stamps_ns: IntArray,
    moments: Sequence[int],
    poses: tuple[FloatArray, FloatArray],
    shift_ns: int,
) -> None:
    schema = writer.register_schema(TRANSFORM.name, "ros2msg", TRANSFORM.definition.encode())
    channel = writer.register_channel("/tf", "cdr", schema)
    for index in moments:
        at_ns = int(stamps_ns[index]) + shift_ns
        for body, link in enumerate(links, start=1):
            position, (w, x, y, z) = poses[0][index, body], poses[1][index, body]
            if np.isfinite(position).all():
                stamp = divmod(at_ns, 10**9)
                data = TRANSFORM.encode(1, *stamp, "world", link, *position, x, y, z, w)
                writer.add_message(channel, at_ns, data, at_ns)


def _write_shapes(writer: Writer, links: Sequence[str], shapes: Sequence[Shape], at_ns: int) -> None:
    schema = writer.register_schema(SCENE_NAME, "ros2msg", SCENE_TEXT.encode())
    channel = writer.register_channel("/scene", "cdr", schema)
    for shape in shapes:
        frame = "world" if shape.body == 0 else links[shape.body]
        writer.add_message(channel, at_ns, scene_update(shape, frame, at_ns), at_ns)


def scene_update(shape: Shape, frame: str, at_ns: int) -> bytes:
    """Return a ``foxglove.SceneUpdate`` that draws one shape in a frame for ever, as CDR."""
    values: list[tuple[str, object]] = [("uint32", 0), ("uint32", 1)]
    values += zip(("int32", "uint32"), divmod(at_ns, 10**9), strict=True)
    values += [("string", frame), ("string", shape.name), ("int32", 0), ("uint32", 0), ("bool", True)]
    parts = _primitives(shape)
    for name in _LISTS:
        entries = parts.get(name, [])
        values.append(("uint32", len(entries)))
        values += [value for entry in entries for value in entry]
    kinds = tuple((kind, str(number)) for number, (kind, _) in enumerate(values))
    return RosMessageType(SCENE_NAME, kinds).encode(*(value for _, value in values))


def _primitives(shape: Shape) -> dict[str, list[list[tuple[str, object]]]]:
    """Return the primitives of a shape by list of the entity: type and value of each field, in order."""
    w, x, y, z = shape.quaternion
    turn, color = (x, y, z, w), tuple(shape.color)
    radius, half = float(shape.size[0]), float(shape.size[1])

    def floats(*numbers: float) -> list[tuple[str, object]]:
        return [("float64", float(number)) for number in numbers]

    def at(offset: float) -> tuple[float, ...]:
        """Return the pose of a point along the shape's own z axis."""
        axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        return (*(np.asarray(shape.position) + offset * axis), *turn)

    if shape.kind == "mesh":
        points = [("uint32", len(shape.vertices)), *floats(*np.ravel(shape.vertices))]
        faces = [("uint32", int(index)) for index in np.ravel(shape.faces)]
        rest: list[tuple[str, object]] = [*floats(*color), ("uint32", 0), ("uint32", len(faces)), *faces]
        return {"triangles": [[*floats(*at(0.0)), *points, *rest]]}
    if shape.kind == "box":
        return {"cubes": [floats(*at(0.0), *(2 * shape.size), *color)]}
    if shape.kind in ("sphere", "ellipsoid"):
        size = 2 * shape.size if shape.kind == "ellipsoid" else np.full(3, 2 * radius)
        return {"spheres": [floats(*at(0.0), *size, *color)]}
    cylinder = floats(*at(0.0), 2 * radius, 2 * radius, 2 * half, 1.0, 1.0, *color)
    if shape.kind == "cylinder":
        return {"cylinders": [cylinder]}
    ends = [floats(*at(offset), *(2 * radius,) * 3, *color) for offset in (half, -half)]
    return {"cylinders": [cylinder], "spheres": ends}
