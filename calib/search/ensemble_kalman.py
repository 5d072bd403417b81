"""Ensemble Kalman inversion: a population moves by the regression of its coordinates on its residuals.

:class:`EnsembleKalman` knows no simulator: it is asked for an ensemble and told that ensemble's whitened
residuals. :class:`KalmanStepper` moves it in logits of a search range, for `eki` and `deal`. Perturbed
observations and the tempered update are those of Iglesias, Law and Stuart (2013); the data-misfit controller
is that of Iglesias and Yang (2021), the discrepancy rule for the regularisation that of Iglesias (2016). On a
linear model with a Gaussian prior the ensemble is, for large N, a sample of the exact posterior once the
tempering reaches 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.search.base import Search, SearchLog, Stepper
from deal_hw.calib.search.resume import Kept
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True)
class KalmanStep:
    """What one update did.

    Attributes:
        inflation: By how much the noise was inflated, a >= 1 with the misfit controller.
        misfit: Mean over members of the mean squared residual.
        spread: Mean standard deviation of the coordinates after the step.
    """

    inflation: float
    misfit: float
    spread: float


class EnsembleKalman(Kept):
    """An ensemble (N, C) that is moved towards residual zero.

    Args:
        ensemble: Initial members, (N, C).
        rng: Draws the perturbations.
        step_clip: Largest move of a coordinate in one step; a regression far from its samples means nothing.
    """

    KEPT = ("_members", "tempering")

    def __init__(self, ensemble: FloatArray, rng: np.random.Generator, step_clip: float = 2.0) -> None:
        self._members = np.array(ensemble, dtype=float)
        self._rng = rng
        self._clip = step_clip
        self.tempering = 0.0

    def ask(self) -> FloatArray:
        """Return the members to evaluate, (N, C)."""
        return self._members.copy()

    @property
    def finished(self) -> bool:
        """Whether the whole likelihood has been used."""
        return self.tempering >= 1.0 - 1e-12

    def tell(self, residual: FloatArray, keep: float | None = None) -> KalmanStep:
        """Move the ensemble.

        Args:
            residual: Observed minus predicted, (N, M), whitened: unit variance where the model is right. Rows
                that are not finite are members whose simulation diverged; they restart from another member.
            keep: None tempers by the misfit controller until ``finished``. A number in (0, 1) instead
                inflates the noise until that share of the mean residual remains after the step (discrepancy
                rule): for residuals whose meaning changes from step to step, where tempering has no end.
        """
        residual = self._replace_diverged(residual)
        N, M = residual.shape
        misfit = 0.5 * np.sum(residual**2, axis=1)
        # Rows of `left` span members, rows of `right` span observations.
        centred = (residual.mean(axis=0) - residual) / np.sqrt(N - 1)
        left, scale, right = np.linalg.svd(centred, full_matrices=False)
        # Members that predict alike leave no rank, and nothing moves.
        rank = scale > 1e-10 * max(float(scale.max(initial=0.0)), 1e-300)
        left, scale, right = left[:, rank], scale[rank], right[rank]
        if keep is None:
            inflation = 1.0 / self._misfit_step(misfit, M)
            self.tempering += 1.0 / inflation
        else:
            mean = residual.mean(axis=0)
            inflation = _discrepancy(scale, right @ mean, mean, keep)
        # z + C_zg (C_gg + a I)^-1 (y + sqrt(a) xi - g): the singular vectors make it N x N, and the
        # perturbations are drawn in the span of the ensemble, the only part of them that acts.
        projected = residual @ right.T + np.sqrt(inflation) * self._rng.standard_normal((N, len(scale)))
        deviation = (self._members - self._members.mean(axis=0)) / np.sqrt(N - 1)
        gain = (scale / (scale**2 + inflation))[:, None] * (left.T @ deviation)
        step = projected @ gain
        self._members += np.clip(step, -self._clip, self._clip)
        return KalmanStep(
            inflation, float(2 * misfit.mean() / max(M, 1)), float(self._members.std(axis=0, ddof=1).mean())
        )

    def widen(self, spread: float) -> None:
        """Scale deviations so that no coordinate's spread is below ``spread``; the tempering restarts."""
        mean = self._members.mean(axis=0)
        std = np.maximum(self._members.std(axis=0, ddof=1), 1e-12)
        self._members = mean + (self._members - mean) * np.maximum(spread / std, 1.0)
        self.tempering = 0.0

    def _misfit_step(self, misfit: FloatArray, observations: int) -> float:
        mean, variance = float(misfit.mean()), float(misfit.var())
        step = max(
            observations / (2 * max(mean, 1e-300)), np.sqrt(observations / (2 * max(variance, 1e-300)))
        )
        return float(min(step, 1.0 - self.tempering))

    def _replace_diverged(self, residual: FloatArray) -> FloatArray:
        bad = ~np.isfinite(residual).all(axis=1)
        if not bad.any():
            return residual
        good = np.flatnonzero(~bad)
        if good.size < 2:
            # Nothing to learn from: the next generation starts as it is, with residuals that move nothing.
            return np.zeros_like(residual)
        source = self._rng.choice(good, int(bad.sum()))
        self._members[bad] = self._members[source]
        filled = residual.copy()
        filled[bad] = residual[source]
        return filled


def _discrepancy(scale: FloatArray, projected: FloatArray, residual: FloatArray, keep: float) -> float:
    # The smallest a = 2^i with ||a (C + a I)^-1 d|| >= keep ||d||; the part of d outside the ensemble's span
    # always stays, so it is counted too.
    total = float(residual @ residual)
    outside = max(total - float(projected @ projected), 0.0)
    inflation = 1e-12 * max(float(scale[0]) ** 2, 1e-300) if scale.size else 1.0
    for _ in range(200):
        left = outside + float(np.sum((inflation / (scale**2 + inflation) * projected) ** 2))
        if left >= keep**2 * total:
            break
        inflation *= 2.0
    return inflation


class KalmanStepper(Stepper):
    """A run whose population is an ensemble Kalman inversion's, in logits.

    The search's settings say by how many logits a coordinate may move in one step (``step_clip``).
    """

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self.kalman = self.new_ensemble()

    def new_ensemble(self) -> EnsembleKalman:
        """Return an ensemble drawn over the whole range."""
        unit = self.coordinates.sample(self.rng, self.log.budget.population)
        return EnsembleKalman(logit(unit), self.rng, step_clip=self.settings.step_clip)

    def population(self, z: FloatArray) -> tuple[Members, Members]:
        """Return the members at logits z, (N, C), and the one at their mean."""
        middle = logistic(z.mean(axis=0, keepdims=True))
        return self.coordinates.members(logistic(z)), self.coordinates.members(middle)


def logit(unit: FloatArray, edge: float = 1e-9) -> FloatArray:
    """Map the unit interval, but for its edges, to the real line: unbounded steps then stay inside."""
    inside = np.clip(unit, edge, 1 - edge)
    return np.asarray(np.log(inside) - np.log1p(-inside))


def logistic(z: FloatArray) -> FloatArray:
    """Undo :func:`logit`."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * z)))
