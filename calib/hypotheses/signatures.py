"""Signatures: the effect of each cause of model error on the predictions, by simulation.

A disturbance, such as a force against the velocity, is applied in the fitted windows along the fitted motion.
The change of the prediction is the cause's signature. So joints held by friction stay held, and coupling
between joints counts. For a body, the mass itself is changed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from deal_hw.calib.data.noise import rows_by_value
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.refinement import Refined
from deal_hw.parameters import Parameter
from deal_hw.sim.engine.inverse_dynamics import link_torques
from deal_hw.sim.parameters import KIND_TABLE
from deal_hw.sim.recordings.own_setups import recording_of, recordings_of
from deal_hw.sim.recordings.windows import setpoints
from deal_hw.types import FloatArray

Cause = Literal[
    "friction",
    "backlash",
    "delay",
    "damping",
    "inertia",
    "lag",
    "load",
    "zero",
    "mass",
    "contact",
    "drive",
    "scale",
]


PUSH = 0.2
"""Size of a disturbance, as a share of the torque that the joint's own inertia needed [-]."""

HEAVIER = 0.02
"""Relative change of a mass [-]."""

SHIFT = 0.01
"""Change of an encoder's zero [rad or m]."""

LOW_SPEEDS = (0.1, 0.4)
"""Speeds at which friction's excess at low speed falls to 1/e, as parts of a joint's rms speed [-]."""

STILL = 1e-3
"""Part of the rms speed below which a velocity has no direction [-]."""

PLAYS = (0.005, 0.02, 0.06)
"""Plays whose crossing is simulated [rad or m]: the time of a crossing grows with the play."""

NUDGE = 1e-3
"""Change of a set-point for one sample that shows a joint's response [rad or m]."""


@dataclass(frozen=True, slots=True)
class Signature:
    """Effect of one cause at one place on the predictions.

    Attributes:
        cause: The cause.
        where: Joint or body.
        columns: Change of the whitened predictions by each of n disturbances, per episode (W, H M, n).
        unit: Unit of the disturbance, where it has one.
    """

    cause: Cause
    where: str
    columns: tuple[FloatArray, ...]
    unit: str = ""


@dataclass(frozen=True, slots=True)
class SignatureResponse:
    """Response of an episode's windows to commands.

    Attributes:
        response: Whitened change of the predictions by a unit pulse of a set-point in the first sample,
            (A, W, H, M) [1/(rad s) or 1/(m s)]. It is the mean over all windows of one length in
            samples; where friction holds a joint it is zero.
        change: Change of the set-points from sample to sample, (W, H, A) [rad or m].
    """

    response: FloatArray
    change: FloatArray


