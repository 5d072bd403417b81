"""Inner folds and the robust loss, on recordings of the real device core with hidden truths."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from fakes.fixed_search import FixedSearch

from deal_hw.bench.tasks import Case
from deal_hw.calib.data.folds import fold_masks
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.output_error import Recipe, fit_output_error, prediction_errors
from deal_hw.calib.fit.refinement import Refined, at_parameters
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calib.fit.solver import huber_weights, kurtosis
from deal_hw.calib.pipeline.stages import CalibrationPipeline
from deal_hw.calib.validation.checks import unexplained
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget


def test_folds_are_disjoint_and_cover_everything(noisy_problem: Problem) -> None:
    """Each sample is left out exactly once, and each fold leaves out two stretches."""
    masks = fold_masks(noisy_problem, 2)
    total = np.sum([m[0] for m in masks], axis=0)
    assert np.all(total == 1)
    assert np.count_nonzero(np.diff(masks[0][0].astype(int)) == 1) == 1
    part = noisy_problem.part(masks[0])
    assert part.episodes[0].usable.sum() == (noisy_problem.episodes[0].usable & masks[0][0]).sum()
    assert (
        part.starts is noisy_problem.starts
        and noisy_problem.episodes[0].usable.sum() > part.episodes[0].usable.sum()
    )


def test_the_truth_predicts_left_out_motion_better(noisy: Case, noisy_problem: Problem) -> None:
    """The error of a prediction is smaller at the truth than 10 % beside it."""
    members = [(noisy.theta, noisy.latency_s), (noisy.theta * 1.1, noisy.latency_s)]
    each = [error / data.std for data, error in prediction_errors(noisy_problem, members, 0.2)]
    truth = np.sum([np.sum(error**2, axis=(1, 2, 3)) for error in each], axis=0)
    assert truth[0] < truth[1]


def test_given_parameters_get_start_states(noisy: Case, noisy_problem: Problem) -> None:
    """At a search's estimate the start states settle to a lower cost, and the estimate stays."""
    searched = FixedSearch(noisy.theta, noisy.latency_s).run(
        noisy_problem, Budget(), np.random.default_rng(0)
    )
    shooting = Shooting(noisy_problem, 40)
    smoothed = shooting.smoothed()
    there = at_parameters(noisy_problem, searched.estimate, searched.latency_s, 40, smoothed)
    assert there.theta == pytest.approx(noisy.theta)
    assert there.normal.cost < shooting.cost(shooting.start(noisy.theta, noisy.latency_s, smoothed))
    assert there.chi2 < 1.3 and not unexplained(there)


@pytest.mark.slow
def test_unexplained_data_keep_the_refinement_and_are_diagnosed(
    small_problem: Callable[..., Problem],
) -> None:
    """With a latency 10 ms off the model fails: the refinement stays, whatever fits of halves predict."""
    problem = small_problem(fixed_latency_s=0.01)
    search = FixedSearch(problem.space.nominal, 0.01)
    result = CalibrationPipeline(search, settings=Validation(split_half=False)).run(
        problem, Budget(generations=16), np.random.default_rng(0)
    )
    asked = [b.generations for b in search.budgets]
    assert len(asked) <= 2 and "cross_validation" not in result.provenance
    here = at_parameters(problem, problem.space.nominal, 0.01, round(result.provenance["window_s"] / 0.005))
    assert result.chi2 < here.chi2
    assert "diagnosis" in result.provenance
    assert any("does not explain" in alarm.means for alarm in result.alarms)


def test_a_residual_that_was_chosen_explains_itself_so_a_search_follows(
    small_problem: Callable[..., Problem],
) -> None:
    """With residuals taken to be 50 times the noise chi2 says nothing: the search runs all the same."""
    plain = small_problem()
    problem = dataclasses.replace(plain, known_std=50 * plain.noise_std)
    search = FixedSearch(plain.space.nominal, 0.0)
    result = CalibrationPipeline(search, settings=Validation(split_half=False, diagnosis=False)).run(
        problem, Budget(generations=15), np.random.default_rng(0)
    )
    assert result.chi2 < 0.5 and len(search.budgets) == 1


def test_huber_weights_by_hand() -> None:
    """Residuals within 1.345 weigh 1, one of 13.45 weighs a tenth; a large median widens the belt."""
    weights = huber_weights(np.array([0.1, -1.0, 13.45, 0.2, 0.3]))
    assert weights == pytest.approx([1.0, 1.0, 0.1, 1.0, 1.0])
    assert huber_weights(np.full(5, 10.0)) == pytest.approx(np.ones(5))
    assert kurtosis([np.array([1.0, -1.0])]) == 1.0
    # Missing samples are no quiet ones.
    assert kurtosis([np.array([1.0, 0.0, 0.0, -1.0, 0.0])]) == 1.0


@pytest.mark.slow
def test_robust_fit_shrugs_off_wild_samples(
    noisy: Case, noisy_problem: Problem, noisy_refined: Refined
) -> None:
    """A cart sample in the middle of each window off by 10 mm: Huber's loss stays nearer to the clean fit."""
    wild = noisy.fit.position.copy()
    wild[20::40, 0] += 1e-2
    spoilt = Problem(
        noisy.robot,
        noisy.space,
        [dataclasses.replace(noisy.fit, position=wild)],
        threads=1,
        fixed_latency_s=noisy.latency_s,
    )
    # The noise is that of the clean recording: an outlier is what noise does not make.
    spoilt = spoilt.sharing(noise=noisy_problem.noise, starts=noisy_problem.starts)
    start, equal = (noisy_refined.theta, noisy.latency_s), Recipe(seconds=0.2)
    clean, plain = (fit_output_error(p, *start, equal) for p in (noisy_problem, spoilt))
    assert kurtosis(plain.normal.residual) > 6.0
    robust = fit_output_error(spoilt, *start, Recipe(seconds=0.2, robust=True))
    scaled = [spoilt.space.to_scale(p.theta) for p in (clean, plain, robust)]
    assert np.linalg.norm(scaled[2] - scaled[0]) < 0.5 * np.linalg.norm(scaled[1] - scaled[0])
