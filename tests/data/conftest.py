"""Recordings of known content for the data tests."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.data.table import Table
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.transport import Message
from deal_hw.types import Event, FloatArray, JointCommand, RobotState, Status, Trajectory

MakeCycle = Callable[[int], CycleRecord]
WriteEpisode = Callable[..., Path]

HOST_START_NS = 7_000_000_000_000
DEVICE_START_NS = 3_000_000_000
CYCLE_NS = 20_000_000


def _cycle(number: int) -> CycleRecord:
    """Cycle n: four samples 5 ms apart, values linear in their number; asked 0.1 + n mm, sent 0.09 + n mm."""
    start_ns = HOST_START_NS + number * CYCLE_NS

    def state(sample: int) -> RobotState:
        return RobotState(
            position=np.array([1e-3 * sample, 0.01 * (sample % 50)]),
            velocity=np.array([0.2, -0.2 if sample % 100 < 50 else 0.2]),
            effort=np.array([0.5 * sample, 0.0]),
            receive_ns=HOST_START_NS + sample * 5_000_000 + 400_000,
            device_ns=DEVICE_START_NS + sample * 5_000_000,
            sequence=sample,
            command_sequence=number - 1,
            command_age_ns=1_000_000 + (sample % 4) * 5_000_000 if number else -1,
            status=Status.ARMED | Status.HOMED,
        )

    def command(target: float) -> JointCommand:
        return JointCommand(*(np.array([value]) for value in (target, 0.0, 80.0, 8.0, 0.0, 4.0, 1.0)))

    states = tuple(state(4 * number + i) for i in range(4))
    return CycleRecord(
        cycle=number,
        deadline_ns=start_ns,
        start_ns=start_ns + 50_000,
        states=states,
        action=np.array([0.25 * number]),
        requested=command(0.1 + 1e-3 * number),
        sent=command(0.09 + 1e-3 * number),
        sent_sequence=number,
        sent_ns=start_ns + 19_000_000,
        state_age_ns=123_000,
        safety_state="ACTIVE",
        flags=2,
        events=(Event(start_ns, "clipped", "the target was too far", {"joint": "cart"}),)
        if number == 3
        else (),
        wire=(Message("rx", bytes([number % 256]) * 40, start_ns), Message("tx", b"\x01\x02", start_ns + 1)),
        lost=0,
    )


@pytest.fixture
def make_cycle() -> MakeCycle:
    """Return a function that makes the n-th cycle of a recording of known content."""
    return _cycle


@pytest.fixture(scope="session")
def recorded_bytes(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], tuple[bytes, bytes]]:
    """Return a function that records cycles in virtual time, once: the file before and after its close."""

    @functools.cache
    def record(cycles: int) -> tuple[bytes, bytes]:
        path = tmp_path_factory.mktemp("recorded") / "episode.mcap"
        clock = VirtualClock(HOST_START_NS)
        recorder = EpisodeRecorder(path, DESCRIPTION.to_json(), {"purpose": "test"}, clock)
        recorder.open()
        for number in range(cycles):
            clock.sleep_until_ns(HOST_START_NS + (number + 1) * CYCLE_NS)
            recorder.write(_cycle(number))
        unfinished = path.read_bytes()
        recorder.close()
        return unfinished, path.read_bytes()

    return record


@pytest.fixture
def write_episode(tmp_path: Path, recorded_bytes: Callable[[int], tuple[bytes, bytes]]) -> WriteEpisode:
    """Return a function that writes recorded cycles to a file; ``torn`` leaves it as a kill would."""

    def write(name: str = "episode.mcap", cycles: int = 150, torn: bool = False) -> Path:
        unfinished, whole = recorded_bytes(cycles)
        (tmp_path / name).write_bytes(unfinished if torn else whole)
        return tmp_path / name

    return write


@pytest.fixture
def make_trajectory() -> Callable[..., Trajectory]:
    """Return a function that makes a sound 4 s trajectory at 200 Hz; keywords replace fields."""

    def make(**changes: object) -> Trajectory:
        samples, commands = 800, 200
        time_s = np.arange(samples) * 0.005
        sent_s = np.arange(commands) * 0.02
        in_force = np.floor((time_s - 0.001) / 0.02).astype(np.int64)
        target = 0.1 * np.sign(np.sin(2 * np.pi * sent_s))[:, None]
        fields: dict[str, object] = {
            "joint_names": ("cart", "pole"),
            "actuated": ("cart",),
            "receive_s": time_s + 0.0004,
            "device_s": time_s,
            "position": np.stack([0.1 * np.sin(6 * time_s), np.cos(5 * time_s)], axis=1),
            "velocity": np.stack([0.6 * np.cos(6 * time_s), -5 * np.sin(5 * time_s)], axis=1),
            "effort": np.zeros((samples, 2)),
            "status": np.full(samples, int(Status.ARMED)),
            "command_sequence": in_force,
            "command_age_s": np.where(in_force >= 0, time_s - 0.02 * in_force - 0.001, np.nan),
            "sent_s": sent_s,
            "sent_sequence": np.arange(commands),
            "requested_position": target,
            "position_target": target,
            "stiffness": np.full((commands, 1), 80.0),
            "damping": np.full((commands, 1), 8.0),
            "effort_limit": np.full((commands, 1), 4.0),
            "speed_limit": np.full((commands, 1), 1.0),
            "metadata": {"description": DESCRIPTION.to_json()},
        }
        return Trajectory(**{**fields, **changes})  # type: ignore[arg-type]

    return make


@pytest.fixture
def make_table() -> Callable[..., Table]:
    """Return a function that makes a sound 12 s recording at 100 Hz; keywords replace fields.

    Three joints follow sums of sines of their own with a lag of 30 ms; commands have the samples' stamps.
    """

    def make(**changes: object) -> Table:
        time_s = np.arange(1200, dtype=np.float64) * 0.01
        frequency = np.array([[0.31, 1.13], [0.47, 1.51], [0.23, 0.89]])
        size = np.array([[0.4, 0.2], [0.3, 0.25], [0.5, 0.15]])

        def motion(at: FloatArray) -> FloatArray:
            waves = size[:, None] * np.sin(2 * np.pi * frequency[:, None] * at[None, :, None])
            return np.asarray(waves.sum(axis=2).T)

        fields: dict[str, object] = {
            "joint_names": ("hip", "knee", "foot"),
            "actuated": ("hip", "knee", "foot"),
            "units": ("rad", "rad", "rad"),
            "time_s": time_s,
            "position": 0.98 * motion(time_s - 0.03),
            "velocity": None,
            "effort": None,
            "command_s": time_s,
            "target": motion(time_s),
            "orientation": None,
            "gyro": None,
            "source": {"file": "rec.csv", "part": "", "kind": "csv", "sha256": "0" * 64},
        }
        return Table(**{**fields, **changes})  # type: ignore[arg-type]

    return make
