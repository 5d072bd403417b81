"""Evidence on the residual of one joint, made by hand: white noise, and what forces at it do."""

from __future__ import annotations

import numpy as np

from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.hypotheses.evidence import Evidence
from deal_hw.calib.hypotheses.signatures import Cause, Signature
from deal_hw.types import FloatArray

WINDOWS, SAMPLES, PERIOD_S, STD = 24, 80, 0.005, 1e-4
DAMPING = 2.0
"""Of the joint that this is about: its velocity decays with 1 / DAMPING seconds [1/s]."""


def knee_motion() -> tuple[FloatArray, FloatArray]:
    """Return velocity and acceleration of a joint that stirs, (W, H) [rad/s, rad/s^2]."""
    t = (np.arange(WINDOWS * SAMPLES, dtype=np.float64) * PERIOD_S).reshape(WINDOWS, SAMPLES)
    velocity, acceleration = np.zeros_like(t), np.zeros_like(t)
    for f, a, phase in ((0.9, 0.4, 0.0), (2.3, 0.3, 1.0), (4.1, 0.1, 2.0)):
        w = 2 * np.pi * f
        velocity += a * np.sin(w * t + phase)
        acceleration += a * w * np.cos(w * t + phase)
    return velocity, acceleration


def moved_by(force: FloatArray) -> FloatArray:
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


def knee_signatures() -> list[Signature]:
    """Return what forces of size 1 do, and an offset of 1 mrad with the direction of motion."""
    v, a = knee_motion()
    made: dict[Cause, FloatArray] = {
        "friction": moved_by(-np.sign(v) * np.exp(-np.abs(v) / 0.1)),
        "damping": moved_by(-v),
        "inertia": moved_by(a),
        "load": moved_by(np.ones_like(v)),
        "backlash": 1e-3 * np.sign(v),
    }
    return [Signature(cause, "knee", (x[..., None] / STD,)) for cause, x in made.items()]


def knee_evidence(wrong: FloatArray, columns: tuple[FloatArray, ...] = ()) -> Evidence:
    """Return white noise plus what is wrong, (W, H) [rad]; ``columns`` are what free parameters do."""
    rng = np.random.default_rng(0)
    time = np.arange(1, SAMPLES + 1) * PERIOD_S
    kick = np.broadcast_to((1 - np.exp(-DAMPING * time)) / DAMPING / STD, (WINDOWS, SAMPLES))
    start = np.stack([np.full((WINDOWS, SAMPLES), 1 / STD), kick], axis=-1)
    known = np.broadcast_to(np.diag([1 / STD, 1 / 30.0]), (WINDOWS, 2, 2))
    residual = rng.normal(size=(WINDOWS, SAMPLES)) + wrong / STD
    parameter = np.stack([c / STD for c in (*columns, rng.normal(size=(WINDOWS, SAMPLES)))], axis=-1)
    rows = WindowRows(
        np.concatenate([residual, rng.normal(size=(WINDOWS, 2))], axis=1),
        np.concatenate([parameter, np.zeros((WINDOWS, 2, parameter.shape[2]))], axis=1),
        np.concatenate([start, known], axis=1),
    )
    return Evidence(
        rows=[rows],
        prior=np.full(parameter.shape[2], 1e-6),
        found=knee_signatures(),
        answers=(),
        periods_s=[PERIOD_S],
        time_s=[(np.arange(WINDOWS * SAMPLES, dtype=np.float64) * PERIOD_S).reshape(WINDOWS, SAMPLES)],
        names=["rec.csv"],
    )
