"""Ranges that nobody chose go on where the recordings press against their ends."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts, run_identity
from deal_hw.calib.fit.refinement import Refined, local_fit
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.methods import make_method
from deal_hw.calib.pipeline.wider_ranges import MOST, pressed, with_wider_ranges
from deal_hw.calib.report.verdict import trust
from deal_hw.calib.search.no_data import nominal
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget, Progress
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.parameters import wider, with_usual_range
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.result_folder import BestSoFar
from deal_hw.workflows.calibration.settings import FilesSettings

MODEL_DAMPING, TRUE_DAMPING = 0.02, 0.3
"""The truth is three times the higher end of the usual range, 0.1 N·m·s/rad."""
ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="shoulder" axis="0 1 0" damping="{damping}" frictionloss="0.02" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8"/></body>
</worldbody><actuator>
<motor name="shoulder" joint="shoulder" ctrlrange="-3 3"/></actuator></mujoco>"""
COLUMNS = """
time: time
joints:
  - {name: shoulder, position: shoulder, target: shoulder.command, unit: rad, target_unit: Nm}
"""
PERIOD_S, SECONDS, NOISE_RAD = 0.01, 5.0, 1e-3


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A model whose damping is far too low, and a recording of the arm."""
    folder = tmp_path_factory.mktemp("arm")
    model = mujoco.MjModel.from_xml_string(ARM.format(damping=TRUE_DAMPING))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    time = np.arange(round(SECONDS / PERIOD_S)) * PERIOD_S
    phase, frequency = rng.uniform(0, 2 * np.pi, 5), np.geomspace(0.2, 2.5, 5)
    command = 0.8 * np.sin(2 * np.pi * np.outer(time, frequency) + phase).sum(axis=1)
    position = np.empty(len(time))
    for row, torque in enumerate(command):
        position[row] = data.qpos[0]
        data.ctrl[0] = torque
        mujoco.mj_step(model, data, round(PERIOD_S / model.opt.timestep))
    position += rng.normal(0.0, NOISE_RAD, len(time))
    np.savez(folder / "swing.npz", **{"time": time, "shoulder": position, "shoulder.command": command})
    (folder / "columns.yaml").write_text(COLUMNS)
    (folder / "arm.xml").write_text(ARM.format(damping=MODEL_DAMPING))
    return {
        "model": folder / "arm.xml",
        "data": folder / "swing.npz",
        "columns": folder / "columns.yaml",
    }


def run_of(problem: Problem, said: list[str]) -> CalibrationRun:
    """Return the state of a calibration without a search."""

    def note(progress: Progress) -> None:
        said.append(progress.message)

    rng = np.random.default_rng(0)
    return CalibrationRun(
        problem=problem,
        budget=Budget(population=8, generations=1),
        rng=rng,
        attempts=Restarts(nominal(), rng, None),
        settings=Validation(),
        progress=note,
    )


def problem_of(files: dict[str, Path], **settings: object) -> Problem:
    """Return the problem of the arm, as `calibrate` makes it."""
    work = calibration_input(
        FilesSettings(
            model=files["model"],
            data=(files["data"],),
            columns=files["columns"],
            **settings,  # type: ignore[arg-type]
        )
    )
    return Problem(work.robot, work.space, work.episodes, threads=1, guessed=work.guessed)


def again(problem: Problem, fit: Refined) -> Refined | None:
    """Fit on."""
    return local_fit(problem, start=fit)


def test_calibrate_finds_a_value_far_outside_the_usual_range(files: dict[str, Path]) -> None:
    """Truth recovery: damping of 15 times the model's within 3 %, and the new range is noted and said."""
    said: list[str] = []
    found = deal_hw.calibrate(
        model=files["model"], data=files["data"], columns=files["columns"], threads=1, say=said.append
    )
    rows = {row["parameter"]: row for row in found.rows()}
    assert rows["shoulder.damping"]["estimate"] == pytest.approx(TRUE_DAMPING, rel=0.03)
    low, high = found.result.provenance["grown_ranges"]["shoulder.damping"]
    assert (low, high) == pytest.approx((MODEL_DAMPING / 10, MODEL_DAMPING * 100))
    assert found.result.space["shoulder.damping"].high == high
    assert any("shoulder.damping 0.002 to 2 N·m·s/rad" in text for text in said)
    assert not any("Ended at the bound" in alarm.seen for alarm in found.result.alarms)


