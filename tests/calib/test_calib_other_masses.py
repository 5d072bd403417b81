"""Another mass of a body as a candidate: it is fitted, taken, and told from that of another body or not."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fakes.plain_truth import problem_of, refused, truth
from fakes.small_runs import small_run

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import local_fit
from deal_hw.calib.hypotheses.cause_words import Diagnosis
from deal_hw.calib.hypotheses.diagnosis import all_allowed, diagnose
from deal_hw.calib.hypotheses.hypothesis import off_value, one_sided, tried_value
from deal_hw.calib.hypotheses.laws import other_masses
from deal_hw.calib.hypotheses.thresholds import FAR_CHI2
from deal_hw.calib.hypotheses.trials import (
    Explained,
    explained,
    keeps_mass,
    likeliest,
    of_masses,
    rivals,
    try_hypotheses,
)
from deal_hw.calib.pipeline.attempts import with_explanation
from deal_hw.calib.validation.checks import hold_alike
from deal_hw.calib.validation.settings import Validation
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.testing.plain_robots import make_robot

UPPER, FORE = "another mass of upper", "another mass of fore"
LINK = 1.5
"""Mass of the robot's last link over the model's."""


def test_each_moving_body_has_another_mass_of_its_own(tmp_path: Path) -> None:
    """From its own mass to both sides; one that is searched already is no candidate, nor is a free base's."""
    problem = problem_of(make_robot("double-pendulum", 3), tmp_path)
    of = of_masses(problem)
    assert [each.name for each in of] == [UPPER, FORE] and all(each.in_mjcf for each in of)
    ((upper,), (fore,)) = of.values()
    assert (upper.name, upper.kind, upper.nominal, fore.nominal) == ("upper.mass", "body_mass", 0.5, 0.3)
    assert off_value(fore) == 0.3 and tried_value(fore) == pytest.approx(0.3 + 0.02 * (1.5 - 0.3))
    assert not one_sided(problem, [fore]).any()
    assert [each.name for each in other_masses(problem.with_more([upper]))] == [FORE]
    floating: Any = SimpleNamespace(robot=SimpleNamespace(base="trunk"), noise_free=False)
    assert of_masses(floating) == {}


def test_a_body_that_keeps_nothing_has_no_other_mass() -> None:
    """Searched from a fifth of the mass on; at that end the mass takes up something else."""
    p = Parameter.around("fore.mass", "body_mass", ("fore",), "kg", 0.3)
    assert [keeps_mass(p, value) for value in (0.06, 0.0605, 0.07, 0.45)] == [False, False, True, True]


def test_around_a_poor_fit_no_mass_is_fitted() -> None:
    """Its effect there says nothing, and near the noise the same masses are screened."""
    _, problem, fit = truth("double-pendulum", None)
    poor = try_hypotheses(problem, dataclasses.replace(fit, chi2=FAR_CHI2 + 1), refused)
    near = try_hypotheses(problem, fit, refused)
    assert not {UPPER, FORE} & {one.hypothesis.name for one in poor}
    assert {UPPER, FORE} <= {one.hypothesis.name for one in near}


def _explained(problem: Problem, body: str, deviance: float, own: float, mass: float) -> Explained:
    """Return an explanation by another mass, with all own values ``own`` times the model's."""
    law = next(each for each in other_masses(problem) if each.name.endswith(body))
    wide = problem.with_more(law.parameters(problem))
    theta = np.append(own * problem.space.nominal, mass)
    alarm = Finding.alarm("a", "b", "c")
    cause = Diagnosis.of("mass", 0.6, deviance, (body,), alarm)
    return Explained(law, cause, wide, theta, 0.01, 1.0, 2.0)


