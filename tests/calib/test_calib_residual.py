"""Multiple shooting: predictions that are kept, and fits that start from a fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import at_parameters, refine, refine_windows
from deal_hw.calib.fit.residual import Point, Shooting
from deal_hw.calib.hypotheses.laws import HYPOTHESES
from deal_hw.calib.validation.time_steps import scan_latency
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings


def stepped(shooting: Shooting, problem: Problem) -> tuple[Point, Point]:
    """Return a point at the nominal values and where start states follow a step to."""
    here = shooting.start(problem.space.nominal, 0.004)
    step = np.append(0.02 * np.cos(np.arange(len(problem.space))), 1e-4)
    return here, shooting.followed(here, shooting.normal(here), step)


@pytest.mark.parametrize("central", [False, True])
def test_kept_predictions_are_those_of_the_point(
    small_problem: Callable[..., Problem], central: bool
) -> None:
    """A fit that has just predicted at a point gives the same numbers as one that has not."""
    problem = small_problem()
    kept, fresh = Shooting(problem, 20), Shooting(problem, 20)
    _, point = stepped(kept, problem)
    before = problem.steps
    cost, residuals = kept.cost(point), kept.residuals(point)
    assert problem.steps == before
    assert cost == fresh.cost(point)
    for a, b in zip(residuals, Shooting(problem, 20).residuals(point), strict=True):
        np.testing.assert_array_equal(a, b)
    one, other = (s.normal(point, central=central) for s in (kept, Shooting(problem, 20)))
    np.testing.assert_array_equal(one.hessian, other.hessian)
    np.testing.assert_array_equal(one.gradient, other.gradient)


def test_kept_predictions_are_not_used_at_another_point(small_problem: Callable[..., Problem]) -> None:
    """Points in turn: each time the numbers are that point's own."""
    problem = small_problem()
    shooting = Shooting(problem, 20)
    here, there = stepped(shooting, problem)
    costs = [shooting.cost(p) for p in (here, there, here)]
    assert costs[0] == costs[2] == Shooting(problem, 20).cost(here) != costs[1]


def test_a_scan_of_the_latency_ends_where_each_tick_fitted_alone_ends(
    small_problem: Callable[..., Problem],
) -> None:
    """The start that the free latency's fit foretells leads to the same least cost."""
    problem = small_problem(latency_ticks=3, fixed_latency_s=None)
    free = refine(problem, problem.space.nominal, 0.004, (0.2,))
    scan = scan_latency(problem, free, None)
    assert scan is not None
    tick_s = problem.episodes[0].step_s
    for tick, found in zip(scan.ticks, scan.refined, strict=True):
        start = free.shooting.start(free.theta, tick * tick_s)
        alone = refine_windows(free.shooting.on(free.shooting.data, fixed_latency=True), start, 10)
        assert found.normal.cost == pytest.approx(alone.normal.cost, rel=2e-3)
    assert scan.ticks[scan.best] == 3


def test_a_start_state_behind_a_kink_starts_again(tmp_path: Path) -> None:
    """Dry friction: of 28 windows two stay where their velocity has the wrong sign, and chi2 is 15.

    The parameters are the true ones, so 1 is right. Windows from smoothed start states end there.
    """
    robot = make_robot("pendulum", 0)
    model, paths, held_out = write(robot, tmp_path, seconds=3.0)
    work = calibration_input(FilesSettings(model=model, data=paths, holdout=held_out))
    problem = Problem(work.robot, work.space, work.episodes, threads=1)
    theta = np.array([robot.truth.get(p.name, p.nominal) for p in problem.space])
    right = at_parameters(problem, theta, robot.delay_s, 40)
    states = right.shooting.states(right.point)
    disturbed = [(x - 0.02, v - 0.6 * np.sign(v)) for x, v in states]
    found = at_parameters(problem, theta, robot.delay_s, 40, disturbed)
    assert right.chi2 == pytest.approx(1.0, abs=0.15)
    assert found.chi2 == pytest.approx(right.chi2, abs=0.1)


