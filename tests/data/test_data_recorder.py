"""Writing an episode and reading it back, value for value."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from deal_hw.clock import VirtualClock
from deal_hw.data.recording import recorder as recorder_module
from deal_hw.data.recording.mcap_scan import FoundRecord, messages, scan
from deal_hw.data.recording.reader import read_episode, read_trajectory, read_wire
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.data.recording.repair import repair, verify
from deal_hw.data.recording.schemas import CHANNELS, FIRST_CHANNELS, OLD_TOPICS, STANDARD
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError, EmptyRecordingError, TornRecordingError
from deal_hw.transport import Message
from deal_hw.types import BodyState

CYCLES = 150
MakeCycle = Callable[[int], CycleRecord]
WriteEpisode = Callable[..., Path]


def test_samples_come_back(write_episode: WriteEpisode) -> None:
    """600 samples: times, kinematics, status and the command in force are those that were recorded."""
    trajectory = read_trajectory(write_episode(cycles=CYCLES))
    sample = np.arange(4 * CYCLES)
    assert trajectory.joint_names == ("cart", "pole")
    assert trajectory.actuated == ("cart",)
    np.testing.assert_allclose(trajectory.receive_s, 0.005 * sample, atol=1e-12)
    np.testing.assert_allclose(trajectory.device_s, 0.005 * sample, atol=1e-12)
    np.testing.assert_array_equal(
        trajectory.position, np.stack([1e-3 * sample, 0.01 * (sample % 50)], axis=1)
    )
    np.testing.assert_array_equal(trajectory.effort[:, 0], 0.5 * sample)
    np.testing.assert_array_equal(trajectory.velocity[:, 1], np.where(sample % 100 < 50, -0.2, 0.2))
    np.testing.assert_array_equal(trajectory.status, np.full(4 * CYCLES, 3))
    np.testing.assert_array_equal(trajectory.command_sequence, sample // 4 - 1)
    age = np.where(sample < 4, np.nan, 0.001 + 0.005 * (sample % 4))
    np.testing.assert_allclose(trajectory.command_age_s, age, atol=1e-12)
    assert trajectory.position.flags.c_contiguous


def test_a_topic_by_its_former_name_is_read(
    make_cycle: MakeCycle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the policy requests was recorded on /command/asked until November 2026."""
    former = {new: old for old, new in OLD_TOPICS.items()}
    channels: dict[str, Any] = {former.get(topic, topic): kind for topic, kind in CHANNELS.items()}
    add = EpisodeRecorder._add_command
    monkeypatch.setattr(recorder_module, "CHANNELS", channels)
    monkeypatch.setattr(
        EpisodeRecorder,
        "_add_command",
        lambda self, topic, *rest: add(self, former.get(topic, topic) or topic, *rest),
    )
    path = tmp_path / "former.mcap"
    with EpisodeRecorder(path, DESCRIPTION.to_json(), {"purpose": "test"}, VirtualClock()) as recorder:
        for number in range(5):
            recorder.write(make_cycle(number))
    monkeypatch.undo()
    with open(path, "rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert "/command/asked" in topics and "/command/requested" not in topics
    np.testing.assert_array_equal(read_trajectory(path).requested_position[:, 0], 0.1 + 1e-3 * np.arange(5))


def test_commands_asked_and_sent_come_back(write_episode: WriteEpisode) -> None:
    """Asked 0.1 + n mm, sent 0.09 + n mm, 19 ms into each cycle; the first sample came at 0.4 ms."""
    trajectory = read_trajectory(write_episode(cycles=CYCLES))
    number = np.arange(CYCLES)
    np.testing.assert_array_equal(trajectory.sent_sequence, number)
    np.testing.assert_allclose(trajectory.sent_s, 0.02 * number + 0.019 - 0.0004, atol=1e-12)
    np.testing.assert_array_equal(trajectory.requested_position[:, 0], 0.1 + 1e-3 * number)
    np.testing.assert_array_equal(trajectory.position_target[:, 0], 0.09 + 1e-3 * number)
    for name, value in (("stiffness", 80), ("damping", 8), ("effort_limit", 4), ("speed_limit", 1)):
        np.testing.assert_array_equal(getattr(trajectory, name), np.full((CYCLES, 1), value), err_msg=name)


def test_cycles_events_wire_and_metadata_come_back(write_episode: WriteEpisode) -> None:
    """The rest of an episode is what was recorded, on the time base of the samples."""
    path = write_episode(cycles=CYCLES)
    episode = read_episode(path)
    cycles = episode.cycles
    number = np.arange(CYCLES)
    np.testing.assert_array_equal(cycles.cycle, number)
    np.testing.assert_allclose(cycles.deadline_s, 0.02 * number - 0.0004, atol=1e-12)
    np.testing.assert_allclose(cycles.start_s - cycles.deadline_s, 50e-6, atol=1e-12)
    np.testing.assert_allclose(cycles.state_age_s, 123e-6, atol=1e-12)
    np.testing.assert_array_equal(cycles.action[:, 0], 0.25 * number)
    np.testing.assert_array_equal(cycles.flags, np.full(CYCLES, 2))
    assert cycles.safety_state == ("ACTIVE",) * CYCLES
    (event,) = episode.trajectory.events
    assert (event.kind, event.message, event.data) == ("clipped", "the target was too far", {"joint": "cart"})
    wire = list(read_wire(path))
    assert [message.payload for message in wire if message.channel == "rx"] == [
        bytes([n]) * 40 for n in number
    ]
    assert sum(message.channel == "tx" for message in wire) == CYCLES
    assert episode.metadata == {"purpose": "test"}
    assert episode.trajectory.metadata["lost_frames"] == 0
    assert episode.trajectory.metadata["hand_over_losses"] == 0
    assert episode.description == json.loads(json.dumps(DESCRIPTION.to_json()))
    assert (episode.start_ns, episode.device_start_ns) == (7_000_000_400_000, 3_000_000_000)
    assert episode.anchor_ns == 7_000_000_000_000


def test_mcap_ros2_reads_the_whole_file(write_episode: WriteEpisode) -> None:
    """An independent reader decodes every message by the schemas in the file."""
    path = write_episode(cycles=CYCLES)
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]
    # Per cycle: 4 states, asked, sent, cycle, rx, tx; states and commands once more for other programs; once:
    # the robot and one event, that once more.
    assert len(decoded) == 15 * CYCLES + 3
    states = [message for topic, message in decoded if topic == "/state"]
    assert [state.sequence for state in states] == list(range(4 * CYCLES))
    assert states[10].position == [0.01, 0.1]