def late(files: dict[str, Path], folder: Path, delay_s: float) -> dict[str, Path]:
    """Return files of the same arm whose commands act later than they are noted."""
    with np.load(files["data"]) as noted:
        columns = dict(noted)
    # The commands were sent earlier than they acted, so the recording begins as much later.
    shift = round(delay_s / PERIOD_S)
    time = columns["time"][: len(columns["time"]) - shift]
    sent, position = columns["shoulder.command"][shift:], columns["shoulder"][: len(time)]
    np.savez(folder / "late.npz", **{"time": time, "shoulder": position, "shoulder.command": sent})
    return files | {"data": folder / "late.npz"}


def test_calibrate_finds_a_latency_beyond_the_usual_range(files: dict[str, Path], tmp_path: Path) -> None:
    """Truth recovery: a delay of 60 ms within 2 ms, and the new range is noted and said."""
    said: list[str] = []
    own = late(files, tmp_path, 0.06)
    found = deal_hw.calibrate(
        model=own["model"], data=own["data"], columns=own["columns"], threads=1, say=said.append
    )
    assert found.result.latency_s == pytest.approx(0.06, abs=0.002)
    assert found.result.provenance["grown_ranges"]["latency"] == [0.0, 0.08]
    assert any("latency 0 to 0.08 s" in text and "--latency-range LOW HIGH" in text for text in said)
    assert [str(a) for a in found.result.alarms if "The latency ended" in a.seen] == []


