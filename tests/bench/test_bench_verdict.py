"""`bench verdict`: robots in plain MuJoCo with hidden truths and faults, and what its rows say."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.bench import verdict as bench_verdict
from deal_hw.bench.verdict import line, named_laws, names, robots, run_cell, summary
from deal_hw.calibration import Budget, CalibrationResult
from deal_hw.errors import UnknownNameError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.testing import plain_effects, plain_faults
from deal_hw.testing.plain_faults import COUNTS, FAULTS, LAWS, NOISE, WITH_MOTORS, WITH_STEPS, WITHOUT
from deal_hw.testing.plain_robots import KINDS, PlainRobot, can_have, make_robot, record, write
from deal_hw.types import FloatArray


def samples(robot: PlainRobot, seconds: float = 2.0) -> FloatArray:
    """Return the columns of a recording: time, positions, commands."""
    return np.loadtxt(record(robot, 0, seconds).splitlines(), delimiter=",", skiprows=1)


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_is_its_model_with_other_numbers(kind: str) -> None:
    """Same seed, same robot; truths lie within their factors of the model, which has the same joints."""
    robot, again, other = make_robot(kind, 3), make_robot(kind, 3), make_robot(kind, 4)
    assert robot == again and robot.truth != other.truth
    model, truth = (mujoco.MjModel.from_xml_string(text) for text in (robot.model, robot.robot))
    assert model.nq == truth.nq and model.nu == truth.nu
    assert np.all(np.abs(np.log(truth.dof_damping / model.dof_damping)) <= np.log(2.0) + 1e-9)
    assert np.allclose(truth.body_mass, model.body_mass)
    joint = model.joint(0).name
    assert robot.truth[f"{joint}.damping"] == pytest.approx(float(truth.dof_damping[0]))
    assert any(robot.delay_s == pytest.approx(0.001 * n) for n in range(2, 16))


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault not in WITHOUT])
def test_each_fault_changes_the_recording_beyond_noise(
    fault: plain_faults.Fault, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands are the same, positions differ by more than ten times the noise (jitter by 5, others by 4).

    A play of 1 degree behind the encoder changes what it reads by a count or two. Motors and limited servos
    are compared with such a drive without the fault.
    """
    kind = next(kind for kind in ("double-pendulum", "cart-pole") if can_have(kind, fault))
    wrong = samples(make_robot(kind, 1, fault))
    usual: plain_faults.Fault | plain_faults.RightModel | None = "encoders" if fault == "motor-play" else None
    if fault in (*WITH_MOTORS, *WITH_STEPS):
        usual = fault
        monkeypatch.setattr(plain_effects, "COMMANDS", {})
        monkeypatch.setattr(plain_effects, "FORCES", {})
    right, joints = samples(make_robot(kind, 1, usual)), len(KINDS[kind].joints)
    assert np.array_equal(right[:, 1 + joints :], wrong[:, 1 + joints :])
    least = {"jitter": 5 * NOISE, "motor-play": 0.9 * COUNTS["hinge"]}
    least |= dict.fromkeys(("zeros", "friction-rise"), 4 * NOISE)
    apart = np.abs(right[:, 1 : 1 + joints] - wrong[:, 1 : 1 + joints]).max()
    assert apart > least.get(fault, 10 * NOISE)


def test_a_robot_with_encoders_has_whole_counts_and_its_models_values() -> None:
    """The PD's damping stands in for the joint's: both robots move alike; the model is coarse."""
    plain, encoders = (make_robot("arm", 1, fault) for fault in (None, "encoders"))
    assert plain.truth == encoders.truth and encoders.delay_s == plain.delay_s
    first, second = samples(plain)[:, 1:4], samples(encoders)[:, 1:4]
    count = COUNTS["hinge"]
    assert np.allclose(second / count, np.round(second / count), atol=1e-4)
    assert np.abs(first - second).max() < 5 * NOISE
    assert mujoco.MjModel.from_xml_string(encoders.model).opt.timestep == 0.002


def test_the_mass_fault_makes_the_last_link_half_as_heavy_again() -> None:
    """0.3 kg in the model, 0.45 kg in the robot; the other link is right."""
    robot = make_robot("double-pendulum", 0, "mass")
    model, truth = (mujoco.MjModel.from_xml_string(text) for text in (robot.model, robot.robot))
    assert model.body("fore").mass[0] == pytest.approx(0.3)
    assert truth.body("fore").mass[0] == pytest.approx(0.45)
    assert truth.body("upper").mass[0] == model.body("upper").mass[0]


def test_a_truth_outside_its_range_is_an_error_and_no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    """A damping a thousand times the model's: no colour, since no search could find it."""
    robot = make_robot("pendulum", 1)
    name = next(name for name in robot.truth if name.endswith(".damping"))
    damped = dataclasses.replace(robot, truth={**robot.truth, name: 1e3 * robot.truth[name]})
    monkeypatch.setattr(bench_verdict, "make_robot", lambda *_: damped)
    row = run_cell("pendulum", "", 1, budget=Budget(population=4, generations=1), threads=1)
    assert name in row["error"] and "outside its search range" in row["error"] and "colour" not in row


