"""Reads an episode into contiguous arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mcap.records import Channel, Metadata
from mcap.records import Message as McapMessage

from deal_hw.data.files import opened_episode
from deal_hw.data.recording.mcap_scan import FoundRecord, Lost, messages, scan
from deal_hw.data.recording.schemas import BODY, METADATA_NAME, OLD_TOPICS, RosMessageType, message_type
from deal_hw.errors import (
    ConfigurationError,
    DatasetError,
    EmptyRecordingError,
    ProtocolError,
    TornRecordingError,
    shown,
)
from deal_hw.schema import read_json
from deal_hw.types import BodyTrajectory, Event, FloatArray, IntArray, Trajectory

if TYPE_CHECKING:
    from deal_hw.transport import Message

_BLOCK = 4096
"""Number of messages that are decoded at once."""


@dataclass(frozen=True, slots=True, eq=False)
class CycleTable:
    """The N control cycles of an episode, on the time base of ``Trajectory.receive_s``.

    Attributes:
        cycle: Number, (N,).
        deadline_s: Time at which each should have started, (N,) [s].
        start_s: Time at which each started, (N,) [s].
        state_age_s: Age of the newest state when the action was computed, (N,) [s]; NaN where there was none.
        flags: :class:`~deal_hw.data.recording.record.CycleFlag` bits, (N,).
        lost: Number of records that the recorder refused so far, (N,).
        safety_state: Name of the safety filter's state, N entries.
        action: Action of the policy, (N, K); NaN for none.
        requested_position: Requested position targets, (N, A); NaN for none. Dry runs have them, too.
    """

    cycle: IntArray
    deadline_s: FloatArray
    start_s: FloatArray
    state_age_s: FloatArray
    flags: IntArray
    lost: IntArray
    safety_state: tuple[str, ...]
    action: FloatArray
    requested_position: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Episode:
    """One recording.

    Attributes:
        path: The file.
        description: ``RobotDescription.to_json()`` of the robot.
        metadata: Values given to the recorder: purpose, policy, task, ...
        wall_utc: Wall-clock time, ISO 8601, at ``anchor_ns``.
        anchor_ns: Host clock when the recording was opened [ns].
        start_ns: Host clock at the zero of ``Trajectory.receive_s`` [ns].
        device_start_ns: Device clock at the zero of ``Trajectory.device_s`` [ns].
        sequence: Numbers of the state samples, (T,).
        trajectory: The samples, commands and events.
        cycles: The control cycles.
    """

    path: Path
    description: Mapping[str, Any]
    metadata: Mapping[str, Any]
    wall_utc: str
    anchor_ns: int
    start_ns: int
    device_start_ns: int
    sequence: IntArray
    trajectory: Trajectory
    cycles: CycleTable


def read_trajectory(path: Path) -> Trajectory:
    """Read the samples, commands and events of an episode; errors as :func:`read_episode`."""
    return read_episode(path).trajectory


def read_episode(path: Path) -> Episode:
    """Read an episode.

    ``Trajectory.metadata`` holds the values given to the recorder, and ``description``, ``lost_frames``
    (state samples that never arrived), ``hand_over_losses`` (cycles that the recorder did not get) and
    ``start_ns``.

    Raises:
        EmptyRecordingError: There is no state sample in it.
        TornRecordingError: It has no footer or is damaged.
        DatasetError: It cannot be read or is not an episode of deal-hw.
    """
    try:
        return _episode(Path(path), _collect(Path(path)))
    except (KeyError, ValueError, ProtocolError) as error:
        raise _unreadable(path, error) from error


def read_metadata(path: Path) -> dict[str, Any]:
    """Return the values given to an episode's recorder, without its samples; errors as :func:`read_wire`."""
    try:
        for found in _records(path):
            if isinstance(found.record, Metadata) and found.record.name == METADATA_NAME:
                return read_json(dict[str, Any], found.record.metadata["metadata"])
    except (KeyError, ValueError, ProtocolError) as error:
        raise _unreadable(path, error) from error
    return {}