@pytest.fixture(scope="module")
def fast_clock(files: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same arm under its right model, in a recording whose times were doubled."""
    folder = tmp_path_factory.mktemp("fast")
    with np.load(files["data"]) as noted:
        columns = dict(noted)
    np.savez(folder / "fast.npz", **columns | {"time": 2 * columns["time"]})
    (folder / "arm.xml").write_text(ARM.format(damping=TRUE_DAMPING))
    return files | {"data": folder / "fast.npz", "model": folder / "arm.xml"}


def test_a_wrong_clock_is_named_beside_values_beyond_the_usual_ranges(fast_clock: dict[str, Path]) -> None:
    """Twice the time looks like four times the inertia: both are named, and the verdict is red."""
    said: list[str] = []
    found = deal_hw.calibrate(**fast_clock, threads=1, say=said.append)
    result = found.result
    # (0.024 of the rod + 0.02) * 4 - 0.024: twice the time is a quarter of the acceleration.
    assert result.space["shoulder.armature"].high == pytest.approx(0.02 * 25)
    assert result.estimate[result.space.names.index("shoulder.armature")] == pytest.approx(0.152, rel=0.03)
    assert result.provenance["shared_error"]["errors"][0]["kind"] == "clock"
    verdict = trust(result)
    assert verdict.colour == "red" and "the clock were 2 times too fast" in verdict.seen
    assert "shoulder.armature = 0.15" in verdict.means and "usual: 0.004 to 0.1 kg·m²" in verdict.means
    assert "--range NAME LOW HIGH" in verdict.do
    assert any("If they are right, give the ranges yourself" in text for text in said)


def test_a_range_that_somebody_gave_is_no_sign_of_a_wrong_clock(fast_clock: dict[str, Path]) -> None:
    """The advice of that alarm ends it."""
    found = deal_hw.calibrate(**fast_clock, threads=1, range=(("shoulder.armature", 0.004, 0.5),))
    assert "shared_error" not in found.result.provenance and trust(found.result).colour != "red"


@pytest.mark.parametrize("given", [{"latency_range": (0.0, 0.05)}, {"latency": 0.01}])
def test_a_latency_that_somebody_gave_stays(
    files: dict[str, Path], tmp_path: Path, given: dict[str, object]
) -> None:
    """A given range or value of the latency is no guess, and an alarm asks for a wider range."""
    own = late(files, tmp_path, 0.06)
    settings = FilesSettings(model=own["model"], data=(own["data"],), columns=own["columns"], **given)  # type: ignore[arg-type]
    assert "latency" not in calibration_input(settings).guessed


@pytest.mark.parametrize("given", [{"range": (("shoulder.damping", 0.004, 0.101),)}, {"range_ratio": 5.0}])
def test_a_range_that_somebody_gave_stays(files: dict[str, Path], given: dict[str, object]) -> None:
    """A user's limits are facts about the robot; the fit ends at them."""
    problem = problem_of(files, **given)
    assert "shoulder.damping" not in problem.guessed
    fit = local_fit(problem)
    assert fit is not None
    said: list[str] = []
    run = run_of(problem, said)
    assert with_wider_ranges(run, fit, again) == (run, fit)
    assert not said
    # The same range as a guess grows.
    guessed = dataclasses.replace(problem, guessed=("shoulder.damping",))
    assert pressed(guessed, fit) == {"shoulder.damping": 1}


def test_a_range_grows_only_where_the_fit_becomes_better(files: dict[str, Path]) -> None:
    """A wider range in which nothing is gained, or the fit diverges, is not kept; and it ends."""
    problem = problem_of(files)
    fit = local_fit(problem)
    assert fit is not None and "shoulder.damping" in pressed(problem, fit)
    run, tries = run_of(problem, []), []

    def no_better(of: Problem, before: Refined) -> Refined:
        tries.append(of.space["shoulder.damping"].high)
        return before

    assert with_wider_ranges(run, fit, no_better) == (run, fit)
    assert with_wider_ranges(run, fit, lambda *_: None) == (run, fit)
    assert tries == [pytest.approx(2.0)]

    def at_the_new_end(of: Problem, before: Refined) -> Refined:
        theta = np.where(np.array(of.space.names) == "shoulder.damping", of.space.high, before.theta)
        tries.append(float(of.space["shoulder.damping"].high))
        return dataclasses.replace(before, theta=theta, chi2=before.chi2 / 2)

    wide, _ = with_wider_ranges(run, fit, at_the_new_end)
    assert tries[1:] == pytest.approx([2.0, 20.0]) and len(tries) == 1 + MOST
    assert wide.problem.space["shoulder.damping"].high == pytest.approx(20.0)


def test_a_state_of_a_search_knows_which_ranges_may_grow(files: dict[str, Path]) -> None:
    """A search in wider ranges does not go on from one in narrower ranges."""
    problem = problem_of(files)
    assert problem.guessed == (
        "shoulder.frictionloss",
        "shoulder.damping",
        "shoulder.armature",
        "shoulder.motor_gain",
        "shoulder.encoder_bias",
        "latency",
    )
    chosen = dataclasses.replace(problem, guessed=())
    first, again, other = (
        run_identity(of, make_method("default"), Budget(), np.random.default_rng(0))
        for of in (problem, problem, chosen)
    )
    assert first == again != other


def parameter(kind: str, nominal: float, low: float, high: float, **more: object) -> Parameter:
    """Return a parameter of a joint."""
    return Parameter(
        name=kind, kind=kind, elements=("j",), unit="-", nominal=nominal, low=low, high=high, **more  # type: ignore[arg-type]
    )  # fmt: skip


def test_which_ranges_are_usual() -> None:
    """A factor of 10, of 20 for dry friction, 0.3 to both sides for an asymmetry; and nobody gave a prior."""
    space = ParameterSpace(
        [
            parameter("dof_damping", 0.1, 0.1 / 10, 0.1 * 10),
            parameter("dof_frictionloss", 0.1, 0.1 / 20, 0.1 * 20),
            parameter("command_asymmetry", 0.0, -0.3, 0.3, scale="linear"),
            parameter("dof_armature", 0.1, 0.1 / 5, 0.1 * 5, prior_mean=0.1, prior_std=0.1),
            parameter("joint_stiffness", 0.1, 0.1 / 4, 0.1 * 5),
        ]
    )
    assert with_usual_range(space) == ("dof_damping", "dof_frictionloss", "command_asymmetry")


def test_a_range_goes_on_at_one_end_and_not_past_what_its_kind_allows() -> None:
    """By hand: 0.5 times 10 above, 0.005 over 20 below; an asymmetry is 1 at most."""
    space = ParameterSpace(
        [
            parameter("dof_damping", 0.1, 0.02, 0.5),
            parameter("dof_frictionloss", 0.1, 0.005, 2.0),
            parameter("command_asymmetry", 0.0, -0.5, 0.5, scale="linear"),
        ]
    )
    found = wider(space, {"dof_damping": 1, "dof_frictionloss": -1, "command_asymmetry": 1})
    assert (found["dof_damping"].low, found["dof_damping"].high) == (0.02, 5.0)
    assert (found["dof_frictionloss"].low, found["dof_frictionloss"].high) == (0.00025, 2.0)
    ends = []
    for _ in range(3):
        ends.append((found["command_asymmetry"].low, found["command_asymmetry"].high))
        found = wider(found, {"command_asymmetry": 1})
    assert ends == [(-0.5, 0.8), (-0.5, 1.0), (-0.5, 1.0)]


def test_an_interrupted_calibration_keeps_a_fit_outside_the_first_range() -> None:
    """Its range holds the value that a wider one found."""
    space = ParameterSpace([parameter("dof_damping", 0.1, 0.02, 0.5)])
    best = BestSoFar(space, None)
    best(Progress("local fit", 1, 1, "", estimate=np.array([1.2]), latency_s=0.0, values={"chi2": 1.0}))
    assert best.result is not None
    assert best.result.interval.tolist() == [[0.02, 1.2]] and best.result.space["dof_damping"].high == 1.2
