"""The advice of a finished calibration: its recordings say what the robot may be asked to do next."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.design.advice import Advice, advise
from deal_hw.calibration import CalibrationResult
from deal_hw.control.behaviours import Behaviour
from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import DealHwError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import Episode
from deal_hw.types import FloatArray

BEYOND = 0.25
"""A joint of a robot without limits may leave its recorded range by this share of it on either side."""

FASTER = 5.0
"""It may be so many times as fast as in the recordings; what is asked of it is half of that."""


def next_recordings(
    robot: RobotModel,
    result: CalibrationResult,
    episodes: Sequence[Episode],
    *,
    balance: Callable[[], Behaviour] | None = None,
    threads: int | None = None,
) -> tuple[Advice, ...]:
    """Say for each weak or unidentified parameter what to record next.

    A robot whose description knows no limits is kept to what its recordings covered; the noise that is
    reckoned with is what the calibration found to be left.

    Args:
        robot: The nominal model.
        result: What the calibration found.
        episodes: The fitted recordings.
        balance: Makes the policy that balances; None for robots that stand by themselves.
        threads: Simulation threads.
    """
    open_ = [n for n, v in zip(result.space.names, result.verdicts, strict=False) if v != "identifiable"]
    if not open_:
        return ()
    if robot.base is not None:
        return _without(open_, "motions are planned for a fixed base only; record it held by its trunk")
    try:
        known = dataclasses.replace(robot, description=_described(robot, result, episodes, threads))
        found = advise(known, result, balance=balance, threads=threads)
    except DealHwError as err:
        return _without(open_, str(err))
    # A parameter that the verdict holds for identifiable needs no recording, wide as it may be.
    return tuple(one for one in found if one.parameter in open_)


def _without(names: Sequence[str], why: str) -> tuple[Advice, ...]:
    return tuple(
        Advice(name, float("nan"), float("nan"), "", f"{name} is open, and no advice was computed: {why}")
        for name in names
    )


def _described(
    robot: RobotModel, result: CalibrationResult, episodes: Sequence[Episode], threads: int | None
) -> RobotDescription:
    """Return the robot with the noise that is left, and with its recordings' limits where it has none."""
    description = robot.description
    problem = Problem(robot, result.space, episodes, threads=threads)
    noise = _noise(problem, result)
    sensor = SensorModel(
        noise=tuple(map(float, noise)), resolution=(0.0,) * len(noise), velocity_window_s=0.0
    )
    description = dataclasses.replace(description, sensor=sensor)
    if np.isfinite(np.array(description.limits.target)).all():
        return description
    targets = np.concatenate([e.target for e in episodes])
    positions = np.concatenate([e.position[e.usable] for e in episodes])
    low, high = np.nanmin(targets, axis=0), np.nanmax(targets, axis=0)
    least, most = np.nanmin(positions, axis=0), np.nanmax(positions, axis=0)
    spare = BEYOND * (most - least)
    fastest = np.max([np.abs(s.velocity).max(axis=0) for s in problem.starts], axis=0)
    home = 0.5 * (least + most)
    if description.actuation == "position":
        home[list(description.actuated_index)] = 0.5 * (low + high)
    limits = dataclasses.replace(
        description.limits,
        target=_pairs(low, high),
        trip_position=_pairs(least - spare, most + spare),
        trip_velocity=tuple(map(float, FASTER * fastest)),
    )
    return dataclasses.replace(description, limits=limits, default_position=tuple(map(float, home)))


def _noise(problem: Problem, result: CalibrationResult) -> FloatArray:
    """Return what a position may be off, (J,): noise of the sensor, and what the model leaves unexplained."""
    joints = len(problem.robot.description.joint_names)
    used = result.provenance.get("noise_std", ())
    noise = np.array(used) if len(used) == joints else problem.noise_std[:joints]
    left = result.chi2 if np.isfinite(result.chi2) else 1.0
    return np.asarray(noise * np.sqrt(max(left, 1.0)))


def _pairs(low: FloatArray, high: FloatArray) -> tuple[tuple[float, float], ...]:
    return tuple((float(a), float(b)) for a, b in zip(low, high, strict=True))
