"""A robot in plain MuJoCo with a hidden truth, its recordings, and a fit that begins at that truth."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from pathlib import Path

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import with_rows
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters import without_masses_and_zeros
from deal_hw.testing.plain_faults import Fault
from deal_hw.testing.plain_robots import PlainRobot, make_robot, write
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

Truth = tuple[PlainRobot, Problem, Refined]


def problem_of(robot: PlainRobot, folder: Path, seconds: float = 3.0) -> Problem:
    """Return the problem of two recordings of a robot, of 3 s or another length [s].

    Its owner has measured masses and zeros: what else a model lacks is the subject of these tests.
    """
    model, paths, held_out = write(robot, folder, seconds=seconds)
    work = calibration_input(FilesSettings(model=model, data=paths, holdout=held_out))
    doubted = without_masses_and_zeros(work.space).parameters
    space = ParameterSpace(dataclasses.replace(p, prior_mean=None, prior_std=None) for p in doubted)
    return Problem(work.robot, space, work.episodes, threads=1)


@functools.cache
def truth(kind: str, fault: Fault | None) -> Truth:
    """Return a simulated robot, its recordings, and a fit from its own values; each pair is made once."""
    robot = make_robot(kind, 3, fault)
    with tempfile.TemporaryDirectory() as folder:
        problem = problem_of(robot, Path(folder))
    theta = np.array([robot.truth[name] for name in problem.space.names])
    return robot, problem, with_rows(refine(problem, theta, robot.delay_s, (0.4,), iterations=4))


def refused(name: str, steps: float) -> bool:
    """Allow no check."""
    return not (name and steps > 0)
