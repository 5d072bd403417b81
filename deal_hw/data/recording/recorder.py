"""Writes an episode as MCAP, in small chunks that are handed to the kernel every 50 ms.

Log times are on the wall clock, as other programs expect; the messages contain the monotonic stamps. The file
has our own messages, and the same values as standard ones (JointState, foxglove.Log, tf).

A chunk goes to the kernel in one piece and is never changed afterwards. So a killed recorder loses only the
chunk in progress. Its file has no footer: :mod:`deal_hw.data.recording.repair` writes one.
"""

from __future__ import annotations

import datetime
import json
import operator
import os
import time
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex, DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from typing_extensions import Self

from deal_hw.clock import Clock
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.schemas import (
    BODY,
    CHANNELS,
    COMMAND,
    CYCLE,
    EVENT,
    JOINT_STATE,
    LOG,
    METADATA_NAME,
    ROBOT,
    STATE,
    TRANSFORM,
    WIRE,
    message_type,
)
from deal_hw.errors import DatasetError
from deal_hw.types import NOT_FOLLOWING, JointCommand, RobotState
from deal_hw.version import __version__

FLUSH_INTERVAL_S = 0.05
"""Longest time until the chunk of a record is closed [s]: half of the allowed loss, so that a busy machine
may be late by the other half."""
FORMAT_VERSION = 2
"""Since 2 log times are on the wall clock and standard messages are written; both versions read alike."""
END_NAME = "deal-hw.end"
LOG_LEVELS = {"velocity": 1, "clipped": 3, "warning": 3, NOT_FOLLOWING: 3}
"""Level of foxglove.Log by an event's kind: 1 debug, 3 warning; others 2, info."""
LIBRARY = f"deal-hw/{__version__}"
_state_of = operator.attrgetter(*(name for _, name in STATE.fields))
_command_of = operator.attrgetter(*(name for _, name in COMMAND.fields[3:]))
_body_of = operator.attrgetter(*(name for _, name in BODY.fields[2:]))
"""Values of a state, command or body in the order of their messages' fields."""


