"""Held-out error: open-loop prediction of a recording the search has not seen, beside null predictors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from deal_hw.calib.data.problem import Problem, samples_in
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import to_vector
from deal_hw.sim.recordings.episode import Episode
from deal_hw.types import FloatArray, IntArray

HELDOUT_WINDOW_S = 0.2


def heldout_nrmse(
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[Episode],
    candidates: Mapping[str, tuple[FloatArray, float]],
    truth: Sequence[FloatArray] | None = None,
    window_s: float = HELDOUT_WINDOW_S,
    threads: int | None = None,
) -> dict[str, float]:
    """Return the error of each candidate over the signal's range, mean over the measured coordinates.

    Args:
        robot: The robot's model.
        space: The parameters.
        episodes: Held-out recordings.
        candidates: Name to physical parameters, (K,), and latency [s].
        truth: Noise-free positions at the episodes' samples, (T, n) each in
            the order of the measured coordinates, where there are any; else the
            reported ones.
        window_s: Prediction restarts from the smoothed reported state this often [s].
        threads: Simulation threads.

    Returns:
        Error by name; beside the candidates "null", which predicts that each window keeps its start position.
    """
    problem = Problem(robot, space, episodes, threads=threads)
    names = list(candidates)
    theta = np.stack([candidates[name][0] for name in names])
    latency = np.array([candidates[name][1] for name in names])
    columns = problem.channels[problem.channels < problem.coordinates]
    squares = np.zeros((len(names) + 1, len(columns)))
    count, spans = 0, []
    for data in problem.windows(samples_in(problem, window_s)):
        episode = problem.episodes[data.episode]
        reference = episode.position[:, columns] if truth is None else truth[data.episode]
        span = signal_range(episode, reference, columns, robot.rotation)
        wanted = reference[data.windows.samples()]
        predicted = problem.predict(theta, latency, data).position[..., columns]
        null = np.broadcast_to(data.start_position[:, None, columns], wanted.shape)
        both = np.concatenate([predicted, null[None]])
        # A diverged member is as wrong as the whole range.
        error = np.where(np.isfinite(both), both - wanted, span)
        squares += np.sum(error**2, axis=(1, 2))
        count += wanted.shape[0] * wanted.shape[1]
        spans.append(span)
    nrmse = np.mean(np.sqrt(squares / count) / np.max(spans, axis=0), axis=1)
    return dict(zip([*names, "null"], map(float, nrmse), strict=True))


def signal_range(episode: Episode, values: FloatArray, columns: IntArray, rotation: slice) -> FloatArray:
    """Return the range that each measured coordinate covers in a recording, (n,).

    Args:
        episode: The recording.
        values: The coordinates' values, (T, n).
        columns: Which coordinates they are, (n,).
        rotation: Which coordinates are a base's rotation vector: their charts move with the base, so their
            range is that of the whole turn from the first orientation.
    """
    span = np.ptp(values, axis=0)
    if episode.reference is not None:
        turned = np.ptp(to_vector(episode.reference, episode.reference[0]), axis=0)
        for i, c in enumerate(columns):
            if rotation.start <= c < rotation.stop:
                span[i] = turned[c - rotation.start]
    return np.asarray(span)
