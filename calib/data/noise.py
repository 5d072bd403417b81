"""Noise of a recording, estimated from it alone, and the smoothed states at which windows start."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import scipy
from numpy.lib.stride_tricks import sliding_window_view

from deal_hw.errors import InsufficientDataError
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray, IntArray

Mask: TypeAlias = npt.NDArray[np.bool_]

MAD_TO_STD = 1.4826022185056018
"""Of a normal distribution: standard deviation over median absolute deviation."""


RESOLUTION = 1e-6
"""Step of positions on the wire [m or rad]."""

FLOOR_STD = RESOLUTION / math.sqrt(12.0)
"""Least noise of positions: rounding on the wire [m or rad]."""

NOISE_FREE_STD = 2e-5
"""Positions with less noise are taken as exact [m or rad]."""

HELD_STD = 1e-3
"""Noise of a position that never changes, which shows none [m or rad]: a count of a coarse encoder.
Without it such a joint would outweigh all that move."""

NOISE_ORDER = 6
"""Order of the differences that remove smooth motion and leave white noise."""

OUTLIER = 3.0
"""Differences beyond so many standard deviations, by their median, are impacts and stick-slip [-]."""

WITHIN = 0.97334
"""Variance of a normal distribution within these, as a share of its own [-]."""

SPEED_BINS = 10
"""Number of bins of equal speed in which noise is estimated."""

FEWEST_IN_BIN = 20
"""Fewest samples per bin for an estimate of jitter."""

ROUNDED = 0.5
"""Least share of rounding in a channel's noise from which it limits the estimate of jitter [-]."""

LEAST_COUNTS = 2.0
"""Least motion in a sampling period for that estimate then [counts]: slower, rounding is a saw-tooth."""

SAW_TOOTH = 0.3
"""Uncertainty of each variance where rounding is a saw-tooth, as a share of rounding's [-]. Of 288 motions
of one or six sines at 200 Hz for 4 to 28 s, rounded to 12 bits a turn, none seems to jitter by 0.1 ms or
more; 38 do without this and `LEAST_COUNTS`. A jitter of 0.5 ms is found in 40 of 108 motions to 0.2 ms, in
50 without them."""

SHARED = 3.2
"""How many neighbouring differences of order 6 tell as much as one alone: the sum of their squared
correlations [-]."""

REWEIGHTED = 3
"""Fits of a line to variances whose uncertainty follows from it; the first takes that of each."""

CERTAIN_JITTER = 3.0
"""Least significance of a timing jitter [standard errors]. At 2, 12 of 288 such motions with 1 mrad of noise
instead of coarse counts seem to jitter by 0.1 ms or more, at 3 none does."""

SMOOTHING_S = 0.1
"""Width over which start states are smoothed [s]."""

SMOOTHING_ORDER = 3
"""Order of the smoothing polynomial."""

FEWEST_SMOOTHED = 7
"""Fewest samples of a polynomial."""

WHOLE_STEPS = 0.05
"""Largest distance from a whole number of steps of values that are counts [steps]."""