class EpisodeRecorder:
    """Writes one episode; a context manager.

    Args:
        path: The file to create; it must not exist.
        description: ``RobotDescription.to_json()`` of the robot.
        metadata: Plain JSON values: robot, description digest, purpose, policy, task, ...
        clock: The host's monotonic clock, on which all stamps are.
        flush_interval_s: Longest time a record waits for its chunk to be closed [s].
        wall_ns: The wall clock [ns since 1970]; read once, when the file is opened.
    """

    def __init__(
        self,
        path: Path,
        description: Mapping[str, Any],
        metadata: Mapping[str, Any],
        clock: Clock,
        flush_interval_s: float = FLUSH_INTERVAL_S,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.path = Path(path)
        self.cycles = 0
        self.states = 0
        self._description = description
        self._metadata = metadata
        self._clock = clock
        self._flush_interval_ns = round(flush_interval_s * 1e9)
        self._oldest_ns = -1
        self._read_wall_ns = wall_ns
        self._wall_minus_host_ns = 0
        self._joints: tuple[str, ...] = tuple(description.get("joint_names", ()))
        self._actuated: tuple[str, ...] = tuple(description.get("actuated", ()))
        self._channels: dict[str, int] = {}
        self._file: _ChunkFile | None = None

    def open(self) -> None:
        """Create the file and write the episode's description and metadata.

        Raises:
            DatasetError: The file exists or cannot be written.
        """
        if self.path.exists():
            raise DatasetError(f"{self.path} exists; a recording never overwrites another")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _ChunkFile(self.path)
        except OSError as error:
            raise DatasetError(f"{self.path} cannot be created: {error.strerror}") from error
        self._writer = Writer(
            cast(IO[bytes], self._file), compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        # mcap keeps its index as objects: 1.5 KiB a chunk, 90 MiB an hour. Only memory depends on this line.
        if hasattr(self._writer, "_Writer__chunk_indices"):
            setattr(self._writer, "_Writer__chunk_indices", _PackedIndex())  # noqa: B010
        self._writer.start(profile="ros2", library=LIBRARY)
        self._writer.add_metadata(METADATA_NAME, self._preamble())
        self._register_channels()
        text = json.dumps(self._description)
        self._add("/robot", self._clock.now_ns(), ROBOT.encode(text, self._joints, self._actuated))
        self.flush()

    def write(self, record: CycleRecord) -> None:
        """Add one cycle; closes the chunk when it is due.

        Raises:
            DatasetError: The disk is full or gone; data flushed before are kept, and the file is closed
                properly.
        """
        # Counted from the cycle's own stamp: after a stall the queued cycles arrive together and are already
        # old.
        self._wait_since(record.start_ns)
        for message in record.wire:
            self._add(
                f"/wire/{message.channel}", message.stamp_ns, WIRE.encode(message.stamp_ns, message.payload)
            )
        for state in record.states:
            self._add("/state", state.receive_ns, STATE.encode(*_state_of(state)), state.sequence)
            self._add_joints("/joint_states", state.receive_ns, self._joints, state)
            self._add_body(state)
        self._add_command("/command/requested", "/joint_commands/requested", record, record.requested)
        self._add_command("/command", "/joint_commands", record, record.sent)
        for event in record.events:
            data = EVENT.encode(event.stamp_ns, event.kind, event.message, json.dumps(dict(event.data)))
            self._add("/events", event.stamp_ns, data)
            level = LOG_LEVELS.get(event.kind, 2)
            words = event.message or json.dumps(dict(event.data))
            self._add(
                "/log",
                event.stamp_ns,
                LOG.encode(*self._wall(event.stamp_ns), level, words, event.kind, "", 0),
            )
        action = () if record.action is None else record.action
        data = CYCLE.encode(
            record.cycle,
            record.deadline_ns,
            record.start_ns,
            record.state_age_ns,
            record.lost,
            record.flags,
            record.action is not None,
            action,
            record.safety_state,
        )
        self._add("/cycle", record.start_ns, data, record.cycle)
        self.cycles += 1
        self.states += len(record.states)
        self.flush_if_due()

    def flush_if_due(self) -> None:
        """Close the chunk in progress if its oldest record has waited long enough; call it when idle."""
        if self.due_in_s() == 0.0:
            self.flush()

    def due_in_s(self) -> float | None:
        """Time until the chunk in progress should be closed [s]; None while nothing waits."""
        if self._oldest_ns < 0:
            return None
        return max(0, self._oldest_ns + self._flush_interval_ns - self._clock.now_ns()) * 1e-9

    def flush(self) -> None:
        """Close the chunk in progress and hand it to the kernel.

        Raises:
            DatasetError: The disk is full or gone.
        """
        self._oldest_ns = -1
        try:
            self._writer.flush()
        except OSError as error:
            raise self._give_up(error) from error

    def close(self) -> None:
        """Write the index and the footer; idempotent.

        Raises:
            DatasetError: The disk is full or gone.
        """
        if self._file is None:
            return
        try:
            end = {
                "cycles": str(self.cycles),
                "states": str(self.states),
                "host_ns": str(self._clock.now_ns()),
            }
            self._writer.flush()
            self._writer.add_metadata(END_NAME, end)
            self._writer.finish()
            self._file.flush()
            self._file.close()
        except OSError as error:
            raise self._give_up(error) from error
        self._file = None

    def _give_up(self, error: OSError) -> DatasetError:
        if self._file is not None:
            self._file.seal()
        self._file = None
        return DatasetError(
            f"recording to {self.path} stopped after {self.cycles} cycles: {error.strerror}; the data "
            "written before are kept. Free some space, then check the file with: deal-hw data info"
        )

    def _wait_since(self, stamp_ns: int) -> None:
        if self._oldest_ns < 0:
            self._oldest_ns = min(max(stamp_ns, 0), self._clock.now_ns())

    def _preamble(self) -> dict[str, str]:
        # Whole microseconds, as wall_utc has them: the difference can be taken from the file again.
        host_ns, wall_ns = self._clock.now_ns(), self._read_wall_ns() // 1000 * 1000
        # One difference for the whole episode: if the wall clock is set meanwhile, the log times must not
        # jump.
        self._wall_minus_host_ns = wall_ns - host_ns
        wall = datetime.datetime.fromtimestamp(wall_ns / 1e9, datetime.timezone.utc)
        return {
            "format_version": str(FORMAT_VERSION),
            "host_ns": str(host_ns),
            "wall_utc": wall.isoformat(timespec="microseconds"),
            "description": json.dumps(self._description),
            "metadata": json.dumps(self._metadata),
        }

    def _register_channels(self) -> None:
        schemas: dict[str, int] = {}
        for topic, kind in CHANNELS.items():
            if kind.name not in schemas:
                definition = kind.definition.encode()
                schemas[kind.name] = self._writer.register_schema(kind.name, "ros2msg", definition)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schemas[kind.name])
        self._schemas = schemas

    def _add_body(self, state: RobotState) -> None:
        body = state.body
        if body is None:
            return
        data = BODY.encode(state.receive_ns, state.sequence, *_body_of(body))
        self._add("/body", state.receive_ns, data, state.sequence)
        w, x, y, z = body.orientation
        frames = 1, *self._wall(state.receive_ns), "world", "base"
        data = TRANSFORM.encode(*frames, 0.0, 0.0, 0.0, x, y, z, w)
        self._add("/tf", state.receive_ns, data, state.sequence)

    def _add_joints(
        self, topic: str, stamp_ns: int, names: Sequence[str], values: JointCommand | RobotState
    ) -> None:
        if isinstance(values, JointCommand):
            moving = values.position_target, values.velocity_target
        else:
            moving = values.position, values.velocity
        data = JOINT_STATE.encode(*self._wall(stamp_ns), "", names, *moving, values.effort)
        self._add(topic, stamp_ns, data)

    def _wall(self, stamp_ns: int) -> tuple[int, int]:
        """Return seconds and nanoseconds of the wall clock at a host stamp."""
        return divmod(max(stamp_ns, 0) + self._wall_minus_host_ns, 10**9)

    def _add_command(
        self, topic: str, standard: str, record: CycleRecord, command: JointCommand | None
    ) -> None:
        if command is None:
            return
        stamp_ns = record.sent_ns if record.sent_ns >= 0 else record.start_ns
        data = COMMAND.encode(stamp_ns, record.cycle, record.sent_sequence, *_command_of(command))
        self._add(topic, stamp_ns, data, record.cycle)
        self._add_joints(standard, stamp_ns, self._actuated, command)

    def _add(self, topic: str, stamp_ns: int, data: bytes, sequence: int = 0) -> None:
        if topic not in self._channels:
            kind = message_type(topic)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind.name])
        self._wait_since(self._clock.now_ns())
        wall_ns = max(stamp_ns, 0) + self._wall_minus_host_ns
        self._writer.add_message(self._channels[topic], wall_ns, data, wall_ns, sequence & 0xFFFFFFFF)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        self.close()


