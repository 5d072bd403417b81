"""How noisy a recording is, estimated from it alone, and the smoothed states at which windows start."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import savgol_coeffs

from deal_hw.errors import InsufficientDataError
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

Mask: TypeAlias = npt.NDArray[np.bool_]

MAD_TO_STD = 1.4826022185056018
"""Of a normal distribution: standard deviation over median absolute deviation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSettings:
    """What is taken to be so of recordings.

    Attributes:
        resolution: Positions travel as whole micrometres and microradians [m or rad].
        noise_free_std: Positions with less noise than this are taken as they are [m or rad].
        noise_free_residual: What residuals are measured by where nothing is noisy [m or rad]: far above
            rounding, far below sensors.
        noise_order: White noise is what differences of this order leave of smooth motion.
        speed_bins: Bins of equal speed in which noise is estimated; fewer recordings than hold
            ``fewest_in_bin`` samples in each say nothing of jitter.
        fewest_in_bin: See ``speed_bins``.
        certain: A timing jitter counts where it explains this many standard errors of the noise's growth
            with speed.
        slowest_jitter_s: Sampling periods above this are too long to tell a jitter of the samples' time: what
            is left of the motion itself grows with speed like a jitter's noise does [s].
        smoothing_s: Start states are smoothed over so long [s].
        smoothing_order: Order of the polynomial.
        fewest_smoothed: Least samples of a polynomial: fewer hardly smooth.
        velocity_prior_std: Weak prior on start velocities by the unit of the coordinate [m/s and rad/s]:
            keeps windows of few samples solvable.
        unseen_std: Prior on a base's place on the floor where nobody measured it: no trajectory depends on
            it [m].
        least_motion: Joints must move by so many times the sensor's noise.
        least_chosen_motion: The same where the residual was chosen: allowing for what the model lacks, it is
            far above the sensor's noise.
        fewest_changes: The target must change so often.
    """

    resolution: float = 1e-6
    noise_free_std: float = 2e-5
    noise_free_residual: float = 1e-5
    noise_order: int = 6
    speed_bins: int = 10
    fewest_in_bin: int = 20
    certain: float = 2.0
    slowest_jitter_s: float = 0.01
    smoothing_s: float = 0.1
    smoothing_order: int = 3
    fewest_smoothed: int = 7
    velocity_prior_std: Mapping[str, float] = field(default_factory=lambda: {"m": 3.0, "rad": 30.0})
    unseen_std: float = 1e-6
    least_motion: float = 20.0
    least_chosen_motion: float = 5.0
    fewest_changes: int = 5

    @property
    def floor(self) -> float:
        """The least noise of positions: rounding on the wire [m or rad]."""
        return float(self.resolution / np.sqrt(12.0))


SETTINGS = DataSettings()


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """White noise on positions, and samples whose time is uncertain.

    A sample that reports the state of a slightly other moment is off by speed times time, so a jittering
    sensor looks noisier the faster the joint moves.

    Attributes:
        position_std: Noise of positions at rest, (J,) [m or rad].
        timing_std_s: Standard deviation of the samples' time [s].
    """

    position_std: FloatArray
    timing_std_s: float

    def std(self, velocity: FloatArray) -> FloatArray:
        """Return the standard deviation of positions reported at these velocities, (..., J)."""
        return np.sqrt(self.position_std**2 + (self.timing_std_s * velocity) ** 2)


def white_noise_std(
    values: FloatArray, settings: DataSettings = SETTINGS, reported: Mask | None = None
) -> FloatArray:
    """Estimate the standard deviation of white noise on top of smooth motion.

    The sixth difference of a smooth motion nearly vanishes while white noise of variance s^2 comes out with
    variance 924 s^2 (the sum of the squared binomial coefficients); the median keeps impacts and stick-slip
    out.

    Args:
        values: Uniformly sampled channels, (T, J).
        settings: Which differences; the least that is returned.
        reported: Which samples are no fillings of gaps, which are smooth, (T,). None: all.

    Returns:
        Standard deviations, (J,).
    """
    order = settings.noise_order
    whole = _whole(len(values), order, reported)
    if whole.sum() <= order:
        return np.full(values.shape[1], settings.floor)
    return np.maximum(_spread(np.diff(values, n=order, axis=0)[whole], order), settings.floor)