REST = 24
"""Steps of one value above which a joint is at rest [-]. In fewer, a slow motion passes a count of its
encoder: that is rounding, which counts as noise."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """White noise on positions, and jitter of the sample times.

    A sample taken at a slightly wrong time is off by speed times time. So a jittering sensor looks noisier
    the faster the joint moves.

    Attributes:
        position_std: Noise of positions at rest, (J,) [m or rad].
        timing_std_s: Standard deviation of the sample times [s].
    """

    position_std: FloatArray
    timing_std_s: float

    def std(self, velocity: FloatArray) -> FloatArray:
        """Return the standard deviation of positions at these velocities, (..., J)."""
        return np.sqrt(self.position_std**2 + (self.timing_std_s * velocity) ** 2)


def white_noise_std(parts: Sequence[FloatArray], reported: Sequence[Mask | None] = ()) -> FloatArray:
    """Estimate the standard deviation of white noise on top of smooth motion, (J,), from parts (T, J) each.

    The sixth difference of a smooth motion nearly vanishes. That of white noise with variance s^2 has
    variance 924 s^2 (the sum of the squared binomial coefficients). The median ignores impacts and
    stick-slip. It is taken over the differences of all parts together: a sensor does not change with the
    place where a recording is cut, and a part with few samples hardly counts. Samples that filled a gap,
    False in ``reported``, (T,) for each part, are smooth and do not count. Nor do stretches of one constant
    value: a joint at rest on a count of its encoder shows no noise.
    """
    masks = reported or [None] * len(parts)
    differences = _differences(parts, NOISE_ORDER, masks)
    rounding = _rounding_std(parts, masks)
    found = [_spread(d, NOISE_ORDER) if len(d) else 0.0 for d, _ in differences]
    first = next((x[0] for x in parts if len(x)), None)
    held = np.all([np.all(x == first, axis=0) for x in parts], axis=0)
    least = np.where(held, HELD_STD, FLOOR_STD)
    return np.maximum(np.maximum(found, rounding), least)


def _rounding_std(parts: Sequence[FloatArray], reported: Sequence[Mask | None]) -> FloatArray:
    """Return the noise of rounding to an encoder's counts, (J,): the least step between values over sqrt(12).

    The values of all parts count together: few samples of a fast motion lie many counts apart. Values that
    differ by less than the wire's resolution are one value, such as 0.1 and 0.1 + 2 pi - 2 pi. An uneven
    clock is resampled, which makes values between counts; those that stay for two samples are counts.
    """
    taken = [x if m is None else x[m] for x, m in zip(parts, reported, strict=True)]
    return np.array([_count([x[:, j] for x in taken]) for j in range(taken[0].shape[1])]) / math.sqrt(12.0)


def _count(parts: Sequence[FloatArray]) -> float:
    """Return the step between the counts of a channel; 0 where it has one value."""
    every, held = _Counts.of(parts), _Counts.of([x[1:][x[1:] == x[:-1]] for x in parts])
    return held.step if held.regular and not every.regular else every.step


@dataclass(frozen=True, slots=True)
class _Counts:
    """The least step between values, and whether more than two values all lie whole steps apart."""

    step: float
    regular: bool

    @classmethod
    def of(cls, parts: Sequence[FloatArray]) -> _Counts:
        values = np.unique(np.concatenate(parts))
        steps = np.diff(values)
        step = min(steps[steps > RESOLUTION / 2], default=0.0)
        if len(values) < 3 or step <= 0:
            return cls(float(step), regular=False)
        apart = (values - values[0]) / step
        return cls(float(step), regular=bool(np.all(np.abs(apart - np.round(apart)) < WHOLE_STEPS)))


def _differences(
    parts: Sequence[FloatArray], order: int, reported: Sequence[Mask | None]
) -> list[tuple[FloatArray, IntArray]]:
    """Return the differences of each of J columns that show noise, and their rows among those of all parts.

    Part by part there are ``T - order`` rows.
    """
    tried = [(x, m) for x, m in zip(parts, reported, strict=True) if len(x) > order]
    if not tried:
        return [(np.empty(0), np.empty(0, dtype=np.int64))] * parts[0].shape[1]
    every = np.concatenate([np.diff(x, n=order, axis=0) for x, _ in tried])
    moving = [sliding_window_view(_moves(x), order, axis=0).any(axis=-1) for x, _ in tried]
    whole = [
        np.ones(len(x) - order, dtype=bool) if m is None else sliding_window_view(m, order + 1).all(axis=1)
        for x, m in tried
    ]
    shows = np.concatenate(moving) & np.concatenate(whole)[:, None]
    rows = [np.flatnonzero(column) for column in shows.T]
    return [(every[row, j], row) for j, row in enumerate(rows)]


def _moves(values: FloatArray) -> Mask:
    """Return which steps from a sample to the next are no part of a rest, (T - 1, J)."""
    return np.asarray(scipy.ndimage.maximum_filter1d(np.diff(values, axis=0) != 0, REST + 1, axis=0))


def _spread(difference: FloatArray, order: int) -> float:
    """Return the standard deviation of the noise that leaves these differences, (n,).

    The median is safe from impacts and stick-slip, but needs three times as many samples as the mean square,
    and a jittering clock, whose errors are not normal, is larger than it says. So the mean square is taken of
    those differences that the median lets pass as noise.
    """
    centred = np.abs(difference - np.median(difference))
    most = OUTLIER * MAD_TO_STD * float(np.median(centred))
    noise = centred[centred <= most]
    return math.sqrt(float(np.mean(noise**2)) / WITHIN / math.comb(2 * order, order))


def noise_model(
    positions: Sequence[FloatArray],
    velocities: Sequence[FloatArray],
    reported: Sequence[Mask | None] = (),
) -> NoiseModel:
    """Estimate noise and timing jitter from positions and smoothed velocities of recordings, (T, J) each.

    The noise is estimated in bins of equal speed, joint by joint, over all recordings together. A straight
    line is fitted to its square over the squared speed. The intercept is the noise at rest; the slope, shared
    by all joints, is the jitter's variance. ``reported`` holds a mask for each recording, as in
    :func:`white_noise_std`.
    """
    order, bins, floor = NOISE_ORDER, SPEED_BINS, FLOOR_STD
    masks = reported or [None] * len(positions)
    whole = white_noise_std(positions, masks)
    differences = _differences(positions, order, masks)
    fewest = bins * FEWEST_IN_BIN - order
    if all(len(d) <= fewest for d, _ in differences) or np.all(whole <= 10 * floor):
        return NoiseModel(whole, 0.0)
    middle = order // 2
    speed2 = np.concatenate([v[middle : middle + len(v) - order] ** 2 for v in velocities if len(v) > order])
    rounding = _rounding_std(positions, masks)
    slopes, weights = [], []
    lines: list[tuple[int, FloatArray, FloatArray, FloatArray]] = []
    moved = np.concatenate([np.abs(p[order:] - p[:-order]) for p in positions if len(p) > order])
    least = LEAST_COUNTS * order * math.sqrt(12.0)
    for j, (difference, rows) in enumerate(differences):
        # Slower than some counts a sample, rounding is a saw-tooth: its differences grow with the speed, as
        # those of a jitter do.
        rounded = rounding[j] > ROUNDED * whole[j]
        saw_tooth = SAW_TOOTH * rounding[j] ** 2 if rounded else 0.0
        fast = np.flatnonzero(~rounded | (moved[rows, j] > least * rounding[j]))
        if len(fast) <= fewest:
            continue
        squared = speed2[rows, j]
        parts = np.array_split(fast[np.argsort(squared[fast])], bins)
        x = np.array([squared[part].mean() for part in parts])
        y = np.array([_spread(difference[part], order) ** 2 for part in parts])
        y = np.maximum(y, rounding[j] ** 2)
        # n samples give a variance to sqrt(2 / n), relative, and neighbouring differences share samples.
        share = math.sqrt(2.0 * SHARED / len(parts[0]))
        slope, error, sigma = _line(x, y, share, floor**2 + saw_tooth, max(rounding[j], floor) ** 2)
        slopes.append(slope)
        weights.append(1.0 / error**2)
        lines.append((j, x, y, sigma))
    if not slopes:
        return NoiseModel(whole, 0.0)
    variance = float(np.average(slopes, weights=weights))
    error = float(1.0 / math.sqrt(sum(weights)))
    if variance < CERTAIN_JITTER * error:
        return NoiseModel(whole, 0.0)
    at_rest = whole.copy()
    for j, x, y, s in lines:
        found = float(np.average(y - variance * x, weights=1 / s**2))
        at_rest[j] = math.sqrt(max(found, floor**2, rounding[j] ** 2))
    return NoiseModel(at_rest, math.sqrt(variance))


def _line(
    x: FloatArray, y: FloatArray, share: float, more: float, least: float
) -> tuple[float, float, FloatArray]:
    """Return the slope of a line through variances, its standard error, and the variances' uncertainty, (n,).

    That is a share of the line's own variance, which is at least ``least``, and ``more``. Weights by what
    each bin has found would prefer those that found too little.
    """
    line = y
    for _ in range(REWEIGHTED):
        sigma = share * line + more
        slope, error = _slope(x, y, sigma)
        rise = max(slope, 0.0) * x
        line = np.maximum(np.average(y - rise, weights=1 / sigma**2) + rise, least)
    return slope, error, sigma


def _slope(x: FloatArray, y: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Return the slope of a weighted line and its standard error."""
    w = 1.0 / sigma**2
    mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
    spread = float(np.sum(w * (x - mean_x) ** 2))
    if spread <= 0:
        return 0.0, math.inf
    return float(np.sum(w * (x - mean_x) * (y - mean_y)) / spread), 1.0 / math.sqrt(spread)