class _PackedIndex:
    """The index of the chunks, kept as bytes of the file, 0.2 KiB for each chunk; mcap's Writer fills it."""

    def __init__(self) -> None:
        self._data = RecordBuilder()

    def append(self, entry: ChunkIndex) -> None:
        entry.write(self._data)

    def __iter__(self) -> Iterator[Self]:
        yield self

    def write(self, summary: RecordBuilder) -> None:
        summary.write(self._data.end())


class _ChunkFile:
    """A file that grows by whole flushes, so that it can always be cut at the end of the last one."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._buffer = bytearray()
        self._flushed = [0]

    def write(self, data: bytes) -> int:
        self._buffer += data
        return len(data)

    def tell(self) -> int:
        return self._flushed[-1] + len(self._buffer)

    def flush(self) -> None:
        if not self._buffer:
            return
        left = memoryview(bytes(self._buffer))
        while left:
            left = left[os.write(self._descriptor, left) :]
        self._flushed.append(self.tell())
        self._buffer.clear()

    def close(self) -> None:
        os.fsync(self._descriptor)
        os.close(self._descriptor)

    def seal(self) -> None:
        """Cut the rest of a failed flush and end the file properly; on a full disk drop the last chunks."""
        end = _ending()
        for size in self._flushed[:0:-1]:
            try:
                os.ftruncate(self._descriptor, size)
                if os.pwrite(self._descriptor, end, size) == len(end):
                    break
                os.ftruncate(self._descriptor, size)
            except OSError:
                continue  # Without an ending the file is complete up to here, and repair can read it.
        os.close(self._descriptor)


def _ending() -> bytes:
    """Bytes that end an MCAP file without a summary."""
    builder = RecordBuilder()
    DataEnd(0).write(builder)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    return bytes(builder.end()) + MCAP0_MAGIC
