"""Laws on top of delays of single commands, and what their results say."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from fakes.fixed_search import FixedSearch

from deal_hw.bench.loop import calibration_row
from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.fit.intervals import uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import Refined, at_parameters
from deal_hw.calib.hypotheses import trials
from deal_hw.calib.hypotheses.cause_words import Diagnosis
from deal_hw.calib.hypotheses.hypothesis import Hypothesis, sized, tried_value
from deal_hw.calib.hypotheses.judge import needed
from deal_hw.calib.hypotheses.laws import PLAY
from deal_hw.calib.hypotheses.random_delay import DelayFit, DelaysAsked, RandomDelay
from deal_hw.calib.hypotheses.signatures import Signature
from deal_hw.calib.hypotheses.trials import applicable
from deal_hw.calib.hypotheses.wider_models import WiderFit
from deal_hw.calib.pipeline import laws_on_delays
from deal_hw.calib.pipeline.calibration_run import CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.conclusion import conclude_fit, without_search
from deal_hw.calib.pipeline.laws_on_delays import LawsOnDelays
from deal_hw.calib.pipeline.methods import usual_budget
from deal_hw.calib.pipeline.stages import Fits, best_of
from deal_hw.calib.validation import checks
from deal_hw.calib.validation.checks import hold_windows
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter

FALLING = "friction that falls with speed"
LATE = "a delay of its own for each command"


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "before", "most"), [(0, 4.7, 3.5), (5, 14.4, 5.0)])
def test_friction_by_speed_and_jitter_are_found_together(seed: int, before: float, most: float) -> None:
    """On the demo's realistic cart-pole; with delays alone the values were off by ``before`` %."""
    case = make_case("cartpole", "realistic", seed, 5.0)
    row, result = calibration_row(case, "default", usual_budget("default", None, 25, refine=True), 1)
    assert result.provenance["search"] == "local fit" and result.chi2 < 1.15
    taken = [c["explanation"] for c in result.provenance["candidates"] if c["outcome"] == "taken"]
    assert taken == [LATE, FALLING]
    assert row["error_percent"] < most < before and row["coverage90"] >= 0.88
    found = dict(zip(result.space.names, map(float, result.estimate), strict=True))
    truth = dict(zip(case.space.names, map(float, case.theta), strict=True))
    # The emulator's friction is 40 % larger at standstill, and the excess falls to 1/e at 0.02 m/s.
    assert found["cart.friction_stribeck"] == pytest.approx(0.4 * truth["cart.frictionloss"], rel=0.6)
    assert 0.005 < found["cart.stribeck_speed"] < 0.05
    assert "pole.friction_stribeck" not in found
    assert any("the fit leaves a chi2 of" in str(alarm) for alarm in result.alarms)


def _law(problem: Problem) -> tuple[Hypothesis, list[Parameter]]:
    return next((each, more) for each, more in applicable(problem).items() if each.name == FALLING)


