"""When a search is repeated: not where refinements from other points end about as high."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fakes.fixed_search import FixedSearch

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.calib.pipeline import minima, stages
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.minima import (
    RestartSettings,
    gains_on_part,
    lower_minimum,
    refined_search,
    unseen,
)
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
    for module in (minima, stages):
        monkeypatch.setattr(module, "refined_from", lambda *_: refined)
    monkeypatch.setattr(minima, "lower_minimum", lambda *_: dataclasses.replace(refined, chi2=lower))
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


@pytest.mark.parametrize(
    ("levels", "share"),
    [
        ([900.0], 1.0),
        ([900.0, 880.0], 1.0),
        ([900.0] * 4, 2 / 12),
        ([900.0, 880.0, 910.0, 905.0, 870.0], 2 / 20),
        ([900.0, 300.0, 310.0, 890.0, 905.0], 6 / 20),
        ([3.0, 2.4, np.inf, np.inf], 12 / 12),
    ],
)
def test_unseen_share_of_points(levels: list[float], share: float) -> None:
    """By hand: w (w + 1) / (n (n - 1)) for n fits in w minima; fits that diverge are one."""
    assert unseen(levels, 0.2) == pytest.approx(share)


@pytest.mark.parametrize(("others", "fits"), [((900.0,), 4), ((900.0, 300.0), 8)])
def test_no_more_points_are_drawn_once_all_fits_end_alike(
    small_problem: Callable[..., Problem],
    monkeypatch: pytest.MonkeyPatch,
    others: tuple[float, ...],
    fits: int,
) -> None:
    """Four more that end as the first do, are enough; a second minimum asks for all eight."""
    problem = small_problem()
    fit = dataclasses.replace(refine(problem, problem.space.nominal, 0.0, (0.2,), iterations=1), chi2=890.0)
    ends = itertools.cycle(others)
    tried: list[float] = []

    def from_start(*_: Any, **__: Any) -> Refined:
        tried.append(next(ends) if tried else 890.0)
        return dataclasses.replace(fit, chi2=tried[-1])

    monkeypatch.setattr(minima, "from_start", from_start)
    monkeypatch.setattr(minima, "conclusive", lambda *_: False)
    lower_minimum(run_of(problem, FixedSearch(problem.space.nominal, 0.0, 0.05), []), fit, RestartSettings())
    # The first is that of the fit itself, and the last that of the lowest on all recordings.
    assert len(tried) - 1 - (300.0 in tried) == fits


@pytest.mark.parametrize(("of_search", "drawn"), [(900.0, 0), (500.0, 1)])
def test_nothing_is_drawn_where_the_local_fit_and_the_search_end_alike(
    small_problem: Callable[..., Problem], monkeypatch: pytest.MonkeyPatch, of_search: float, drawn: int
) -> None:
    problem = small_problem()
    local = dataclasses.replace(refine(problem, problem.space.nominal, 0.0, (0.2,), iterations=1), chi2=890.0)
    search = FixedSearch(problem.space.nominal, 0.0, 0.05)
    monkeypatch.setattr(minima, "from_start", lambda *_, **__: dataclasses.replace(local, chi2=of_search))
    asked: list[Refined] = []
    monkeypatch.setattr(minima, "lower_minimum", lambda _, fit, *__: asked.append(fit))
    run = dataclasses.replace(run_of(problem, search, []), local=local)
    searched = search.run(problem, run.budget, run.rng)
    settings = RestartSettings(alike_ends=True)
    refined, alike = refined_search(run, searched, settings)
    assert len(asked) == drawn
    assert alike
    assert refined.chi2 == min(of_search, 890.0)


def test_a_brief_search_sees_a_part_of_long_recordings(small_problem: Callable[..., Problem]) -> None:
    """Every other second of 17; a whole search, and one of 15 s, see all."""
    seen: list[int] = []

    class Counting(FixedSearch):
        def run(self, problem: Problem, *rest: Any) -> Any:
            seen.append(sum(int(e.usable.sum()) for e in problem.episodes))
            return super().run(problem, *rest)

    for seconds in (17.0, 15.0):
        problem = small_problem(seconds)
        searches = Restarts(Counting(problem.space.nominal, 0.0, 0.05), np.random.default_rng(0), None)
        brief = Budget(population=8, generations=2, brief=True)
        results = [searches.run(problem, 0, brief, None) for _ in range(2)]
        assert results[0] is results[1]
        searches.run(problem, 1, dataclasses.replace(brief, brief=False), None)
    second = round(1 / problem.episodes[0].period_s)
    assert [count / second for count in seen] == pytest.approx([9, 17, 15, 15], abs=0.1)


@pytest.mark.parametrize(
    ("ends", "kept", "alike"),
    [((900.0, 890.0), 900.0, True), ((900.0, 300.0), 300.0, False), ((1.1,), 1.1, True)],
)
def test_long_recordings_are_refined_once_from_the_best_point_of_a_part(
    small_problem: Callable[..., Problem],
    monkeypatch: pytest.MonkeyPatch,
    ends: tuple[float, ...],
    kept: float,
    alike: bool,
) -> None:
    """What a part decides: the search's estimate, or another point that ends lower.

    Where the part is explained and the whole is not, other points are tried as for short recordings.
    """
    problem = small_problem(17.0)
    fit = refine(small_problem(), problem.space.nominal, 0.0, (0.2,), iterations=1)
    levels, whole = itertools.chain(ends, itertools.repeat(ends[-1])), list[Any]()

    def from_start(on: Problem, start: Any, stages_s: Any = None, notify: Any = None) -> Refined:
        if stages_s is None:
            whole.append(start[0])
            return dataclasses.replace(fit, theta=start[0], chi2=5.0)
        level = next(levels)
        return dataclasses.replace(fit, theta=problem.space.nominal + level, chi2=level)

    monkeypatch.setattr(minima, "from_start", from_start)
    monkeypatch.setattr(minima, "conclusive", lambda *_: False)
    monkeypatch.setattr(minima, "clearly_lower", lambda a, b: a.chi2 < 0.5 * b.chi2)
    run = run_of(problem, FixedSearch(problem.space.nominal, 0.0, 0.05), [])
    searched = run.attempts.run(problem, 0, run.budget, None)
    _, same = refined_search(run, searched, RestartSettings())
    assert same is alike
    if kept == 1.1:
        assert len(whole) == 2
        np.testing.assert_allclose(whole[0], problem.space.nominal + kept)
        return
    (start,) = whole
    np.testing.assert_allclose(start, problem.space.nominal + kept)


@pytest.mark.parametrize(("ends", "gains"), [((9.0, 3.0), True), ((9.0, 8.9), False)])
def test_wider_ranges_are_tried_on_a_part_of_long_recordings(
    small_problem: Callable[..., Problem],
    monkeypatch: pytest.MonkeyPatch,
    ends: tuple[float, ...],
    gains: bool,
) -> None:
    """All of them are fitted only where the part gains; short ones are fitted at once."""
    problem, short = small_problem(17.0), small_problem()
    fit = refine(short, problem.space.nominal, 0.0, (0.2,), iterations=1)
    left = iter(ends)
    monkeypatch.setattr(minima, "from_start", lambda *_: dataclasses.replace(fit, chi2=next(left)))
    search = FixedSearch(problem.space.nominal, 0.0, 0.05)
    assert gains_on_part(run_of(problem, search, []), problem.with_space(problem.space), fit) is gains
    assert next(left, None) is None
    assert gains_on_part(run_of(short, search, []), short, fit)