WALL_NS = 1_760_000_000_123_456_000


def standard_messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return log time and message of each topic, as another program decodes them."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, raw, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((raw.log_time, message))
    return found


def nanoseconds(stamp: Any) -> int:
    """Return a ROS stamp in ns."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


@pytest.fixture
def with_body(tmp_path: Path, make_cycle: MakeCycle) -> Path:
    """A recording of ten cycles on a known wall clock, with a body that leans by a quarter turn about y."""
    half = np.sqrt(0.5)
    body = BodyState(
        orientation=np.array([half, 0.0, half, 0.0]),
        angular_velocity=np.zeros(3),
        acceleration=np.zeros(3),
        foot_force=np.zeros(4),
        temperature=np.zeros(2),
        lost=np.zeros(2, dtype=np.int64),
        battery=1.0,
        voltage=28.0,
        current=1.0,
        sticks=np.zeros(4),
        buttons=0,
    )
    path = tmp_path / "wall.mcap"
    clock = VirtualClock(7_000_000_000_000)
    with EpisodeRecorder(path, DESCRIPTION.to_json(), {}, clock, wall_ns=lambda: WALL_NS) as recorder:
        for number in range(10):
            cycle = make_cycle(number)
            states = tuple(dataclasses.replace(state, body=body) for state in cycle.states)
            recorder.write(dataclasses.replace(cycle, states=states))
    return path


def test_log_times_are_on_the_wall_clock(with_body: Path) -> None:
    """Every message is logged at the wall time of its host stamp, by one difference for the whole episode."""
    found = standard_messages(with_body)
    shift = WALL_NS - 7_000_000_000_000
    assert [at - message.receive_ns for at, message in found["/state"]] == [shift] * 40
    assert [at - message.stamp_ns for at, message in found["/command"]] == [shift] * 10
    assert [at - message.start_ns for at, message in found["/cycle"]] == [shift] * 10
    assert found["/robot"][0][0] == WALL_NS
    assert read_episode(with_body).wall_utc == "2025-10-09T08:53:20.123456+00:00"


def test_standard_messages_hold_what_ours_hold(with_body: Path) -> None:
    """JointState measured, sent and requested, foxglove.Log and tf, with stamps that are their log times."""
    found = standard_messages(with_body)
    for (at, ours), (their_at, theirs) in zip(found["/state"], found["/joint_states"], strict=True):
        assert at == their_at == nanoseconds(theirs.header.stamp) and theirs.name == ["cart", "pole"]
        for name in ("position", "velocity", "effort"):
            assert getattr(theirs, name) == getattr(ours, name)
    for ours_topic, topic in (
        ("/command", "/joint_commands"),
        ("/command/requested", "/joint_commands/requested"),
    ):
        for (at, ours), (their_at, theirs) in zip(found[ours_topic], found[topic], strict=True):
            assert at == their_at == nanoseconds(theirs.header.stamp) and theirs.name == ["cart"]
            assert theirs.position == ours.position_target and theirs.velocity == ours.velocity_target
    ((at, log),) = found["/log"]
    assert (at, log.level, log.name) == (nanoseconds(log.timestamp), 3, "clipped")
    assert log.message == "the target was too far"
    (transform,) = found["/tf"][0][1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("world", "base")
    turn = transform.transform.rotation
    np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [0, np.sqrt(0.5), 0, np.sqrt(0.5)])
    assert len(found["/tf"]) == 40


def test_recordings_on_the_monotonic_clock_read_alike(
    with_body: Path, make_cycle: MakeCycle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Version 1 logged on the host's clock and had our own messages alone: the same episode comes out."""
    monkeypatch.setattr(recorder_module, "FORMAT_VERSION", 1)
    monkeypatch.setattr(recorder_module, "CHANNELS", dict(list(CHANNELS.items())[:FIRST_CHANNELS]))
    monkeypatch.setattr(EpisodeRecorder, "_add_joints", lambda *_: None)
    add = EpisodeRecorder._add
    monkeypatch.setattr(
        EpisodeRecorder, "_add", lambda self, topic, *rest: topic in STANDARD or add(self, topic, *rest)
    )
    old = tmp_path / "old.mcap"
    clock = VirtualClock(7_000_000_000_000)
    with EpisodeRecorder(old, DESCRIPTION.to_json(), {}, clock, wall_ns=clock.now_ns) as recorder:
        for number in range(10):
            cycle = make_cycle(number)
            recorder.write(dataclasses.replace(cycle, wire=(Message("can0", b"x", cycle.start_ns),)))
    monkeypatch.undo()
    before, after = read_episode(old), read_episode(with_body)
    assert (before.start_ns, before.device_start_ns) == (after.start_ns, after.device_start_ns)
    for name in ("receive_s", "device_s", "position", "position_target", "sent_s", "command_age_s"):
        np.testing.assert_array_equal(getattr(before.trajectory, name), getattr(after.trajectory, name))
    # Without the first chunk and the index nothing names /wire/can0, and no other topic takes its place.
    data = bytearray(old.read_bytes())
    chunk = next(i for i in scan(bytes(data)) if isinstance(i, FoundRecord) and i.contents)
    data[chunk.offset + 80] ^= 0x10
    old.write_bytes(data[: len(data) - 4000])
    repair(old)
    assert not set(standard_messages(old)) & set(STANDARD)


