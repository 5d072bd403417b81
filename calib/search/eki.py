"""Ensemble Kalman inversion: a population moves by the regression of its coordinates on its residuals.

:class:`EnsembleKalman` knows no simulator: ``ask`` returns an ensemble, and ``tell`` takes its whitened
residuals. :class:`LogitStepper` moves it in logits of a search range. Perturbed
observations and the tempered update follow Iglesias, Law and Stuart (2013). The misfit controller is from
Iglesias and Yang (2021), the discrepancy rule for the regularisation from Iglesias (2016). For a linear model
with a Gaussian prior and large N, the ensemble samples the exact posterior once the tempering reaches 1.

Symbols, for N members:
    Z: members minus their mean, over (N - 1)^(1/2), (N, C) [logits].
    d_n: residual of member n, observed minus predicted, whitened, (M,) [-].
    G: mean residual minus residuals, over (N - 1)^(1/2), (N, M).
    C_zg = Z^T G, (C, M), and C_gg = G^T G, (M, M): covariances of the ensemble.
    a: inflation of the noise's variance in one step, >= 1 [-]; the tempering is the sum of 1 / a so far.
Update: z_n += C_zg (C_gg + a 1)^-1 (d_n + a^(1/2) xi_n), with standard normal xi_n, (M,).

`eki` regresses on the vector of all window innovations, whitened for noise and start-state error; there is no
critic. Short windows come first, because an unstable pole makes long predictions of a wrong simulator
meaningless. Long windows then hold the information.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.innovations import Members, cut, explained, is_noisy, whitened_residual
from deal_hw.calib.data.resume import State, Stateful
from deal_hw.calib.data.search import Search, SearchLog, Stepper
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray

STEP_CLIP = 2.0
"""Largest step of a coordinate, in logits."""

NEAR_SPREAD = 0.8
"""Spread at which a brief search ends, in logits: the refinement's basin is that wide."""


@dataclass(frozen=True, slots=True)
class KalmanStep:
    """Result of one update.

    Attributes:
        inflation: Inflation factor of the noise, a >= 1 with the misfit controller.
        misfit: Mean over members of the mean squared residual.
        spread: Mean standard deviation of the coordinates after the step.
    """

    inflation: float
    misfit: float
    spread: float


class EnsembleKalman(Stateful):
    """An ensemble (N, C) that moves towards residual zero.

    ``step_clip`` is the largest move of a coordinate in one step: a regression is not valid far from its
    samples.
    """

    STATE = ("_members", "tempering")

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
                that are not finite are diverged members; they restart from another member.
            keep: None tempers by the misfit controller until ``finished``. A number in (0, 1) instead
                inflates the noise until that share of the mean residual remains after the step (discrepancy
                rule). It is for residuals that change their meaning between steps, where tempering has no
                end.
        """
        residual = self._replace_diverged(residual)
        N, M = residual.shape
        # |d_n|^2 / 2, minus the logarithm of the likelihood up to a constant.
        misfit = 0.5 * np.sum(residual**2, axis=1)
        # G = left diag(scale) right: columns of `left` span members, rows of `right` span observations. A
        # prediction is a constant minus the residual, hence the sign.
        centred = (residual.mean(axis=0) - residual) / np.sqrt(N - 1)
        left, scale, right = np.linalg.svd(centred, full_matrices=False)
        # Members with equal predictions leave no rank, and nothing moves.
        rank = scale > 1e-10 * max(float(scale.max(initial=0.0)), 1e-300)
        left, scale, right = left[:, rank], scale[rank], right[rank]
        if keep is None:
            inflation = 1.0 / self._misfit_step(misfit, M)
            self.tempering += 1.0 / inflation
        else:
            mean = residual.mean(axis=0)
            inflation = _discrepancy(scale, right @ mean, mean, keep)
        # (C_gg + a 1)^-1 on the span of `right` is 1 / (scale^2 + a), so C_zg (C_gg + a 1)^-1 v is
        # Z^T left diag(scale / (scale^2 + a)) right v: nothing of size M x M. The perturbations are drawn in
        # the span of the ensemble, the only part of them with an effect.
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
        # z_n = mean + max(spread / std, 1) (z_n - mean), coordinate by coordinate.
        self._members = mean + (self._members - mean) * np.maximum(spread / std, 1.0)
        self.tempering = 0.0

    def _misfit_step(self, misfit: FloatArray, observations: int) -> float:
        # 1 / a = min(max(M / (2 mean), (M / (2 var))^(1/2)), 1 - tempering), with mean and variance over
        # members of the misfits |d|^2 / 2: Iglesias and Yang (2021).
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
            # Nothing to learn from: residuals of zero move nothing.
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


def spread_of(statistics: FloatArray) -> tuple[npt.NDArray[np.bool_], FloatArray]:
    """Return which statistics differ between members, (F,), and the standard deviations of those.

    Statistics, (N, F), that are equal for all members carry no information and would divide by zero.
    """
    std = statistics.std(axis=0)
    alive = std > 1e-6 * max(float(std.max()), 1e-30)
    return alive, std[alive]


class LogitStepper(Stepper):
    """A run of ensemble Kalman inversion in logits."""

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self.kalman = self.new_ensemble()

    def new_ensemble(self) -> EnsembleKalman:
        """Return an ensemble drawn over the whole range."""
        unit = self.coordinates.sample(self.rng, self.log.budget.population)
        return EnsembleKalman(logit(unit), self.rng, step_clip=STEP_CLIP)

    def population(self, z: FloatArray) -> tuple[Members, Members]:
        """Return the members at logits z, (N, C), and the member at their mean."""
        middle = logistic(z.mean(axis=0, keepdims=True))
        return self.coordinates.members(logistic(z)), self.coordinates.members(middle)


class KalmanStepper(LogitStepper):
    """The same in stages of windows; a brief run has the first stage.

    It needs the settings ``widen`` [logits], ``noisy_ticks`` and ``clean_ticks``, too.
    """

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self._noisy, self._brief = is_noisy(self.problem), log.budget.brief
        lengths = self.settings.noisy_ticks if self._noisy else self.settings.clean_ticks
        self._lengths = lengths[:1] if self._brief else lengths

    def _enter_stage(self, stage: int) -> None:
        """Begin a stage; each but the first widens the ensemble."""
        self._stage = stage
        if stage:
            self.kalman.widen(self.settings.widen)

    def load(self, state: State) -> None:
        """Begin the saved state's stage, and continue there."""
        self._enter_stage(state["_stage"])
        super().load(state)