def signatures(problem: Problem, fit: Refined) -> list[Signature]:
    """Return the effects of all causes in the windows of a fit."""
    states = fit.shooting.states(fit.point)
    C, joints = problem.coordinates, problem.robot.joints
    moved = np.concatenate(
        [states[d.episode][1][d.windows.samples()].reshape(-1, C) for d in fit.shooting.data]
    )
    speed = np.sqrt(np.mean(moved**2, axis=0))
    found: dict[tuple[Cause, str], list[FloatArray]] = {}
    heavier, shifted = masses(problem), zeros(problem)
    more = [*heavier, *shifted]
    wide, before = problem.with_more(more), np.array([p.nominal for p in more])
    change = np.array([HEAVIER * p.nominal for p in heavier] + [SHIFT] * len(shifted))
    for e, data in enumerate(fit.shooting.data):
        x, v = fit.point.position[e], fit.point.velocity[e]
        if more:
            theta = np.repeat(np.append(fit.theta, before)[None], 1 + len(more), axis=0)
            theta[1:, len(fit.theta) :] += np.diag(change)
            late = np.full(len(theta), fit.latency_s)
            changed = whitened_changes(wide.predict(theta, late, data, x, v).observed, data)
            for p, column in zip(more, changed, strict=True):
                cause: Cause = "mass" if p in heavier else "zero"
                share = HEAVIER if p in heavier else SHIFT
                found.setdefault((cause, p.elements[0]), []).append(column[..., None] / share)
        path = _path(problem, fit, data)
        position, velocity, acceleration = _along(problem, data, *states[data.episode])
        for name, c in zip(problem.robot.description.joint_names, range(C)[joints], strict=True):
            forces = _forces(velocity[..., c], speed[c])
            forces["inertia"] = [acceleration[..., c] / max(float(np.std(acceleration[..., c])), 1e-300)]
            size = PUSH * _inertia(problem, c) * float(np.std(acceleration[..., c]))
            geared = name in problem.robot.description.actuated and problem.robot.base is None
            if geared:
                forces["backlash"] = _crossing(problem, data, states[data.episode], c, size)
                moving = position[..., c], velocity[..., c], acceleration[..., c]
                forces["lag"] = [_late_damping(problem, fit, data, *moving, path, c)]
            each = [(cause, shape) for cause, shapes in forces.items() for shape in shapes]
            force = np.zeros((1 + len(each), *velocity.shape[:2], C))
            force[1:, ..., c] = size * np.stack([shape for _, shape in each])
            pushed = _predict(problem, fit, data, e, np.repeat(path, len(force), axis=0), force)
            columns = np.moveaxis(whitened_changes(pushed, data), 0, -1)
            number = {cause: [k for k, (own, _) in enumerate(each) if own == cause] for cause in forces}
            of_cause = {cause: columns[..., mine] for cause, mine in number.items()}
            if geared:
                offset = _offset(problem, data, states[data.episode][1], c, speed[c])
                of_cause["backlash"] = np.concatenate([of_cause["backlash"], offset], axis=2)
            for cause, mine in of_cause.items():
                found.setdefault((cause, name), []).append(mine)
    units = {p.elements[0]: p.unit for p in shifted}
    return [
        Signature(cause, where, tuple(columns), units[where] if cause == "zero" else "")
        for (cause, where), columns in found.items()
    ]


def by_recording(found: Sequence[Signature], names: Sequence[str]) -> list[Signature]:
    """Return signatures with the zero of each joint's encoder another one in each recording.

    Args:
        found: Signatures; those of a zero are the same in all recordings, and say little beside a load.
        names: Name of each of their episodes, with its part if gaps divide the recording.
    """
    recordings, own = recordings_of(names), [recording_of(name) for name in names]
    others = [s for s in found if s.cause != "zero"]
    if len(recordings) < 2:
        return others
    return others + [
        Signature(
            "zero",
            s.where,
            tuple(c if of == name else np.zeros_like(c) for of, c in zip(own, s.columns, strict=True)),
            s.unit,
        )
        for s in found
        if s.cause == "zero"
        for name in recordings
    ]


def answers(problem: Problem, fit: Refined) -> list[SignatureResponse]:
    """Return the responses to commands of a fit's windows; see :func:`signatures`."""
    responses, changes = [], []
    for e, data in enumerate(fit.shooting.data):
        path = _path(problem, fit, data)
        A, stride, step_s = path.shape[2], data.windows.stride, problem.episodes[data.episode].step_s
        at = problem.episodes[data.episode].sample[data.windows.start]
        # Windows follow each other: a change at the start of one comes back before the next is simulated.
        paths = np.repeat(path, 1 + A, axis=0)
        for step in range(stride):
            rows = np.minimum(at + step, paths.shape[1] - 1)
            paths[1:, rows] += NUDGE * np.eye(A)[:, None]
        observed = _predict(problem, fit, data, e, paths)
        responses.append((observed[1:] - observed[:1]) / (NUDGE * stride * step_s))
        edges = np.minimum(at[:, None] + stride * np.arange(data.windows.length + 1), path.shape[1] - 1)
        changes.append(np.diff(path[0][edges], axis=1))
    means: dict[int, FloatArray] = {}
    # Recordings of another rate, and short ones, have windows of another length.
    for rows in rows_by_value([data.windows.length for data in fit.shooting.data]):
        every = np.concatenate([responses[e] for e in rows], axis=1)
        means |= dict.fromkeys(rows.tolist(), np.nan_to_num(np.mean(every, axis=1)))
    return [
        SignatureResponse(means[e][:, None] / data.std, change)
        for e, (data, change) in enumerate(zip(fit.shooting.data, changes, strict=True))
    ]