def _whole(count: int, order: int, reported: Mask | None) -> Mask:
    """Return which differences of an order hold no sample that was filled in, (T - order,)."""
    if reported is None or count <= order:
        return np.ones(max(count - order, 0), dtype=bool)
    return np.asarray(sliding_window_view(reported, order + 1).all(axis=1))


def _spread(difference: FloatArray, order: int) -> FloatArray:
    centred = np.abs(difference - np.median(difference, axis=0))
    return np.asarray(MAD_TO_STD * np.median(centred, axis=0) / math.sqrt(math.comb(2 * order, order)))


def noise_model(
    positions: list[FloatArray],
    velocities: list[FloatArray],
    settings: DataSettings = SETTINGS,
    reported: Sequence[Mask | None] | None = None,
) -> NoiseModel:
    """Estimate noise and timing jitter of recordings.

    The noise is estimated in bins of equal speed, joint by joint, and its square fitted by a straight line in
    the squared speed: the intercept is the noise at rest, the slope, which all joints share, the jitter's
    variance.

    Args:
        positions: Reported positions of each recording, (T, J) each, uniformly sampled.
        velocities: Smoothed velocities, likewise.
        settings: How.
        reported: Which samples of each are no fillings of gaps, (T,); None: all.
    """
    order, bins, floor = settings.noise_order, settings.speed_bins, settings.floor
    masks = reported or [None] * len(positions)
    whole = np.max(
        [white_noise_std(x, settings, mask) for x, mask in zip(positions, masks, strict=True)], axis=0
    )
    kept = [_whole(len(x), order, mask) for x, mask in zip(positions, masks, strict=True)]
    usable = [i for i, one in enumerate(kept) if one.sum() > bins * settings.fewest_in_bin - order]
    if not usable or np.all(whole <= 10 * floor):
        return NoiseModel(whole, 0.0)
    difference = np.concatenate([np.diff(positions[i], n=order, axis=0)[kept[i]] for i in usable])
    middle = order // 2
    speed2 = np.concatenate(
        [velocities[i][middle : middle + len(velocities[i]) - order][kept[i]] ** 2 for i in usable]
    )
    slopes, weights = [], []
    lines: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for j in range(positions[0].shape[1]):
        parts = np.array_split(np.argsort(speed2[:, j]), bins)
        x = np.array([speed2[part, j].mean() for part in parts])
        y = np.array([float(_spread(difference[part, j : j + 1], order)[0]) ** 2 for part in parts])
        # A variance from n samples through a median is known to about 2.3 / sqrt(n); neighbours share
        # differences.
        sigma = y * 2.3 * math.sqrt(3.0 / len(parts[0])) + floor**2
        slope, error = _slope(x, y, sigma)
        slopes.append(slope)
        weights.append(1.0 / error**2)
        lines.append((x, y, sigma))
    variance = float(np.average(slopes, weights=weights))
    error = float(1.0 / math.sqrt(sum(weights)))
    if variance < settings.certain * error:
        return NoiseModel(whole, 0.0)
    rest = [max(float(np.average(y - variance * x, weights=1 / s**2)), floor**2) for x, y, s in lines]
    return NoiseModel(np.sqrt(rest), math.sqrt(variance))