def logit(unit: FloatArray, edge: float = 1e-9) -> FloatArray:
    """Map the unit interval, without its edges, to the real line, where steps need no bounds."""
    # z = ln(u / (1 - u))
    inside = np.clip(unit, edge, 1 - edge)
    return np.asarray(np.log(inside) - np.log1p(-inside))


def logistic(z: FloatArray) -> FloatArray:
    """Return the inverse of :func:`logit`."""
    # 1 / (1 + e^-z) = (1 + tanh(z / 2)) / 2, which does not overflow.
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * z)))


@dataclass(frozen=True, slots=True, kw_only=True)
class EkiSettings:
    """Settings of `eki`.

    Attributes:
        noisy_ticks: Window lengths of the stages for noisy positions [control periods].
        clean_ticks: The same for positions without noise.
        widen: Least spread of a coordinate at the start of each further stage, in logits.
        restart_chi2: Chi2 above which the search starts again from the whole range.
        stage_generations: Most generations of one stage.
    """

    noisy_ticks: tuple[int, ...] = (5, 20, 20)
    clean_ticks: tuple[int, ...] = (5, 10)
    widen: float = 0.5
    restart_chi2: float = 3.0
    stage_generations: int = 20


class _Eki(KalmanStepper):
    """A run of `eki`: searches, each of several stages, each of several generations."""

    STATE = ("kalman", "_restarts", "_best", "_over", "_stage", "_generation", "_offsets")

    settings: EkiSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self._near = False
        self._restarts = 0
        self._best: tuple[float, FloatArray] | None = None
        self._over = log.budget.generations <= 0
        self._offsets: list[FloatArray] | None = None
        self._enter_stage(0)

    @property
    def finished(self) -> bool:
        """Whether a search has explained the recording, or the budget is used up."""
        return self._over

    def step(self) -> None:
        """Do one Kalman step; at the end of a stage or search, begin the next."""
        z = self.kalman.ask()
        members, centre = self.population(z)
        residual = whitened_residual(
            self.problem, members, centre, self._windows, self._offsets, population=True
        )
        step = self.kalman.tell(residual)
        self._generation += 1
        self._near = self._brief and step.spread < NEAR_SPREAD
        ticks = self._lengths[self._stage]
        self.log.note(
            f"windows of {ticks} ticks: misfit {step.misfit:.3g}, spread {step.spread:.3g}",
            members,
            {
                "ticks": float(ticks),
                "misfit": step.misfit,
                "spread": step.spread,
                "inflation": step.inflation,
                "tempering": self.kalman.tempering,
            },
        )
        while self._stage_over and not self._over:
            if self._stage + 1 < len(self._lengths):
                self._enter_stage(self._stage + 1)
            else:
                self._end_search()

    def result(self) -> CalibrationResult:
        chi2, z = self._best or (float("nan"), self.kalman.ask())
        alarms = []
        if not chi2 <= self.settings.restart_chi2 and not self._brief:
            alarms.append(self.log.unexplained(chi2))
        members, centre = self.population(z)
        return self.log.result(
            centre,
            members,
            chi2=chi2,
            alarms=alarms,
            extra={"restarts": self._restarts, "interval": "ensemble spread, uncalibrated"},
        )

    @property
    def _stage_over(self) -> bool:
        return (
            self.kalman.finished
            or self._near
            or self._generation >= self.settings.stage_generations
            or len(self.log.trace) >= self.log.budget.generations
        )

    def _enter_stage(self, stage: int) -> None:
        super()._enter_stage(stage)
        self._generation = 0
        self._windows = cut(self.problem, self._lengths[stage])
        self._offsets = None
        if stage:
            # From the second stage on the population is near enough to locate window starts better than a
            # smoother does: linearise around the last generation's most probable start states.
            self._offsets = [np.zeros((len(d.windows), 2 * d.start_position.shape[1])) for d in self._windows]

    def _end_search(self) -> None:
        z = self.kalman.ask()
        chi2 = explained(self.problem, self.population(z)[1], self._lengths[-1])
        if self._best is None or chi2 < self._best[0]:
            self._best = (chi2, z)
        spent = len(self.log.trace) >= self.log.budget.generations
        if self._brief or spent or chi2 <= self.settings.restart_chi2:
            self._over = True
            return
        self._restarts += 1
        self.kalman = self.new_ensemble()
        self._enter_stage(0)


@dataclass(frozen=True)
class Eki(Search):
    """Whitened ensemble Kalman inversion; restarts while the residual is unexplained and the budget lasts."""

    name = "eki"
    stepper = _Eki
    settings: EkiSettings = field(default_factory=EkiSettings)