def held_direction(velocity: FloatArray, speed: float) -> FloatArray:
    """Return the direction of a joint's last motion, (W, H): its velocity's sign, kept while it is still.

    ``speed`` is the rms of the velocity.
    """
    moving = np.abs(velocity) > STILL * speed
    index = np.where(moving, np.arange(velocity.shape[1]), 0)
    return np.asarray(np.sign(np.take_along_axis(velocity, np.maximum.accumulate(index, axis=1), axis=1)))


def _forces(velocity: FloatArray, speed: float) -> dict[Cause, list[FloatArray]]:
    """Return forces of order 1 on a joint in the windows, (W, S), by cause."""
    v = velocity / max(speed, 1e-300)
    against = -np.sign(v)
    return {
        "friction": [against * np.exp(-np.abs(v) / s) for s in LOW_SPEEDS],
        "damping": [-v, -v * np.abs(v)],
        "load": [np.ones_like(v)],
    }


def _offset(problem: Problem, data: WindowData, velocity: FloatArray, c: int, speed: float) -> FloatArray:
    """Return an offset of a joint's sensor with the direction of motion, whitened, (W, H M, 1).

    A gear in which friction decides on which side of the play the joint lies shows it.
    """
    seen = np.flatnonzero(problem.channels == c)
    offset = np.zeros(data.measured.shape)
    moving = held_direction(velocity[data.windows.samples()][..., c], speed)
    offset[:, :, seen] = moving[..., None] * problem.noise_std[c]
    return data.whitened(offset).reshape(len(offset), -1, 1)


def _crossing(
    problem: Problem, data: WindowData, states: tuple[FloatArray, FloatArray], c: int, size: float
) -> list[FloatArray]:
    """Return the forces on a motor whose link crosses plays, in the windows, (W, S), in units of ``size``.

    The encoder is on the motor's side. Where the load turns round, the link crosses the play, and the motor
    does not feel it until it arrives: the force is the link's inertia times its acceleration relative to the
    motor. There is one force for each play of `plays`, divided by it.
    """
    windows, episode = data.windows, problem.episodes[data.episode]
    at = windows.start[:, None] * windows.stride + np.arange(windows.length * windows.stride)
    position, velocity = states
    acceleration = np.gradient(velocity, episode.period_s, axis=0)
    load = link_torques(problem.robot, position, velocity, acceleration)[:, c]
    rotor = float(problem.robot.model.dof_armature[list(problem.robot.qvel)[c]])
    inertia = max(_inertia(problem, c) - rotor, 1e-9)
    rows = np.arange(len(load)) * windows.stride
    fine = np.interp(np.arange(rows[-1] + windows.stride), rows, load)
    found = []
    for play in PLAYS:
        place = place_in_play(fine / inertia, episode.step_s, play)
        relative = np.gradient(np.gradient(place, episode.step_s), episode.step_s)
        found.append(-inertia * relative[at] / play * PLAYS[0] / size)
    return found


def _late_damping(
    problem: Problem,
    fit: Refined,
    data: WindowData,
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    path: FloatArray,
    c: int,
) -> FloatArray:
    """Return the force of a servo whose damping acts on an older speed, in the windows, (W, S), of order 1.

    To first order it is in proportion to the joint's acceleration, and 0 where the effort limit cuts the
    servo's demand. The joint's motion is (W, S) each; ``path`` are the set-points, (1, S, A).
    """
    recorded = problem.episodes[data.episode]
    servo = list(problem.robot.description.actuated_index).index(c - problem.robot.joints.start)
    first = recorded.sample[data.windows.start][:, None]
    at = np.minimum(first + np.arange(velocity.shape[1]), path.shape[1] - 1)
    batch = problem.batch(1, data.episode)
    batch.set_parameters(fit.theta[None])
    stiffness, damping, limit = (
        batch.servo_factor(kind)[0, servo] * sent[at, servo]
        for kind, sent in (
            ("servo_stiffness", recorded.stiffness),
            ("servo_damping", recorded.damping),
            ("servo_effort_limit", recorded.effort_limit),
        )
    )
    demand = stiffness * (path[0, at, servo] - position) - damping * velocity
    force = damping * acceleration * (np.abs(demand) < limit)
    return np.asarray(force / max(float(np.std(force)), 1e-300))


