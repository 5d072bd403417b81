"""When a search is repeated: not where refinements from other points end about as high."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fakes.fixed_search import FixedSearch

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.calib.pipeline import stages
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.minima import RestartSettings, lower_minimum
from deal_hw.calib.pipeline.stages import Refinement
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget, Progress


def run_of(problem: Problem, search: FixedSearch, told: list[Progress]) -> CalibrationRun:
    """Return a calibration of a problem that has begun; its progress is noted."""
    return CalibrationRun(
        problem=problem,
        budget=Budget(population=8, generations=60),
        rng=np.random.default_rng(0),
        attempts=Restarts(search, np.random.default_rng(0), None),
        settings=Validation(),
        progress=told.append,
    )


@pytest.mark.parametrize(("chi2", "lower", "searches"), [(900.0, 880.0, 1), (900.0, 300.0, 2), (3.0, 2.4, 2)])
def test_another_search_follows_where_a_drawn_point_ends_much_lower(
    small_problem: Callable[..., Problem],
    monkeypatch: pytest.MonkeyPatch,
    chi2: float,
    lower: float,
    searches: int,
) -> None:
    """Not for a fiftieth of a residual far above the noise, but for a third of one near it."""
    problem = small_problem()
    refined = dataclasses.replace(refine(problem, problem.space.nominal, 0.0), chi2=chi2)
    monkeypatch.setattr(stages, "refined_from", lambda *_: refined)
    monkeypatch.setattr(stages, "lower_minimum", lambda *_: dataclasses.replace(refined, chi2=lower))
    kept: list[tuple[Refined, int]] = []

    def conclude(_: Any, searched: Any, fit: Refined, more: int) -> None:
        kept.append((fit, more))

    monkeypatch.setattr(stages, "conclude_fit", conclude)
    search = FixedSearch(problem.space.nominal, 0.0, 0.05)
    Refinement(RestartSettings(restarts=1)).best(run_of(problem, search, []))
    ((fit, more),) = kept
    assert (fit.chi2, more, len(search.budgets)) == (lower, searches - 1, searches)


def test_drawn_points_say_how_many_are_left(small_problem: Callable[..., Problem]) -> None:
    """Each is reported with its number; a residual that was given proves nothing, so all are tried."""
    problem = small_problem()
    problem = dataclasses.replace(problem, known_std=np.full(4, 1e-3))
    start = refine(problem, problem.space.high, 0.0, (0.2,), iterations=1)
    told: list[Progress] = []
    search = FixedSearch(problem.space.nominal, 0.0, 0.05)
    lower_minimum(run_of(problem, search, told), start, RestartSettings(drawn=2))
    drawn = [(p.done, p.total) for p in told if p.message.startswith("from another point, chi2 ")]
    assert drawn == [(1, 2), (2, 2)]
