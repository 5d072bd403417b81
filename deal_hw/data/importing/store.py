"""Writes imported recordings as a dataset of deal-hw: the same files that `deal-hw collect` writes."""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.clock import VirtualClock
from deal_hw.data.importing.channels import digest_of_file
from deal_hw.data.importing.grid import Recording
from deal_hw.data.recording.dataset import Dataset, Notify
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.types import BodyState, BodyTrajectory, JointCommand, RobotState, Status, Trajectory

START_NS = 1_000_000_000_000
"""Start of the clocks of an imported episode, whose own clock has no meaning here [ns]."""


def write_dataset(
    folder: Path,
    recordings: Sequence[Recording],
    description: RobotDescription | Mapping[str, Any],
    facts: Sequence[Mapping[str, Any]] | None = None,
    notify: Notify = print,
    episodes: Sequence[Path] = (),
) -> Dataset:
    """Write recordings as the episodes of a dataset and return it, closed.

    Args:
        folder: The dataset; made if missing.
        recordings: On one grid, with the description's joints.
        description: Of the robot, or its plain JSON values.
        facts: Plain JSON values to keep with each episode, those of ``episodes`` first.
        notify: Called with a sentence for each repair.
        episodes: Our own episodes of the same robot, to copy unchanged.

    Raises:
        DatasetError: It belongs to another robot, or cannot be written.
        ConfigurationError: The recordings' joints are not the description's.
    """
    values = description.to_json() if isinstance(description, RobotDescription) else dict(description)
    for recording in recordings:
        has, wants = recording.trajectory.joint_names, tuple(values["joint_names"])
        if has != wants or recording.trajectory.actuated != tuple(values["actuated"]):
            raise ConfigurationError(
                f"the recording has the joints {', '.join(has)} (commands: "
                f"{', '.join(recording.trajectory.actuated)}), but the description {', '.join(wants)} "
                f"(commands: {', '.join(values['actuated'])}); correct the column map"
            )
    noted = iter(facts or [{}] * (len(episodes) + len(recordings)))
    with Dataset.create_or_open(folder, values, notify) as dataset:
        for episode in episodes:
            path = dataset.next_episode_path()
            shutil.copyfile(episode, path)
            dataset.note_episode(path, next(noted))
        for recording in recordings:
            path = dataset.next_episode_path()
            write_episode(path, recording.trajectory, values)
            dataset.note_episode(path, next(noted))
    return dataset


def write_episode(path: Path, trajectory: Trajectory, description: Mapping[str, Any]) -> None:
    """Write a trajectory as an episode file, with one control cycle per command."""
    metadata = {key: value for key, value in trajectory.metadata.items() if key != "description"}
    clock = VirtualClock(START_NS)
    sent_ns = START_NS + np.round(trajectory.sent_s * 1e9).astype(np.int64)
    device_ns = START_NS + np.round(trajectory.device_s * 1e9).astype(np.int64)
    # A state belongs to the first cycle with a command sent at or after it; the last cycle gets the rest.
    cycle = np.searchsorted(sent_ns, device_ns, side="left")
    begin = np.searchsorted(cycle, np.arange(sent_ns.size + 2))
    number = _numbers(trajectory)
    with EpisodeRecorder(path, description, metadata, clock) as recorder:
        for index in range(sent_ns.size + 1):
            states = tuple(
                _state(trajectory, row, int(device_ns[row]), int(number[row]))
                for row in range(int(begin[index]), int(begin[index + 1]))
            )
            last = index == sent_ns.size
            if last and not states:
                continue
            stamp_ns = states[-1].receive_ns if last else int(sent_ns[index])
            command = None if last else _command(trajectory, index)
            sequence = -1 if last else int(trajectory.sent_sequence[index])
            clock.sleep_until_ns(max(stamp_ns, clock.now_ns()))
            recorder.write(
                CycleRecord(
                    cycle=index,
                    deadline_ns=stamp_ns,
                    start_ns=stamp_ns,
                    states=states,
                    requested=command,
                    sent=command,
                    sent_sequence=sequence,
                    sent_ns=-1 if last else stamp_ns,
                    safety_state="IMPORTED",
                )
            )


