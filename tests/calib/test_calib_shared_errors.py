"""Errors that commands and measurements share: changes of channels, and which of them are named."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from fakes.plain_truth import problem_of
from fakes.small_runs import small_run
from hypothesis import given
from hypothesis import strategies as st

import deal_hw
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import at_parameters, local_fit, refine
from deal_hw.calib.hypotheses import shared_errors as shared_errors_module
from deal_hw.calib.hypotheses.judge import UnseenGain
from deal_hw.calib.hypotheses.random_delay import DelayFit, DelaysAsked, RandomDelay
from deal_hw.calib.hypotheses.shared_errors import (
    ChannelChange,
    FoundError,
    SharedErrorCheck,
    find_shared_error,
    shared_errors,
)
from deal_hw.calib.pipeline import attempts, laws_on_delays
from deal_hw.calib.pipeline.attempts import with_random_delays
from deal_hw.calib.pipeline.calibration_run import SHARED_ERRORS, CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.conclusion import without_search
from deal_hw.calib.pipeline.stages import (
    Fits,
    Refinement,
    with_shared_error,
)
from deal_hw.calib.report.verdict import trust
from deal_hw.calib.validation.checks import unexplained
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Progress
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.testing.plain_faults import Fault, SharedFault
from deal_hw.testing.plain_robots import make_robot, shared_words, write
from deal_hw.workflows.calibration.intake import CalibrationInput
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import CalibrateSettings

SAMPLES, JOINTS, ACTUATED = 7, 4, (0, 1, 3)


def episode() -> SampledEpisode:
    """Return a recording of four joints, the third without a motor."""
    rng = np.random.default_rng(0)
    sent = np.ones((SAMPLES, 3))
    return SampledEpisode(
        step_s=0.005,
        sample=np.arange(SAMPLES),
        position=rng.normal(size=(SAMPLES, JOINTS)),
        velocity=rng.normal(size=(SAMPLES, JOINTS)),
        target=rng.normal(size=(SAMPLES, 3)),
        stiffness=sent,
        damping=sent,
        effort_limit=sent,
        speed_limit=sent,
        usable=np.ones(SAMPLES, dtype=bool),
        start_setpoint=rng.normal(size=3),
    )


factors = st.sampled_from([-1.0, 0.5, 2.0, math.pi / 180, 180 / math.pi, -3.0])
changes = st.builds(
    ChannelChange,
    # Motors change places among each other.
    source=st.permutations(ACTUATED).map(lambda p: (p[0], p[1], 2, p[2])),
    scale=st.tuples(*[factors] * JOINTS),
    clock=st.sampled_from([0.5, 1.0, 2.0, 3.0]),
)


def same(a: SampledEpisode, b: SampledEpisode) -> bool:
    """Return whether two recordings agree to rounding."""
    names = ("position", "velocity", "target", "start_setpoint", "step_s")
    return all(np.allclose(getattr(a, n), getattr(b, n), rtol=1e-9, atol=1e-12) for n in names)


@given(changes, st.booleans())
def test_a_change_undone_is_the_recording(change: ChannelChange, efforts: bool) -> None:
    """The change with the inverse permutation, scales and clock undoes it."""
    if efforts:
        # Efforts take the sign only, which is its own inverse.
        change = dataclasses.replace(change, clock=1.0)
    recorded = episode()
    changed = change.of(recorded, ACTUATED, [not efforts] * len(ACTUATED))
    back = tuple(map(int, np.argsort(change.source)))
    scale = tuple(1 / change.scale[j] for j in back)
    inverse = ChannelChange(source=back, scale=scale, clock=1 / change.clock)
    assert same(inverse.of(changed, ACTUATED, [not efforts] * len(ACTUATED)), recorded)


def test_a_change_takes_each_channel_of_a_joint_along() -> None:
    """The joint without a motor has no command; a slower clock makes velocities smaller."""
    recorded = episode()
    change = ChannelChange(source=(1, 0, 2, 3), scale=(1.0, 1.0, -1.0, 2.0), clock=2.0)
    found = change.of(recorded, ACTUATED, [True] * len(ACTUATED))
    assert np.array_equal(found.position[:, 0], recorded.position[:, 1])
    assert np.array_equal(found.target[:, 0], recorded.target[:, 1])
    assert np.array_equal(found.position[:, 2], -recorded.position[:, 2])
    assert np.array_equal(found.target[:, 2], 2 * recorded.target[:, 2])
    assert np.array_equal(found.velocity[:, 3], recorded.velocity[:, 3])
    assert found.step_s == 0.01
    efforts = change.of(recorded, ACTUATED, [False] * len(ACTUATED))
    assert np.array_equal(efforts.target[:, 2], recorded.target[:, 2])


def problem(kind: str, fault: Fault | SharedFault | None, folder: Path, seconds: float = 2.5) -> Problem:
    """Return the problem of a simulated robot's recordings, whose masses and zeros are not searched."""
    return problem_of(make_robot(kind, 3, fault), folder, seconds)


