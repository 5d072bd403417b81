"""Output-error fits, folds by motion, what goes with what: two motions of a hinge with a hidden truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import mujoco
import numpy as np
import pytest

from deal_hw.calib.baselines.least_squares import MultiStartLeastSquares, MultiStartSettings
from deal_hw.calib.data.folds import fold_masks, motion_numbers, time_masks
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts, SearchCheckpoint
from deal_hw.calib.fit.intervals import uncertainty_at
from deal_hw.calib.fit.null_space import confounded
from deal_hw.calib.fit.output_error import (
    SHORT,
    Recipe,
    fit_output_error,
    prediction_rmse,
    standing_rmse,
)
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.output_error_fits import (
    OutputErrorFits,
    OutputErrorSettings,
    output_error_method,
)
from deal_hw.calib.pipeline.stages import CalibrationPipeline
from deal_hw.calib.pipeline.wider_ranges import fit_beyond_ends
from deal_hw.calib.search.eki import Eki
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import BEFORE_SEARCH, Budget, CalibrationResult, Progress
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

HINGE = """
<mujoco model="hinge">
  <compiler angle="radian"/>
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" armature="0.01" damping="{damping}" frictionloss="{friction}"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><position name="hinge" joint="hinge" kp="12" kv="0.1" forcerange="-20 20"/></actuator>
</mujoco>
"""
PARAMETERS = """
parameters:
  - {kind: dof_damping, elements: hinge}
  - {kind: dof_frictionloss, elements: hinge}
"""
TRUTH = np.array([0.4, 0.05])
LATE_S = 0.012
NOISE = 3e-4
BUDGET = Budget(population=12, generations=6)


def recording(phase: float, seconds: float = 5.0) -> str:
    """Return a CSV of a motion in which commands act 12 ms late."""
    model = mujoco.MjModel.from_xml_string(HINGE.format(damping=TRUTH[0], friction=TRUTH[1]))
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    time = np.arange(0.0, seconds, 0.02)
    wave = 0.4 * np.sin(2 * np.pi * np.outer(time, (0.4, 0.9, 1.7)) + phase * np.arange(3)).sum(axis=1)
    rows, command = ["time,hinge_pos,hinge_cmd"], wave[0]
    data.qpos[0] = wave[0]
    for t, wanted in zip(time, wave, strict=True):
        rows.append(f"{t:.3f},{data.qpos[0] + NOISE * rng.standard_normal():.7f},{wanted:.7f}")
        for step in range(5):
            data.ctrl[0] = wanted if 0.004 * step >= LATE_S else command
            mujoco.mj_step(model, data)
        command = wanted
    return "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Return two motions of the hinge, whose model has half the damping and friction."""
    folder = tmp_path_factory.mktemp("hinge")
    (folder / "hinge.xml").write_text(HINGE.format(damping="0.2", friction="0.025"))
    (folder / "params.yaml").write_text(PARAMETERS)
    for name, phase in (("first", 1.0), ("second", 2.3)):
        (folder / f"{name}.csv").write_text(recording(phase))
    source = FilesSettings(
        model=folder / "hinge.xml",
        data=(folder / "first.csv", folder / "second.csv"),
        parameters=folder / "params.yaml",
        holdout_part=0.0,
        threads=1,
    )
    work = calibration_input(source)
    return Problem(work.robot, work.space, work.episodes, threads=1)


def test_a_long_fit_finds_parameters_and_latency_and_says_how_far_predictions_are_off(
    problem: Problem,
) -> None:
    """Damping and friction come within 2 and 10 %, the latency within 1 ms, the residual near the noise."""
    fit = fit_output_error(problem, problem.space.nominal, 0.0, Recipe())
    assert fit.theta[0] == pytest.approx(TRUTH[0], rel=0.02)
    assert fit.theta[1] == pytest.approx(TRUTH[1], rel=0.1)
    assert fit.latency_s == pytest.approx(LATE_S, abs=1e-3)
    assert NOISE < fit.scale[0] < 2 * NOISE
    rmse = prediction_rmse(problem, [(fit.theta, fit.latency_s), (problem.space.nominal, 0.0)], 2.0)
    assert rmse[0, 0] == pytest.approx(fit.scale[0], rel=1e-6)
    assert rmse[1, 0] > 20 * rmse[0, 0]


