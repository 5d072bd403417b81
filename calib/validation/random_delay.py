"""Test for a random delay of each command, on the residual of a fit.

Random delays predict no sample, but they predict where the residual is large: each pushes in proportion to
the change of its command. Any other model error looks like a random force of constant size, white or slow.
All are Gaussian processes beside white noise. Random delays are found where the residual is likelier with
them than with these forces alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import Bounds, minimize

from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.validation.signatures import SignatureResponse
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomDelaySettings:
    """Settings of :func:`random_delay`.

    Attributes:
        fewest: Fewest windows.
        windows: Most windows, spread over the recordings.
        rows: Residuals of each window, from its start.
        slow_s: Correlation time of the slow force [s].
        ratio: Least and largest ratio of the mean variances of a process and the noise [-].
    """

    fewest: int = 4
    windows: int = 30
    rows: int = 240
    slow_s: float = 0.1
    ratio: tuple[float, float] = (1e-5, 1e5)


SETTINGS = RandomDelaySettings()


@dataclass(frozen=True, slots=True)
class RandomDelay:
    """How well random delays explain a residual.

    Attributes:
        deviance: Gain in deviance over white noise.
        gain: Gain in deviance over white noise and random forces, beside these.
        share: Share of the residual's variance.
        std_s: Standard deviation of the delays [s].
    """

    deviance: float
    gain: float
    share: float
    std_s: float


def random_delay(
    rows: Sequence[WindowRows], answers: Sequence[SignatureResponse], period_s: float
) -> RandomDelay | None:
    """Compare random delays and forces with forces alone; None where there is nothing to compare.

    Residuals and the windows' responses to commands are given per episode.
    """
    every = [(e, w) for e, _ in enumerate(answers) for w in range(len(rows[e].residual))]
    chosen = every[:: max(-(-len(every) // SETTINGS.windows), 1)]
    if len(chosen) < SETTINGS.fewest or not any(np.any(a.change) for a in answers):
        return None
    windows = [_Window.of(rows[e], answers[e], w) for e, w in chosen]
    change = np.concatenate([a.change.reshape(-1, a.change.shape[2]) for a in answers])
    rms = np.sqrt(np.mean(change**2, axis=0))
    residual = np.stack([window.residual for window in windows])
    delay, scale = _process(windows, "delay", rms, period_s)
    forces = [_process(windows, name, rms, period_s)[0] for name in ("white", "slow")]
    noise, delays, without = (_fitted(residual, these)[0] for these in ([], [delay], forces))
    both, ratios, level = _fitted(residual, [*forces, delay])
    return RandomDelay(
        deviance=noise - delays,
        gain=without - both,
        share=float(ratios[-1] / (1 + ratios.sum())),
        std_s=float(np.sqrt(ratios[-1] * level / scale)),
    )


@dataclass(frozen=True, slots=True)
class _Window:
    """The first residuals of a window without their projection on the start state.

    Attributes:
        residual: In the remaining directions, (D,).
        basis: These directions, (H M, D).
        response: Whitened response to a set-point, (A, H, M).
        change: Changes of the set-points, (H, A).
    """

    residual: FloatArray
    basis: FloatArray
    response: FloatArray
    change: FloatArray

    @classmethod
    def of(cls, rows: WindowRows, answer: SignatureResponse, w: int) -> _Window:
        R, S, M = rows.residual.shape[1], rows.start.shape[2], answer.response.shape[3]
        H = min(answer.response.shape[2], max(SETTINGS.rows // M, 4))
        # The start state's prior comes last.
        kept = np.concatenate([np.arange(H * M), np.arange(R - S, R)])
        basis = np.linalg.qr(rows.start[w][kept], mode="complete")[0][:, S:] if S else np.eye(len(kept))
        residual = basis.T @ rows.residual[w][kept]
        return cls(residual, basis[: H * M], answer.response[:, w, :H], answer.change[w, :H])


def _process(
    windows: Sequence[_Window], name: Literal["delay", "white", "slow"], rms: FloatArray, period_s: float
) -> tuple[FloatArray, float]:
    """Return the covariance of late commands, or of forces as large as command changes, (A,) rms.

    It is that of the windows' residuals, (W, D, D), for a mean variance of 1. The mean variance of an
    intensity of 1 follows.
    """
    covariance = []
    for window in windows:
        A, H, M = window.response.shape
        later = np.zeros((A, H, H, M))
        for k in range(H):
            later[:, k, k:] = window.response[:, : H - k]
        if name == "delay":
            moved = np.einsum("ka,akhm->khm", window.change, later)
        else:
            moved = rms[:, None, None, None] * later
        if name == "slow":
            apart = np.abs(np.subtract.outer(np.arange(H), np.arange(H))) * period_s
            root = np.linalg.cholesky(np.exp(-apart / SETTINGS.slow_s) + 1e-9 * np.eye(H))
            moved = np.einsum("lk,alhm->akhm", root, moved)
        columns = moved.reshape(-1, H * M) @ window.basis
        covariance.append(columns.T @ columns)
    every = np.stack(covariance)
    scale = max(float(np.mean(np.einsum("wdd->wd", every))), 1e-300)
    return every / scale, scale


def _fitted(residual: FloatArray, covariances: Sequence[FloatArray]) -> tuple[float, FloatArray, float]:
    """Return the deviance of residuals, (W, D), from the most likely processes beside white noise.

    Their mean variances over that of the noise, and the noise's variance, follow.
    """
    count, (W, D) = residual.size, residual.shape
    unit = np.broadcast_to(np.eye(D), (W, D, D))

    def likelihood(log_ratios: FloatArray) -> tuple[float, FloatArray, float]:
        """Return deviance, its gradient, and the noise's variance."""
        parts = [ratio * c for ratio, c in zip(np.exp(log_ratios), covariances, strict=True)]
        total = sum(parts, unit)
        inverse = np.linalg.inv(total)
        whitened = np.einsum("wij,wj->wi", inverse, residual)
        level = max(float(np.sum(residual * whitened)) / count, 1e-300)
        deviance = count * np.log(level) + float(np.sum(np.linalg.slogdet(total)[1]))
        slope = [
            np.sum(inverse * part) - np.einsum("wi,wij,wj->", whitened, part, whitened) / level
            for part in parts
        ]
        return float(deviance), np.array(slope), level

    def cost(log_ratios: FloatArray) -> tuple[float, FloatArray]:
        return likelihood(log_ratios)[:2]

    found = np.zeros(len(covariances))
    if covariances:
        least, most = np.log(SETTINGS.ratio)
        found = minimize(cost, found, jac=True, bounds=Bounds(least, most)).x
    deviance, _, level = likelihood(found)
    return deviance, np.exp(found), level