def minimal_description(
    recordings: Sequence[Recording],
    name: str,
    units: Sequence[str],
    rate_hz: float,
    mjcf: Path | None = None,
    rates_per_sample: int = 1,
) -> dict[str, Any]:
    """Return a description of a robot from its recordings alone, as plain JSON values.

    It has the entries of ``RobotDescription.to_json()``; unknown values are NaN, unknown limits infinite.

    Args:
        recordings: Its recordings.
        name: Its name.
        units: Unit of each position, (J,).
        rate_hz: Sampling rate of the recordings' grid.
        mjcf: Its model, or None.
        rates_per_sample: Device periods between two samples, 1 or more.
    """
    if not recordings:
        raise ConfigurationError("no recording to describe the robot by")
    first = recordings[0].trajectory
    J, A = len(first.joint_names), len(first.actuated)
    unknown, free = (math.nan,) * A, (math.inf,) * A
    return {
        "name": name,
        "joint_names": list(first.joint_names),
        "actuated": list(first.actuated),
        "position_units": list(units),
        "default_position": [0.0] * J,
        "stiffness": list(unknown),
        "damping": list(unknown),
        "effort_limit": list(free),
        "speed_limit": list(free),
        "control_rate_hz": rate_hz,
        "device_rate_hz": rate_hz * rates_per_sample,
        "state_rate_hz": rate_hz,
        "limits": {
            "target": [[-math.inf, math.inf]] * A,
            "target_step": list(free),
            "target_distance": list(free),
            "trip_position": [[-math.inf, math.inf]] * J,
            "trip_velocity": [math.inf] * J,
            "stiffness": list(free),
            "damping": list(free),
            "effort": list(free),
            "speed": list(free),
            "state_age_s": math.inf,
            "action_age_s": math.inf,
            "ease_in_s": 0.0,
        },
        "sensor": {"noise": [0.0] * J, "resolution": [0.0] * J, "velocity_window_s": 0.0},
        "mjcf": "" if mjcf is None else digest_of_file(mjcf),
        "sources": {"joint_names": "the column map", "state_rate_hz": "the recordings' own stamps"},
    }


def _numbers(trajectory: Trajectory) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the number of each sample on the grid, (T,); lost samples leave gaps in the numbers."""
    period = trajectory.metadata.get("import", {}).get("period_s")
    if not period:
        return np.arange(trajectory.device_s.size)
    return np.asarray(np.round(trajectory.device_s / float(period)).astype(np.int64))


def _state(trajectory: Trajectory, row: int, stamp_ns: int, number: int) -> RobotState:
    sequence, age_s = int(trajectory.command_sequence[row]), float(trajectory.command_age_s[row])
    return RobotState(
        position=trajectory.position[row],
        velocity=trajectory.velocity[row],
        effort=trajectory.effort[row],
        receive_ns=stamp_ns,
        device_ns=stamp_ns,
        sequence=number,
        command_sequence=sequence,
        command_age_ns=round(age_s * 1e9) if sequence >= 0 else -1,
        status=Status(int(trajectory.status[row])),
        body=None if trajectory.body is None else _body(trajectory.body, row),
    )


def _body(body: BodyTrajectory, row: int) -> BodyState:
    values = {entry.name: getattr(body, entry.name)[row] for entry in dataclasses.fields(body)}
    return BodyState(**{**values, "lost": values["lost"].astype(np.int64)})


def _command(trajectory: Trajectory, index: int) -> JointCommand:
    target = trajectory.position_target[index]
    return JointCommand(
        position_target=target,
        velocity_target=np.zeros_like(target),
        stiffness=trajectory.stiffness[index],
        damping=trajectory.damping[index],
        effort=np.zeros_like(target),
        effort_limit=trajectory.effort_limit[index],
        speed_limit=trajectory.speed_limit[index],
    )
