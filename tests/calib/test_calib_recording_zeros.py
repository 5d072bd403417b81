"""The zero of an encoder in each recording as a signature: who is told apart, and what is said."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from fakes.knee_evidence import STD, knee_evidence, knee_motion, moved_by
from fakes.sine_arm import MJCF, record

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calib.hypotheses.diagnosis import name_causes
from deal_hw.calib.hypotheses.recording_zeros import (
    MOST_ZERO,
    named_zeros,
    next_zeros,
    own_zeros,
    zeros_of,
)
from deal_hw.calib.hypotheses.signatures import Signature, by_recording
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings


def test_each_recording_gets_its_own_zero() -> None:
    """Parts between gaps share one; other recordings are untouched by it, and a single one has none."""
    columns = tuple(np.full((2, 3, 1), float(k)) for k in (1, 2, 3))
    zero, load = Signature("zero", "elbow", columns, "rad"), Signature("load", "elbow", columns)
    found = by_recording([zero, load], ["a", "a", "b"])
    assert found[0] is load and [s.cause for s in found[1:]] == ["zero", "zero"]
    (a, b) = ([float(c.max()) for c in s.columns] for s in found[1:])
    assert a == [1.0, 2.0, 0.0] and b == [0.0, 0.0, 3.0]
    assert {s.unit for s in found[1:]} == {"rad"}
    assert by_recording([zero, load], ["a", "a", "a"]) == [load]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Return the problem of an arm in two recordings, without zeros."""
    folder = tmp_path_factory.mktemp("two")
    (folder / "arm.xml").write_text(MJCF, encoding="utf-8")
    (folder / "p.yaml").write_text("parameters:\n  - {kind: dof_damping, elements: '*'}\n", encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = [record(model, folder / f"{name}.csv", seed, 2.2) for seed, name in enumerate("ab")]
    settings = FilesSettings(
        model=folder / "arm.xml",
        data=tuple(data),
        parameters=folder / "p.yaml",
        holdout_part=0.0,
        threads=1,
    )
    work = calibration_input(settings)
    return Problem(work.robot, work.space, work.episodes, threads=1, fixed_latency_s=0.0)


def test_a_zero_of_one_recording_has_no_derivative_in_another(two: Problem) -> None:
    """In its own recording it has that of a zero that all share; others are not simulated for it."""
    shared = [Parameter.encoder_bias(joint, MOST_ZERO) for joint in ("pitch", "elbow")]
    own = own_zeros({"pitch": "rad", "elbow": "rad"}, ["a.csv", "b.csv"])
    rows = []
    for more in (shared, own):
        wide = two.with_more(more)
        shooting = Shooting(wide, 20)
        point = shooting.start(wide.space.nominal, 0.0)
        rows.append(shooting.normal(point, keep=True).rows)
        if more is own:
            assert wide.reach(0).any(axis=1).tolist() == [True, True, True, True, True, False, False]
    for e in (0, 1):
        (with_shared, with_own) = (rows[k][e].parameter for k in (0, 1))
        mine, other = slice(3 + 2 * e, 5 + 2 * e), slice(5 - 2 * e, 7 - 2 * e)
        np.testing.assert_allclose(with_own[..., mine], with_shared[..., 3:5], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(with_own[..., :3], with_shared[..., :3], rtol=1e-9, atol=1e-9)
        assert np.abs(with_own[..., mine]).max() > 1 and not with_own[..., other].any()


def test_start_states_take_the_same_step_without_derivatives_by_parameters(two: Problem) -> None:
    """And the steps of these derivatives are saved: of 3 parameters and a latency, beside 6 states."""
    shooting = Shooting(two, 20)
    point = shooting.start(two.space.nominal, 0.0)
    shooting.cost(point)
    before = two.steps
    whole = shooting.normal(point)
    between = two.steps
    fast = shooting.normal(point, states_only=True)
    assert (two.steps - between) / (between - before) == pytest.approx(6 / 10, abs=0.01)
    assert fast.cost == whole.cost
    for (_, one), (_, other) in zip(whole.back, fast.back, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


def test_the_next_zero_is_predicted_from_those_found() -> None:
    """Of 0.01 and 0.03: mean 0.02, std 0.0141 of them, and 0.0173 of a further one."""
    own = own_zeros({"elbow": "rad"}, ["a", "b"])
    space = ParameterSpace([Parameter.around("d", "dof_damping", ["elbow"], "N·m·s/rad", 0.1), *own])
    theta = np.array([0.1, 0.01, 0.03])
    assert zeros_of(space, theta) == {"elbow": {"a": 0.01, "b": 0.03}}
    more, mean, std = next_zeros(space, theta)
    assert [p.name for p in more] == ["elbow.encoder_bias"] and not more[0].setup
    assert mean == pytest.approx([0.02]) and std == pytest.approx([0.017320508])
    assert next_zeros(ParameterSpace(space.free[:1]), theta[:1])[0] == []


def test_an_alarm_has_the_zeros_of_six_recordings() -> None:
    """And says how many more there are."""
    words = named_zeros("elbow", "rad", {f"r{k}": 0.01 * k for k in range(8)})
    assert words.startswith("elbow: +0 rad in r0, +0.01 rad in r1") and words.endswith("r5, and in 2 more")


def test_no_zero_that_one_would_see_is_named() -> None:
    """A yaw joint about a vertical axis whose zero moves next to nothing would need 500 rad."""
    v, a = knee_motion()
    effects = {"knee": moved_by(np.sign(v)), "yaw": 1e-6 * moved_by(a)}
    zeros = [Signature("zero", where, (moved[..., None] / STD,), "rad") for where, moved in effects.items()]
    residual = -0.05 * effects["knee"] - 500 * effects["yaw"]
    known = dataclasses.replace(knee_evidence(residual), names=["a"], found=zeros)
    (found,) = name_causes(known)
    assert found.code == "zero" and found.subject == ("knee",) and "knee: +0.05 rad in a" in found.seen
    assert name_causes(dataclasses.replace(known, found=zeros[1:])) == []
