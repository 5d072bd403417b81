"""What a robot with legs senses of its body, from the recorder to arrays and back out of torn files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Chunk
from mcap_ros2.decoder import DecoderFactory

from deal_hw.clock import VirtualClock
from deal_hw.data.recording import recorder as recorder_module
from deal_hw.data.recording.mcap_scan import FoundRecord, messages, scan
from deal_hw.data.recording.reader import read_episode, read_trajectory
from deal_hw.data.recording.record import CycleRecord, decode, encode
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.data.recording.repair import repair, verify
from deal_hw.data.recording.schemas import CHANNELS
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.types import BodyState, BodyTrajectory, RobotState, Status, Trajectory

STATES_EACH = 10
"""States of a cycle: 500 Hz at 50 cycles a second."""
CYCLES = 30
CYCLE_NS = 20_000_000
START_NS = 7_000_000_000_000


def body(sample: int) -> BodyState:
    """Sample n: every number is another, and linear in n."""
    base = 1e-3 * sample
    return BodyState(
        orientation=np.array([1.0, 2.0, 3.0, 4.0]) + base,
        angular_velocity=np.array([5.0, 6.0, 7.0]) + base,
        acceleration=np.array([8.0, 9.0, 10.0]) + base,
        foot_force=np.arange(4.0) + 100.0 + sample,
        temperature=np.arange(12.0) + 30.0 + base,
        lost=np.arange(12) + sample,
        battery=0.25 + 1e-4 * sample,
        voltage=29.5 + base,
        current=1.5 - base,
        sticks=np.array([-1.0, -0.5, 0.5, 1.0]) * base,
        buttons=-1 if sample % 7 == 0 else 0xFFFF - sample,
    )


def state(sample: int, with_body: bool = True) -> RobotState:
    joints = np.arange(12.0) + 1e-3 * sample
    stamp_ns = sample * (CYCLE_NS // STATES_EACH)
    return RobotState(
        joints,
        -joints,
        2 * joints,
        START_NS + stamp_ns + 400_000,
        stamp_ns,
        sample,
        -1,
        -1,
        Status.ARMED,
        body(sample) if with_body else None,
    )


def cycle(number: int, with_body: bool = True) -> CycleRecord:
    first = number * STATES_EACH
    start_ns = START_NS + number * CYCLE_NS
    states = tuple(state(first + i, with_body) for i in range(STATES_EACH))
    return CycleRecord(number, start_ns, start_ns, states=states)


Bodies = Callable[[int], bool]


def everywhere(number: int) -> bool:
    """Every cycle's states have a body."""
    return True