def read_wire(path: Path) -> Iterator[Message]:
    """Yield the raw messages of an episode in order; channels as the robot named them.

    Raises:
        TornRecordingError: It has no footer or is damaged.
        DatasetError: It cannot be read or is not an episode of deal-hw.
    """
    from deal_hw.transport import Message

    try:
        for channel, (stamp_ns, payload) in _wire_rows(Path(path)):
            yield Message(channel, payload, stamp_ns)
    except ProtocolError as error:
        raise _unreadable(path, error) from error


def check_description(values: Mapping[str, Any]) -> None:
    """Check that a description given as JSON names a robot and its joints.

    Raises:
        ConfigurationError: It does not name them.
    """
    names = [*_names(values, "joint_names"), *_names(values, "actuated")]
    if not names or not isinstance(values.get("name"), str):
        raise ConfigurationError(f"the description {shown(dict(values))} names no robot with joints")


def _names(description: Mapping[str, Any], field: str) -> list[str]:
    names = description.get(field)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigurationError(f"the description's {field} are {shown(names)}; wanted: a list of names")
    return names


def _unreadable(path: Path, error: Exception) -> DatasetError:
    what = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
    return DatasetError(f"{path} is not an episode that this version reads: {what}")


def _records(path: Path) -> Iterator[FoundRecord]:
    with opened_episode(path) as data:
        for item in scan(data):
            if isinstance(item, Lost):
                state = "is torn" if item.torn else "is damaged"
                raise TornRecordingError(
                    f"{path} {state} at byte {item.offset} ({item.reason}); "
                    f"repair it with: deal-hw data repair {path}"
                )
            yield item


def _wire_rows(path: Path) -> Iterator[tuple[str, tuple[Any, ...]]]:
    channels: dict[int, Channel] = {}
    for found in _records(path):
        for record in found.contents:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                channel = _channel(channels, record)
                if channel.topic.startswith("/wire/"):
                    yield (
                        channel.topic.removeprefix("/wire/"),
                        message_type(channel.topic).decode(record.data),
                    )


def _channel(channels: Mapping[int, Channel], message: McapMessage) -> Channel:
    channel = channels.get(message.channel_id)
    if channel is None:
        raise ProtocolError(f"a message is on channel {message.channel_id}, which the file does not name")
    return channel


@dataclass(frozen=True, slots=True)
class _Content:
    """What a recording contains.

    Attributes:
        preamble: Values given to the recorder.
        tables: Fields of the messages without text, by topic; none of a topic without messages.
        rows: Values of the other messages, by topic.
    """

    preamble: Mapping[str, str]
    tables: Mapping[str, _Fields]
    rows: Mapping[str, Sequence[tuple[Any, ...]]]


_TABLES = ("/state", "/body", "/command", "/command/requested")
"""Topics of messages without text."""
_Fields = dict[str, npt.NDArray[Any]]
"""Values of each field of N messages, by name, (N,) or (N, K)."""


class _Table:
    """The messages of a type without text; a long recording has too many to decode them one by one."""

    def __init__(self, kind: RosMessageType) -> None:
        self._kind = kind
        self._waiting: list[bytes] = []
        self._layout: np.dtype[np.void] | None = None
        self._count = 0
        # Not lists of blocks: joining these takes the memory twice, and the heap keeps the second one.
        self._columns = {name: bytearray() for _, name in kind.fields}

    def append(self, data: bytes) -> None:
        """Take the next message."""
        self._waiting.append(data)
        if len(self._waiting) == _BLOCK:
            self._decode()

    def fields(self) -> _Fields:
        """Hand over all messages; nothing where there are none."""
        if self._waiting:
            self._decode()
        if self._layout is None:
            return {}
        kinds = {name: self._layout[name] for name in self._columns}
        return {
            name: np.frombuffer(column, kinds[name].base).reshape(self._count, *kinds[name].shape)
            for name, column in self._columns.items()
        }

    def _decode(self) -> None:
        block = self._kind.decode_all(self._waiting)
        self._waiting = []
        if self._layout not in (None, block.dtype):
            raise ProtocolError(f"{self._kind.name}: the messages have different lengths")
        self._layout, self._count = block.dtype, self._count + len(block)
        for name, column in self._columns.items():
            column += block[name].tobytes()


