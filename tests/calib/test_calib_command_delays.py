"""Random delays of commands as unknowns of a fit: whitening, their likeliest size, moved commands."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from fakes.small_runs import small_run

from deal_hw import calibrate
from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.parts import taken
from deal_hw.calib.data.problem import CommandDelays, Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit import command_delays as command_delays_module
from deal_hw.calib.fit.command_delays import (
    FreeRows,
    LikelyStd,
    _numbers,
    command_begins,
    commands_of,
    delay_columns,
    free_rows,
    likely_std,
    moved_commands,
    with_command_delays,
)
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import STAGES_S, Refined, refine
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calib.hypotheses import random_delay as random_delay_module
from deal_hw.calib.hypotheses.random_delay import DelaysAsked, RandomDelay, _too_many, fit_delays
from deal_hw.calib.hypotheses.signatures import signatures
from deal_hw.calib.hypotheses.thresholds import EVIDENCE
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.conclusion import conclude_fit
from deal_hw.calib.search.eki import Eki
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget
from deal_hw.drivers.cartpole.plant.profiles import PROFILES
from deal_hw.errors import InsufficientDataError
from deal_hw.parameters import Parameter
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.types import FloatArray

DELAY_S = 1.1e-3


def test_whitened_errors_have_unit_covariance(noisy: Case, noisy_problem: Problem) -> None:
    """W (1 + s^2 D D^T) W^T is the unit matrix, with W as the windows apply it."""
    theta, latency_s = noisy.theta, noisy.latency_s
    problem = noisy_problem.with_command_delays(CommandDelays(DELAY_S, theta, latency_s, ({},)))
    (data,) = noisy_problem.windows(40)
    (late,) = with_command_delays(problem, [data])
    columns = delay_columns(problem, theta, latency_s, data)
    assert columns is not None and np.abs(columns * DELAY_S).max() > 0.5
    H, M = data.measured.shape[1:]
    unit = np.eye(H * M).reshape(H * M, 1, H, M) * np.ones((1, len(data.windows), 1, 1))
    white = late.whitened(unit * data.std).reshape(H * M, -1, H * M)
    for w in range(len(data.windows)):
        covariance = np.eye(H * M) + DELAY_S**2 * columns[w] @ columns[w].T
        W = white[:, w].T
        np.testing.assert_allclose(W @ covariance @ W.T, np.eye(H * M), atol=1e-9)
    np.testing.assert_array_equal(late.measured, data.measured)
    # A fit around these windows need not simulate the columns again; a part of the windows has its own.
    np.testing.assert_array_equal(late.by_delay, columns)
    np.testing.assert_array_equal(taken(late, np.array([0])).by_delay, columns[:1])


def test_windows_have_no_columns_where_commands_are_too_many(
    noisy: Case, noisy_problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each command of a window counts, and eight before it; with one more than is allowed there is none."""
    (data,) = noisy_problem.windows(40)
    episode = noisy_problem.episodes[0]
    begins, start = command_begins(episode), episode.sample[data.windows.start]
    ends = start + data.windows.length * data.windows.stride
    inside = max(int(np.sum((begins >= a) & (begins < b))) for a, b in zip(start, ends, strict=True))
    count = commands_of(noisy_problem, data)
    assert count == inside + 8
    columns = delay_columns(noisy_problem, noisy.theta, noisy.latency_s, data)
    assert columns is not None and columns.shape[2] == count
    seconds = 40 * episode.period_s
    assert not _too_many(noisy_problem, seconds) and not _too_many(noisy_problem, 100.0)
    for module in (command_delays_module, random_delay_module):
        monkeypatch.setattr(module, "MOST_COMMANDS", count - 1)
    assert delay_columns(noisy_problem, noisy.theta, noisy.latency_s, data) is None
    assert _too_many(noisy_problem, seconds)


