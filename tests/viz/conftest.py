"""One simulated recording, with predictions and a calibration result beside it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calibration import CalibrationResult
from deal_hw.clock import VirtualClock
from deal_hw.data.recording.reader import CycleTable
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.findings import Finding
from deal_hw.sim.recordings.overlay import Overlay, compute_overlay
from deal_hw.types import Event, JointCommand, RobotState, Status, Trajectory
from deal_hw.viz.episode_log import write_episode

HOST_START_NS = 5_000_000_000_000
LATENCY_S = 0.008


@dataclass(frozen=True)
class Shown:
    """What went into a recording of the viewer."""

    trajectory: Trajectory
    cycles: CycleTable
    overlay: Overlay
    result: CalibrationResult
    rrd: Path


@pytest.fixture(scope="session")
def result() -> CalibrationResult:
    """A calibration result with one weak parameter, an alarm and a null direction."""
    space = k9_space()
    estimate = space.nominal * np.linspace(0.6, 1.5, len(space))
    return CalibrationResult(
        method="deal",
        space=space,
        estimate=estimate,
        interval=np.stack([0.9 * estimate, 1.1 * estimate], axis=1),
        verdicts=tuple("identifiable" if number else "weak" for number in range(len(space))),
        null_directions=("all masses together",),
        latency_s=LATENCY_S,
        latency_interval_s=(0.007, 0.009),
        alarms=(Finding.alarm("backlash of 2 mm", "play in the gear", "mend it"),),
    )


@pytest.fixture(scope="session")
def trajectory(result: CalibrationResult) -> Trajectory:
    """Two seconds of a robot whose truth is the calibration's estimate."""
    made = simulated_episode(DESCRIPTION, result.space, result.estimate, seconds=2.0, latency_ticks=8)
    status = made.status.copy()
    status[100:120] |= int(Status.SPEED_CLAMPED)
    events = (
        Event(HOST_START_NS, "armed", "the motors follow commands"),
        Event(HOST_START_NS + 1_500_000_000, "passive", "operator stop"),
    )
    metadata = {**made.metadata, "start_ns": HOST_START_NS}
    # The clocks differ: the host's runs 0.01 % fast and a sample takes 0.3 ms to arrive.
    return dataclasses.replace(
        made,
        status=status,
        events=events,
        metadata=metadata,
        receive_s=1.0001 * made.device_s + 0.3e-3,
        sent_s=1.0001 * made.sent_s,
    )


@pytest.fixture(scope="session")
def shown(
    tmp_path_factory: pytest.TempPathFactory, trajectory: Trajectory, result: CalibrationResult
) -> Shown:
    """The recording, written once for all tests that read it back."""
    sets = {"nominal": result.space.nominal, "calibrated": result.estimate}
    overlay = compute_overlay(
        trajectory, DESCRIPTION, result.space, sets, latency_s=LATENCY_S, smoothing_s=0.0
    )
    start_s = np.arange(100, dtype=np.float64) * 0.02
    cycles = CycleTable(
        cycle=np.arange(100),
        deadline_s=start_s,
        start_s=start_s + 0.0002,
        state_age_s=np.full(100, 0.0011),
        flags=np.zeros(100, dtype=np.int64),
        lost=np.zeros(100, dtype=np.int64),
        safety_state=("active",) * 75 + ("passive",) * 25,
        action=np.zeros((100, 1)),
        requested_position=np.zeros((100, 1)),
    )
    rrd = tmp_path_factory.mktemp("viz") / "episode.rrd"
    verdict = "**amber:** look at it"
    write_episode(
        rrd,
        trajectory,
        DESCRIPTION,
        cycles=cycles,
        overlay=overlay,
        result=result,
        verdict=verdict,
        name="shown",
    )
    return Shown(trajectory, cycles, overlay, result, rrd)


@pytest.fixture(scope="session")
def episode_file(tmp_path_factory: pytest.TempPathFactory, trajectory: Trajectory) -> Path:
    """The trajectory as the recorder writes it."""
    return record(tmp_path_factory.mktemp("dataset") / "episodes" / "000000.mcap", trajectory)


def record(path: Path, trajectory: Trajectory) -> Path:
    """Write a trajectory through the recorder, one cycle for each command."""
    clock = VirtualClock(HOST_START_NS)
    path.parent.mkdir(parents=True, exist_ok=True)
    with EpisodeRecorder(
        path, DESCRIPTION.to_json(), {"robot": "cartpole", "purpose": "collect"}, clock
    ) as recorder:
        edges = np.searchsorted(trajectory.receive_s, [*trajectory.sent_s, np.inf])
        for number, sequence in enumerate(trajectory.sent_sequence):
            first = 0 if number == 0 else edges[number]
            sent_ns = HOST_START_NS + round(trajectory.sent_s[number] * 1e9)
            clock.sleep_until_ns(sent_ns)
            command = _command(trajectory, number)
            recorder.write(
                CycleRecord(
                    cycle=number,
                    deadline_ns=sent_ns,
                    start_ns=sent_ns,
                    states=tuple(_state(trajectory, i) for i in range(first, edges[number + 1])),
                    requested=command,
                    sent=command,
                    sent_sequence=int(sequence),
                    sent_ns=sent_ns,
                    state_age_ns=1_000_000,
                    safety_state="active",
                    events=tuple(trajectory.events) if number == 0 else (),
                )
            )
    return path


def _command(trajectory: Trajectory, i: int) -> JointCommand:
    zeros = np.zeros(1)
    return JointCommand(
        trajectory.position_target[i],
        zeros,
        trajectory.stiffness[i],
        trajectory.damping[i],
        zeros,
        trajectory.effort_limit[i],
        trajectory.speed_limit[i],
    )


def _state(trajectory: Trajectory, i: int) -> RobotState:
    age_s: Any = trajectory.command_age_s[i]
    return RobotState(
        position=trajectory.position[i],
        velocity=trajectory.velocity[i],
        effort=trajectory.effort[i],
        receive_ns=HOST_START_NS + round(trajectory.receive_s[i] * 1e9),
        device_ns=round(trajectory.device_s[i] * 1e9),
        sequence=i,
        command_sequence=int(trajectory.command_sequence[i]),
        command_age_ns=-1 if np.isnan(age_s) else round(age_s * 1e9),
        status=Status(int(trajectory.status[i])),
    )
