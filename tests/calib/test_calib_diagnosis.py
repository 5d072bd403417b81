"""The look of a residual names its cause: residuals of one joint, made by hand from each cause."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.validation.diagnosis import Finding, Motion, diagnose, held_direction
from deal_hw.types import FloatArray

WINDOWS, SAMPLES, PERIOD_S, STD = 12, 80, 0.005, 1e-4
DAMPING = 2.0
"""Of the joint that all of this is about: its velocity decays with 1 / DAMPING seconds [1/s]."""

Force = Callable[[FloatArray, FloatArray], FloatArray]


def _motion() -> tuple[FloatArray, FloatArray]:
    """Return velocity and acceleration of a joint that stirs, (W, H) [rad/s, rad/s^2]."""
    t = (np.arange(WINDOWS * SAMPLES) * PERIOD_S).reshape(WINDOWS, SAMPLES)
    velocity, acceleration = np.zeros_like(t), np.zeros_like(t)
    for f, a, phase in ((0.9, 0.4, 0.0), (2.3, 0.3, 1.0), (4.1, 0.1, 2.0)):
        w = 2 * np.pi * f
        velocity += a * np.sin(w * t + phase)
        acceleration += a * w * np.cos(w * t + phase)
    return velocity, acceleration


def _moved_by(force: FloatArray) -> FloatArray:
    """Integrate x'' = -DAMPING x' + force in small steps from rest in each window, (W, H)."""
    fine = 20
    x, v = np.zeros(WINDOWS), np.zeros(WINDOWS)
    out = np.zeros((WINDOWS, SAMPLES))
    for h in range(SAMPLES):
        for _ in range(fine):
            v += (force[:, h] - DAMPING * v) * PERIOD_S / fine
            x += v * PERIOD_S / fine
        out[:, h] = x
    return out


def _diagnosed(wrong: FloatArray, columns: tuple[FloatArray, ...] = ()) -> tuple[Finding, ...]:
    """Diagnose white noise plus what is wrong, (W, H) [rad]; ``columns`` are what free parameters do."""
    rng = np.random.default_rng(0)
    velocity, _ = _motion()
    time = np.arange(1, SAMPLES + 1) * PERIOD_S
    kick = np.broadcast_to((1 - np.exp(-DAMPING * time)) / DAMPING / STD, (WINDOWS, SAMPLES))
    start = np.stack([np.full((WINDOWS, SAMPLES), 1 / STD), kick], axis=-1)
    known = np.broadcast_to(np.diag([1 / STD, 1 / 30.0]), (WINDOWS, 2, 2))
    residual = rng.normal(size=(WINDOWS, SAMPLES)) + wrong / STD
    parameter = np.stack([c / STD for c in (*columns, rng.normal(size=(WINDOWS, SAMPLES)))], axis=-1)
    rows = WindowRows(
        0,
        np.concatenate([residual, rng.normal(size=(WINDOWS, 2))], axis=1),
        np.concatenate([parameter, np.zeros((WINDOWS, 2, parameter.shape[2]))], axis=1),
        np.concatenate([start, known], axis=1),
    )
    # The hessian with start states eliminated, as the refinement has it.
    js, jp = rows.start, rows.parameter
    gain = np.linalg.solve(np.einsum("wrs,wrt->wst", js, js), np.einsum("wrs,wrp->wsp", js, jp))
    left = jp - np.einsum("wrs,wsp->wrp", js, gain)
    motion = Motion(
        rows=rows,
        velocity=velocity[..., None],
        response=np.asarray(kick)[..., None, None],
        direct=np.full((WINDOWS, SAMPLES, 1, 1), 1 / STD),
        period_s=PERIOD_S,
        time_s=(np.arange(WINDOWS * SAMPLES) * PERIOD_S).reshape(WINDOWS, SAMPLES),
    )
    return diagnose([motion], np.einsum("wrp,wrq->pq", left, left), ("knee",))


def test_noise_looks_like_nothing() -> None:
    """White residuals of the right size have no excess to explain: no cause is named."""
    assert _diagnosed(np.zeros((WINDOWS, SAMPLES))) == ()


def test_friction_at_low_speed() -> None:
    """A force against the motion that dies out with speed."""
    v, _ = _motion()
    found = _diagnosed(_moved_by(-1.0 * np.sign(v) * np.exp(-np.abs(v) / 0.1)))
    assert found[0].cause == "friction" and found[0].joints == ("knee",)
    assert found[0].share > 0.5 and "dof_friction_creep" in found[0].alarm.do


def test_backlash() -> None:
    """The sensor sits on the motor's side of 0.4 mrad of play: an offset with the direction of motion."""
    v, _ = _motion()
    found = _diagnosed(2e-4 * np.sign(v))
    assert found[0].cause == "backlash" and "play in the gear" in found[0].alarm.means
    assert "the gear of knee" in found[0].alarm.do
    assert found[0].share > 0.5


def test_varying_delay() -> None:
    """Samples are late by another 0-1.5 ms every tenth of a second."""
    v, _ = _motion()
    late = np.repeat(np.random.default_rng(1).uniform(0, 1.5e-3, (WINDOWS, 4)), 20, axis=1)
    found = _diagnosed(-late * v)
    assert found[0].cause == "delay" and found[0].share > 0.5


def test_damping_that_no_parameter_has() -> None:
    """A force in proportion to velocity, and none left once a parameter does that."""
    v, _ = _motion()
    wrong = _moved_by(-0.3 * v)
    found = _diagnosed(wrong)
    assert found[0].cause == "damping" and found[0].share > 0.8
    assert _diagnosed(wrong, (wrong,)) == ()


def test_inertia_or_gain() -> None:
    """A force in proportion to acceleration."""
    _, a = _motion()
    found = _diagnosed(_moved_by(0.05 * a))
    assert found[0].cause == "inertia" and "dof_armature" in found[0].alarm.do


def test_missing_load() -> None:
    """A constant force."""
    found = _diagnosed(_moved_by(np.full((WINDOWS, SAMPLES), 0.3)))
    assert found[0].cause == "load" and found[0].share > 0.8


def test_contact_comes_in_bursts() -> None:
    """Two stretches of 60 ms with an error of 20 standard deviations, at 1.0 and 3.2 s."""
    wrong = np.zeros((WINDOWS, SAMPLES))
    rng = np.random.default_rng(2)
    for window, sample in ((2, 40), (8, 0)):
        wrong[window, sample : sample + 12] = 20 * STD * rng.normal(size=12)
    found = {f.cause: f for f in _diagnosed(wrong)}
    assert "contact" in found
    assert "0.98-1.07 s, 3.18-3.28 s" in found["contact"].alarm.do


def test_direction_is_kept_where_a_joint_is_still() -> None:
    """0.5, 0.01, -0.01, -0.5, 0.01 with 0.1 as still: up, up, up, down, down."""
    v = np.array([0.5, 0.01, -0.01, -0.5, 0.01])[None, :, None]
    assert held_direction(v, np.array([0.1])).ravel() == pytest.approx([1, 1, 1, -1, -1])