@pytest.mark.parametrize(
    ("expected", "guessed", "beyond"), [(True, True, True), (False, True, False), (True, False, False)]
)
def test_a_range_that_nobody_chose_does_not_end_a_fit_that_an_expected_value_holds(
    problem: Problem, expected: bool, guessed: bool, beyond: bool
) -> None:
    """The true damping is twice the higher end of the range."""
    given = problem.space.with_range("hinge.damping", 0.05, TRUTH[0] / 2)
    prior = {"prior_mean": 0.2, "prior_std": 1.0} if expected else {"prior_mean": None, "prior_std": None}
    damping = dataclasses.replace(given["hinge.damping"], **prior)
    narrow = problem.with_space(ParameterSpace([damping, *given.parameters[1:]]))
    narrow = narrow.sharing(guessed=("hinge.damping",) if guessed else ())
    fit = fit_beyond_ends(narrow, (narrow.space.nominal, 0.0), Recipe())
    assert fit.theta[0] == pytest.approx(TRUTH[0] if beyond else TRUTH[0] / 2, rel=0.02)
    assert bool(fit.plain.problem.space["hinge.damping"].high > TRUTH[0]) is beyond


def test_the_expected_value_of_a_parameter_counts_once(problem: Problem) -> None:
    """Where somebody expects a value, the range says nothing more."""
    damping, friction = problem.space.parameters
    expected = dataclasses.replace(damping, prior_mean=damping.nominal, prior_std=0.5)
    ranged = dataclasses.replace(friction, prior_mean=None, prior_std=None)
    held = problem.with_space(ParameterSpace([expected, ranged]))
    shooting = Shooting(held, 10, prior_share=0.289)
    of_range = 1 / (0.289 * held.space.width[1]) ** 2
    assert shooting.prior_information.tolist() == pytest.approx([4.0, of_range, 0.0])


def test_the_robust_loss_shrugs_off_a_stretch_that_no_model_has(problem: Problem) -> None:
    """Half a second in which the arm is held 0.2 rad off: the middle of the residuals measures them."""
    first = problem.episodes[0]
    held = first.position.copy()
    held[60:85] += 0.2
    spoilt = dataclasses.replace(
        problem, episodes=[dataclasses.replace(first, position=held), *problem.episodes[1:]]
    ).sharing(starts=problem.starts)
    plain, robust = (
        fit_output_error(spoilt, TRUTH, LATE_S, Recipe(seconds=1.0, robust=wanted))
        for wanted in (False, True)
    )
    off = [np.abs(np.log(fit.theta / TRUTH)).max() for fit in (plain, robust)]
    assert off[1] < 0.05 and off[1] < off[0]
    assert robust.scale[0] < 0.3 * plain.scale[0]


def test_the_expected_residual_is_at_least_the_noise(problem: Problem) -> None:
    """A search gets the residual of a first fit; channels that were not measured have none."""
    std = fit_output_error(problem, problem.space.nominal, problem.first_latency_s, SHORT).expected_std
    assert problem.noise_std[0] <= std[0] < 5e-3


def test_intervals_count_the_correlation_of_residuals_once(problem: Problem) -> None:
    """Noise that lasts 19 samples. Counted twice, errors were 0.09 and 0.14 of their standard deviation."""
    errors = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        drifting = [
            dataclasses.replace(e, position=e.position + 1e-3 * lasting_noise(rng, len(e.position)))
            for e in problem.episodes
        ]
        spoilt = dataclasses.replace(problem, episodes=drifting).sharing(starts=problem.starts)
        fit = fit_output_error(spoilt, TRUTH, LATE_S, Recipe(), central=True)
        assert fit.normal.cost == pytest.approx(fit.normal.count, rel=0.05)
        known = uncertainty_at(problem, fit, own_scale=True)
        off = problem.space.to_scale(fit.theta) - problem.space.to_scale(TRUTH)
        errors.append(off / np.sqrt(np.diag(known.covariance)))
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 1.2