def test_only_joints_that_show_a_law_get_it(noisy_problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with what shapes it; the first of all where none is seen beyond chance."""
    _, more = _law(noisy_problem)
    assert len(sized(more)) == 2 and len(more) == 4
    effect = Signature("friction", FALLING, (np.arange(2.0) * np.ones((3, 4, 1)),))
    alone = {0.0: 30.0, 1.0: 5.0}
    monkeypatch.setattr(
        laws_on_delays,
        "screened_effect",
        lambda seen, own, way: (alone[float(own.columns[0][0, 0, 0])], None),
    )
    seen: object = None
    found = laws_on_delays._seen_alone(seen, effect, noisy_problem, more)  # type: ignore[arg-type]
    first = more[sized(more)[0]].elements
    assert [p.elements for p in found] == [first, first] and len({p.kind for p in found}) == 2
    alone[0.0] = 4.0
    found = laws_on_delays._seen_alone(seen, effect, noisy_problem, more)  # type: ignore[arg-type]
    assert {p.elements for p in found} == {more[sized(more)[1]].elements}
    alone |= {0.0: 25.0, 1.0: 35.0}
    assert laws_on_delays._seen_alone(seen, effect, noisy_problem, more) == more  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("gain", "judged", "after", "bare", "laws"),
    [
        (-1.0, 40.0, 0.9, 1.0, []),
        (1.0, 40.0, 0.9, 1.0, [FALLING]),
        (1.0, 5.0, 0.9, 1.0, []),
        (25.0, 40.0, 0.999, 1.0, []),
        (1.0, 40.0, 0.9, 0.9, []),
    ],
    ids=["no effect", "is there", "does not predict", "no better fit", "another minimum"],
)
def test_a_fit_and_what_it_predicts_decide_whether_a_law_is_there(
    gain: float,
    judged: float,
    after: float,
    bare: float,
    laws: list[str],
    noisy_problem: Problem,
    noisy_refined: Refined,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The effect of a first value only says which law to fit; that of the found one has to predict."""
    (law, more), shift = _law(noisy_problem), np.full(len(noisy_refined.theta) + 1, 0.1)
    wide = noisy_problem.with_more(more)
    theta = np.append(noisy_refined.theta, [tried_value(p) for p in more])
    fit = at_parameters(wide, theta, noisy_refined.latency_s, noisy_refined.shooting.length)
    fit = dataclasses.replace(fit, chi2=after * noisy_refined.chi2)
    monkeypatch.setattr(laws_on_delays, "applicable", lambda of: {law: more} if of is noisy_problem else {})
    of_values: list[object] = []

    def screened(*_: object) -> Signature:
        of_values.append(_[4] if len(_) > 4 else None)
        return Signature("friction", FALLING, ())

    monkeypatch.setattr(laws_on_delays, "screened", screened)
    monkeypatch.setattr(
        laws_on_delays, "screened_effect", lambda *_: (gain if of_values[-1] is None else judged, shift)
    )
    seen = SimpleNamespace(count=500.0)
    monkeypatch.setattr(laws_on_delays, "evidence", lambda *_, **__: seen)
    monkeypatch.setattr(laws_on_delays, "_seen_alone", lambda *_: more)
    monkeypatch.setattr(laws_on_delays, "_fitted", lambda *_: WiderFit(noisy_problem, more, fit, fit))
    lower = dataclasses.replace(noisy_refined, chi2=bare * noisy_refined.chi2)
    monkeypatch.setattr(laws_on_delays, "_refined", lambda *_: lower)
    run = _run(noisy_problem, Validation(thorough=True))
    found = laws_on_delays.laws_on_delays(run, _late(noisy_problem, noisy_refined), run.may_try)
    assert list(found.laws) == laws
    # A weight of exp(gain / 2) beside 1 for no law; one beyond chance that a fit has refused weighs nothing.
    weight = np.exp(gain / 2) / (1 + np.exp(gain / 2))
    expected = np.zeros(0) if laws or gain > needed(1) else np.sqrt(weight) * shift
    np.testing.assert_allclose(found.unsure, expected)


def test_the_effect_of_found_values_keeps_their_shape(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Friction at rest is judged with the speed at which it falls; without any it has no effect."""
    law, more = _law(noisy_problem)
    values = np.array([p.nominal for p in more])
    (first,) = trials.screened(noisy_problem, noisy_refined, law, more).columns
    (same,) = trials.screened(noisy_problem, noisy_refined, law, more, list(values)).columns
    np.testing.assert_allclose(same, first)
    faster = np.where([k in sized(more) for k in range(len(more))], values, 2 * values)
    (other,) = trials.screened(noisy_problem, noisy_refined, law, more, list(faster)).columns
    assert np.abs(other - first).max() > 0.1 * np.abs(first).max() > 0
    none = np.where([k in sized(more) for k in range(len(more))], 0.0, values)
    assert not np.any(trials.screened(noisy_problem, noisy_refined, law, more, list(none)).columns[0])


def test_the_hypothesis_that_promises_most_is_fitted() -> None:
    """However little its effect gains by a first value, unless a cause gains twice as much."""
    best, second, no = (dataclasses.replace(PLAY, name=name) for name in ("a", "b", "c"))
    screen = {best: 3.0, second: 2.9, no: 0.0}
    assert [law.name for law, gain in screen.items() if gain >= trials._least(screen)] == ["a"]
    assert trials._least(screen, [6.1]) > 3.0 and trials._least({no: 0.0}) == np.inf
    strong = {best: 300.0, second: 160.0, no: 140.0}
    assert [law.name for law, gain in strong.items() if gain >= trials._least(strong)] == ["a", "b"]


def test_laws_that_may_be_there_widen_intervals(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """A shift by one standard deviation makes a value's interval wider by the root of two."""
    fit = with_rows(noisy_refined)
    known = uncertainty_at(noisy_problem, fit)
    std = np.sqrt(np.diag(known.covariance))
    late = _late(noisy_problem, fit)
    found = LawsOnDelays(_run(noisy_problem, Validation()), late, unsure=np.append(std, 0.0))
    searched = without_search(noisy_problem, Budget(), fit)
    outcome = FitOutcome(searched=searched, theta=fit.theta, latency_s=fit.latency_s, chi2=1.0, known=known)
    wider = found.said(outcome).known
    ratio = np.sqrt(np.diag(wider.covariance)) / std
    np.testing.assert_allclose(ratio[~known.blind], np.sqrt(2.0))
    assert wider.latency_interval_s == known.latency_interval_s


def test_intervals_hold_shorter_windows_beside_a_law(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Fits without the law say nothing of its parameters, and widen the others."""
    more = _law(noisy_problem)[1][:1]
    wide = noisy_problem.with_more(more)
    theta = np.append(noisy_refined.theta, more[0].nominal)
    length = noisy_refined.shooting.length
    fit = with_rows(at_parameters(wide, theta, noisy_refined.latency_s, length))
    known = uncertainty_at(wide, fit)
    moved = noisy_refined.theta.copy()
    moved[0] *= 2.0
    refused = dataclasses.replace(noisy_refined, theta=moved)
    held = hold_windows(known, fit.latency_s, dataclasses.replace(noisy_refined, refused=refused))
    ratio = np.sqrt(np.diag(held.covariance) / np.diag(known.covariance))
    assert ratio[0] > 2 and ratio[-1] == pytest.approx(1.0)


def _run(problem: Problem, settings: Validation) -> CalibrationRun:
    rng = np.random.default_rng(0)
    return CalibrationRun(
        problem=problem,
        budget=Budget(),
        rng=rng,
        attempts=Restarts(FixedSearch(problem.space.nominal, 0.0, 0.05), rng, None),
        settings=settings,
        first_steps=problem.steps,
    )


def _late(problem: Problem, fit: Refined) -> DelayFit:
    return DelayFit(problem, fit, RandomDelay(90.0, 40.0, 0.5, 1e-3), fit)


@pytest.mark.parametrize("after_search", [False, True])
def test_delays_that_a_fit_ends_with_get_laws_too(
    after_search: bool, noisy_problem: Problem, noisy_refined: Refined, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The result has both; after a search, laws may take the steps that checks have left, not a search's."""
    run = _run(noisy_problem, Validation(split_half=False, physics_step=False, diagnosis=False))
    late = _late(noisy_problem, noisy_refined)
    law = Diagnosis.of(
        "friction", 0.1, 30.0, ("cart",), Finding.alarm("With a law.", "It is one.", "Use it.")
    )
    allowed: list[object] = []

    def taken(of: CalibrationRun, fit: DelayFit, allows: Callable[[str, float], bool]) -> LawsOnDelays:
        allowed.append(allows)
        return LawsOnDelays(of, fit, {FALLING: law})

    monkeypatch.setattr(laws_on_delays, "laws_on_delays", taken)
    monkeypatch.setattr(CalibrationRun, "random_delays", lambda *_: DelaysAsked(late))
    monkeypatch.setattr(checks, "unexplained", lambda *_: True)
    searched = without_search(noisy_problem, Budget(), noisy_refined) if after_search else None
    found = conclude_fit(run, searched, noisy_refined)
    assert allowed == [run.allows if after_search else run.may_try]
    names = [one["explanation"] for one in found.facts["candidates"] if one["outcome"] == "taken"]
    assert names == [LATE, FALLING]
    assert "With a law. It is one. Use it." in [str(alarm) for alarm in found.known.alarms]


@pytest.mark.parametrize(("diagnosis", "far", "asked"), [(True, 25.0, 1), (False, 25.0, 0), (True, 1e-3, 0)])
def test_no_law_is_asked_for_around_a_poor_fit(
    diagnosis: bool,
    far: float,
    asked: int,
    noisy_problem: Problem,
    noisy_refined: Refined,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nor where causes are not asked for."""
    run, late = _run(noisy_problem, Validation(diagnosis=diagnosis)), _late(noisy_problem, noisy_refined)
    count: list[object] = []

    def none(*_: object) -> tuple[None, list[object]]:
        count.append(None)
        return None, []

    monkeypatch.setattr(laws_on_delays, "FAR_CHI2", far)
    monkeypatch.setattr(laws_on_delays, "_with_a_law", none)
    found = laws_on_delays.laws_on_delays(run, late, run.may_try)
    assert len(count) == asked and not found.laws and not len(found.unsure)


class Ended(Fits):
    """A strategy that ends with a residual.

    Args:
        fit: The fit.
        chi2: Its chi2.
    """

    def __init__(self, fit: Refined, chi2: float) -> None:
        self.fit, self.chi2 = fit, chi2

    def best(self, run: CalibrationRun) -> FitOutcome:
        """Return the fit; see :meth:`Fits.best`."""
        searched = without_search(run.problem, run.budget, self.fit)
        known = uncertainty_at(run.problem, with_rows(self.fit))
        return FitOutcome(
            searched=searched,
            theta=self.fit.theta,
            latency_s=self.fit.latency_s,
            chi2=self.chi2,
            known=known,
        )


@pytest.mark.parametrize(
    ("local", "late", "after", "stands"),
    [
        (20.0, 1.1, 27.0, True),
        (20.0, 1.1, 1.2, False),
        (20.0, 6.0, 5.0, False),
        (20.0, None, 27.0, False),
        (26.0, 1.1, 27.0, False),
    ],
    ids=["explains more", "both explain", "explains less", "none", "far from the noise"],
)
def test_delays_of_the_local_fit_stand_where_a_search_explains_less(
    local: float,
    late: float | None,
    after: float,
    stands: bool,
    noisy_problem: Problem,
    noisy_refined: Refined,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They left more than noise, so the search followed; what it found is only taken if it is better."""
    fit = None
    if late is not None:
        fit = _late(noisy_problem, dataclasses.replace(noisy_refined, chi2=late))
    monkeypatch.setattr(CalibrationRun, "random_delays", lambda *_: DelaysAsked(fit))
    monkeypatch.setattr(laws_on_delays, "_with_a_law", lambda *_: (None, []))
    run = dataclasses.replace(
        _run(noisy_problem, Validation(split_half=False, physics_step=False)),
        local=dataclasses.replace(noisy_refined, chi2=local),
    )
    found = best_of(Ended(noisy_refined, after), run)
    names = [one["explanation"] for one in found.facts.get("candidates", []) if one["outcome"] == "taken"]
    assert (found.chi2, names) == ((late, [LATE]) if stands else (after, []))
    unasked = dataclasses.replace(run, settings=Validation(diagnosis=False))
    assert best_of(Ended(noisy_refined, after), unasked).chi2 == after