def test_missing_cycles_and_frames_are_counted(tmp_path: Path, make_cycle: MakeCycle) -> None:
    """Cycles 5 to 7 never reached the recorder: 3 hand-over losses, and their 12 samples are lost."""
    path = tmp_path / "holes.mcap"
    with EpisodeRecorder(path, DESCRIPTION.to_json(), {}, VirtualClock()) as recorder:
        for number in [*range(5), *range(8, 20)]:
            recorder.write(make_cycle(number))
    metadata = read_trajectory(path).metadata
    assert metadata["hand_over_losses"] == 3
    assert metadata["lost_frames"] == 12


def test_dry_run_has_asked_but_no_sent(tmp_path: Path, make_cycle: MakeCycle) -> None:
    """Where nothing was sent, the trajectory has no command and the cycles keep what was asked."""
    path = tmp_path / "dry.mcap"
    record = make_cycle(0)
    dry = CycleRecord(0, 0, 0, states=record.states, requested=record.requested)
    with EpisodeRecorder(path, DESCRIPTION.to_json(), {}, VirtualClock()) as recorder:
        recorder.write(dry)
    episode = read_episode(path)
    assert episode.trajectory.position_target.shape == (0, 1)
    np.testing.assert_array_equal(episode.cycles.requested_position, [[0.1]])


def test_chunks_close_every_50_ms(write_episode: WriteEpisode) -> None:
    """At 50 Hz no chunk holds more than four cycles (60 ms), even if the recorder is never idle."""
    data = write_episode(cycles=CYCLES).read_bytes()
    chunks = [list(messages(item)) for item in scan(data) if isinstance(item, FoundRecord) and item.contents]
    assert len(chunks) >= CYCLES / 4
    assert max(len(chunk) for chunk in chunks) <= 4 * 15 + 2


