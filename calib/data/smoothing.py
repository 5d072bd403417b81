"""States at every sample of a recording, from local polynomials: where windows start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_coeffs

from deal_hw.errors import InsufficientDataError
from deal_hw.sim.recordings.episode import Episode
from deal_hw.types import FloatArray

SMOOTHING_S = 0.1
SMOOTHING_ORDER = 3
SHORTEST = 7
"""Least samples of a polynomial: fewer hardly smooth."""

NOISE_FREE_STD = 2e-5
"""Positions with less noise than this are taken as they are."""


@dataclass(frozen=True, slots=True)
class StartStates:
    """Smoothed states at every sample of an episode, with their uncertainty.

    Attributes:
        position: Chart coordinates, (T, C).
        velocity: (T, C).
        position_std: Standard deviation of a smoothed position, (C,).
        velocity_std: Standard deviation of a smoothed velocity, (C,).
    """

    position: FloatArray
    velocity: FloatArray
    position_std: FloatArray
    velocity_std: FloatArray


def smooth_states(episode: Episode, noise_std: FloatArray, rotation: slice) -> StartStates:
    """Estimate the state at every sample.

    Positions that are free of noise are left alone, and so are the reported velocities then: smoothing would
    only round off the impacts. Measured angular velocities of a base are smoothed; its rotation vector
    vanishes, because the chart's reference is the smoothed orientation already. What was not measured stays
    the estimate that the episode holds.

    Args:
        episode: The recording.
        noise_std: Noise of (position, velocity), (2 C,).
        rotation: Which coordinates are the base's rotation vector.

    Raises:
        InsufficientDataError: The recording is shorter than the smoother.
    """
    C = episode.position.shape[1]
    channels = episode.channels
    seen = np.zeros(2 * C, dtype=bool)
    seen[channels] = True
    clean = bool(np.all(noise_std[channels[channels < C]] < NOISE_FREE_STD))
    if clean and np.isfinite(episode.velocity).all() and seen[:C].all():
        return StartStates(
            episode.position, episode.velocity, np.maximum(noise_std[:C], 1e-7), np.full(C, 1e-4)
        )
    position, slope, gain, slope_gain = _local_polynomials(episode.position, episode.period_s)
    velocity = slope
    # Twice the propagated noise: kinks of stick-slip and saturation are not polynomials.
    position_std, velocity_std = 2 * noise_std[:C] * gain, 2 * noise_std[:C] * slope_gain
    gyro = [c for c in range(C)[rotation] if seen[C + c]]
    if gyro:
        smooth, _, gyro_gain, _ = _local_polynomials(episode.velocity[:, gyro], episode.period_s)
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


def _local_polynomials(values: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray, float, float]:
    """Smooth columns (Savitzky-Golay); return values and slopes, (T, n), and both gains on white noise."""
    T = len(values)
    length = max(2 * round(SMOOTHING_S / period_s / 2) + 1, SHORTEST)
    half = length // 2
    if length > T:
        raise InsufficientDataError(
            f"the recording has {T} usable samples, the shortest that can be smoothed has {length}; "
            "record longer"
        )
    smooth, slope = np.empty_like(values), np.empty_like(values)
    centre = savgol_coeffs(length, SMOOTHING_ORDER, use="dot")
    rate = savgol_coeffs(length, SMOOTHING_ORDER, deriv=1, delta=period_s, use="dot")
    for t in range(T):
        first = min(max(t - half, 0), T - length)
        at = t - first
        if at == half:
            weights, rates = centre, rate
        else:
            weights = savgol_coeffs(length, SMOOTHING_ORDER, pos=at, use="dot")
            rates = savgol_coeffs(length, SMOOTHING_ORDER, deriv=1, delta=period_s, pos=at, use="dot")
        section = values[first : first + length]
        smooth[t], slope[t] = weights @ section, rates @ section
    return smooth, slope, float(np.linalg.norm(centre)), float(np.linalg.norm(rate))