def test_candidates_are_few_and_each_mends_what_it_says(tmp_path: Path) -> None:
    """Two joints: two signs, one pair, two clocks, three groups of units, three of scales; all differ."""
    found = list(shared_errors(problem("double-pendulum", None, tmp_path, 3.0)))
    counts = {
        kind: sum(e.kind == kind for e in found) for kind in ("sign", "order", "clock", "unit", "scale")
    }
    assert counts == {"sign": 2, "order": 1, "clock": 2, "unit": 6, "scale": 6}
    assert len({e.undo for e in found}) == len({e.words for e in found}) == len(found)
    degrees = next(e for e in found if e.words == "positions of elbow were in degrees")
    assert degrees.undo.scale == pytest.approx((1.0, math.pi / 180)) and "unit: deg for elbow" in degrees.do


@pytest.mark.parametrize(
    ("before", "after", "decides"),
    [(100.0, 0.9, True), (100.0, 9.0, False), (0.4, 0.1, False), (1.1, 1.0, False)],
)
def test_a_correction_that_leaves_more_than_noise_is_no_cause(
    before: float, after: float, decides: bool
) -> None:
    """A poor fit that becomes less poor names nothing: a real cart got a wrong factor of a half that way."""
    assert shared_errors_module._decides(UnseenGain(before, after, 4000), 17) is decides


def test_a_slide_is_in_millimetres_and_no_pair_of_a_hinge(tmp_path: Path) -> None:
    """Cart-pole: units by joint, scales of one joint or both, no swap of a motor and a free joint."""
    found = list(shared_errors(problem("cart-pole", None, tmp_path, 3.0)))
    words = {e.words for e in found}
    assert {
        "positions of slide were in millimetres",
        "positions of pole were in degrees",
        "all positions were multiplied by 2",
    } <= words
    assert not any(e.kind == "order" for e in found)


@pytest.mark.parametrize(("chi2", "confirmed"), [(0.13, False), (1.2, True), (9.0, True)])
def test_a_residual_far_below_the_noise_needs_no_correction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chi2: float, confirmed: bool
) -> None:
    """The correction left 0.08 of the noise; what the search left decides, 0.13 is no sign of an error."""
    right = problem("pendulum", None, tmp_path, 3.0)
    suspicion = FoundError(tuple(shared_errors(right))[:1], 0.08, 13.9, 500.0, right, 10)
    monkeypatch.setattr(shared_errors_module, "_predicted", lambda *_: chi2)
    assert suspicion.confirmed(right.space.nominal, 0.0) is confirmed