def test_an_unknown_robot_is_refused() -> None:
    """The message lists the robots."""
    with pytest.raises(UnknownNameError, match="pendulum"):
        make_robot("pendulu", 0)


@pytest.mark.parametrize(
    ("fault", "causes", "sentences", "named"),
    [
        ("", [], [], True),
        ("friction", ["damping", "friction"], [], True),
        ("friction", [], ["friction law, backlash or a varying delay"], False),
        ("jitter", ["delay"], [], True),
        ("mass", ["backlash"], [], False),
        ("sign", [], ["check the sign in the column map"], True),
        ("sign", ["friction"], ["the model does not explain the recording"], False),
    ],
)
def test_a_fault_is_named_by_its_cause_only(
    fault: str, causes: list[str], sentences: list[str], named: bool
) -> None:
    """A sentence that lists all usual causes names none."""
    assert names("pendulum", fault, causes, sentences) is named


@pytest.mark.parametrize("fault", LAWS)
def test_a_law_names_its_fault_and_its_cause_does_not(fault: str) -> None:
    """All drives have one cause, so the law itself is asked for; every other one is another fault.

    Stribeck friction and play are named by their causes, too.
    """
    own = LAWS[fault]  # type: ignore[index]
    others = [law for laws in LAWS.values() for law in laws if law not in own]
    assert all(names("pendulum", fault, [], [], [law]) for law in own)
    assert not names("pendulum", fault, ["drive", "scale"], [], others)
    assert names("pendulum", fault, ["friction"], [], others) == (fault == "friction")
    assert names("pendulum", fault, ["backlash"], [], others) == (fault in ("backlash", "motor-play"))


@pytest.mark.parametrize(
    ("joint", "low", "high", "named"),
    [
        ("pole", 0.05, 0.4, True),
        ("pole", 0.3, 0.9, True),
        ("pole", -0.9, 0.05, False),
        ("slide", 0.1, 0.3, False),
    ],
)
def test_a_blind_encoder_is_named_by_its_place(joint: str, low: float, high: float, named: bool) -> None:
    """The joint's name and a stretch that meets the gap, which begins at 0.1 rad and ends at 0.36."""
    text = f"80 % of its square lies where {joint} is between {low:.2f} and {high:.2f} rad, with 9 %"
    assert names("cart-pole", "blind-encoder", ["friction"], [text]) is named


def test_laws_that_are_taken_or_named_count() -> None:
    """What was only tried names nothing."""
    space = ParameterSpace([Parameter.encoder_bias("pivot", 0.1)])
    found = CalibrationResult(
        method="local fit",
        space=space,
        estimate=space.nominal,
        interval=np.stack([space.low, space.high], axis=1),
        latency_s=0.0,
    )
    outcomes = {"a": "taken", "b": "named", "c": "chance", "d": "not named"}
    rows = [{"explanation": name, "outcome": outcome} for name, outcome in outcomes.items()]
    assert named_laws(dataclasses.replace(found, provenance={"candidates": rows})) == ["a", "b"]
    assert named_laws(found) == []


def test_cells_begin_with_right_models() -> None:
    """Five robots without a fault for each seed, then each fault, with the robots that can have it."""
    found = robots([0, 1])
    able = sum(can_have(kind, fault) for kind in KINDS for fault in FAULTS)
    assert len(found) == 2 * (len(KINDS) + able) and able < len(KINDS) * len(FAULTS)
    assert {fault for _, fault, _ in found[: 2 * len(KINDS)]} == {""}
    assert [kind for kind, fault, _ in found if fault == "encoder-scale"] == ["cart-pole"] * 2


def test_robots_and_faults_are_chosen_by_name() -> None:
    """The right model is called none."""
    assert robots([7], ["arm"], ["none", "sign"]) == [("arm", "", 7), ("arm", "sign", 7)]
    with pytest.raises(UnknownNameError, match="unknown fault 'wobble'"):
        robots([7], [], ["wobble"])


@pytest.mark.slow
def test_a_right_pendulum_ends_green(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrated from CSV and MJCF as a user would: truths in the intervals, no search, one line."""

    def short(robot: PlainRobot, folder: Path) -> tuple[Path, list[Path], Path]:
        return write(robot, folder, seconds=3.0)

    monkeypatch.setattr(bench_verdict, "write", short)
    row = run_cell("pendulum", "", 2, budget=Budget(population=8, generations=2), threads=1)
    assert row["colour"] == "green" and row["search"] == "local fit" and row["alarms"] == []
    assert row["coverage90"] >= 0.75 and row["latency_found"] == pytest.approx(row["latency_true"], abs=1e-3)
    assert "green" in line(row) and "1 robots, 1 green" in summary([row])[0]
