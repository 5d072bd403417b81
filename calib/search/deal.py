"""`deal`: the paper's adversarial method with another view of the data and another update.

It keeps DEAL's idea: a critic learns to separate the recording from the population's rollouts, and the
population moves to where the critic cannot. It deviates from the paper in three places, each for a measured
reason:

- Input of the critic: innovations of short windows that restart at recorded states, not whole rollouts. After
  the first second, a replay of an unstable robot has little information about its parameters.
- Output per member: not one score, but the mean of every hidden activation and of the output, and beside
  them the innovations themselves. One number per member and a softmax lose what the critic knows. With the
  paper's update even the exact prediction error as fitness ends at 27-54 % error.
- Update: an ensemble Kalman step regresses parameters on those values towards the recording's own values,
  instead of the denoising step of eqs. 1-3 and 8-10.

The critic is a WGAN-GP of 64-64 units with Adam, not a clipped WGAN of 256-256 (section 3.1): with clipped
weights, hidden features hardly depend on the parameters.

Symbols, for member i of N and sample j of n (a window, or a control period):
    e_j, e_ij: innovations of the recording and of the member, (width,); c_j: its context (s, a).
    D: the critic; h1, h2: activations of its hidden layers; phi(e, c) = [h1, h2, D](e, c), (F,).
    Phi = mean_j phi(e_j, c_j), Phi_i = mean_j phi(e_ij, c_j): statistics of recording and member.
    W: whitens a difference of statistics or of innovations, so that 1 is a standard deviation of its noise.
    d_i = [W (Phi - Phi_i), W (e - e_i)]: what the Kalman step takes to zero by moving theta_i (`eki`):
        theta_i += C_theta,d (C_d,d + a 1)^-1 d_i, with the inflation a of `eki`.
    gap = mean_j D(e_j, c_j) - mean_ij D(e_ij, c_j): the Wasserstein estimate of eq. 5.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.innovations import (
    Members,
    cut,
    explained,
    linearise,
    predict_population,
    samples_per_tick,
)
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Stateful
from deal_hw.calib.data.search import Search, SearchLog
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.paper.critic import FEATURE_CRITIC, CriticSettings, PenaltyCritic, Samples
from deal_hw.calib.search.eki import NEAR_SPREAD, KalmanStepper, spread_of
from deal_hw.calibration import CalibrationResult
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray

MOST_GENERATIONS = 50
"""Search steps; never more than the budget's."""

LEAST_SPREAD = 1e-4
"""Spread below which members cannot be separated and the search ends, in logits."""

KEPT_RESIDUAL = 0.25
"""Share of the residual that one step leaves (noise-free recordings, without innovations)."""

ALARM_CHI2 = 3.0
"""Chi2 of a noisy recording above which the result carries an alarm."""

