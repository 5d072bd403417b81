"""Laws on top of delays of single commands, and what their results say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.bench.loop import calibration_row
from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Refined, at_parameters
from deal_hw.calib.pipeline import laws_on_delays
from deal_hw.calib.pipeline.methods import usual_budget
from deal_hw.calib.validation.checks import hold_windows
from deal_hw.calib.validation.explain import applicable
from deal_hw.calib.validation.explanations import sized
from deal_hw.calib.validation.signatures import Signature
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


def _law(problem: Problem) -> list[Parameter]:
    return next(more for each, more in applicable(problem).items() if each.name == FALLING)


def test_only_joints_that_show_a_law_get_it(noisy_problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with what shapes it; all where only their sum is seen."""
    more = _law(noisy_problem)
    assert len(sized(more)) == 2 and len(more) == 4
    effect = Signature("friction", FALLING, (np.arange(2.0) * np.ones((3, 4, 1)),))
    alone = {0.0: 30.0, 1.0: 5.0}
    monkeypatch.setattr(
        laws_on_delays, "screened_gain", lambda seen, own, way: alone[float(own.columns[0][0, 0, 0])]
    )
    seen: object = None
    found = laws_on_delays._seen_alone(seen, effect, noisy_problem, more)  # type: ignore[arg-type]
    first = more[sized(more)[0]].elements
    assert [p.elements for p in found] == [first, first] and len({p.kind for p in found}) == 2
    alone[0.0] = 5.0
    assert laws_on_delays._seen_alone(seen, effect, noisy_problem, more) == more  # type: ignore[arg-type]


def test_intervals_hold_shorter_windows_beside_a_law(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Fits without the law say nothing of its parameters, and widen the others."""
    from deal_hw.calib.fit.intervals import uncertainty_at, with_rows

    more = _law(noisy_problem)[:1]
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