def test_a_long_recording_needs_no_more_memory_than_its_index(tmp_path: Path, make_cycle: MakeCycle) -> None:
    """The library keeps less than 0.4 KiB of a chunk (as objects 1.5), and all chunks are in the index."""
    clock = VirtualClock()
    chunks = 600
    with EpisodeRecorder(tmp_path / "long.mcap", DESCRIPTION.to_json(), {}, clock) as recorder:
        for number in range(chunks):
            if number == chunks // 3:
                tracemalloc.start()
            recorder.write(make_cycle(number))
            recorder.flush()
        of_library = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/mcap/*")])
        tracemalloc.stop()
    kept = sum(trace.size for trace in of_library.statistics("filename"))
    assert 0 < kept / (chunks * 2 // 3) < 400
    with open(tmp_path / "long.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and len(summary.chunk_indexes) == chunks + 1
        assert sum(1 for _ in reader.iter_messages(topics=["/cycle"])) == chunks


def test_nothing_to_flush_means_no_deadline(tmp_path: Path, make_cycle: MakeCycle) -> None:
    """A record waits at most 50 ms; without one there is nothing to wait for."""
    clock = VirtualClock()
    with EpisodeRecorder(tmp_path / "a.mcap", DESCRIPTION.to_json(), {}, clock) as recorder:
        assert recorder.due_in_s() is None
        recorder.write(make_cycle(0))
        clock.advance_ns(30_000_000)
        assert recorder.due_in_s() == pytest.approx(0.02)
        clock.advance_ns(25_000_000)
        recorder.flush_if_due()
        assert recorder.due_in_s() is None


def test_a_recording_is_never_overwritten(write_episode: WriteEpisode) -> None:
    """A second recording into the same file is refused."""
    path = write_episode()
    with pytest.raises(DatasetError, match="exists"):
        EpisodeRecorder(path, DESCRIPTION.to_json(), {}, VirtualClock()).open()


@pytest.mark.parametrize("limit", [4_100, 9_000, 30_000])
def test_full_disk_keeps_what_was_written(tmp_path: Path, make_cycle: MakeCycle, limit: int) -> None:
    """Past the limit the recorder gives up with a clear message and leaves a sound file of whole cycles."""
    path = tmp_path / "full.mcap"
    clock = VirtualClock()
    # A fixed wall clock: the digits of its time change the size of the first chunk, 3.95 kB packed.
    recorder = EpisodeRecorder(path, DESCRIPTION.to_json(), {}, clock, wall_ns=lambda: 1_790_000_000 * 10**9)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(
            DatasetError, match=r"stopped after \d+ cycles: File too large.*deal-hw data info"
        ):
            recorder.open()
            for number in range(2000):
                clock.advance_ns(20_000_000)
                recorder.write(make_cycle(number))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.stat().st_size <= limit
    report = verify(path)
    assert report.sound
    recorder.close()
    if limit >= 9_000:
        trajectory = read_trajectory(path)
        np.testing.assert_array_equal(trajectory.effort[:, 0], 0.5 * np.arange(trajectory.effort.shape[0]))


def test_unwritable_folder_is_said(tmp_path: Path) -> None:
    """A path below a file cannot be created; the message names it."""
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / "a.mcap"
    with pytest.raises(DatasetError, match=f"{path} cannot be created"):
        EpisodeRecorder(path, DESCRIPTION.to_json(), {}, VirtualClock()).open()


def test_unusable_files_are_told_apart(tmp_path: Path, write_episode: WriteEpisode) -> None:
    """Absent, empty, foreign, torn and silent recordings each get their own error."""
    with pytest.raises(DatasetError, match="there is no such file"):
        read_trajectory(tmp_path / "absent.mcap")
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(EmptyRecordingError, match="0 bytes"):
        read_trajectory(tmp_path / "empty.mcap")
    (tmp_path / "foreign.mcap").write_text("time,position\n0,0\n")
    with pytest.raises(DatasetError, match="not an MCAP file"):
        read_trajectory(tmp_path / "foreign.mcap")
    torn = write_episode("torn.mcap", torn=True)
    with pytest.raises(TornRecordingError, match=f"deal-hw data repair {torn}"):
        read_trajectory(torn)
    with pytest.raises(EmptyRecordingError, match="no state sample"):
        read_trajectory(write_episode("silent.mcap", cycles=0))


def test_recorder_leaves_no_descriptor_open(tmp_path: Path, make_cycle: MakeCycle) -> None:
    """After close, and after a second close, the process has as many descriptors as before."""
    before = len(os.listdir("/proc/self/fd"))
    with EpisodeRecorder(tmp_path / "a.mcap", DESCRIPTION.to_json(), {}, VirtualClock()) as recorder:
        recorder.write(make_cycle(0))
    recorder.close()
    assert len(os.listdir("/proc/self/fd")) == before