def _collect(path: Path) -> _Content:
    preamble: dict[str, str] | None = None
    tables = {topic: _Table(message_type(topic)) for topic in _TABLES}
    rows: dict[str, list[tuple[Any, ...]]] = {topic: [] for topic in ("/cycle", "/events")}
    channels: dict[int, Channel] = {}
    for found in _records(path):
        if isinstance(found.record, Metadata) and found.record.name == METADATA_NAME:
            preamble = found.record.metadata
        channels.update({record.id: record for record in found.contents if isinstance(record, Channel)})
        for message in messages(found):
            channel = _channel(channels, message)
            topic = OLD_TOPICS.get(channel.topic, channel.topic)
            if topic in tables:
                tables[topic].append(message.data)
            elif topic in rows:
                rows[topic].append(message_type(topic).decode(message.data))
    if preamble is None:
        raise DatasetError(
            f"{path} has no metadata {METADATA_NAME!r}: it was not written by deal-hw, or is damaged; "
            "import a "
            "foreign file with `deal-hw data import`"
        )
    found_in = {topic: fields for topic, table in tables.items() if (fields := table.fields())}
    if "/state" not in found_in:
        raise EmptyRecordingError(
            f"{path} contains no state sample: the robot sent none; check it with `deal-hw doctor` and "
            "record again"
        )
    return _Content(preamble, found_in, rows)


def _episode(path: Path, content: _Content) -> Episode:
    preamble, tables, rows = content.preamble, content.tables, content.rows
    state, body = tables["/state"], tables.get("/body")
    description = read_json(dict[str, Any], preamble["description"])
    check_description(description)
    metadata = read_json(dict[str, Any], preamble["metadata"])
    J, A = len(description["joint_names"]), len(description["actuated"])
    start_ns, device_start_ns = int(state["receive_ns"][0]), int(state["device_ns"][0])
    cycles = _cycles(rows["/cycle"], tables.get("/command/requested"), start_ns, A)
    for name in ("position", "velocity", "effort"):
        _check_width(state[name].shape[1], J)
    facts = {
        "description": description,
        "lost_frames": lost_frames(state["sequence"]),
        "hand_over_losses": hand_over_losses(cycles),
        "start_ns": start_ns,
    }
    trajectory = Trajectory(
        joint_names=tuple(description["joint_names"]),
        actuated=tuple(description["actuated"]),
        receive_s=_since(state["receive_ns"], start_ns),
        device_s=_since(state["device_ns"], device_start_ns),
        position=state["position"],
        velocity=state["velocity"],
        effort=state["effort"],
        status=state["status"].astype(np.int64),
        command_sequence=state["command_sequence"],
        command_age_s=_seconds_or_nan(state["command_age_ns"]),
        events=tuple(
            Event(stamp, kind, text, read_json(dict[str, Any], data))
            for stamp, kind, text, data in rows["/events"]
        ),
        metadata={**metadata, **facts},
        body=None if body is None else _body(body, state),
        **_commands(tables.get("/command"), tables.get("/command/requested"), start_ns, A),
    )
    return Episode(
        path=path,
        description=description,
        metadata=metadata,
        wall_utc=preamble["wall_utc"],
        anchor_ns=int(preamble["host_ns"]),
        start_ns=start_ns,
        device_start_ns=device_start_ns,
        sequence=state["sequence"],
        trajectory=trajectory,
        cycles=cycles,
    )


def _body(table: _Fields, state: _Fields) -> BodyTrajectory:
    """Return the body's sensor values at each state sample, by stamp and number; empties the table."""
    row: IntArray | None = None
    if any(not np.array_equal(table[name], state[name]) for name in ("receive_ns", "sequence")):
        row_of = {key: number for number, key in enumerate(_keys(table))}
        row = np.array([row_of.get(key, -1) for key in _keys(state)])
    columns = {}
    for field, (_, name) in zip(dataclasses.fields(BodyTrajectory), BODY.fields[2:], strict=True):
        values = table.pop(name)
        if row is not None:
            values = values[row]
            values[row < 0] = -1 if name == "buttons" else np.nan
        columns[field.name] = values
    return BodyTrajectory(**columns)