SMOOTH_DRAWS = 4
"""Number of noise draws in a member's mean statistics."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DealSettings:
    """Settings of `deal`.

    Attributes:
        critic: Size and training.
        noisy_ticks: Window lengths of the stages for noisy positions [control periods]; a long window of a
            distant simulator has no information.
        noise_draws: Draws of the noise that estimate its effect on the statistics (noisy recordings).
        innovations: Whether the update regresses on the innovations, too, as that of `eki`.
        features: Whether it regresses on the critic's statistics; off is a search without a critic.
        trained: Whether the critic is trained; off leaves the features of its random first weights.
    """

    # One stage without noise: ten periods already tell the members apart [control periods].
    clean_ticks: ClassVar[tuple[int, ...]] = (10,)
    # The noisy second stage begins as wide as that of `eki`: the first may have narrowed too much [logits].
    widen: ClassVar[float] = 0.5

    critic: CriticSettings = field(default_factory=lambda: FEATURE_CRITIC)
    noisy_ticks: tuple[int, ...] = (5, 20)
    noise_draws: int = 100
    innovations: bool = True
    features: bool = True
    trained: bool = True

    def __post_init__(self) -> None:
        if not (self.innovations or self.features):
            raise ConfigurationError("without innovations and features nothing is left to fit; set one")

    @property
    def with_critic(self) -> bool:
        """Whether a critic learns."""
        return self.features and self.trained


class _Deal(KalmanStepper):
    """A run of `deal`: stages of windows, one round of critic updates and one Kalman step a generation."""

    STATE = ("kalman", "_stage", "_spread", "_view", "_diverged")

    settings: DealSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self._least_spread = NEAR_SPREAD if self._brief else LEAST_SPREAD
        self._most = min(MOST_GENERATIONS, log.budget.generations)
        self._view: _View
        self._diverged = 0
        self._enter_stage(0)
        self._skip_empty_stages()

    @property
    def finished(self) -> bool:
        """Whether the last stage has ended."""
        return self._last and self._stage_over

    def step(self) -> None:
        """One round of critic updates and one Kalman step."""
        z = self.kalman.ask()
        members, centre = self.population(z)
        residual, gap = self._view.residual(members, centre)
        # Innovations and statistics of noisy recordings are whitened by their noise, so the tempering ends
        # there. Noise-free statistics alone have no such end: each step leaves a share of the residual.
        ends = self._noisy or self.settings.innovations
        step = self.kalman.tell(residual, keep=None if ends else KEPT_RESIDUAL)
        self._spread = step.spread
        values = {"misfit": step.misfit, "spread": step.spread, "inflation": step.inflation}
        words = f"misfit {step.misfit:.3g}, spread {step.spread:.3g}"
        if self.settings.with_critic:
            values["wasserstein"] = gap
            sound = np.isfinite(gap)
            critic = (
                f"critic's distance {gap:.3g}" if sound else "the critic diverged, its last weights go on"
            )
            words = f"adversarial, {critic}, {words}"
        self.log.note(words, members, values)
        self._skip_empty_stages()

    def result(self) -> CalibrationResult:
        members, centre = self.population(self.kalman.ask())
        chi2 = explained(self.problem, centre, self._lengths[-1])
        diverged = self._diverged + self._view.diverged
        alarms = self.log.critic_diverged(diverged)
        # Without sensor noise chi2 is in units of the wire's rounding, which no critic resolves.
        if self._noisy and not chi2 <= ALARM_CHI2:
            alarms.append(self.log.unexplained(chi2))
        return self.log.result(
            centre,
            members,
            chi2=chi2,
            alarms=alarms,
            extra={
                "interval": "ensemble spread, uncalibrated",
                "view": "control periods" if self._noisy else "windows",
                "critic_diverged": diverged,
            },
        )

    @property
    def _last(self) -> bool:
        return self._stage + 1 == len(self._lengths)

    @property
    def _stage_over(self) -> bool:
        # Earlier stages bring the population near; a third of the budget remains for the last.
        end = self._most if self._last else 2 * self._most // 3
        told_apart = self._spread > self._least_spread
        return len(self.log.trace) >= end or self.kalman.finished or not told_apart

    def _skip_empty_stages(self) -> None:
        while self._stage_over and not self._last:
            self._enter_stage(self._stage + 1)

    def _enter_stage(self, stage: int) -> None:
        super()._enter_stage(stage)
        self._diverged += self._view.diverged if stage else 0
        self._spread = float("inf")
        kind: type[_View] = _NoisyView if self._noisy else _CleanView
        self._view = kind(self.problem, self.settings, self._lengths[stage], self.rng, stage > 0)


class _View(Stateful, abc.ABC):
    """The critic's samples of recording and population, and the statistics of each member.

    With ``move_starts`` it linearises around each generation's most probable start states.
    """

    STATE = ("_critic", "_offsets")

    def __init__(
        self,
        problem: Problem,
        settings: DealSettings,
        ticks: int,
        rng: np.random.Generator,
        move_starts: bool,
    ) -> None:
        self._problem, self._settings, self._rng, self._ticks = problem, settings, rng, ticks
        self._move_starts = move_starts
        self._offsets: list[FloatArray | None] = [None] * len(problem.episodes)
        self._every = samples_per_tick(problem)
        self._windows = cut(problem, ticks)
        context = np.concatenate([self._make_context(data) for data in self._windows])
        spread = np.maximum(context.std(axis=0), 1e-9)
        self._context = np.asarray((context - context.mean(axis=0)) / spread, dtype=np.float32)
        self._critic = PenaltyCritic(self._width() + self._context.shape[1], settings.critic, rng)

    @property
    def diverged(self) -> int:
        """How often the critic's training diverged, and was undone."""
        return self._critic.diverged

    @abc.abstractmethod
    def _width(self) -> int:
        """Return the number of innovations in one sample of the critic."""

    @abc.abstractmethod
    def _make_context(self, data: WindowData) -> FloatArray:
        """Return state and action of each sample of an episode, (n, C): the s and a of D(s, a, s')."""

    @abc.abstractmethod
    def _innovations(
        self, members: Members, centre: Members, data: WindowData
    ) -> tuple[FloatArray, FloatArray]:
        """Return innovations of the recording, (n, width), and of the members, (N, n, width)."""

    @abc.abstractmethod
    def _statistics(
        self, real: FloatArray, fake: FloatArray, good: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray, float]:
        """Train the critic; return whitened statistics of recording and members, and the distance."""

    def _whitened(self, difference: FloatArray) -> FloatArray:
        """Return recording minus sound members, (N, n, width), in units of the noise, (N, n width)."""
        return difference.reshape(len(difference), -1)

    def _unit(self, innovations: FloatArray) -> float:
        """Return the unit of the statistics beside innovations in units of the noise, (N, F)."""
        return 1.0

    def residual(self, members: Members, centre: Members) -> tuple[FloatArray, float]:
        """Return the recording's values minus each member's, (N, F), and the Wasserstein estimate.

        Values are the critic's statistics and the innovations, the latter relative to the prediction of
        ``centre``. The estimate is nan without a critic.
        """
        # Episodes follow each other along the samples: e_j is (n, width), e_ij (N, n, width).
        parts = [self._innovations(members, centre, data) for data in self._windows]
        real = np.concatenate([part[0] for part in parts])
        fake = np.concatenate([part[1] for part in parts], axis=1)
        # A member whose simulation diverged has no innovations. Its row stays nan; the update leaves it out.
        good = np.isfinite(fake).all(axis=(1, 2))
        if not good.any() or not np.isfinite(real).all():
            return np.full((len(fake), 1), np.nan), float("nan")
        kinds, gap = [], float("nan")
        if self._settings.features:
            target, found, gap = self._statistics(real, np.nan_to_num(fake), good)
            kinds.append((target - found)[good])
        if self._settings.innovations:
            innovations = self._whitened(real - fake[good])
            if kinds:
                kinds[0] *= self._unit(innovations)
            kinds.append(innovations)
        residual = np.full((len(fake), sum(kind.shape[1] for kind in kinds)), np.nan)
        residual[good] = np.concatenate(kinds, axis=1)
        return residual, gap

    def _train(self, real: Samples, fake: Samples) -> float:
        """Update the critic; return the Wasserstein estimate, nan where it stays untrained."""
        if not self._settings.with_critic:
            return float("nan")
        return self._critic.train(real, fake.reshape(-1, real.shape[1]))

    def _join(self, values: FloatArray, scale: FloatArray) -> Samples:
        # Windows of distant members run away by many scales. Without a limit the critic would fit those
        # alone. 5 s tanh(e / 5 s) is e up to about two scales s, and never more than five.
        limited = (5.0 * np.tanh(values / (5.0 * scale))).astype(np.float32)
        context = np.broadcast_to(self._context, (*values.shape[:-1], self._context.shape[1]))
        return np.concatenate([limited, context], axis=-1)