def rows_by_value(values: Sequence[float]) -> list[IntArray]:
    """Return the rows of each distinct value, such as the episodes of each sampling period."""
    every = np.array(values)
    return [np.flatnonzero(every == value) for value in dict.fromkeys(every.tolist())]


def autocorrelations(residuals: Sequence[FloatArray], longest: int) -> Iterator[tuple[float, int]]:
    """Yield the autocorrelation of residuals, (W, H, ...) per episode, at lags 1, 2, ..., and its pairs.

    The episodes have one rate; some windows may be shorter.
    A missing sample has a residual of exactly 0, and does not count. Lags end at ``longest`` samples.
    """
    count = max(sum(map(np.count_nonzero, residuals)), 1)
    power = max(sum(float(np.sum(r**2)) for r in residuals) / count, 1e-300)
    for lag in range(1, min(longest, max(r.shape[1] for r in residuals) - 1) + 1):
        products = [r[:, lag:] * r[:, :-lag] for r in residuals]
        pairs = max(sum(map(np.count_nonzero, products)), 1)
        yield sum(float(np.sum(p)) for p in products) / pairs / power, pairs


@dataclass(frozen=True, slots=True)
class StartStates:
    """Smoothed states at every sample of an episode, with their uncertainty.

    Attributes:
        position: Tangent coordinates, (T, C).
        velocity: (T, C).
        std: Standard deviation of a smoothed (position, velocity), (T, 2 C). It grows towards both
            ends of the recording, where a sample has neighbours on one side only.
    """

    position: FloatArray
    velocity: FloatArray
    std: FloatArray

    @property
    def typical_std(self) -> FloatArray:
        """Median of the standard deviation over the samples, (2 C,)."""
        return np.asarray(np.median(self.std, axis=0))


