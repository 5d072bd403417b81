"""Latencies beyond 40 ms: given ones are used as they are, searched ones where the range says so."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.output_error import SHORT, OutputErrorFit, fit_output_error
from deal_hw.calib.fit.refinement import Refined, local_fit, refine
from deal_hw.calib.fit.solver import SolverSettings, minimise
from deal_hw.calib.validation.checks import latency_alarms
from deal_hw.errors import ConfigurationError

MakeProblem = Callable[..., Problem]
LATE = 85
"""Device ticks of 1 ms by which the robot of these tests is late."""


def shooting(problem: Problem) -> Refined:
    """Return the local fit of the pipeline."""
    found = local_fit(problem, None)
    assert found is not None
    return found


class Pull:
    """A fit that draws the parameter and the latency away from where they are."""

    def residual(self, value: np.ndarray) -> np.ndarray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        return np.asarray(value + np.array([0.5, 1.0]))

    def jacobian(self, value: np.ndarray) -> np.ndarray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        return np.eye(2)


def output_error(problem: Problem) -> OutputErrorFit:
    """Return the first fit of the output-error method."""
    return fit_output_error(problem, problem.space.nominal, problem.first_latency_s, SHORT)


@pytest.mark.parametrize("latency_s", [0.0, 0.045, 0.085, 0.5])
def test_a_given_latency_is_never_moved(small_problem: MakeProblem, latency_s: float) -> None:
    """The range holds what is given, and a step whose gradient pulls at it leaves it."""
    problem = small_problem(fixed_latency_s=latency_s)
    low, high = problem.latency_range_s
    assert low <= latency_s <= high and problem.first_latency_s == latency_s
    ends = (np.array([-1.0, 0.0]), np.array([1.0, 0.04]))
    value, _ = minimise(Pull(), np.array([0.5, latency_s]), ends, SolverSettings(), fixed_latency=True)
    assert value[1] == latency_s and value[0] < 0.5


def test_given_latency_of_85_ms_is_the_one_that_is_fitted_with(
    small_problem: MakeProblem, recorded: Callable[..., tuple[object, np.ndarray, object]]
) -> None:
    """From 10 % off the truth is found to 1 %; with 40 ms given the residual stays far above the noise."""
    truth = recorded(1.2, LATE)[1]
    fit = refine(small_problem(1.2, LATE, 0.085), truth * 1.1, 0.085)
    assert fit.latency_s == 0.085
    np.testing.assert_allclose(fit.theta, truth, rtol=0.01)
    wrong = refine(small_problem(1.2, LATE, 0.04), truth * 1.1, 0.04)
    assert wrong.chi2 > 100 * max(fit.chi2, 1e-3)


def test_range_bounds_the_search(small_problem: MakeProblem) -> None:
    """The 85 ms are found in 0 to 120 ms; with the default fits end at 40 ms, and that is an alarm."""
    default = small_problem(1.2, LATE, None)
    wide = dataclasses.replace(default, latency_range_s=(0.0, 0.12))
    for fit in (shooting, output_error):
        found = fit(wide)
        assert found.latency_s == pytest.approx(0.085, abs=1.5e-3)
        assert not latency_alarms(wide, found.latency_s)
        ended = fit(default)
        assert ended.latency_s == pytest.approx(0.04, abs=1e-3)
        (alarm,) = latency_alarms(default, ended.latency_s)
        assert "ended at 40 ms" in alarm.seen and "--latency-range 0 0.08" in alarm.do


def test_alarm_at_either_end(small_problem: MakeProblem) -> None:
    """The lower end counts above zero; a latency that was given is nobody's estimate."""
    problem = dataclasses.replace(small_problem(fixed_latency_s=None), latency_range_s=(0.02, 0.8))
    assert problem.first_latency_s == 0.02
    assert not latency_alarms(problem, 0.4)
    (early,) = latency_alarms(problem, 0.021)
    assert "sooner" in early.means and "--latency-range 0 0.8" in early.do
    (late,) = latency_alarms(problem, 0.798)
    assert "later" in late.means and "--latency-range 0.02 1" in late.do
    assert not latency_alarms(small_problem(fixed_latency_s=None), 0.0)
    assert not latency_alarms(small_problem(fixed_latency_s=0.04), 0.04)


@pytest.mark.parametrize(
    ("latencies", "given_s"),
    [((0.04, 0.0), None), ((0.0, 0.0), None), ((0.0, 1.5), None), ((0.0, 0.04), 12.0)],
)
def test_latencies_that_make_no_sense(
    small_problem: MakeProblem, latencies: tuple[float, float], given_s: float | None
) -> None:
    """A range is a lower and a higher value, and a second is the most."""
    problem = small_problem(fixed_latency_s=None)
    with pytest.raises(ConfigurationError, match="no robot is later than 1000 ms"):
        dataclasses.replace(problem, latency_range_s=latencies, fixed_latency_s=given_s)
