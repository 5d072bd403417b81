"""What the data can tell: intervals, verdicts, null directions in words, signs of a wrong model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calibration import Verdict
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray

Z90 = 1.6448536269514722
"""Half width of a 90 % interval in standard deviations."""

KINKS = 1.2
"""Factor on standard deviations for what linearising leaves out: stick-slip and saturation bend the
likelihood. Measured on tuning seeds: without it 90 % intervals held 86-89 % of the truths."""

IDENTIFIABLE_STD = 0.15
"""Up to this standard deviation, in ln units or parts of a linear range, a parameter is identified."""

WEAK_SHARE = 0.5
"""Up to this share of the prior's standard deviation the data say something."""

BLIND_SHARE = 0.9
"""Beyond this share of the prior's standard deviation the data say nothing."""

MISMATCH_CHI2 = 1.3
MISMATCH_TIME = 2.0
_LAGS = 12


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """What is known about parameters and latency.

    Attributes:
        covariance: Of the parameters in their own scale, (K, K).
        interval: 90 % intervals, physical, (K, 2).
        latency_interval_s: 90 % interval of the latency [s].
        verdicts: One a parameter.
        null_directions: Combinations that the data cannot see, in words.
        alarms: Signs that the model is wrong, in words.
        inflation: Factor on the variance for what the model does not explain.
    """

    covariance: FloatArray
    interval: FloatArray
    latency_interval_s: tuple[float, float]
    verdicts: tuple[Verdict, ...]
    null_directions: tuple[str, ...]
    alarms: tuple[str, ...]
    inflation: float


def correlation_time(residuals: tuple[FloatArray, ...]) -> float:
    """Return the integrated autocorrelation time of residuals, in samples; 1 for white ones.

    Args:
        residuals: Whitened residuals of windows, (W, H, J) each.
    """
    worst = 1.0
    for r in residuals:
        H = r.shape[1]
        power = np.mean(r**2, axis=(0, 1))
        for j in range(r.shape[2]):
            if power[j] <= 0:
                continue
            total = 1.0
            for lag in range(1, min(_LAGS, H - 1) + 1):
                rho = float(np.mean(r[:, lag:, j] * r[:, :-lag, j]) / power[j])
                if rho <= 2.0 / np.sqrt(r[:, lag:, j].size):
                    break
                total += 2 * rho
            worst = max(worst, total)
    return worst


def uncertainty(
    space: ParameterSpace,
    theta: FloatArray,
    latency_s: float,
    hessian: FloatArray,
    chi2: float,
    residuals: tuple[FloatArray, ...],
    latency_range_s: tuple[float, float],
    fixed_latency: bool = False,
    timing_std_s: float = 0.0,
) -> Uncertainty:
    """Turn normal equations into statements.

    Args:
        space: The parameters.
        theta: Estimate, (K,).
        latency_s: Estimate [s].
        hessian: Whitened normal matrix of parameters and latency, start states eliminated, (K + 1, K + 1).
        chi2: Mean squared whitened residual.
        residuals: Whitened residuals of windows, (W, H, J) each.
        latency_range_s: Searched latencies [s].
        fixed_latency: The latency was given.
        timing_std_s: Jitter of the samples' time that the recording shows [s].
    """
    K = len(space)
    tau = correlation_time(residuals)
    inflation = KINKS**2 * max(1.0, chi2) * tau
    prior = np.append(space.width**2, (latency_range_s[1] - latency_range_s[0]) ** 2) / 12.0
    if fixed_latency:
        prior[-1] = 1e-12
    # The range is a flat prior; its variance keeps what the data cannot see as wide as the range.
    covariance = np.asarray(np.linalg.inv(hessian / inflation + np.diag(1.0 / prior)), dtype=np.float64)
    std = np.sqrt(np.diag(covariance))
    latency = (
        max(latency_s - Z90 * std[K], latency_range_s[0]),
        min(latency_s + Z90 * std[K], latency_range_s[1]),
    )
    if fixed_latency:
        latency = (latency_s, latency_s)
    verdicts = tuple(_verdict(space, k, float(std[k]), float(np.sqrt(prior[k]))) for k in range(K))
    return Uncertainty(
        covariance=covariance[:K, :K],
        interval=intervals(space, theta, covariance[:K, :K]),
        latency_interval_s=latency,
        verdicts=verdicts,
        null_directions=null_directions(space, hessian[:K, :K] / inflation),
        alarms=_alarms(space, theta, chi2, tau, timing_std_s),
        inflation=inflation,
    )


