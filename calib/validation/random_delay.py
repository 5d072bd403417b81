"""Test for a random delay of each command, on the residual of a fit.

Random delays predict no sample, but they predict where the residual is large: each pushes in proportion to
the change of its command. The alternative is a random force of constant size, white or slow, which is how any
other model error looks. All are Gaussian processes beside white noise. The likelihood of left-out windows
decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.validation.signatures import SignatureResponse
from deal_hw.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Folds:
    """Windows that are left out in turn.

    Attributes:
        parts: Number of turns.
        rounds: Stretches of consecutive windows that each turn leaves out; one where windows are too few.
    """

    parts: int = 4
    rounds: int = 2

    def of(self, windows: int) -> IntArray:
        """Return the turn in which each window is left out, (W,)."""
        rounds = self.rounds if windows >= self.rounds * self.parts else 1
        return np.asarray(np.arange(windows) * rounds * self.parts // max(windows, 1) % self.parts)


FOLDS = Folds()


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomDelaySettings:
    """Settings of :func:`random_delay`.

    Attributes:
        windows: Number of windows, spread over the recordings.
        rows: Residuals of each window, from its start.
        slow_s: Correlation time of the slow force [s].
        most: Largest absolute log ratio of the variances of process and noise [-].
    """

    windows: int = 60
    rows: int = 240
    slow_s: float = 0.1
    most: float = 12.0


SETTINGS = RandomDelaySettings()


@dataclass(frozen=True, slots=True)
class RandomDelay:
    """How well random delays explain a residual.

    Attributes:
        deviance: Gain in held-out deviance over white noise.
        gain: The same over the best of all other processes.
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
    """Compare random delays with other processes; None where there is nothing to compare.

    Residuals and the windows' responses to commands are given per episode.
    """
    every = [(e, w) for e, _ in enumerate(answers) for w in range(len(rows[e].residual))]
    chosen = every[:: max(-(-len(every) // SETTINGS.windows), 1)]
    if len(chosen) < FOLDS.parts or not any(np.any(a.change) for a in answers):
        return None
    windows = [_Window.of(rows[e], answers[e], w) for e, w in chosen]
    change = np.concatenate([a.change.reshape(-1, a.change.shape[2]) for a in answers])
    rms = np.sqrt(np.mean(change**2, axis=0))
    # The process of power 0: noise alone.
    found = {"noise": _Process([0.0 * w.residual for w in windows], [w.residual**2 for w in windows])}
    found |= {
        "delay": _Process.of(windows, "delay", rms, period_s),
        "white": _Process.of(windows, "white", rms, period_s),
        "slow": _Process.of(windows, "slow", rms, period_s),
    }
    held_out = {name: process.held_out() for name, process in found.items()}
    ratio, level = found["delay"].fitted(np.ones(len(windows), dtype=bool))
    power = ratio * found["delay"].mean_power
    return RandomDelay(
        deviance=held_out["noise"] - held_out["delay"],
        gain=min(value for name, value in held_out.items() if name != "delay") - held_out["delay"],
        share=power / (1 + power),
        std_s=float(np.sqrt(ratio * level)),
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


@dataclass(frozen=True, slots=True)
class _Process:
    """A random process beside white noise, along each window's own axes.

    Attributes:
        power: Variance of the process of unit intensity along each axis, one array per window.
        squares: The squared residual along it.
    """

    power: Sequence[FloatArray]
    squares: Sequence[FloatArray]

    @classmethod
    def of(
        cls,
        windows: Sequence[_Window],
        name: Literal["delay", "white", "slow"],
        rms: FloatArray,
        period_s: float,
    ) -> _Process:
        """Return the process of late commands, or that of forces as large as command changes, (A,) rms."""
        power, squares = [], []
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
            values, axes = np.linalg.eigh(columns.T @ columns)
            power.append(np.maximum(values, 0.0))
            squares.append((axes.T @ window.residual) ** 2)
        return cls(power, squares)

    @property
    def mean_power(self) -> float:
        """Mean variance of the process of unit intensity."""
        return float(np.mean(np.concatenate(self.power)))

    def held_out(self) -> float:
        """Return -2 log likelihood of each fold's windows under the parameters most likely in the others."""
        fold = FOLDS.of(len(self.power))
        total = 0.0
        for k in range(FOLDS.parts):
            ratio, level = self.fitted(fold != k)
            power, squares = self._of(fold == k)
            variance = level * (1 + ratio * power)
            total += float(np.sum(squares / variance + np.log(variance)))
        return total

    def fitted(self, windows: npt.NDArray[np.bool_]) -> tuple[float, float]:
        """Return the most likely ratio of intensity to noise variance, and that variance, in some windows."""
        power, squares = self._of(windows)
        scale = float(np.mean(power))
        if scale <= 0:
            return 0.0, max(float(np.mean(squares)), 1e-300)

        def cost(log_ratio: float) -> float:
            spread = 1 + np.exp(log_ratio) / scale * power
            return float(len(power) * np.log(np.mean(squares / spread)) + np.sum(np.log(spread)))

        found = minimize_scalar(
            cost, bounds=(-SETTINGS.most, SETTINGS.most), method="bounded", options={"xatol": 0.01}
        )
        ratio = float(np.exp(found.x)) / scale
        return ratio, max(float(np.mean(squares / (1 + ratio * power))), 1e-300)

    def _of(self, windows: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        rows = np.flatnonzero(windows).tolist()
        return np.concatenate([self.power[k] for k in rows]), np.concatenate([self.squares[k] for k in rows])
