"""Half the physics step says whether the model's step is too coarse: a light hinge, truths of two steps."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.fit.intervals import Uncertainty, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import local_fit
from deal_hw.calib.fit.unexplained import Unexplained
from deal_hw.calib.pipeline.attempts import with_finer_step
from deal_hw.calib.pipeline.calibration_run import CalibrationRun, FitOutcome
from deal_hw.calib.search.eki import Eki
from deal_hw.calib.validation.settings import Validation
from deal_hw.calib.validation.time_steps import (
    CLEARLY,
    MOST_STEPS,
    StepCheck,
    check_step,
    counted,
    halved,
    step_alarm,
)
from deal_hw.calibration import Budget
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

HINGE = """
<mujoco model="hinge">
  <compiler angle="radian"/>
  <option timestep="{step}" integrator="implicitfast"/>
  <worldbody><body name="arm">
    <joint name="hinge" axis="0 1 0" armature="{armature}" damping="{damping}"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.05"/>
  </body></worldbody>
  <actuator><position name="hinge" joint="hinge" kp="8" kv="0"/></actuator>
</mujoco>
"""
PARAMETERS = """
parameters:
  - {kind: dof_damping, elements: hinge}
  - {kind: dof_armature, elements: hinge}
"""
TRUTH = np.array([0.1, 0.002])
STEP_S = 0.0025
NOISE = 3e-4


def recording(step_s: float) -> str:
    """Return a CSV of steps of the set-point, simulated with a physics step."""
    xml = HINGE.format(step=step_s, damping=TRUTH[0], armature=TRUTH[1])
    model = mujoco.MjModel.from_xml_string(xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(4)
    rows, wanted = ["time,hinge_pos,hinge_cmd"], 0.0
    for k in range(600):
        wanted = rng.uniform(-0.8, 0.8) if k % 20 == 5 else wanted
        rows.append(f"{0.01 * k:.3f},{data.qpos[0] + NOISE * rng.standard_normal():.7f},{wanted:.7f}")
        data.ctrl[0] = wanted
        mujoco.mj_step(model, data, round(0.01 / step_s))
    return "\n".join(rows) + "\n"


def checked(
    folder: Path, step_s: float, most_steps: float = MOST_STEPS
) -> tuple[Problem, Uncertainty, StepCheck]:
    """Return problem, what is known and what half the step says, of data with a step."""
    (folder / "hinge.xml").write_text(HINGE.format(step=STEP_S, damping="0.07", armature="0.003"))
    (folder / "params.yaml").write_text(PARAMETERS)
    (folder / "data.csv").write_text(recording(step_s))
    source = FilesSettings(
        model=folder / "hinge.xml",
        data=(folder / "data.csv",),
        parameters=folder / "params.yaml",
        holdout_part=0.0,
        threads=1,
    )
    work = calibration_input(source)
    problem = Problem(work.robot, work.space, work.episodes, threads=1, fixed_latency_s=0.0)
    fit = local_fit(problem, None)
    assert fit is not None
    fit = with_rows(fit)
    return (
        problem,
        uncertainty_at(problem, fit, fixed_latency=True),
        check_step(problem, fit, most_steps),
    )


def test_a_step_that_is_too_coarse_is_named_and_counted(tmp_path: Path) -> None:
    """Truth with a step of 0.1 ms, model with 2.5: the interval misses it, the counted one holds it."""
    problem, known, found = checked(tmp_path, 1e-4)
    inside = (known.interval[:, 0] <= TRUTH) & (known.interval[:, 1] >= TRUTH)
    assert not inside.all()
    wider = counted(problem, known, found).interval
    assert np.all(wider[:, 0] <= TRUTH) and np.all(wider[:, 1] >= TRUTH)
    assert found.gain > CLEARLY
    (alarm,) = step_alarm(known, found)
    # A shift that hardly changes predictions widens the intervals without an alarm.
    same = dataclasses.replace(found, share=0.02)
    assert step_alarm(known, same) == () and np.array_equal(counted(problem, known, same).interval, wider)
    assert "2.5 ms is too coarse" in alarm.means and "--physics-step 0.00125" in alarm.do
    assert "hinge.armature" in alarm.seen or "hinge.damping" in alarm.seen
    # Half the error is removed by half the step: corrected, the estimate is nearer the truth.
    corrected = problem.space.from_scale(problem.space.to_scale(known.theta) + found.bias[:-1])
    off, was = (np.abs(np.log(value / TRUTH)).max() for value in (corrected, known.theta))
    assert off < 0.5 * was


def test_recordings_simulated_with_the_models_own_step_raise_no_alarm(tmp_path: Path) -> None:
    """The finer step explains them worse: nothing is reported, no interval is widened."""
    problem, known, found = checked(tmp_path, STEP_S)
    assert found.gain < -CLEARLY and step_alarm(known, found) == ()
    assert counted(problem, known, found) is known
    assert np.all(known.interval[:, 0] <= TRUTH) and np.all(known.interval[:, 1] >= TRUTH)


def test_a_check_that_would_take_too_long_says_so(tmp_path: Path) -> None:
    """Nothing is compared, nothing is widened, and the provenance says why."""
    problem, known, found = checked(tmp_path, STEP_S, most_steps=10.0)
    assert "it would take" in found.to_json()["note"]
    assert counted(problem, known, found) is known and step_alarm(known, found) == ()


def test_the_halved_problem_shares_all_but_the_step(tmp_path: Path) -> None:
    """The model itself is not touched; steps count together, so a check is charged for them."""
    problem, *_ = checked(tmp_path, STEP_S)
    finer = halved(problem)
    assert finer.robot.step_s == pytest.approx(STEP_S / 2)
    assert problem.robot.step_s == pytest.approx(STEP_S)
    assert finer.starts is problem.starts and finer.steps == problem.steps > 0


@pytest.mark.slow
def test_a_step_that_fine_encoders_show_is_halved_before_a_search(tmp_path: Path) -> None:
    """A right model of 2 ms, on a grid of 2.5 ms, beside a robot of 0.25 ms: no search is needed.

    With 2.5 ms chi2 is 1.12, correlated over 4 samples, and play in the gears was named.
    """
    model, paths, held_out = write(make_robot("cart-pole", 0, "encoders"), tmp_path, seconds=3.0)
    work = calibration_input(FilesSettings(model=model, data=paths, holdout=held_out))
    problem = Problem(work.robot, work.space, work.episodes, threads=1)
    local = local_fit(problem)
    assert local is not None and local.chi2 > 1.1
    rng = np.random.default_rng(0)
    run = CalibrationRun(
        problem=problem, budget=Budget(), rng=rng, attempts=Restarts(Eki(), rng, None), settings=Validation()
    )
    finer = with_finer_step(run, local)
    assert isinstance(finer, FitOutcome) and finer.facts["fit_step_s"] < 0.002
    assert finer.chi2 == pytest.approx(1.0, abs=0.1)
    assert not [alarm for alarm in finer.known.alarms if isinstance(alarm, Unexplained)]
    # A poor fit has other reasons.
    assert with_finer_step(run, dataclasses.replace(local, chi2=9.0)) is run
