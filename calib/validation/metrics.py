"""Quality of a calibration on unseen motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from deal_hw.calib.data.parts import samples_in
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.refinement import at_parameters
from deal_hw.calib.hypotheses.recording_zeros import fitted_zeros, with_other_zeros, zeros_of
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import to_quaternion, to_vector
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class HeldoutErrors:
    """Errors of predictions from the measured state, by predictor.

    Attributes:
        names: The n measured coordinates.
        window_s: Length of the predictions [s].
        nrmse: Root mean square error over the signal's range, mean over the coordinates.
        rmse: Root mean square errors of the coordinates, (n,) [rad or m]; infinite where it diverged.
        units: Unit of each coordinate, (n,).
        span: Range of each coordinate's signal, (n,) [rad or m].
        noise: Root mean square of the sensor's noise, estimated from the recordings, (n,) [rad or m]: a lower
            bound of the error. NaN for noise-free states.
        zeros: Zeros of the recordings that were fitted to them, by predictor, joint and recording [rad or m].
    """

    names: tuple[str, ...]
    window_s: float
    nrmse: Mapping[str, float]
    rmse: Mapping[str, FloatArray]
    units: tuple[str, ...]
    span: FloatArray
    noise: FloatArray
    zeros: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)

    def mean(self) -> dict[str, float]:
        """Return the mean of :attr:`rmse` over the coordinates by predictor."""
        return {name: float(np.mean(values)) for name, values in self.rmse.items()}

    def pooled(self) -> dict[str, float]:
        """Return the root mean square over all samples and coordinates by predictor."""
        return {name: float(np.sqrt(np.mean(values**2))) for name, values in self.rmse.items()}

    def to_json(self) -> dict[str, Any]:
        """Return the errors in rad or m as plain JSON values; None where a prediction diverged."""
        zeros = {"zeros": self.zeros} if any(self.zeros.values()) else {}
        return zeros | {
            "window_s": self.window_s,
            "mean": _plain(self.mean()),
            "pooled": _plain(self.pooled()),
            "by_coordinate": {
                name: _plain(dict(zip(self.names, map(float, values), strict=True)))
                for name, values in self.rmse.items()
            },
            "unit": dict(zip(self.names, self.units, strict=True)),
            "noise": {
                **_plain(
                    {"nrmse": float(np.mean(self.noise / self.span)), "mean": float(np.mean(self.noise))}
                ),
                "by_coordinate": _plain(dict(zip(self.names, map(float, self.noise), strict=True))),
            },
        }


def _plain(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if np.isfinite(value) else None for name, value in values.items()}


class HeldOut:
    """Held-out recordings; each candidate is simulated once.

    Predictions last ``window_s``, each from the smoothed reported state. ``truth`` holds noise-free positions
    at the episodes' samples, (T, n) each in the order of the measured coordinates; without it, the reported
    ones are predicted. If the fitted recordings have zeros of their own, each candidate gets those of these
    recordings, too, fitted to them.

    Raises:
        InsufficientDataError: No recording holds a window.
    """

    def __init__(
        self,
        robot: RobotModel,
        space: ParameterSpace,
        episodes: Sequence[SampledEpisode],
        window_s: float = 0.2,
        threads: int | None = None,
        truth: Sequence[FloatArray] | None = None,
    ) -> None:
        self._others: dict[tuple[str, ...], HeldOut] = {}
        self._of = partial(HeldOut, robot, episodes=episodes, window_s=window_s, threads=threads, truth=truth)
        self.space = space
        space = with_other_zeros(space, episodes)
        self.problem = problem = Problem(robot, space, episodes, threads=threads)
        self._window_s = window_s
        self._columns = columns = problem.channels[problem.channels < problem.coordinates]
        self._windows = problem.windows(samples_in(problem, window_s))
        self._noise = np.full(len(columns), np.nan)
        if truth is None and not problem.noise_free:
            std = np.concatenate([data.std.reshape(-1, len(problem.channels)) for data in self._windows])
            seen = std[np.isfinite(std).all(axis=1)][:, problem.channels < problem.coordinates]
            if len(seen):
                self._noise = np.sqrt(np.mean(seen**2, axis=0))
        self._references = [
            problem.episodes[data.episode].position[:, columns] if truth is None else truth[data.episode]
            for data in self._windows
        ]
        self._spans = [
            signal_range(problem.episodes[data.episode], reference, columns, robot.rotation)
            for data, reference in zip(self._windows, self._references, strict=True)
        ]
        self._known: dict[tuple[bytes, float] | None, tuple[FloatArray, FloatArray, FloatArray]] = {}
        self._simulate({None: None})

    def of(self, space: ParameterSpace) -> HeldOut:
        """Return the same recordings for candidates with these parameters."""
        if space.names == self.space.names:
            return self
        if space.names not in self._others:
            self._others[space.names] = self._of(space)
        return self._others[space.names]

    def errors(self, candidates: Mapping[str, tuple[FloatArray, float]]) -> HeldoutErrors:
        """Return the errors of candidates (parameters, (K,), and latency [s], by name) and of "null"."""
        keys: dict[str, tuple[bytes, float] | None] = {
            name: (np.asarray(theta, dtype=np.float64).tobytes(), latency_s)
            for name, (theta, latency_s) in candidates.items()
        }
        fresh = {key: candidates[name] for name, key in keys.items() if key not in self._known}
        if fresh:
            self._simulate(fresh)
        found = {name: self._known[key] for name, key in {**keys, "null": None}.items()}
        span = np.maximum(np.max(self._spans, axis=0), 1e-300)
        more = ParameterSpace(self.problem.space.free[len(self.space) :])
        return HeldoutErrors(
            names=tuple(self.problem.robot.coordinates[c] for c in self._columns),
            window_s=self._window_s,
            nrmse={name: float(np.mean(rms / span)) for name, (rms, _, _) in found.items()},
            rmse={name: rmse for name, (_, rmse, _) in found.items()},
            units=tuple(self.problem.robot.coordinate_units[c] for c in self._columns),
            span=span,
            noise=self._noise,
            zeros={name: zeros_of(more, zeros) for name, (_, _, zeros) in found.items() if len(zeros)},
        )

    def chi2(self, theta: FloatArray, latency_s: float) -> tuple[float, float]:
        """Return the mean squared error over the noise variance, and its standard deviation by chance.

        Start states are fitted to each window: predictions from measured ones have the error of these, which
        may be larger than the noise. The noise is estimated from these recordings, too, so a short one leaves
        more to chance.

        Args:
            theta: Values of the parameters, (K,).
            latency_s: The latency [s].
        """
        whole = fitted_zeros(self.problem, theta, latency_s)
        length = samples_in(self.problem, self._window_s)
        fit = at_parameters(self.problem, whole, latency_s, length)
        # Of n errors the mean square varies by sqrt(2 / n), and so does the noise that is estimated from it.
        return fit.chi2, 2.0 / np.sqrt(max(fit.normal.count, 1))

    def _simulate(self, fits: Mapping[tuple[bytes, float] | None, tuple[FloatArray, float] | None]) -> None:
        """Store root mean squares, (n,), of all samples, and of the reported ones."""
        given = [fit for fit in fits.values() if fit is not None]
        whole = [fitted_zeros(self.problem, *fit) for fit in given]
        squares, counts = np.zeros((2, len(fits), len(self._columns))), np.zeros(2)
        for data, reference, span in zip(self._windows, self._references, self._spans, strict=True):
            episode, sample = self.problem.episodes[data.episode], data.windows.samples()
            if given:
                theta, latency = np.stack(whole), np.array([fit[1] for fit in given])
                predicted = self.problem.predict(theta, latency, data).position[..., self._columns]
            else:
                predicted = _still(self.problem, data)[None, ..., self._columns]
            # A diverged member counts as an error of the whole range.
            error = np.where(np.isfinite(predicted), predicted - reference[sample], span)
            squares[0] += np.sum(error**2, axis=(1, 2))
            counts[0] += sample.size
            seen = np.ones(sample.shape, bool) if episode.reported is None else episode.reported[sample]
            error = (predicted - episode.position[:, self._columns][sample])[:, seen]
            squares[1] += np.sum(np.where(np.isfinite(error), error, np.inf) ** 2, axis=1)
            counts[1] += np.count_nonzero(seen)
        rms = np.sqrt(squares / np.maximum(counts, 1)[:, None, None])
        zeros = [theta[len(self.space) :] for theta in whole] if given else [np.empty(0)]
        self._known.update(zip(fits, zip(rms[0], rms[1], zeros, strict=True), strict=True))


def _still(problem: Problem, data: WindowData) -> FloatArray:
    """Return constant poses, (W, H, C): a base's reference moves, its orientation does not."""
    sample = data.windows.samples()
    still = np.repeat(data.start_position[:, None], sample.shape[1], axis=1)
    charts = problem.episodes[data.episode].reference
    if charts is not None:
        rotation = problem.robot.rotation
        start = to_quaternion(data.start_position[:, rotation], charts[data.windows.start])
        still[..., rotation] = to_vector(start[:, None], charts[sample])
    return still


def signal_range(
    episode: SampledEpisode, values: FloatArray, columns: IntArray, rotation: slice
) -> FloatArray:
    """Return the range of each measured coordinate in a recording, (n,), from its values, (T, n).

    The reference of a base's rotation vector moves with the base, so its range is that of the turn from the
    first orientation.
    """
    span = np.ptp(values, axis=0)
    if episode.reference is not None:
        turned = np.ptp(to_vector(episode.reference, episode.reference[0]), axis=0)
        for i, c in enumerate(columns):
            if rotation.start <= c < rotation.stop:
                span[i] = turned[c - rotation.start]
    return np.asarray(span)