def lasting_noise(rng: np.random.Generator, samples: int, kept: float = 0.9) -> FloatArray:
    """Return noise of unit variance that keeps a share of itself each sample, (samples, 1)."""
    noise = rng.standard_normal((samples, 1))
    for k in range(1, samples):
        noise[k] = kept * noise[k - 1] + np.sqrt(1 - kept**2) * noise[k]
    return noise


def searching(folds: bool = True) -> CalibrationPipeline:
    """Return the method without a local fit before its search."""
    return CalibrationPipeline(
        Eki(), "output-error", Validation(local_first=False, cross_validation=folds), fits=OutputErrorFits()
    )


@pytest.fixture(scope="module")
def result(problem: Problem) -> CalibrationResult:
    """Return what the whole method finds."""
    return searching().run(problem, BUDGET, np.random.default_rng(0))


def test_a_right_model_needs_no_search(problem: Problem) -> None:
    """The refined nominal values explain the recordings: no search, no alarm, the truth in the intervals."""
    found = output_error_method(Eki()).run(problem, BUDGET, np.random.default_rng(0))
    assert found.provenance["search"] == "local fit" and "cross_validation" not in found.provenance
    assert found.alarms == () and 0.5 < found.chi2 < 1.3
    assert np.all(found.interval[:, 0] <= TRUTH) and np.all(found.interval[:, 1] >= TRUTH)
    assert found.estimate == pytest.approx(TRUTH, rel=0.02)


CANDIDATES = {"short", "0.4 s", "0.8 s", "1.2 s", "long", "long, robust", "long, no latency"}


@pytest.mark.slow
def test_the_method_lets_motions_it_has_not_fitted_choose(result: CalibrationResult) -> None:
    """Every candidate has an error in each fold, a fit of the right model wins; the intervals hold the truth.

    Around the fit of short windows a law can be screened as worth a fit. It is not chosen.
    """
    folds = result.provenance["cross_validation"]
    assert set(folds["errors"]) >= CANDIDATES
    assert all(len(errors) == 2 for errors in folds["errors"].values())
    assert folds["chosen"] in CANDIDATES - {"long, no latency"} and "laws" not in result.provenance
    assert result.estimate[0] == pytest.approx(TRUTH[0], rel=0.03)
    assert np.all(result.interval[:, 0] <= TRUTH) and np.all(result.interval[:, 1] >= TRUTH)
    assert result.latency_s == pytest.approx(LATE_S, abs=2e-3)


Watched = tuple[CalibrationResult, list[tuple[str, float]]]


@pytest.fixture(scope="module")
def stuck_at_first(problem: Problem) -> Watched:
    """Run the method with a first fit that stays at wrong nominal values; return its result and offers."""
    stuck = OutputErrorSettings(first=Recipe(seconds=0.2, iterations=0), windows_s=(0.4, 2.0))
    method = CalibrationPipeline(
        Eki(), "output-error", Validation(local_first=False), fits=OutputErrorFits(stuck)
    )
    offered: list[tuple[str, float]] = []

    def watch(progress: Progress) -> None:
        if progress.estimate is not None:
            offered.append((progress.stage, float(progress.estimate[0])))

    return method.run(problem, BUDGET, np.random.default_rng(0), watch), offered


@pytest.mark.slow
def test_fits_come_before_the_search_which_is_a_candidate_if_it_is_a_better_start(
    problem: Problem, stuck_at_first: Watched
) -> None:
    """A first fit that stays at wrong nominal values: the folds search, and the truth is still found."""
    found, offered = stuck_at_first
    assert [stage for stage, _ in offered] == ["fit of short windows", "fit of long windows", "search"]
    assert offered[0][1] == problem.space.nominal[0]
    assert offered[1][1] == pytest.approx(TRUTH[0], rel=0.03)
    errors = found.provenance["cross_validation"]["errors"]
    assert set(errors) >= (CANDIDATES - {"0.8 s", "1.2 s"}) | {"search"} and "0.8 s" not in errors
    assert "laws" not in found.provenance
    assert found.estimate[0] == pytest.approx(TRUTH[0], rel=0.03)