def test_a_window_may_start_where_the_one_before_it_ends(small_problem: Callable[..., Problem]) -> None:
    """By the prediction of one window of twice the length."""
    problem = small_problem()
    short, long = Shooting(problem, 20), Shooting(problem, 40)
    theta = problem.space.nominal
    handed_on = short.states(short.start(theta, 0.0), handed_on=True)
    own, through = short.states(short.start(theta, 0.0)), long.states(long.start(theta, 0.0))
    first = int(short.data[0].windows.start[0])
    for e, (x, v) in enumerate(handed_on):
        for found, start, expected in zip((x, v), own[e], through[e], strict=True):
            np.testing.assert_allclose(found[first + 20], expected[first + 20], rtol=1e-9)
            assert not np.array_equal(found[first + 20], start[first + 20])


@pytest.mark.parametrize("law", ["friction that falls with speed", "drives that lag"])
def test_windows_that_are_simulated_together_are_predicted_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, law: str
) -> None:
    """Laws act by array code between the steps: with several windows at once it runs a fraction as often."""
    model, paths, _ = write(make_robot("arm", 3), tmp_path, seconds=3.0)
    work = calibration_input(FilesSettings(model=model, data=paths, threads=1))
    plain = Problem(work.robot, work.space, work.episodes, threads=1)
    more = next(each for each in HYPOTHESES if each.name == law).parameters(plain)
    found = []
    for together in (1, 64):
        monkeypatch.setattr("deal_hw.calib.data.problem.TOGETHER", together)
        wide = plain.with_more(more)
        shooting = Shooting(wide, 20)
        before = wide.steps
        normal = shooting.normal(shooting.start(wide.space.nominal, 0.004))
        found.append((normal.hessian, normal.gradient, wide.steps - before))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


TWO = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body><joint name="left" axis="0 1 0" damping=".05" armature=".01" frictionloss=".02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/></body>
  <body pos="0 1 0"><joint name="right" axis="0 1 0" damping=".05" armature=".01" frictionloss=".02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".4"/></body>
</worldbody><actuator><position name="left" joint="left" kp="8"/>
  <position name="right" joint="right" kp="8"/></actuator></mujoco>
"""


@pytest.mark.parametrize("central", [False, True])
def test_independent_pendulums_share_simulations(tmp_path: Path, central: bool) -> None:
    """Ten parameters, a latency and four entries of start states: 8 simulations instead of 15."""
    model, rng = mujoco.MjModel.from_xml_string(TWO), np.random.default_rng(0)
    data, rows = mujoco.MjData(model), []
    for k in range(250):
        data.ctrl[:] = 0.5 * np.sin(0.13 * k), 0.4 * np.sin(0.17 * k)
        rows.append([0.01 * k, *(data.qpos + 1e-4 * rng.standard_normal(2)), *data.ctrl])
        mujoco.mj_step(model, data, 5)
    names = ("time", "left_pos", "right_pos", "left_cmd", "right_cmd")
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header=",".join(names), comments="")
    (tmp_path / "two.xml").write_text(TWO, encoding="utf-8")
    settings = FilesSettings(
        model=tmp_path / "two.xml", data=(tmp_path / "r.csv",), holdout_part=0.0, threads=1
    )
    work = calibration_input(settings)
    problem = Problem(work.robot, work.space, work.episodes, threads=1)
    assert problem.trees[0].tolist() == [0, 1] and len(problem.space) == 10
    alone = problem.sharing(trees=(np.zeros(2, dtype=np.int64),))
    steps, found = [], []
    for of in (problem, alone):
        shooting = Shooting(of, 20)
        point = shooting.start(of.space.nominal, 0.004)
        shooting.cost(point)
        before = of.steps
        found.append(shooting.normal(point, keep=True, central=central))
        steps.append(of.steps - before)
    assert steps[0] * 15 == steps[1] * 8
    together, apart = (f.rows[0] for f in found)
    for mine, other in ((together.parameter, apart.parameter), (together.start, apart.start)):
        np.testing.assert_allclose(mine, other, rtol=1e-6, atol=1e-6 * np.abs(other).max())


def test_between_two_ticks_there_is_no_scan(small_problem: Callable[..., Problem]) -> None:
    """The latency's curvature says how many standard deviations the nearest whole tick is away: over ten."""
    problem = small_problem(latency_ticks=3, fixed_latency_s=None)
    free = refine(problem, problem.space.nominal, 0.004, (0.2,))
    between = dataclasses.replace(free, latency_s=2.5 * problem.episodes[0].step_s)
    assert scan_latency(problem, between, None) is None
