"""What the calibrated MJCF for MuJoCo alone has of the laws, and how far its motion is from theirs."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np

from deal_hw.calibration import percent
from deal_hw.errors import ConfigurationError
from deal_hw.sim.actuators import ActuatorLaws
from deal_hw.sim.engine.model import RobotModel, command_scale
from deal_hw.sim.mjcf.plain import hold, write_plain_mjcf
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

PLAIN_MODEL = "plain_mujoco.xml"
FACTS = "plain_mujoco"
"""Name of the facts in a result's provenance."""

WINDOWS, WINDOW_S = 12, 1.0
"""Most motions that are compared, spread over the recordings, and the longest of them [s]."""

Motion: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Positions and speeds of the joints, (J,) each, and the commands that follow, (S, nu)."""


def plain_facts(
    robot: RobotModel, write: Callable[[Path], object], episodes: Sequence[SampledEpisode]
) -> dict[str, Any]:
    """Return what the model for MuJoCo alone has and lacks, and its distance from the laws: plain JSON.

    Both are simulated from states of the recordings with their commands, for up to a second. ``difference``
    is the root mean square of what they differ by, over the range of the joint's recorded positions, by
    joint; None for a floating base, whose contacts make motions part. ``bristles`` says whether the model has
    friction by speed: only where that brings it nearer to the laws. ``error`` says why there is no model.

    Args:
        robot: The nominal model.
        write: Writes the calibrated MJCF, with its laws in ``<custom>``, to a path.
        episodes: The recordings.
    """
    with tempfile.TemporaryDirectory() as name:
        calibrated, plain = Path(name) / "calibrated.xml", Path(name) / PLAIN_MODEL
        found: list[tuple[float, dict[str, Any]]] = []
        try:
            write(calibrated)
            model = mujoco.MjModel.from_xml_path(str(calibrated))
            motions = [] if robot.base is not None else list(_motions(robot, model, episodes))
            expected = [_with_laws(robot, model, *motion) for motion in motions]
            for bristles in (True, False) if motions else (False,):
                made = write_plain_mjcf(calibrated, plain, bristles=bristles)
                apart = None
                if motions:
                    moved = _alone(robot, plain, command_scale(model, range(model.nu)), motions)
                    apart = _apart(robot, np.concatenate(moved) - np.concatenate(expected), episodes)
                facts = {"has": list(made.has), "lacks": list(made.lacks), "bristles": made.bristles}
                mean = float(np.mean(list(apart.values()))) if apart else 0.0
                found.append((np.nan_to_num(mean, nan=np.inf), facts | {"difference": apart}))
                if not made.bristles:
                    break
        except ConfigurationError as err:
            return {"error": str(err)}
        return min(found, key=lambda one: one[0])[1]


def _with_laws(
    robot: RobotModel, calibrated: Any, position: FloatArray, speed: FloatArray, command: FloatArray
) -> FloatArray:
    """Return positions of the joints after each step of a motion with all laws, (S, J)."""
    # The laws write into their model.
    model = copy.copy(calibrated)
    data = mujoco.MjData(model)
    robot.place(data.qpos, position, data.qvel, speed)
    laws = ActuatorLaws(model, data)
    laws.restart(command[0])
    path = np.empty((len(command), len(robot.qpos)))
    for step, now in enumerate(command):
        laws.step(now)
        path[step] = data.qpos[list(robot.qpos)]
    return path


def _alone(
    robot: RobotModel, plain: Path, per_ctrl: FloatArray, motions: Sequence[Motion]
) -> list[FloatArray]:
    """Return positions of the joints after each step of motions by MuJoCo alone, (S, J) each."""
    model, paths = mujoco.MjModel.from_xml_path(str(plain)), []
    for position, speed, command in motions:
        data = mujoco.MjData(model)
        robot.place(data.qpos, position, data.qvel, speed)
        hold(model, data, command[0] / per_ctrl)
        path = np.empty((len(command), len(robot.qpos)))
        for step, now in enumerate(command / per_ctrl):
            data.ctrl[:] = now
            mujoco.mj_step(model, data)
            path[step] = data.qpos[list(robot.qpos)]
        paths.append(path)
    return paths


def _apart(robot: RobotModel, difference: FloatArray, episodes: Sequence[SampledEpisode]) -> dict[str, float]:
    """Return differences, (S, J), by joint: their root mean square as a share of the recorded range."""
    span = np.ptp(np.concatenate([e.position for e in episodes]), axis=0)
    rms = np.sqrt(np.mean(difference**2, axis=0)) / np.maximum(span, 1e-12)
    return dict(zip(robot.description.joint_names, map(float, rms), strict=True))


def _motions(robot: RobotModel, model: Any, episodes: Sequence[SampledEpisode]) -> Iterator[Motion]:
    """Yield positions and speeds of joints, (J,) each, and the commands that follow, (S, nu).

    There is one command for each physics step.
    """
    each = max(WINDOWS // max(len(episodes), 1), 1)
    for episode in episodes[:WINDOWS]:
        if len(episode.sample) < 3:
            continue
        substeps = max(round(episode.step_s / float(model.opt.timestep)), 1)
        periods = min(round(WINDOW_S / episode.step_s), episode.steps)
        for first in np.linspace(0, episode.steps - periods, each).astype(int):
            row = int(np.clip(np.searchsorted(episode.sample, first), 1, len(episode.sample) - 2))
            beside = slice(row - 1, row + 2, 2)
            passed_s = float(np.diff(episode.sample[beside])[0]) * episode.step_s
            speed = np.diff(episode.position[beside], axis=0)[0] / passed_s
            command = np.zeros((periods, model.nu))
            command[:, list(robot.actuator)] = episode.target[first : first + periods]
            yield episode.position[row], speed, np.repeat(command, substeps, axis=0)


def difference_words(facts: Mapping[str, Any]) -> str:
    """Return the largest difference of a joint, as a sentence; "" where there is none."""
    found = facts.get("difference")
    if not found:
        return ""
    joint = max(found, key=lambda name: found[name])
    share = "under 0.001 %" if found[joint] < 1e-5 else percent(found[joint])
    most = f"{share} of the range at most ({joint})"
    return f"over {WINDOW_S:g} s its motion differs from that with all laws by {most}"