def smooth_states(
    episode: SampledEpisode, noise_std: FloatArray, rotation: slice, smoothing_s: float
) -> StartStates:
    """Estimate the state at every sample; ``noise_std`` is that of (position, velocity), (2 C,).

    Noise-free positions and their reported velocities are kept: smoothing would only round off the impacts.
    Measured velocities of a base are smoothed. Its rotation vector (coordinates ``rotation``) becomes
    zero, because its reference is the smoothed orientation. Unmeasured coordinates keep the episode's
    estimate.

    Raises:
        InsufficientDataError: The recording is shorter than the smoother.
    """
    C = episode.position.shape[1]
    channels = episode.channels
    seen = np.zeros(2 * C, dtype=bool)
    seen[channels] = True
    clean = bool(np.all(noise_std[channels[channels < C]] < NOISE_FREE_STD))
    if clean and np.isfinite(episode.velocity).all() and seen[:C].all():
        rounding = np.concatenate([np.maximum(noise_std[:C], 1e-7), np.full(C, 1e-4)])
        return StartStates(episode.position, episode.velocity, np.tile(rounding, (len(episode.sample), 1)))
    position, velocity, gain, slope_gain = _local_polynomials(episode.position, episode.period_s, smoothing_s)
    # Twice the propagated noise: kinks of stick-slip and saturation are not polynomials.
    std = 2 * np.concatenate([np.outer(gain, noise_std[:C]), np.outer(slope_gain, noise_std[:C])], axis=1)
    known = np.flatnonzero(seen[C:])
    if known.size:
        smooth, _, own_gain, _ = _local_polynomials(episode.velocity[:, known], episode.period_s, smoothing_s)
        position[:, [c for c in range(C)[rotation] if seen[C + c]]] = 0.0
        velocity[:, known] = smooth
        std[:, C + known] = 2 * np.outer(own_gain, noise_std[C:][known])
    if episode.estimate_std is not None:
        estimate = np.broadcast_to(episode.estimate_std, (len(episode.sample), 2 * C))
        given = np.isfinite(estimate).all(axis=0) & ~seen
        position[:, given[:C]] = episode.position[:, given[:C]]
        velocity[:, given[C:]] = episode.velocity[:, given[C:]]
        std[:, given] = estimate[:, given]
    return StartStates(position, velocity, std)


def smoothed_samples(period_s: float, smoothing_s: float = SMOOTHING_S) -> int:
    """Return the number of samples of a smoothing polynomial; no shorter recording can be used."""
    return max(2 * round(smoothing_s / period_s / 2) + 1, FEWEST_SMOOTHED)


def _local_polynomials(
    values: FloatArray, period_s: float, smoothing_s: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Smooth columns (Savitzky-Golay).

    Returns:
        Values and slopes, (T, n), and the gain of each on white noise, (T,).
    """
    T, order = len(values), SMOOTHING_ORDER
    length = smoothed_samples(period_s, smoothing_s)
    half = length // 2
    if length > T:
        raise InsufficientDataError(
            f"the recording has {T} usable samples, the shortest that can be smoothed has {length}; "
            "record longer"
        )
    # Near both ends a sample is not in the middle of its section.
    first = np.clip(np.arange(T) - half, 0, T - length)
    at = np.arange(T) - first

    def filtered(deriv: int, delta: float) -> tuple[FloatArray, FloatArray]:
        weights = [
            scipy.signal.savgol_coeffs(length, order, deriv, delta, p, use="dot") for p in range(length)
        ]
        found = [weights[a] @ values[f : f + length] for a, f in zip(at, first, strict=True)]
        return np.stack(found), np.array([np.linalg.norm(w) for w in weights])[at]

    smooth, gain = filtered(0, 1.0)
    slope, slope_gain = filtered(1, period_s)
    return smooth, slope, gain, slope_gain
