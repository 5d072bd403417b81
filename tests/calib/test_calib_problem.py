"""A calibration problem does not change; who needs another one makes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem


def test_nothing_is_set_from_outside(small_problem: Callable[..., Problem]) -> None:
    """Each field; two fits of one problem would else depend on their order."""
    problem = small_problem()
    for field in dataclasses.fields(problem):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(problem, field.name, None)
    with pytest.raises(AttributeError):
        problem.sharing(engin="warp")


def test_a_shared_problem_estimates_nothing_again_and_counts_along(
    small_problem: Callable[..., Problem],
) -> None:
    """One made anew has estimates and a count of its own."""
    problem = small_problem()
    narrow = problem.space.with_ratio(2.0)
    kinds = {
        "latency": problem.sharing(fixed_latency_s=0.01),
        "space": problem.with_space(narrow),
        "robot": problem.sharing(robot=problem.robot),
        "part": problem.part([np.arange(len(e.sample)) > 20 for e in problem.episodes]),
    }
    data, theta = problem.windows(8)[0], problem.space.nominal[None]
    for name, other in kinds.items():
        before = problem.steps
        other.predict(theta, np.zeros(1), data)
        assert problem.steps == other.steps > before, name
        assert other.noise is problem.noise and other.starts is problem.starts, name
    assert problem.fixed_latency_s == 0.0 and kinds["latency"].fixed_latency_s == 0.01
    assert problem.space is not narrow and kinds["space"].space is narrow
    anew = dataclasses.replace(problem)
    assert anew.steps == 0 and anew.starts is not problem.starts
    np.testing.assert_array_equal(anew.noise_std, problem.noise_std)