class _CleanView(_View):
    """Noise-free recordings: one sample is one window of innovations at the control rate."""

    @property
    def _at(self) -> slice:
        """The samples of a window at the control rate."""
        return slice(self._every - 1, None, self._every)

    def _width(self) -> int:
        return self._ticks * len(self._problem.channels)

    def _make_context(self, data: WindowData) -> FloatArray:
        episode = self._problem.episodes[data.episode]
        span = data.windows.length * data.windows.stride
        begin = episode.sample[data.windows.start]
        target = np.stack([episode.target[k : k + span].mean(axis=0) for k in begin])
        return np.concatenate([data.start_position, data.start_velocity, target], axis=1)

    def _innovations(
        self, members: Members, centre: Members, data: WindowData
    ) -> tuple[FloatArray, FloatArray]:
        both = Members(
            np.concatenate([members.theta, centre.theta]),
            np.concatenate([members.latency_s, centre.latency_s]),
        )
        predicted = predict_population(self._problem, both, data)[:, :, self._at]
        real = data.measured[:, self._at] - predicted[-1]
        fake = predicted[:-1] - predicted[-1]
        return real.reshape(len(real), -1), fake.reshape(*fake.shape[:2], -1)

    def _statistics(
        self, real: FloatArray, fake: FloatArray, good: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray, float]:
        scale = np.maximum(np.sqrt(np.mean(fake[good] ** 2, axis=(0, 1))), 1e-12)
        data, imitation = self._join(real, scale), self._join(fake, scale)
        gap = self._train(data, imitation[good])
        # Without noise nothing says how large a difference of statistics is. W is one over their spread in
        # the population; statistics that no member changes (dead units) go.
        target, found = self._critic.statistics(data[None])[0], self._critic.statistics(imitation)
        alive, std = spread_of(found[good])
        return target[alive] / std, found[:, alive] / std, gap

    def _whitened(self, difference: FloatArray) -> FloatArray:
        std = np.concatenate([data.std[:, self._at].reshape(len(data.std), -1) for data in self._windows])
        return super()._whitened(difference / std)

    def _unit(self, innovations: FloatArray) -> float:
        # Statistics without a noise of their own count as much as innovations of the same spread.
        return float(np.sqrt(np.mean(innovations.var(axis=0))))