def _slope(x: FloatArray, y: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Return the slope of a weighted line and its standard error."""
    w = 1.0 / sigma**2
    mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
    spread = float(np.sum(w * (x - mean_x) ** 2))
    if spread <= 0:
        return 0.0, math.inf
    return float(np.sum(w * (x - mean_x) * (y - mean_y)) / spread), 1.0 / math.sqrt(spread)


@dataclass(frozen=True, slots=True)
class StartStates:
    """Smoothed states at every sample of an episode, with their uncertainty.

    Attributes:
        position: Tangent coordinates, (T, C).
        velocity: (T, C).
        position_std: Standard deviation of a smoothed position, (C,).
        velocity_std: Standard deviation of a smoothed velocity, (C,).
    """

    position: FloatArray
    velocity: FloatArray
    position_std: FloatArray
    velocity_std: FloatArray


def smooth_states(
    episode: SampledEpisode, noise_std: FloatArray, rotation: slice, settings: DataSettings = SETTINGS
) -> StartStates:
    """Estimate the state at every sample.

    Positions that are free of noise are left alone, and so are the reported velocities then: smoothing would
    only round off the impacts. Measured angular velocities of a base are smoothed; its rotation vector
    vanishes, because its reference is the smoothed orientation already. What was not measured stays
    the estimate that the episode holds.

    Args:
        episode: The recording.
        noise_std: Noise of (position, velocity), (2 C,).
        rotation: Which coordinates are the base's rotation vector.
        settings: How.

    Raises:
        InsufficientDataError: The recording is shorter than the smoother.
    """
    C = episode.position.shape[1]
    channels = episode.channels
    seen = np.zeros(2 * C, dtype=bool)
    seen[channels] = True
    clean = bool(np.all(noise_std[channels[channels < C]] < settings.noise_free_std))
    if clean and np.isfinite(episode.velocity).all() and seen[:C].all():
        return StartStates(
            episode.position, episode.velocity, np.maximum(noise_std[:C], 1e-7), np.full(C, 1e-4)
        )
    position, slope, gain, slope_gain = _local_polynomials(episode.position, episode.period_s, settings)
    velocity = slope
    # Twice the propagated noise: kinks of stick-slip and saturation are not polynomials.
    position_std, velocity_std = 2 * noise_std[:C] * gain, 2 * noise_std[:C] * slope_gain
    gyro = [c for c in range(C)[rotation] if seen[C + c]]
    if gyro:
        smooth, _, gyro_gain, _ = _local_polynomials(episode.velocity[:, gyro], episode.period_s, settings)
        position[:, gyro], velocity[:, gyro] = 0.0, smooth
        velocity_std[gyro] = 2 * noise_std[C:][gyro] * gyro_gain
    if episode.estimate_std is not None:
        estimate = np.broadcast_to(episode.estimate_std, (len(episode.sample), 2 * C))
        states, known = np.concatenate([episode.position, episode.velocity], axis=1), np.isfinite(estimate)
        given = known.all(axis=0) & ~seen
        std = np.sqrt(np.mean(np.where(known, estimate, 0.0) ** 2, axis=0))
        position[:, given[:C]], position_std[given[:C]] = states[:, :C][:, given[:C]], std[:C][given[:C]]
        velocity[:, given[C:]], velocity_std[given[C:]] = states[:, C:][:, given[C:]], std[C:][given[C:]]
    return StartStates(position, velocity, position_std, velocity_std)


def _local_polynomials(
    values: FloatArray, period_s: float, settings: DataSettings
) -> tuple[FloatArray, FloatArray, float, float]:
    """Smooth columns (Savitzky-Golay); return values and slopes, (T, n), and both gains on white noise."""
    T, order = len(values), settings.smoothing_order
    length = max(2 * round(settings.smoothing_s / period_s / 2) + 1, settings.fewest_smoothed)
    half = length // 2
    if length > T:
        raise InsufficientDataError(
            f"the recording has {T} usable samples, the shortest that can be smoothed has {length}; "
            "record longer"
        )
    smooth, slope = np.empty_like(values), np.empty_like(values)
    centre = savgol_coeffs(length, order, use="dot")
    rate = savgol_coeffs(length, order, deriv=1, delta=period_s, use="dot")
    for t in range(T):
        first = min(max(t - half, 0), T - length)
        at = t - first
        if at == half:
            weights, rates = centre, rate
        else:
            weights = savgol_coeffs(length, order, pos=at, use="dot")
            rates = savgol_coeffs(length, order, deriv=1, delta=period_s, pos=at, use="dot")
        section = values[first : first + length]
        smooth[t], slope[t] = weights @ section, rates @ section
    return smooth, slope, float(np.linalg.norm(centre)), float(np.linalg.norm(rate))