def test_a_robot_that_stands_still_is_what_fits_that_explain_nothing_are_compared_with(
    problem: Problem,
) -> None:
    """By hand: windows of four samples at a constant speed of 1 rad/s have errors of 1 to 4 periods."""
    first = problem.episodes[0]
    T = len(first.sample)
    moving = dataclasses.replace(problem, episodes=[first])
    position: FloatArray = first.period_s * np.arange(T, dtype=np.float64)[:, None]
    moving = moving.sharing(
        episodes=(dataclasses.replace(first, position=position),),
        starts=(dataclasses.replace(moving.starts[0], position=position, velocity=np.ones((T, 1))),),
    )
    found = standing_rmse(moving, 4 * first.period_s)
    assert found == pytest.approx(first.period_s * np.sqrt(np.mean(np.arange(1, 5) ** 2)), rel=1e-6)


@pytest.mark.parametrize("explains", [True, False])
def test_a_walks_search_runs_only_where_its_fits_explain_nothing(problem: Problem, explains: bool) -> None:
    """An arm whose sensor turns the other way: each fit predicts worse than a robot that stands still."""
    settings = OutputErrorSettings(windows_s=(0.4,), search_always=False)
    if not explains:
        turned = [dataclasses.replace(e, position=-e.position) for e in problem.episodes]
        problem = dataclasses.replace(problem, episodes=turned)
    fit = fit_output_error(problem, TRUTH, LATE_S, Recipe(seconds=0.4, iterations=0))
    reported: list[str] = []
    rng = np.random.default_rng(0)
    run = CalibrationRun(
        problem=problem,
        budget=BUDGET,
        rng=rng,
        attempts=Restarts(Eki(), rng, None),
        settings=Validation(local_first=False, cross_validation=False),
        progress=lambda p: reported.append(p.message) if p.stage == BEFORE_SEARCH else None,
    )
    found = OutputErrorFits(settings, (fit, fit)).best(run)
    assert found.searched.method == ("nominal" if explains else "eki")
    assert (
        any("no better than a robot that stands still, so a search follows" in text for text in reported)
        != explains
    )


def test_halves_of_a_right_model_agree(problem: Problem, stuck_at_first: Watched) -> None:
    """Two motions of one hinge: every parameter and the latency are compared, none is flagged."""
    halves = stuck_at_first[0].provenance["split_half"]
    assert set(halves["parameters"]) == {*problem.space.names, "latency"} and halves["flagged"] == []


class StoppedError(Exception):
    """Raised by a callback."""


@pytest.mark.slow
def test_a_stopped_run_is_resumed_to_the_same_numbers(problem: Problem, tmp_path: Path) -> None:
    """Stopped in the search, the checkpoint holds its generations; the rest is done again."""
    method = searching(folds=False)

    def stop(progress: Progress) -> None:
        if progress.stage == "search" and progress.done == 2:
            raise StoppedError

    whole = method.run(problem, BUDGET, np.random.default_rng(0))
    store = SearchCheckpoint(tmp_path / "checkpoint.npz", "a")
    with pytest.raises(StoppedError):
        method.run(problem, BUDGET, np.random.default_rng(0), stop, store)
    resumed = method.run(problem, BUDGET, np.random.default_rng(0), None, store)
    assert np.array_equal(resumed.estimate, whole.estimate)
    assert np.array_equal(resumed.interval, whole.interval)


def test_least_squares_from_several_starts_finds_them_too(problem: Problem) -> None:
    """The best of three starts ends within 5 % in damping and 2 ms in latency."""
    method = MultiStartLeastSquares(MultiStartSettings(starts=3, survivors=1))
    found = method.run(problem, Budget(population=3, generations=10), np.random.default_rng(0))
    assert found.estimate[0] == pytest.approx(TRUTH[0], rel=0.05)
    assert found.latency_s == pytest.approx(LATE_S, abs=2e-3)
    assert found.provenance["stopped"] == "best of 3 starts, 1 of them fitted to all recordings"


