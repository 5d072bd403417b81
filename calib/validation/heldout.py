"""Held-out error in physical units, joint by joint: what a user compares with what a task can bear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem, samples_in
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import Episode
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class HeldoutRmse:
    """Root mean square errors of open-loop predictions.

    Attributes:
        names: The n measured coordinates.
        window_s: Predictions restarted from the measured state this often [s].
        rmse: By predictor, (n,) [rad or m]; infinite where it diverged.
    """

    names: tuple[str, ...]
    window_s: float
    rmse: Mapping[str, FloatArray]

    def mean(self) -> dict[str, float]:
        """Return the mean over the coordinates by predictor."""
        return {name: float(np.mean(values)) for name, values in self.rmse.items()}

    def pooled(self) -> dict[str, float]:
        """Return the root mean square over all samples and coordinates by predictor."""
        return {name: float(np.sqrt(np.mean(values**2))) for name, values in self.rmse.items()}

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; None where a prediction diverged."""
        return {
            "window_s": self.window_s,
            "mean": _plain(self.mean()),
            "pooled": _plain(self.pooled()),
            "by_coordinate": {
                name: _plain(dict(zip(self.names, map(float, values), strict=True)))
                for name, values in self.rmse.items()
            },
        }


def _plain(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if np.isfinite(value) else None for name, value in values.items()}


def heldout_rmse(
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[Episode],
    candidates: Mapping[str, tuple[FloatArray, float]],
    window_s: float,
    threads: int | None = None,
) -> HeldoutRmse:
    """Return how far predictions of recordings are off that the search has not seen.

    Args:
        robot: The robot's model.
        space: The parameters.
        episodes: Held-out recordings.
        candidates: Name to physical parameters, (K,), and latency [s].
        window_s: Predictions restart from the smoothed reported state this often [s].
        threads: Simulation threads.

    Returns:
        The errors; beside the candidates "null", which predicts that each window keeps its start position.

    Raises:
        InsufficientDataError: No recording holds a window.
    """
    problem = Problem(robot, space, episodes, threads=threads)
    names = list(candidates)
    theta = np.stack([candidates[name][0] for name in names])
    latency = np.array([candidates[name][1] for name in names])
    columns = problem.channels[problem.channels < problem.coordinates]
    squares, count = np.zeros((len(names) + 1, len(columns))), 0
    for data in problem.windows(samples_in(problem, window_s)):
        episode, sample = problem.episodes[data.episode], data.windows.samples()
        wanted = episode.position[:, columns][sample]
        predicted = problem.predict(theta, latency, data).position[..., columns]
        null = np.broadcast_to(data.start_position[:, None, columns], wanted.shape)
        error = np.concatenate([predicted, null[None]]) - wanted
        if episode.reported is not None:
            error = error[:, episode.reported[sample]]
        error = np.where(np.isfinite(error), error, np.inf).reshape(len(names) + 1, -1, len(columns))
        squares += np.sum(error**2, axis=1)
        count += error.shape[1]
    rmse = np.sqrt(squares / max(count, 1))
    return HeldoutRmse(
        names=tuple(problem.robot.coordinates[c] for c in columns),
        window_s=window_s,
        rmse=dict(zip([*names, "null"], rmse, strict=True)),
    )