def _delayed(std_s: float, seed: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return residuals of 12 windows with 20 commands each, which a fit followed, and their derivatives."""
    rng = np.random.default_rng(seed)
    columns = np.cumsum(np.repeat(rng.standard_normal((12, 20, 1)), 6, axis=1) * 100.0, axis=1)
    columns = np.where(np.arange(120)[:, None] // 6 >= np.arange(20), columns, 0.0)
    followed = columns @ rng.standard_normal((12, 20, 8)) / 1e3
    residual = rng.standard_normal((12, 120)) + (columns @ rng.normal(0.0, std_s, (12, 20, 1)))[..., 0]
    fit = np.linalg.lstsq(followed.reshape(-1, 8), residual.ravel(), rcond=None)[0]
    last = ((0, 0), (0, 1))
    start = np.concatenate([np.ones((12, 120, 1)), np.full((12, 1, 1), 1e-3)], axis=1)
    return np.pad(residual - followed @ fit, last), np.pad(followed, (*last, (0, 0))), start, columns


@pytest.mark.parametrize("std_s", [0.3e-3, DELAY_S])
def test_the_delays_size_is_found_although_a_fit_followed_them(std_s: float) -> None:
    """Within 10 % on average over ten draws of 240 delays each; the gain decides beyond doubt."""
    found = []
    for seed in range(10):
        free = free_rows(*_delayed(std_s, seed))
        likely = likely_std([free.residual], [free.columns], [free.parameter], np.full(8, 1e-6))
        assert likely.gain > 20
        assert std_s < likely.most_s < 2 * std_s
        found.append(likely.std_s)
    assert np.mean(found) == pytest.approx(std_s, rel=0.1)


def test_noise_alone_has_no_delays() -> None:
    """The likeliest size is the least, and nothing is gained."""
    free = free_rows(*_delayed(0.0, 0))
    likely = likely_std([free.residual], [free.columns], [free.parameter], np.full(8, 1e-6))
    assert likely.gain < 4


def _largest(columns: FloatArray, problem: Problem, data: WindowData) -> int:
    """Return the command of the second window that moves it most."""
    size = np.where(_numbers(problem, data, columns.shape[2])[1] >= 0, np.abs(columns[1]).max(axis=0), 0.0)
    return int(_numbers(problem, data, columns.shape[2])[1, np.argmax(size)])


def _late(episode: SampledEpisode, command: int, periods: int) -> SampledEpisode:
    """Return the episode with one command that acts later."""
    begin, target = command_begins(episode)[command], episode.target.copy()
    target[begin : begin + periods] = episode.target[begin - 1]
    return dataclasses.replace(episode, target=target)


def test_a_column_is_what_a_late_command_does(noisy: Case, noisy_problem: Problem) -> None:
    """The command that moves the second window most, moved by hand by one period."""
    problem, latency = noisy_problem, np.array([noisy.latency_s])
    (data,) = problem.windows(40)
    columns = delay_columns(problem, noisy.theta, noisy.latency_s, data)
    assert columns is not None
    k = _largest(columns, problem, data)
    (episode,) = problem.episodes
    other = problem.with_command_delays(None, [_late(episode, k, 1)])
    on_time, late = (p.predict(noisy.theta[None], latency, data).observed[0, 1] for p in (problem, other))
    by_hand = ((late - on_time) / data.std[1]).ravel() / episode.step_s
    assert np.abs(by_hand * DELAY_S).max() > 0.2
    np.testing.assert_allclose(columns[1, :, k % columns.shape[2]], by_hand, atol=1e-6)


def test_commands_move_to_their_likeliest_delay(noisy: Case, noisy_problem: Problem) -> None:
    """One command acts 4 ms late, without noise: in four steps it is moved by 4 periods.

    Delays stay unknowns around the mean.
    """
    plain, latency = noisy_problem, np.array([noisy.latency_s])
    (data,), (episode,) = plain.windows(40), plain.episodes

    def predicted(problem: Problem) -> FloatArray:
        return np.asarray(problem.predict(noisy.theta[None], latency, data).observed[0])

    def columns_of(problem: Problem) -> FloatArray:
        found = delay_columns(problem, noisy.theta, noisy.latency_s, data)
        assert found is not None
        return found

    late = _largest(columns_of(plain), plain, data)
    measured = predicted(plain.with_command_delays(None, [_late(episode, late, 4)]))
    known = CommandDelays(5e-3, noisy.theta, noisy.latency_s, ({},))
    problem = plain.with_command_delays(known)
    for _ in range(4):
        residual = ((predicted(problem) - measured) / data.std).reshape(len(data.windows), -1)
        # Nothing but the delays is unknown.
        rows = FreeRows(residual, columns_of(problem), np.zeros((*residual.shape, 0)))
        episodes, shift, changed = moved_commands(problem, [data], [rows], 5e-3)
        problem = problem.with_command_delays(dataclasses.replace(known, shift=shift), episodes)
    assert not changed
    begin = int(command_begins(episode)[late])
    assert {period: by for period, by in shift[0].items() if by} == {begin + 4: 4}
    # The measurements take the straight part of the move, so that a delay of 0 is still the likeliest.
    (around,) = with_command_delays(problem, [data])
    columns = columns_of(problem)
    alone = _numbers(problem, data, columns.shape[2]) == late
    by = 0.004 * np.einsum("wdp,wp->wd", columns, alone).reshape(data.measured.shape)
    np.testing.assert_allclose(around.measured, data.measured + by * data.std, atol=1e-12)


def test_a_fit_of_a_part_is_judged_by_that_part(noisy: Case, noisy_problem: Problem) -> None:
    """A local fit that explains nothing ends after a part of the recordings, with that part's windows."""
    usable = [np.arange(len(e.sample)) < len(e.sample) // 2 for e in noisy_problem.episodes]
    found = refine(noisy_problem.part(usable), noisy.theta, noisy.latency_s, (0.2,), 1)
    assert fit_delays(noisy_problem, found, EVIDENCE).found is None


def test_a_cause_is_whitened_as_the_residual_is(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Its effect times (1 + s^2 D D^T)^-1/2; otherwise a diagnosis looks for friction where there is none."""
    plain, problem = noisy_refined, noisy_problem
    delays = CommandDelays(DELAY_S, plain.theta, plain.latency_s, ({},))
    delayed = problem.with_command_delays(delays)
    fit = dataclasses.replace(plain, shooting=Shooting(delayed, plain.shooting.length))
    (data,) = plain.shooting.data
    columns = delay_columns(problem, plain.theta, plain.latency_s, data)
    assert columns is not None
    size, axes = np.linalg.eigh(DELAY_S**2 * columns @ np.swapaxes(columns, 1, 2))
    W = (axes / np.sqrt(1 + np.maximum(size, 0.0))[:, None]) @ np.swapaxes(axes, 1, 2)
    before, after = signatures(problem, plain), signatures(delayed, fit)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(other.columns[0], W @ one.columns[0], atol=1e-6, err_msg=one.cause)
    changed = [not np.allclose(a.columns[0], b.columns[0]) for a, b in zip(before, after, strict=True)]
    assert "friction" in {a.cause for a, c in zip(before, changed, strict=True) if c}


def _jittering(seed: int, stribeck_ratio: float = 0.0) -> Case:
    profile = dataclasses.replace(
        PROFILES["sensor"],
        name="jittering",
        latency_ticks=(5, 25),
        actuation_jitter_ticks=3,
        stribeck_ratio=stribeck_ratio,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PROFILES, "jittering", profile)
        return make_case("cartpole", "jittering", seed, 5.0)


def _problem_of(case: Case, free: tuple[str, ...]) -> tuple[Problem, FloatArray]:
    """Return the problem in which the others have their true values, and all true values, (K,)."""
    truth = dict(zip(case.space.names, map(float, case.theta), strict=True))
    space = case.space.with_known({name: value for name, value in truth.items() if name not in free})
    theta = np.array([truth[name] for name in space.names])
    return Problem(case.robot, space, [case.fit], threads=1), theta


@pytest.fixture(scope="module")
def jittering() -> Case:
    """A demonstration over a link on which each command acts 0 to 3 ms later; nothing else is unknown."""
    return _jittering(0)


@pytest.mark.slow
def test_the_mean_delay_of_a_jittering_link_is_found(jittering: Case) -> None:
    """Latency, its interval, parameters and the noise; one constant delay leaves a chi2 above 2."""
    # Those that late commands move most; the others are known.
    free = ("cart.mass", "servo.stiffness", "servo.damping", "servo.speed_limit")
    problem, theta = _problem_of(jittering, free)
    space = problem.space
    constant = refine(problem, theta, jittering.latency_s)
    assert constant.chi2 > 2
    late = fit_delays(problem, constant, EVIDENCE).found
    assert late is not None and late.fit.chi2 < 1.1
    assert late.found.std_s == pytest.approx(1.12e-3, rel=0.5)
    known = uncertainty_at(late.problem, with_rows(late.fit))
    low, high = known.latency_interval_s
    assert low <= jittering.latency_s <= high and high - low < 3e-3
    assert np.all((known.interval[:, 0] <= theta) & (theta <= known.interval[:, 1]))
    # Delays also take up what else a model lacks: no interval is narrower than with one constant delay.
    wide, before = late.widened(known, late.fit.latency_s), uncertainty_at(problem, with_rows(constant))
    assert np.all(np.diag(wide.covariance) >= np.diag(before.covariance) * (1 - 1e-9))
    assert np.ptp(wide.latency_interval_s) >= 0.99 * np.ptp(before.latency_interval_s)
    # Commands that a part of a recording counts from another beginning have no known delays.
    assert late.problem.on([jittering.fit], None).command_delays is None
    assert dataclasses.replace(late.problem, episodes=[jittering.fit]).command_delays is None
    more = Parameter.around("cart.more", "dof_damping", ("cart",), "N·s/m", 0.1)
    more_delays = late.problem.with_more([more]).command_delays
    assert more_delays is not None and more_delays.theta.shape == (len(space) + 1,)


@pytest.mark.slow
def test_delays_are_asked_of_windows_that_do_not_hold_too_many_commands(
    jittering: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the longest windows of a fit do, those of its last stage before them are asked."""
    problem, theta = _problem_of(jittering, ("cart.mass", "servo.stiffness", "servo.damping"))
    short, long = (refine(problem, theta, jittering.latency_s, (seconds,)) for seconds in STAGES_S[:2])
    constant = dataclasses.replace(long, shorter=short)
    most = max(commands_of(problem, data) for data in long.shooting.data)
    for module in (command_delays_module, random_delay_module):
        monkeypatch.setattr(module, "MOST_COMMANDS", most - 1)
    assert fit_delays(problem, long, EVIDENCE) == DelaysAsked()
    late = fit_delays(problem, constant, EVIDENCE).found
    assert late is not None and late.before is constant
    assert late.fit.chi2 < 1.1 and late.fit.shooting.length == short.shooting.length


@pytest.mark.slow
def test_a_wrong_friction_law_leaves_the_mean_delay_in_its_interval() -> None:
    """Friction that is 40 % larger at standstill moves the latency by 6 ms; the delays vary by 1.1 ms.

    Whole ticks gave it an interval of 2 ms around the wrong value, and halves of the data left it alone.
    """
    case = _jittering(3, stribeck_ratio=0.4)
    problem, theta = _problem_of(case, ("cart.frictionloss", "servo.stiffness", "servo.damping"))
    fit = refine(problem, theta, case.latency_s, (0.2, 0.4))
    assert fit.latency_s - case.latency_s > 4e-3
    assert fit.shorter is not None and fit.shorter.shooting.length < fit.shooting.length
    rng = np.random.default_rng(0)
    run = CalibrationRun(
        problem=problem,
        budget=Budget(),
        rng=rng,
        attempts=Restarts(Eki(), rng, None),
        settings=Validation(physics_step=False, diagnosis=False, thorough=True),
        first_steps=problem.steps,
    )
    found = conclude_fit(run, None, fit)
    low, high = found.known.latency_interval_s
    assert low <= case.latency_s <= high and "latency_scan" not in found.facts
    json.dumps(found.facts)
    # It is wide, and is reported to be.
    assert high - low < 20e-3 and found.facts["split_half"]["scale"] > 1.5
    # A residual above the noise is no random error.
    assert fit.chi2 > MISMATCH_CHI2 and "random_errors" not in found.facts


@pytest.mark.parametrize(("std_s", "tried"), [(0.012, True), (0.021, False)])
def test_delays_that_vary_by_more_than_latencies_do_are_something_else(
    std_s: float,
    tried: bool,
    noisy_problem: Problem,
    noisy_refined: Refined,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Latencies up to 40 ms have at most half of that as standard deviation, however rare commands are."""
    begun: list[Problem] = []

    def refused(problem: Problem, *_: object, **__: object) -> Refined:
        begun.append(problem)
        raise InsufficientDataError("no window")

    assert noisy_problem.latency_range_s[1] == 0.04
    monkeypatch.setattr(random_delay_module, "_random_delay", lambda *_: RandomDelay(99.0, 99.0, 0.5, std_s))
    monkeypatch.setattr(random_delay_module, "_likely", lambda *_: LikelyStd(std_s, 99.0, std_s))
    monkeypatch.setattr(random_delay_module, "command_spacing_s", lambda _: 0.1)
    monkeypatch.setattr(random_delay_module, "refine", refused)
    assert fit_delays(noisy_problem, noisy_refined, EVIDENCE).found is None
    assert bool(begun) is tried


def test_a_fit_is_asked_for_delays_once(
    noisy_problem: Problem, noisy_refined: Refined, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the search and after it, if that ended where the local fit was; another fit is asked itself."""
    asked: list[Refined] = []

    def none(problem: Problem, fit: Refined, least: float) -> DelaysAsked:
        assert problem is noisy_problem and least == EVIDENCE
        asked.append(fit)
        return DelaysAsked()

    monkeypatch.setattr(random_delay_module, "fit_delays", none)
    run = small_run(noisy_problem)
    other = dataclasses.replace(noisy_refined, theta=1.01 * noisy_refined.theta)
    same = dataclasses.replace(noisy_refined, theta=noisy_refined.theta.copy())
    for fit in (noisy_refined, same, other):
        assert dataclasses.replace(run, local=fit).random_delays(fit) == DelaysAsked()
    assert asked == [noisy_refined, other]


@pytest.mark.slow
def test_delays_longer_than_the_time_between_commands_are_found_without_a_search(tmp_path: Path) -> None:
    """Commands at 200 Hz, each 0 to 22 ms late, so many wait for those before them: chi2 5 becomes 1."""
    robot = make_robot("pendulum", 3, "jitter")
    model, data, held_out = write(robot, tmp_path, seconds=6.0)
    result = calibrate(model=model, data=data, holdout=held_out, threads=1).result
    assert result.provenance["search"] == "local fit" and result.chi2 < 1.1
    (row,) = (c for c in result.provenance["candidates"] if c["outcome"] == "taken")
    assert row["explanation"] == "a delay of its own for each command"
    assert "Each command acts after its own delay" in str(result.alarms[0])
    truth = np.array([robot.truth.get(p.name, p.nominal) for p in result.space])
    assert np.all((result.interval[:, 0] <= truth) & (truth <= result.interval[:, 1]))
    sized = truth != 0
    assert np.mean(np.abs(result.estimate[sized] / truth[sized] - 1)) < 0.15