class _NoisyView(_View):
    """Noisy recordings: one sample is one control period of whitened innovations.

    Members get simulated noise of the same whitened size, or the critic would recognise them by its absence.
    """

    def _width(self) -> int:
        return self._every * len(self._problem.channels)

    def _make_context(self, data: WindowData) -> FloatArray:
        starts, episode = self._problem.starts[data.episode], self._problem.episodes[data.episode]
        row = (data.windows.start[:, None] + np.arange(0, data.windows.length, self._every)).ravel()
        target = episode.target[episode.sample[row]]
        return np.concatenate([starts.position[row], starts.velocity[row], target], axis=1)

    def _innovations(
        self, members: Members, centre: Members, data: WindowData
    ) -> tuple[FloatArray, FloatArray]:
        offset = self._offsets[data.episode]
        whitening = linearise(self._problem, centre, data, offset)
        starts = whitening.starts(data)
        predicted = predict_population(self._problem, members, data, *starts)
        if self._move_starts:
            self._offsets[data.episode] = whitening.next_offset(data.measured)
        # The inverse Cholesky factor is lower triangular: each period's innovation is whitened by its past.
        fake = whitening.apply(predicted - whitening.reference).reshape(len(predicted), -1, self._width())
        real = whitening.innovation(data.measured, whitening.reference[None]).reshape(-1, self._width())
        return real, fake

    def _statistics(
        self, real: FloatArray, fake: FloatArray, good: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray, float]:
        settings = self._settings
        # Whitened innovations have noise of variance 1. So a simulated noise of e_ij is a standard normal
        # draw, and the scale of a channel is sqrt(1 + mean_ij e_ij^2), that of innovations with noise.
        draws = self._rng.standard_normal((settings.noise_draws, *real.shape))
        scale = np.sqrt(1.0 + np.mean(fake[good] ** 2, axis=(0, 1)))
        noise = draws[self._rng.integers(len(draws), size=len(fake))]
        data, imitation = self._join(real, scale), self._join(fake + noise, scale)
        gap = self._train(data, imitation[good])
        target = self._critic.statistics(data[None])[0]
        # Phi_i without the noise of a single draw: the mean over some. tanh and ReLU bend the mean, so noise
        # is added before phi, not left out.
        repeats = [self._critic.statistics(self._join(fake + d, scale)) for d in draws[:SMOOTH_DRAWS]]
        found = np.mean(repeats, axis=0)
        # cov Phi from noise alone (a model that is right), and W = L^-1 with L L^T = cov Phi (Cholesky).
        covariance = np.cov(self._critic.statistics(self._join(draws, scale)), rowvar=False)
        variance = np.diag(covariance)
        alive = variance > 1e-12 * max(float(variance.max()), 1e-30)
        # The covariance of so many statistics from as few draws is singular: shrink it to its diagonal.
        covariance = 0.9 * covariance[np.ix_(alive, alive)] + 0.1 * np.diag(variance[alive])
        factor = np.linalg.inv(np.linalg.cholesky(covariance))
        return factor @ target[alive], found[:, alive] @ factor.T, gap


@dataclass(frozen=True)
class Deal(Search):
    """Critic features, innovations, and an ensemble Kalman step."""

    settings: DealSettings = field(default_factory=DealSettings)
    name: str = "deal"
    stepper = _Deal

    @property
    def adversarial(self) -> bool:
        """Whether the critic learns; the variants without it regress on innovations or first weights."""
        return self.settings.with_critic


def critic_alone() -> Deal:
    """Return `deal` that regresses on the critic's features alone."""
    return Deal(DealSettings(innovations=False), "deal-critic")


def untrained() -> Deal:
    """Return `deal` with a critic that is never trained."""
    return Deal(DealSettings(trained=False), "deal-untrained")


def without_critic() -> Deal:
    """Return `deal` that regresses on the innovations alone, without a critic."""
    return Deal(DealSettings(features=False), "deal-no-critic")