def place_in_play(acceleration: FloatArray, step_s: float, play: float) -> FloatArray:
    """Return the place of a link within its play, (S,), whose load needs this acceleration, (S,).

    Between the stops the link is free, so it falls behind the motor by that acceleration. A stop ends its
    relative motion.
    """
    place, speed, half = play / 2, 0.0, play / 2
    found = np.empty(len(acceleration))
    for k, a in enumerate(acceleration.tolist()):
        speed -= a * step_s
        place += speed * step_s
        if abs(place) >= half:
            place, speed = math.copysign(half, place), 0.0
        found[k] = place
    return found


def masses(problem: Problem) -> list[Parameter]:
    """Return the masses of moving bodies that are neither searched nor known."""
    model, kind = problem.robot.model, KIND_TABLE["body_mass"]
    taken = {e for p in problem.space.parameters if p.kind == kind.name for e in p.elements}
    return [
        Parameter.around(
            f"{body.name}.{kind.quantity}", kind.name, (body.name,), kind.unit, float(body.mass[0])
        )
        for body in map(model.body, range(1, model.nbody))
        if model.body_weldid[body.id] and body.mass[0] > 0 and body.name and body.name not in taken
    ]


def zeros(problem: Problem) -> list[Parameter]:
    """Return the encoders' zeros of a fixed-base robot in several recordings that no parameter sets."""
    # In a single recording a zero is one of all, which looks like a load.
    if problem.robot.base is not None or len(recordings_of(e.name for e in problem.episodes)) < 2:
        return []
    taken = {e for p in problem.space.parameters if p.kind == "encoder_bias" for e in p.elements}
    facts = problem.robot.description
    joints = zip(facts.joint_names, facts.position_units, strict=True)
    return [Parameter.encoder_bias(j, 10 * SHIFT, unit=unit) for j, unit in joints if j not in taken]


def _inertia(problem: Problem, coordinate: int) -> float:
    """Return a joint's inertia in the model's zero pose [kg m^2 or kg]."""
    joint = coordinate - problem.robot.joints.start
    return float(problem.robot.model.dof_M0[problem.robot.qvel[joint]])


def _path(problem: Problem, fit: Refined, data: WindowData) -> FloatArray:
    """Return the set-points of an episode at a fit's values, (1, S, A)."""
    batch = problem.batch(1, data.episode)
    batch.set_parameters(fit.theta[None])
    return setpoints(batch, problem.episodes[data.episode], np.array([max(fit.latency_s, 0.0)]))


def _predict(
    problem: Problem,
    fit: Refined,
    data: WindowData,
    e: int,
    path: FloatArray,
    force: FloatArray | None = None,
) -> FloatArray:
    batch = problem.batch(len(path), data.episode)
    batch.set_parameters(np.repeat(fit.theta[None], len(path), axis=0))
    start = fit.point.position[e], fit.point.velocity[e]
    return problem.predict_along(batch, path, data, *start, force).observed


def whitened_changes(observed: FloatArray, data: WindowData) -> FloatArray:
    """Return the whitened differences of members from the first, (1 + n, W, H, M), as (n, W, H M)."""
    change = np.nan_to_num(observed[1:] - observed[:1], nan=0.0, posinf=0.0, neginf=0.0)
    return data.whitened(change).reshape(*change.shape[:2], -1)


def _along(
    problem: Problem, data: WindowData, position: FloatArray, velocity: FloatArray
) -> list[FloatArray]:
    """Return positions, velocities and accelerations at the device periods of each window, (W, S, C) each."""
    period_s = problem.episodes[data.episode].period_s
    return _between(data, position, velocity, np.gradient(velocity, period_s, axis=0))


def _between(data: WindowData, *values: FloatArray) -> list[FloatArray]:
    """Return values at samples, (T, ...), at the device periods of each window, (W, H * stride, ...)."""
    windows = data.windows
    samples = np.concatenate([windows.start[:, None], windows.samples()], axis=1)
    at = np.arange(windows.length * windows.stride) / windows.stride
    before = at.astype(int)
    found = []
    for value in values:
        part = (at - before).reshape(-1, *[1] * (value.ndim - 1))
        found.append((1 - part) * value[samples[:, before]] + part * value[samples[:, before + 1]])
    return found