def intervals(space: ParameterSpace, theta: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return 90 % intervals, (K, 2), inside the range.

    Args:
        space: The parameters.
        theta: Estimate, (K,).
        covariance: In each parameter's own scale, (K, K).
    """
    std, center = np.sqrt(np.diag(covariance)), space.to_scale(theta)
    low = np.maximum(space.from_scale(center - Z90 * std), space.low)
    high = np.minimum(space.from_scale(center + Z90 * std), space.high)
    # The estimate of a parameter that the data cannot see is arbitrary: its interval is the range's own 90 %.
    blind = std > BLIND_SHARE * space.width / np.sqrt(12.0)
    K = len(space)
    low = np.where(blind, space.unnormalize(np.full(K, 0.05)), low)
    high = np.where(blind, space.unnormalize(np.full(K, 0.95)), high)
    return np.stack([low, high], axis=1)


def _verdict(space: ParameterSpace, k: int, std: float, prior_std: float) -> Verdict:
    unit = 1.0 if space.log_scale[k] else float(space.width[k])
    if std <= IDENTIFIABLE_STD * unit:
        return "identifiable"
    return "weak" if std <= WEAK_SHARE * prior_std else "not identifiable"


def null_directions(space: ParameterSpace, hessian: FloatArray) -> tuple[str, ...]:
    """Name the combinations of parameters that the data see less than the range does.

    Args:
        space: The parameters.
        hessian: Information of the data in each parameter's own scale, (K, K).
    """
    root = space.width / np.sqrt(12.0)
    values, vectors = np.linalg.eigh(hessian * np.outer(root, root))
    words = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > 1.0:
            break
        direction = vector * root
        direction = direction / np.max(np.abs(direction))
        parts = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > 0.25]
        lead = np.sign(direction[parts[0]])
        up = [space.names[k] for k in parts if np.sign(direction[k]) == lead]
        down = [space.names[k] for k in parts if np.sign(direction[k]) != lead]
        if len(parts) == 1:
            words.append(f"{up[0]} leaves no trace in this recording: excite it or measure it by other means")
        elif not down:
            words.append(
                f"{', '.join(up)} can only be told up to a common factor: measure one of them "
                "(a scale will do for a mass)"
            )
        else:
            words.append(
                f"{', '.join(up)} can be raised while {', '.join(down)} "
                f"{'is' if len(down) == 1 else 'are'} lowered without a trace: measure one of them"
            )
    return tuple(words)


def _alarms(
    space: ParameterSpace, theta: FloatArray, chi2: float, tau: float, timing_std_s: float
) -> tuple[str, ...]:
    alarms = []
    if timing_std_s > 0:
        alarms.append(
            f"the state samples' time jitters by {1e3 * timing_std_s:.1f} ms: the model's delay is "
            "constant, so where commands jitter too the intervals are too narrow"
        )
    if chi2 > MISMATCH_CHI2:
        alarms.append(
            f"the model does not explain the recording: residuals are {np.sqrt(chi2):.1f} times the "
            "sensor noise (friction law, backlash, jittering delay, or a range that is too narrow)"
        )
    if tau > MISMATCH_TIME:
        alarms.append(
            f"residuals hang together over {tau:.1f} samples where noise would not: something moves that "
            "the model does not have (friction law, backlash or a varying delay)"
        )
    unit = space.normalize(theta)
    for k in np.flatnonzero((unit < 1e-6) | (unit > 1 - 1e-6)):
        alarms.append(
            f"{space.names[k]} ended at the bound of its range, {theta[k]:.4g} {space.free[k].unit}: "
            "widen the range"
        )
    return tuple(alarms)
