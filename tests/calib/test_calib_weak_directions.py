"""Directions that the recordings hardly show: what a fit claims to know of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import NEAR_STRETCH, uncertainty_at, with_rows
from deal_hw.calib.fit.null_space import expected_directions
from deal_hw.calib.fit.refinement import Refined, at_parameters
from deal_hw.calib.fit.weak_directions import with_weak_directions
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings


@pytest.fixture(scope="module")
def at_truth(tmp_path_factory: pytest.TempPathFactory) -> Refined:
    """Two links that motors drive, at their true values, with all forces and masses searched."""
    robot = make_robot("double-pendulum", 3, "motor-dead-zone")
    model, paths, held_out = write(robot, tmp_path_factory.mktemp("motors"), seconds=4.0)
    work = calibration_input(FilesSettings(model=model, data=paths, holdout=held_out))
    problem = Problem(work.robot, work.space, work.episodes, threads=1)
    theta = np.array([robot.truth.get(p.name, p.nominal) for p in problem.space])
    return at_parameters(problem, theta, robot.delay_s, 160)


def scale_of(found: Refined) -> FloatArray:
    """The direction in which all masses, frictions, inertias and gains grow by one factor, (K + 1,)."""
    return np.append(found.shooting.problem.space.log_scale.astype(float), 0.0)


def test_no_recording_shows_the_common_scale(at_truth: Refined) -> None:
    """By hand it is 0: the motion is the same. Sums of columns, off by kinks of dry friction, find some."""
    shooting, point = at_truth.shooting, at_truth.point
    sums = shooting.normal(point, keep=True, stretch=NEAR_STRETCH, central=True)
    along = with_weak_directions(shooting, point, sums)
    scale = scale_of(at_truth)
    found, of_sums = (scale @ (n.hessian - np.diag(n.prior)) @ scale for n in (along, sums))
    assert found < 1e-4 < 0.1 < of_sums
    # What the recordings show stays what it was.
    np.testing.assert_allclose(np.diag(along.hessian), np.diag(sums.hessian), rtol=1e-2)
    assert (along.cost, along.count) == (sums.cost, sums.count)


def test_the_interval_of_what_no_recording_shows_is_that_of_the_prior(at_truth: Refined) -> None:
    """By hand: independent priors hold a common factor with the sum of their informations, and no better."""
    problem = at_truth.shooting.problem
    fit = with_rows(at_truth)
    known = uncertainty_at(problem, fit)
    scale = scale_of(at_truth)[:-1]
    dual = scale / scale.sum()
    held = 1 / np.sqrt(np.sum(scale / problem.space.prior[1] ** 2))
    assert np.sqrt(dual @ known.covariance @ dual) > 0.95 * held


def test_a_common_scale_is_named_with_what_to_weigh() -> None:
    """By hand: four masses and forces whose ratios are known to 1 %, and a zero that nothing shows.

    Priors of 0.3 of two masses, and of 0.8 of two forces, hold the scale to 1 / sqrt(2 / 0.09 + 2 / 0.64) =
    0.199 of ln, which is 39 % at 1.645 times that.
    """
    kinds = {
        "fore.mass": "body_mass",
        "hand.mass": "body_mass",
        "a.motor_gain": "motor_gain",
        "b.motor_gain": "motor_gain",
    }
    parameters = [
        Parameter(
            name=name,
            kind=kind,
            elements=(name.split(".")[0],),
            unit="kg",
            nominal=1.0,
            low=0.2,
            high=5.0,
            scale="log",
            prior_mean=1.0,
            prior_std=0.3 if kind == "body_mass" else 0.8,
        )
        for name, kind in kinds.items()
    ]
    space, alike = ParameterSpace(parameters), np.full((4, 4), 0.25)
    data = 1e4 * (np.eye(4) - alike)
    covariance = np.linalg.inv(data + np.diag(1 / space.prior[1] ** 2))
    (words,) = expected_directions(space, data, covariance)
    names = "fore.mass, hand.mass, a.motor_gain, b.motor_gain"
    assert words.startswith(f"the common scale of {names}: no motion shows it")
    assert "to +-39 %" in words and "weigh fore (--known fore.mass VALUE)" in words
    # Where a mass is weighed to 1 %, the recordings and that hold the scale.
    known = np.diag([1e4, 0.0, 0.0, 0.0])
    assert expected_directions(space, data + known, np.linalg.inv(data + known + np.eye(4))) == ()


def test_at_an_end_of_its_range_a_direction_is_seen_from_one_side(at_truth: Refined) -> None:
    """A mass at the end of its range: the scale leads out of it on one side, and still shows nothing."""
    shooting, point = at_truth.shooting, at_truth.point
    value = point.value.copy()
    value[0] = shooting.problem.space.to_scale(shooting.problem.space.low)[0]
    there = dataclasses.replace(point, value=value)
    sums = shooting.normal(there, keep=True, stretch=NEAR_STRETCH, central=True)
    along = with_weak_directions(shooting, there, sums)
    scale = scale_of(at_truth)
    assert scale @ (along.hessian - np.diag(along.prior)) @ scale < 1e-2