@pytest.mark.slow
def test_a_right_recording_has_no_shared_error(tmp_path: Path) -> None:
    """Nothing explains it better, although the mirror image explains it as well."""
    right = problem("pendulum", None, tmp_path)
    fit = refine(right, right.space.nominal, 0.0, (0.2,), iterations=8)
    assert find_shared_error(right, fit).found is None


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["friction", "backlash"])
def test_a_fault_of_the_robot_is_no_error_of_the_recording(fault: Fault, tmp_path: Path) -> None:
    """The model does not explain these, and no change of the recordings mends that."""
    wrong = problem("pendulum", fault, tmp_path)
    fit = refine(wrong, wrong.space.nominal, 0.0, (0.2,), iterations=8)
    assert unexplained(fit) and find_shared_error(wrong, fit).found is None


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["mirrored", "swapped"])
def test_a_shared_error_is_named(fault: SharedFault, tmp_path: Path) -> None:
    """A double pendulum: the error is named and the alarm says what to mend."""
    wrong = problem("double-pendulum", fault, tmp_path)
    found = find_shared_error(wrong, local_fit(wrong)).found
    assert found is not None and found.chi2 < 1.3 < found.before
    assert any(words in str(found.alarm) for words in shared_words("double-pendulum", fault))
    assert found.to_json()["chi2_as_recorded"] == found.before


@pytest.mark.slow
def test_a_calibration_says_it_first_and_ends_red(tmp_path: Path) -> None:
    """A pendulum whose clock ran twice as fast: reported before the search, the first alarm, the verdict.

    Another mass would explain that, too, and is not taken.
    """
    wrong = problem("pendulum", "fast-clock", tmp_path, 2.0)
    printed: list[Progress] = []
    work = CalibrationInput(robot=wrong.robot, space=wrong.space, episodes=wrong.episodes)
    # So brief a search would leave the usual checks no steps.
    settings = CalibrateSettings(population=8, generations=2, threads=1, checks="all")
    result = calibrate_or_raise(settings, work, "default", progress=printed.append)
    assert any("the clock were 2 times too fast" in p.message for p in printed)
    verdict = trust(result)
    assert result.space.names == wrong.space.names
    assert verdict.colour == "red" and "Multiply all times by 0.5" in verdict.do
    assert result.provenance["shared_error"]["errors"][0]["kind"] == "clock"


@pytest.mark.slow
def test_a_mass_that_takes_the_place_of_a_clock_is_far_from_what_was_expected(tmp_path: Path) -> None:
    """With its mass free, a pendulum whose clock ran twice as fast is explained by a quarter of that mass."""
    model, data, held_out = write(make_robot("pendulum", 3, "fast-clock"), tmp_path)
    found = deal_hw.calibrate(model, data, holdout=held_out, threads=1)
    assert found.colour == "amber" and found.result.chi2 < 1.1
    (far,) = (alarm for alarm in found.result.alarms if alarm.seen.startswith("Far from what was expected"))
    assert "rod.mass" in far.seen and "standard deviations" in far.seen and "clock" in far.means


@pytest.fixture
def suspected(tmp_path: Path) -> tuple[CalibrationRun, FoundError, list[Progress]]:
    """Return a run on right recordings, a suspicion that they are wrong, and what the run reports."""
    right = problem("pendulum", None, tmp_path)
    printed: list[Progress] = []
    run = small_run(right, progress=printed.append)
    return run, FoundError(tuple(shared_errors(right))[:1], 1.0, 100.0, 500.0, right, 10), printed


