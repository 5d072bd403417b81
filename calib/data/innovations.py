"""Window innovations: recording minus prediction, whitened for sensor noise and for start-state error.

Each window restarts the simulation at a smoothed state, whose error enters the prediction. So a window's
innovation has the covariance Sigma = sensor variance + J P0 J'. J is the derivative of the prediction by the
start state, and P0 the covariance of that state. Multiplying by the inverse Cholesky factor of Sigma gives
unit variance where the model is right, and removes what a wrong start state explains.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.independent import in_order
from deal_hw.calib.data.noise import NOISE_FREE_STD
from deal_hw.calib.data.parts import measurements
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.sim.engine.batch import ServoBatch, default_threads
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.windows import setpoints
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True)
class Members:
    """A population in physical units.

    Attributes:
        theta: Parameter values, (N, K).
        latency_s: Total latency of each member, (N,) [s]; may be negative by less than the margin.
    """

    theta: FloatArray
    latency_s: FloatArray


def is_noisy(problem: Problem) -> bool:
    """Return whether the measurements carry sensor noise."""
    std = problem.noise_std[problem.channels]
    return not problem.noise_free and bool(np.any(std >= NOISE_FREE_STD))


def samples_per_tick(problem: Problem) -> int:
    """Return the number of state samples in a control period."""
    description = problem.robot.description
    return max(round(description.state_rate_hz / description.control_rate_hz), 1)


def cut(problem: Problem, ticks: int) -> list[WindowData]:
    """Cut the recordings into windows of ``ticks`` control periods.

    Noisy recordings are used from half a smoothing width on. Before that the smoother is one-sided, and its
    start states are worse than their stated uncertainty.
    """
    per_tick = samples_per_tick(problem)
    if not is_noisy(problem):
        return problem.windows(ticks * per_tick, shorter=False)
    margin = round(0.5 * problem.smoothing_s * problem.robot.description.state_rate_hz)
    return problem.windows(ticks * per_tick, offset=margin, shorter=False)


def early_setpoints(
    batch: ServoBatch, episode: SampledEpisode, latency_s: FloatArray, advance_s: float = 0.008
) -> FloatArray:
    """Return set-points like :func:`setpoints`, also for latencies, (N,) [s], down to ``-advance_s``.

    They are computed with the delay ``advance_s`` and shifted back.
    """
    ahead = round(advance_s / episode.step_s)
    late = setpoints(batch, episode, latency_s + ahead * episode.step_s)
    return np.concatenate([late[:, ahead:], np.repeat(late[:, -1:], ahead, axis=1)], axis=1)


def predict(
    problem: Problem,
    members: Members,
    data: WindowData,
    position: FloatArray | None = None,
    velocity: FloatArray | None = None,
    *,
    population: bool = False,
) -> FloatArray:
    """Predict windows like :meth:`Problem.predict`, also for slightly negative latencies.

    A search's ``population`` is simulated by the problem's engine, which may be less exact. Returns the
    measured channels, (N, W, H, M).
    """
    batch = problem.batch(len(members.theta), data.episode, population=population)
    batch.set_parameters(members.theta)
    path = early_setpoints(batch, problem.episodes[data.episode], members.latency_s)
    return problem.predict_along(batch, path, data, position, velocity).observed


def predict_population(
    problem: Problem,
    members: Members,
    data: WindowData,
    position: FloatArray | None = None,
    velocity: FloatArray | None = None,
) -> FloatArray:
    """Predict windows with a search's population; NaN where a member diverged.

    The problem's engine simulates it, which may be less exact. Where the problem's tasks have more workers
    than this process has threads, each worker simulates some of the members: the predictions are the same.

    Args:
        problem: Recordings, simulator and workers.
        members: N members.
        data: W windows of H samples.
        position: Start positions of all members, (W, C); the smoothed ones by default.
        velocity: Start velocities, (W, C).

    Returns:
        The measured channels, (N, W, H, M).
    """
    tasks, count = problem.tasks, len(members.theta)
    parts = 1 if tasks.here or problem.engine != "mujoco" else min(tasks.workers, count)
    if parts <= (problem.threads or default_threads()):
        return predict(problem, members, data, position, velocity, population=True)
    # Only windows and their start states are sent.
    nothing = np.empty((0, 0, 0))
    sent = dataclasses.replace(
        data, measured=nothing, std=nothing, prior_mean=nothing, prior_std=nothing, late=None, by_delay=None
    )
    if position is not None and velocity is not None:
        sent = dataclasses.replace(sent, start_position=position, start_velocity=velocity)
    rows = np.array_split(np.arange(count), parts)
    specs = [(Members(members.theta[r], members.latency_s[r]), sent) for r in rows]
    return np.concatenate(list(in_order(problem, _predict_some, specs)))


def _predict_some(problem: Problem, spec: tuple[Members, WindowData]) -> FloatArray:
    return predict(problem, *spec)


@dataclass(frozen=True, slots=True)
class Whitening:
    """Whitening transform of one episode's windows.

    Attributes:
        reference: Prediction at the linearisation point, (W, H, M).
        factor: Inverse Cholesky factors of Sigma, (W, H M, H M); rows of 0 for missing samples.
        root: J sqrt(P0): effect of one standard deviation of each start coordinate, (W, H M, 2 C).
        std: Standard deviations of each start state, (W, 2 C).
        offset: Start states at the linearisation point relative to the smoothed ones, in units of ``std``,
            (W, 2 C).
    """

    reference: FloatArray
    factor: FloatArray
    root: FloatArray
    std: FloatArray
    offset: FloatArray

    def apply(self, difference: FloatArray) -> FloatArray:
        """Whiten differences of channels, (N, W, H, M); returns (N, W, H M)."""
        flat = difference.reshape(*difference.shape[:2], -1)
        return np.asarray(np.einsum("wij,nwj->nwi", self.factor, flat, optimize=True))

    def innovation(self, measured: FloatArray, predicted: FloatArray) -> FloatArray:
        """Whiten recording minus prediction, the latter shifted to the smoothed start states, (N, W, H M).

        The prediction, (N, W, H, M), is from the start states of :meth:`starts`.
        """
        moved = np.einsum("wis,ws->wi", self.root, self.offset).reshape(measured.shape)
        return self.apply(measured + moved - predicted)

    def starts(self, data: WindowData) -> tuple[FloatArray, FloatArray]:
        """Return the start positions and velocities at the linearisation point, (W, C) each."""
        C = data.start_position.shape[1]
        moved = self.offset * self.std
        return data.start_position + moved[:, :C], data.start_velocity + moved[:, C:]

    def next_offset(self, measured: FloatArray, limit: float = 3.0) -> FloatArray:
        """Return the most probable start states under the linearised simulator: the next ``offset``.

        Without the limit [standard deviations], start states would explain a wrong model.
        """
        whitened = self.innovation(measured, self.reference[None])[0]
        response = np.einsum("wij,wjs->wis", self.factor, self.root)
        found = np.einsum("wis,wi->ws", response, whitened)
        return np.asarray(np.clip(found, -limit, limit))


_MOST_SPREAD = 1e6
"""Largest ratio of start-state effect to noise that counts [-]; the factorisation is stable up to 1e7."""


def linearise(
    problem: Problem, centre: Members, data: WindowData, offset: FloatArray | None = None
) -> Whitening:
    """Linearise the prediction by the start states around one simulator, such as the population's mean.

    ``offset`` are the start states at that point, in standard deviations from the smoothed ones, (W, 2 C).
    """
    W, C = data.start_position.shape
    std = problem.starts[data.episode].std[data.windows.start]
    around = np.zeros((W, 2 * C)) if offset is None else offset
    # Central differences at half the uncertainty. Friction makes kinks in predictions, and a secant as wide
    # as the error itself describes them better than a derivative.
    count = 1 + 4 * C
    position = np.repeat(data.start_position[None] + around[:, :C] * std[:, :C], count, axis=0)
    velocity = np.repeat(data.start_velocity[None] + around[:, C:] * std[:, C:], count, axis=0)
    for s in range(2 * C):
        state, c = (position, s) if s < C else (velocity, s - C)
        state[1 + 2 * s, :, c] += 0.5 * std[:, s]
        state[2 + 2 * s, :, c] -= 0.5 * std[:, s]
    members = Members(np.repeat(centre.theta, count, axis=0), np.repeat(centre.latency_s, count))
    predicted = predict(problem, members, data, position, velocity)
    # Where the centre diverges, the window has no information on its start state: use the recording.
    reference = np.where(np.isfinite(predicted[0]), predicted[0], data.measured)
    predicted = np.where(np.isfinite(predicted), predicted, reference)
    flat = predicted.reshape(count, W, -1)
    root = np.moveaxis(flat[1::2] - flat[2::2], 0, -1)
    noise = data.std.reshape(W, -1)
    # Where predictions nearly diverge, the noise would be lost to rounding beside them.
    most = np.abs(root).max(axis=(1, 2)) / noise.min(axis=1)
    root = root / np.maximum(most / _MOST_SPREAD, 1.0)[:, None, None]
    # Samples that filled a gap have infinite noise, which no factorisation is safe from: they get rows of 0.
    seen = np.isfinite(noise)
    known = np.where(seen[..., None], root, 0.0)
    sigma = known @ np.swapaxes(known, 1, 2)
    diagonal = np.arange(noise.shape[1])
    sigma[:, diagonal, diagonal] += np.where(seen, noise, 1.0) ** 2
    factor = np.linalg.inv(np.linalg.cholesky(sigma)) * seen[..., None]
    return Whitening(reference, factor, root, std, around)


def whitened_residual(
    problem: Problem,
    members: Members,
    centre: Members,
    windows: list[WindowData],
    offsets: list[FloatArray] | None = None,
    whitenings: Sequence[Whitening] | None = None,
    *,
    population: bool = False,
) -> FloatArray:
    """Return recording minus prediction of every window, whitened around one simulator, ``centre``.

    It is (N, M), not finite in rows of diverged members. ``offsets`` are the start states at the
    linearisation point, one array per entry of ``windows``, updated in place; None for the smoothed states.
    ``whitenings`` were computed before for the same simulator and start states. A search's ``population`` is
    simulated by :func:`predict_population`.
    """
    simulate = predict_population if population else predict
    parts = []
    for i, data in enumerate(windows):
        if problem.noise_free:
            predicted = simulate(problem, members, data)
            whitened = (data.measured - predicted) / data.std
            parts.append(whitened.reshape(len(whitened), -1))
            continue
        if whitenings is not None:
            whitening = whitenings[i]
        else:
            whitening = linearise(problem, centre, data, None if offsets is None else offsets[i])
        starts = whitening.starts(data)
        predicted = simulate(problem, members, data, *starts)
        whitened = whitening.innovation(data.measured, predicted)
        parts.append(whitened.reshape(len(whitened), -1))
        if offsets is not None:
            offsets[i] = whitening.next_offset(data.measured)
    return np.concatenate(parts, axis=1)


def explained(problem: Problem, centre: Members, ticks: int) -> float:
    """Return the mean squared whitened residual of one simulator, ``centre``; 1 for a perfect model.

    Windows have ``ticks`` control periods.
    """
    windows = cut(problem, ticks)
    chi2 = float(np.sum(whitened_residual(problem, centre, centre, windows) ** 2)) / measurements(windows)
    return chi2 if np.isfinite(chi2) else float("inf")