def nowhere(number: int) -> bool:
    """No cycle's states have one."""
    return False


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that records cycles as the recorder process does, datagram by datagram."""

    def make(bodies: Bodies = everywhere, *, torn: bool = False) -> Path:
        path = tmp_path / "episode.mcap"
        clock = VirtualClock(START_NS)
        recorder = EpisodeRecorder(path, DRIVER.to_json(), {"purpose": "test"}, clock)
        recorder.open()
        for number in range(CYCLES):
            clock.sleep_until_ns(START_NS + (number + 1) * CYCLE_NS)
            recorder.write(decode(encode(cycle(number, bodies(number)))))
        whole = path.read_bytes()
        recorder.close()
        if torn:
            path.write_bytes(whole)
        return path

    return make


def sensed(trajectory: Trajectory) -> BodyTrajectory:
    """Return the body of a recording that has one."""
    if trajectory.body is None:
        raise AssertionError("the recording has no body")
    return trajectory.body


def assert_rows(got: BodyTrajectory, samples: np.ndarray[tuple[int], np.dtype[np.int64]]) -> None:
    """Check that the first rows are those of these samples, number for number."""
    wanted = [body(int(n)) for n in samples]
    for field in dataclasses.fields(BodyTrajectory):
        values = np.array([getattr(b, field.name) for b in wanted])
        np.testing.assert_array_equal(getattr(got, field.name)[: len(samples)], values, err_msg=field.name)


def test_the_body_comes_back_number_for_number(write: Callable[..., Path]) -> None:
    """300 samples through datagram, file and reader; shapes as documented, buttons and -1 for no remote."""
    got = sensed(read_trajectory(write()))
    T = CYCLES * STATES_EACH
    assert_rows(got, np.arange(T))
    shapes = {field.name: getattr(got, field.name).shape for field in dataclasses.fields(BodyTrajectory)}
    assert shapes == {
        "orientation": (T, 4),
        "angular_velocity": (T, 3),
        "acceleration": (T, 3),
        "foot_force": (T, 4),
        "temperature": (T, 12),
        "lost": (T, 12),
        "battery": (T,),
        "voltage": (T,),
        "current": (T,),
        "sticks": (T, 4),
        "buttons": (T,),
    }
    assert got.buttons.dtype == np.int64


def test_samples_without_a_body_are_nan(write: Callable[..., Path]) -> None:
    """From cycle 20 on nothing is sensed: NaN, and -1 for the buttons; the rows before are untouched."""
    trajectory = read_trajectory(write(lambda number: number < 20))
    got = sensed(trajectory)
    assert_rows(got, np.arange(20 * STATES_EACH))
    for field in dataclasses.fields(BodyTrajectory):
        values = getattr(got, field.name)[20 * STATES_EACH :]
        assert len(values) == 10 * STATES_EACH
        assert (values == -1).all() if field.name == "buttons" else np.isnan(values).all(), field.name
    assert np.isfinite(trajectory.position).all()


def test_a_body_that_begins_late_is_found_by_stamp_and_number(write: Callable[..., Path]) -> None:
    """The body of sample 50 belongs to sample 50 although it is the first on its channel."""
    got = sensed(read_trajectory(write(lambda number: number >= 5)))
    assert np.isnan(got.voltage[:50]).all()
    assert got.voltage[50] == pytest.approx(29.55)
    assert (got.buttons[:50] == -1).all()


def test_a_robot_without_a_body_has_none(write: Callable[..., Path]) -> None:
    """The channel is declared and empty."""
    assert read_trajectory(write(nowhere)).body is None


def test_recordings_from_before_the_channel_still_read(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that does not know /body reads as ever, and so does its repair."""
    older = {topic: kind for topic, kind in CHANNELS.items() if topic != "/body"}
    monkeypatch.setattr(recorder_module, "CHANNELS", older)
    path = write(nowhere, torn=True)
    monkeypatch.undo()
    found = [item for item in scan(path.read_bytes()) if isinstance(item, FoundRecord)]
    topics = {r.topic for item in found for r in item.contents if isinstance(r, Channel)}
    assert topics == set(older)
    assert repair(path).repaired
    trajectory = read_trajectory(path)
    assert trajectory.body is None
    assert trajectory.position.shape[1] == 12


def test_mcap_ros2_decodes_the_body(write: Callable[..., Path]) -> None:
    """An independent reader gets the same numbers from the schema in the file."""
    with open(write(), "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [message for _, _, _, message in reader.iter_decoded_messages(topics=["/body"])]
    assert [message.sequence for message in decoded] == list(range(CYCLES * STATES_EACH))
    wanted, got = body(13), decoded[13]
    assert got.receive_ns == START_NS + 13 * 2_000_000 + 400_000
    for name in ("orientation", "angular_velocity", "acceleration", "foot_force", "temperature", "sticks"):
        assert list(getattr(got, name)) == getattr(wanted, name).tolist(), name
    assert list(got.lost) == wanted.lost.tolist()
    assert (got.battery, got.voltage, got.current) == (wanted.battery, wanted.voltage, wanted.current)
    assert got.buttons == 0xFFFF - 13


def test_the_body_is_the_last_channel() -> None:
    """Repair names channels by their number: what was added later must not move those before."""
    topics = list(CHANNELS)
    assert topics[:8] == [
        "/robot",
        "/state",
        "/command",
        "/command/requested",
        "/cycle",
        "/events",
        "/wire/rx",
        "/wire/tx",
    ]
    assert topics[8] == "/body"


@pytest.mark.parametrize("damaged", [False, True], ids=["torn", "torn and without the names"])
def test_a_torn_file_keeps_its_bodies(write: Callable[..., Path], damaged: bool) -> None:
    """Also where the chunk that names the channels is gone, and the reader must not mix them up."""
    path = write(torn=True)
    if damaged:
        damage_first_chunk(path)
    report = repair(path)
    assert report.repaired and report.torn and bool(report.damaged) is damaged
    assert verify(path).sound
    episode = read_episode(path)
    samples = episode.sequence
    assert len(samples) >= (CYCLES - 6) * STATES_EACH
    got = sensed(episode.trajectory)
    assert np.isfinite(got.orientation).all()
    assert_rows(got, samples)


def damage_first_chunk(path: Path) -> None:
    """Flip a bit in the chunk that names the channels."""
    data = bytearray(path.read_bytes())
    chunks = [i for i in scan(bytes(data)) if isinstance(i, FoundRecord) and isinstance(i.record, Chunk)]
    assert any(isinstance(record, Channel) for record in chunks[0].contents)
    assert sum(1 for _ in messages(chunks[0])) >= 1
    data[chunks[0].offset + 80] ^= 0x10
    path.write_bytes(data)