def test_the_other_body_is_where_the_values_go_if_it_is_true(tmp_path: Path) -> None:
    """1.5 times all other values and the lower link's mass, or 1/1.5 of the upper one's: the same motion.

    A value that is known, and so not searched, is none of them.
    """
    problem = problem_of(make_robot("double-pendulum", 3), tmp_path)
    first, *others = problem.space.parameters
    problem = problem.with_space(ParameterSpace([dataclasses.replace(first, known=True), *others]))
    K = len(others)
    fore = _explained(problem, "fore", 100.0, 1.5, 0.45)
    upper = dataclasses.replace(_explained(problem, "upper", 90.0, 1.0, 0.5 / 1.5), latency_s=0.012)
    assert upper.change == pytest.approx(0.0)
    assert fore.change == pytest.approx(np.log(1.5) / problem.space.width.mean(), rel=0.3)
    shift = fore.shift_to(upper)
    assert shift[:K] == pytest.approx(np.full(K, -np.log(1.5)))
    # The lower link then has the model's mass.
    assert shift[K:] == pytest.approx([-np.log(1.5), 0.002])
    poor = dataclasses.replace(upper, diagnosis=dataclasses.replace(upper.diagnosis, deviance=70.0))

    def bodies(found: list[Explained]) -> list[str]:
        return [one.hypothesis.name for one in found]

    assert bodies(rivals([fore, upper])) == bodies(likeliest([fore, upper])) == [FORE, UPPER]
    assert bodies(likeliest([fore, poor])) == [FORE]


def test_intervals_hold_what_other_models_say() -> None:
    """Two models as likely: the values spread by half of the squared shift, which all of them share."""
    _, problem, fit = truth("pendulum", None)
    known = uncertainty_at(problem, fit, fixed_latency=False)
    K, before = len(known.space), known.covariance
    shift = np.append(np.full(K, -0.2), 0.001)
    held, added = hold_alike(problem, known, fit.latency_s, [shift])
    seen = ~known.blind
    assert seen.any() and held.covariance == pytest.approx(before + 0.02 * np.outer(seen, seen))
    assert list(added.values()) == pytest.approx(np.where(seen, np.sqrt(0.02), 0.0))
    moved = known.space.from_scale(known.space.to_scale(known.theta) + shift[:K])
    assert (held.interval[seen, 0] <= moved[seen]).all() and (moved[seen] <= held.interval[seen, 1]).all()
    reach_s = min(known.latency_reach_s(fit.latency_s) + 0.001, 0.04)
    assert held.latency_reach_s(fit.latency_s) >= reach_s - 1e-12
    # Beside a model that says the same, a third is not enough for 90 %: the farthest one is held.
    third, _ = hold_alike(problem, known, fit.latency_s, [shift, 0 * shift])
    assert (third.interval[seen, 0] <= moved[seen] * (1 + 1e-9)).all()


@pytest.mark.slow
def test_a_wrong_mass_becomes_a_parameter_and_the_other_body_is_named() -> None:
    """The last link weighs 50 % more. Under servos motion shows ratios of masses: two bodies explain alike.

    That is taken with which the other values change less, and the intervals hold those of both, so the truth.
    """
    robot, problem, _ = truth("double-pendulum", "mass")
    local = local_fit(problem)
    assert local is not None
    fit = with_rows(local)
    tried = try_hypotheses(problem, fit, all_allowed)
    found = explained(problem, fit, tried)
    assert {one.hypothesis.name for one in rivals(found)} == {UPPER, FORE}
    assert "in the model 0." in found[0].diagnosis.seen and found[0].explains
    # An MJCF can say it, so those who want no laws get it, too.
    outcome = with_explanation(small_run(problem, settings=Validation(laws=False), local=fit, tried=tried))
    assert outcome is not None and outcome.chi2 < MISMATCH_CHI2 and outcome.space is not None
    K, (mass,) = len(problem.space), outcome.space.names[len(problem.space) :]
    # Both masses together are the robot's, up to one factor, which all other values have, too.
    ratio = outcome.theta[K] / outcome.space.nominal[K]
    factor = 1.0 if mass == "fore.mass" else 1 / LINK
    assert ratio == pytest.approx(LINK * factor if mass == "fore.mass" else factor, rel=0.03)
    true = np.array([robot.truth[name] for name in problem.space.names])
    assert np.median(outcome.theta[:K] / true) == pytest.approx(factor, rel=0.03)
    low, high = outcome.known.interval[:K].T
    assert np.mean((low <= true) & (true <= high)) >= 0.9
    rows = {row["explanation"]: row["outcome"] for row in outcome.facts["candidates"]}
    assert sorted((rows[UPPER], rows[FORE])) == ["named", "taken"]
    (alarm,) = [one for one in outcome.known.alarms if "do not tell it from" in one.do]
    assert f"it has the mass as {mass}" in alarm.do
    causes = diagnose(problem, fit, tried)
    assert causes.causes[0].code == "mass"
    names = [row.explanation for row in causes.candidates]
    assert len(names) == len(set(names))