def _keys(table: _Fields) -> Iterator[tuple[int, int]]:
    """Yield stamp and number of each sample."""
    return zip(table["receive_ns"].tolist(), table["sequence"].tolist(), strict=True)


def _commands(
    sent: _Fields | None, requested: _Fields | None, start_ns: int, actuated: int
) -> dict[str, Any]:
    """Return the command fields of a Trajectory."""
    names = ("position_target", "stiffness", "damping", "effort_limit", "speed_limit")
    if sent is None:
        nothing = dict.fromkeys(("requested_position", *names), np.empty((0, actuated)))
        return {"sent_s": np.empty(0), "sent_sequence": np.empty(0, dtype=np.int64), **nothing}
    for name in names:
        _check_width(sent[name].shape[1], actuated)
    return {
        "sent_s": _since(sent["stamp_ns"], start_ns),
        "sent_sequence": sent["sequence"],
        "requested_position": _requested(requested, sent["cycle"], actuated),
        **{name: sent[name] for name in names},
    }


def _requested(requested: _Fields | None, cycle: IntArray, actuated: int) -> FloatArray:
    """Return the position targets that were requested in each cycle, (N, A); NaN for none."""
    found = np.full((len(cycle), actuated), np.nan)
    if requested is not None:
        _check_width(requested["position_target"].shape[1], actuated)
        row_of = {number: row for row, number in enumerate(requested["cycle"].tolist())}
        row = np.array([row_of.get(number, -1) for number in cycle.tolist()], dtype=np.int64)
        found[row >= 0] = requested["position_target"][row[row >= 0]]
    return found


def _cycles(
    table: Sequence[tuple[Any, ...]], requested: _Fields | None, start_ns: int, actuated: int
) -> CycleTable:
    width = max((row[7].size for row in table), default=0)
    cycle = np.array([row[0] for row in table], dtype=np.int64)
    return CycleTable(
        cycle=cycle,
        deadline_s=_since([row[1] for row in table], start_ns),
        start_s=_since([row[2] for row in table], start_ns),
        state_age_s=_seconds_or_nan([row[3] for row in table]),
        flags=np.array([row[5] for row in table], dtype=np.int64),
        lost=np.array([row[4] for row in table], dtype=np.int64),
        safety_state=tuple(row[8] for row in table),
        action=_table([row[7] if row[6] else np.full(width, np.nan) for row in table], width),
        requested_position=_requested(requested, cycle, actuated),
    )


def lost_frames(sequence: IntArray) -> int:
    """Return the number of state samples that never arrived, from the sequence numbers of the others."""
    steps = np.diff(sequence)
    return int(np.sum(steps[steps > 1] - 1))


def hand_over_losses(cycles: CycleTable) -> int:
    """Return the number of missing cycles, from their sequence numbers and from the sender's own count."""
    if not cycles.cycle.size:
        return 0
    missing = int(np.sum(np.maximum(np.diff(cycles.cycle) - 1, 0)))
    return max(missing, int(cycles.lost[-1]))


def _since(stamps_ns: Sequence[int] | IntArray, start_ns: int) -> FloatArray:
    # Differences in integers first: absolute ns beyond 2^53 would lose their last digits as floats.
    return (np.array(stamps_ns, dtype=np.int64) - start_ns).astype(np.float64) * 1e-9


def _seconds_or_nan(ages_ns: Sequence[int] | IntArray) -> FloatArray:
    ages_s = np.array(ages_ns, dtype=np.float64) * 1e-9
    ages_s[ages_s < 0] = np.nan
    return ages_s


def _table(rows: Sequence[FloatArray], width: int) -> FloatArray:
    for row in rows:
        _check_width(row.size, width)
    return np.stack(rows) if rows else np.empty((0, width))


def _check_width(numbers: int, wanted: int) -> None:
    if numbers != wanted:
        raise ValueError(f"a row has {numbers} numbers, expected {wanted}")