def episode_at(row: int, samples: int = 10) -> SampledEpisode:
    """Return what folds look at of an episode."""
    return cast(
        "SampledEpisode",
        SimpleNamespace(first_row=row, origin=10 * row, sample=np.arange(samples), usable=np.ones(samples)),
    )


def test_folds_leave_out_whole_motions_where_there_are_several() -> None:
    """Stretches of one recording follow each other; a new one begins where they do not."""
    parts = [episode_at(row) for row in (0, 5, 9, 0, 7, 0)]
    assert motion_numbers(parts) == [0, 0, 0, 1, 1, 2]
    masks = fold_masks(cast("Problem", SimpleNamespace(episodes=parts)), 2)
    assert [bool(m.all()) for m in masks[0]] == [True, True, True, False, False, True]
    assert [bool(m.any()) for m in masks[1]] == [False, False, False, True, True, False]
    # One motion: its stretches take turns; one stretch: its blocks do.
    one = fold_masks(cast("Problem", SimpleNamespace(episodes=parts[:3])), 2)
    assert [bool(m.all()) for m in one[0]] == [True, False, True]
    single = fold_masks(cast("Problem", SimpleNamespace(episodes=[episode_at(0, 8)])), 2)
    assert single[0][0].tolist() == [True, True, False, False, True, True, False, False]


def test_one_motion_is_left_out_stretch_by_stretch_of_time() -> None:
    """Recordings of 8 and 4 samples in three folds of four samples each, in order."""
    masks = time_masks(cast("Problem", SimpleNamespace(episodes=[episode_at(0, 8), episode_at(9, 4)])), 3)
    assert [[mask.astype(int).tolist() for mask in fold] for fold in masks] == [
        [[1, 1, 1, 1, 0, 0, 0, 0], [0, 0, 0, 0]],
        [[0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 0, 0]],
        [[0, 0, 0, 0, 0, 0, 0, 0], [1, 1, 1, 1]],
    ]


def space_of(kinds: tuple[str, ...]) -> Problem:
    """Return what the comparison of kinds looks at: ranges of width 1, latencies up to 1 s."""

    class Space(list[SimpleNamespace]):
        width: FloatArray = np.ones(len(kinds))

    space = Space(SimpleNamespace(kind=kind) for kind in kinds)
    return cast("Problem", SimpleNamespace(space=space, latency_range_s=(0.0, 1.0), fixed_latency_s=None))


def test_a_delay_that_goes_with_all_armatures_together_is_named() -> None:
    """Only the sum of two armatures and the delay is known: the delay is sqrt(3) times narrower without one.

    A flat prior over ten ranges has information 0.12. With that on each and information I on the sum, the
    delay's variance is (1/0.12) (0.12 + 2 I) / (0.12 + 3 I); with both armatures known it is 1 / (0.12 + I).
    """
    problem, strong = space_of(("dof_armature", "dof_armature")), 1e4
    found = confounded(problem, strong * np.ones((3, 3)))
    (pair,) = found
    assert (pair.first, pair.second) == ("latency", "dof_armature")
    expected = np.sqrt((0.12 + 2 * strong) / (0.12 + 3 * strong) / 0.12 * (0.12 + strong))
    assert pair.factor == pytest.approx(expected)
    assert "latency and dof_armature are confounded" in pair.words
    assert confounded(problem, strong * np.eye(3)) == ()


def test_kinds_that_share_half_of_what_is_unknown_are_partly_confounded() -> None:
    """A correlation of 0.7 makes them 1 / sqrt(1 - 0.49) = 1.40 times narrower, one of 0.5 1.15 times."""
    problem = space_of(("dof_armature",))
    (pair,) = confounded(problem, 1e6 * np.array([[1.0, 0.7], [0.7, 1.0]]))
    assert pair.factor == pytest.approx(1.40, abs=0.005)
    assert "latency and dof_armature are partly confounded" in pair.words
    assert confounded(problem, 1e6 * np.array([[1.0, 0.5], [0.5, 1.0]])) == ()