@pytest.mark.slow
def test_a_search_that_predicts_as_well_withdraws_it(
    suspected: tuple[CalibrationRun, FoundError, list[Progress]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Right recordings that were suspected: printed, tried by a brief search, and taken back in print."""
    run, suspicion, printed = suspected
    monkeypatch.setattr(
        shared_errors_module, "find_shared_error", lambda *_: SharedErrorCheck(found=suspicion)
    )
    found = with_shared_error(Refinement(), run)
    words = [p.message for p in printed]
    assert words.index(str(suspicion.alarm)) < words.index(suspicion.withdrawn)
    assert suspicion.withdrawn.startswith("withdrawn: ")
    assert "shared_error" not in found.facts and suspicion.alarm not in found.known.alarms
    # The brief run checks nothing. The second takes its search.
    assert "split_half" in found.facts
    generations = [p.done for p in printed if p.stage == "search" and p.total > 1]
    assert generations and generations == sorted(set(generations))


class AsGiven(Fits):
    """A strategy that returns an outcome without a search."""

    def best(self, run: CalibrationRun) -> FitOutcome:
        """Return the nominal values; see :meth:`Fits.best`."""
        problem = run.problem
        fit = at_parameters(problem, problem.space.nominal, 0.0, 40)
        searched = without_search(problem, run.budget, fit)
        return FitOutcome(
            searched=searched,
            theta=fit.theta,
            latency_s=0.0,
            chi2=fit.chi2,
            known=uncertainty_at(problem, fit),
        )


def test_corrections_that_take_longer_than_the_fits_are_left_out_and_said(
    suspected: tuple[CalibrationRun, FoundError, list[Progress]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing was fitted, so they get the steps of the search that follows; --checks all allows any."""
    run, _, _ = suspected
    allowed: list[float] = []

    def check(problem: Problem, local: object, tell: object, most: float) -> SharedErrorCheck:
        allowed.append(most)
        return SharedErrorCheck(tried=2 if most < math.inf else 5, of=5)

    monkeypatch.setattr(shared_errors_module, "find_shared_error", check)
    with_shared_error(AsGiven(), run)
    assert "3 of 5 corrections were not tried" in run.left_out[SHARED_ERRORS]
    thorough = dataclasses.replace(run, settings=Validation(thorough=True), left_out={}, shared=[])
    with_shared_error(AsGiven(), thorough)
    assert thorough.left_out == {}
    search = 20 * 4 * sum(e.steps for e in run.problem.episodes)  # individuals x generations x steps
    assert allowed == [search, math.inf]


def test_no_step_allowed_no_step_taken(tmp_path: Path) -> None:
    """The check ends before its first simulation."""
    right = problem("pendulum", None, tmp_path)
    assert find_shared_error(right, None, None, 0.0) == SharedErrorCheck(of=5) and right.steps == 0


def test_a_wrong_clock_comes_before_delays_that_explain_it(
    suspected: tuple[CalibrationRun, FoundError, list[Progress]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Delays end the calibration where they leave only noise and nothing is found that is worse."""
    run, suspicion, _ = suspected
    fit = with_rows(at_parameters(run.problem, run.problem.space.nominal, run.problem.first_latency_s, 40))
    late = DelayFit(run.problem, dataclasses.replace(fit, chi2=1.0), RandomDelay(99.0, 99.0, 0.5, 1e-3), fit)
    monkeypatch.setattr(CalibrationRun, "random_delays", lambda self, of: DelaysAsked(late))
    monkeypatch.setattr(attempts, "conclusive", lambda problem, fit, chance: fit.chi2 < 1.3)
    monkeypatch.setattr(laws_on_delays, "_with_a_law", lambda before, allows: (None, []))
    concluded: list[laws_on_delays.LawsOnDelays] = []
    ended = without_search(run.problem, run.budget, fit)
    known = uncertainty_at(run.problem, fit)
    outcome = FitOutcome(searched=ended, theta=fit.theta, latency_s=fit.latency_s, chi2=1.0, known=known)

    def conclude(*_: object, late: laws_on_delays.LawsOnDelays) -> FitOutcome:
        concluded.append(late)
        return outcome

    monkeypatch.setattr(attempts, "conclude_fit", conclude)
    near = dataclasses.replace(fit, chi2=5.0)
    doubted = dataclasses.replace(run, shared=[SharedErrorCheck(found=suspicion)])
    assert with_random_delays(doubted, near) is doubted
    assert with_random_delays(doubted, dataclasses.replace(fit, chi2=26.0)) is doubted
    assert concluded == []
    assert with_random_delays(dataclasses.replace(run, shared=[SharedErrorCheck(of=5)]), near) is outcome
    assert [one.late for one in concluded] == [late]
