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
from deal_hw.calib.pipeline.minima import RestartSettings
from deal_hw.calib.pipeline.stages import Refinement
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget


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
    run = CalibrationRun(
        problem=problem,
        budget=Budget(population=8, generations=60),
        rng=np.random.default_rng(0),
        attempts=Restarts(search, np.random.default_rng(0), None),
        settings=Validation(),
    )
    Refinement(RestartSettings(restarts=1)).best(run)
    ((fit, more),) = kept
    assert (fit.chi2, more, len(search.budgets)) == (lower, searches - 1, searches)
