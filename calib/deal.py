"""`deal`: the adversarial method that works; the paper's critic, another view of the data and another update.

It keeps DEAL's idea (a critic learns what tells the recording from the population's rollouts, and the population moves
to where it cannot tell) and deviates from the paper in three places, each for a measured reason:

- What the critic sees: innovations of short windows that restart at recorded states, not whole rollouts. A replay of an
  unstable robot says little of its parameters after the first second.
- What a member is told: not one score, but the mean of every hidden activation and of the output. One number a member
  and a softmax lose what the critic knows (with the paper's update even the exact prediction error as fitness ends
  at 27-54 % error).
- How the population moves: an ensemble Kalman step regresses parameters on those statistics towards the recording's own
  statistics, instead of the denoising step of eqs. 1-3 and 8-10.

And the critic is a WGAN-GP of 64-64 units with Adam, not a clipped WGAN of 256-256 (section 3.1): clipped weights make
hidden features that hardly depend on the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.coordinates import Coordinates, Members, logistic, logit
from deal_hw.calib.critic import CriticSettings, PenaltyCritic, Samples, torch_threads
from deal_hw.calib.ensemble_kalman import EnsembleKalman
from deal_hw.calib.innovations import is_noisy, linearise, predict, samples_per_tick
from deal_hw.calib.outcome import Run
from deal_hw.calib.problem import Problem, WindowData
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback
from deal_hw.types import FloatArray

_CRITIC = CriticSettings(hidden=(64, 64), learning_rate=1e-3, updates=20, batch=512)


@dataclass(frozen=True, slots=True, kw_only=True)
class DealSettings:
    """Settings of `deal`.

    Attributes:
        critic: Size and training.
        generations: Search steps; never more than the budget's.
        clean_ticks: Window length in control periods where positions carry no noise.
        noisy_ticks: The same where they do.
        keep: Share of the statistics' residual that one step leaves.
        step_clip: Largest step of a coordinate, in logits.
        noise_draws: Draws of the noise from which its effect on the statistics is estimated (noisy recordings).
        average: How many last generations' means make the estimate (noisy recordings).
        torch_threads: Threads of the critic's arithmetic.
    """

    critic: CriticSettings = field(default_factory=lambda: _CRITIC)
    generations: int = 15
    clean_ticks: int = 10
    noisy_ticks: int = 20
    keep: float = 0.3
    step_clip: float = 2.0
    noise_draws: int = 100
    average: int = 4
    smooth: int = 4
    context: bool = True
    white: bool = True
    floor: float = 1e-8
    torch_threads: int = 1


class Deal(CalibrationMethod[Problem]):
    """Critic features and an ensemble Kalman step.

    Args:
        settings: How to run.
    """

    name = "deal"

    def __init__(self, settings: DealSettings | None = None) -> None:
        self.settings = settings or DealSettings()

    def run(
        self, problem: Problem, budget: Budget, rng: np.random.Generator, progress: ProgressCallback | None = None
    ) -> CalibrationResult:
        """Calibrate: one critic update round and one Kalman step a generation."""
        settings = self.settings
        run = Run(self.name, problem, budget, progress)
        coordinates = Coordinates(problem)
        kalman = EnsembleKalman(
            logit(coordinates.sample(rng, budget.population)), rng, step_clip=settings.step_clip
        )
        noisy = is_noisy(problem)
        view: _CleanView | _NoisyView
        view = _NoisyView(problem, settings, rng) if noisy else _CleanView(problem, settings, rng)
        means: list[FloatArray] = []
        with torch_threads(settings.torch_threads):
            for _ in range(min(settings.generations, budget.generations)):
                if kalman.finished:
                    break
                z = kalman.ask()
                members = coordinates.members(logistic(z))
                centre = coordinates.members(logistic(z.mean(axis=0, keepdims=True)))
                residual, gap = view.residual(members, centre)
                step = kalman.tell(residual, keep=None if noisy else settings.keep)
                means.append(kalman.ask().mean(axis=0))
                run.note(
                    f"statistics misfit {step.misfit:.3g}, spread {step.spread:.3g}",
                    members.theta,
                    {"misfit": step.misfit, "spread": step.spread, "inflation": step.inflation, "wasserstein": gap},
                )
        z = kalman.ask()
        middle = np.mean(means[-settings.average :], axis=0) if noisy and means else z.mean(axis=0)
        return run.result(
            coordinates,
            coordinates.members(logistic(middle[None])),
            coordinates.members(logistic(z)),
            settings=settings,
            extra={"interval": "ensemble spread, uncalibrated", "view": "per tick" if noisy else "windows"},
        )


class _CleanView:
    """Noise-free recordings: one sample of the critic is one window of innovations at the control rate."""

    def __init__(self, problem: Problem, settings: DealSettings, rng: np.random.Generator) -> None:
        self._problem, self._settings, self._rng = problem, settings, rng
        self._every = samples_per_tick(problem)
        self._windows = problem.windows(settings.clean_ticks * self._every)
        context = np.concatenate([_context(problem, data) for data in self._windows])
        self._context = ((context - context.mean(axis=0)) / np.maximum(context.std(axis=0), 1e-9)).astype(np.float32)
        if not settings.context: self._context = self._context[:, :0]
        width = settings.clean_ticks * problem.joints + self._context.shape[1]
        self._critic = PenaltyCritic(width, settings.critic, rng)

    def residual(self, members: Members, centre: Members) -> tuple[FloatArray, float]:
        """Return the recording's statistics minus each member's, (N, F), in units of the ensemble's spread."""
        real, fake = [], []
        for data in self._windows:
            together = Members(
                np.concatenate([members.theta, centre.theta]),
                np.concatenate([members.latency_s, centre.latency_s]),
            )
            predicted, _ = predict(self._problem, together, data)
            predicted = predicted[:, :, self._every - 1 :: self._every]
            measured = data.measured[:, self._every - 1 :: self._every]
            real.append((measured - predicted[-1]).reshape(len(measured), -1))
            fake.append((predicted[:-1] - predicted[-1]).reshape(len(members.theta), len(measured), -1))
        return self._statistics(np.concatenate(real), np.concatenate(fake, axis=1))

    def _statistics(self, real: FloatArray, fake: FloatArray) -> tuple[FloatArray, float]:
        good = np.isfinite(fake).all(axis=(1, 2))
        if not good.any() or not np.isfinite(real).all():
            return np.full((len(fake), 1), np.nan), float("nan")
        width = fake.shape[2]
        flat = fake[good].reshape(-1, width)
        scale = np.maximum(np.sqrt(np.mean(flat**2, axis=0)), 1e-12)
        if self._settings.white:
            limited = np.clip(flat / scale, -5, 5)
            values, vectors = np.linalg.eigh(limited.T @ limited / len(limited))
            root = vectors / np.sqrt(np.maximum(values, self._settings.floor * values[-1]))
            def scaled(x): return (5 * np.tanh(x / scale @ root / 5)).astype(np.float32)
        else:
            def scaled(x): return _scaled(x, scale)
        def join(x): return np.concatenate([scaled(x), np.broadcast_to(self._context, (*x.shape[:-1], self._context.shape[1]))], axis=-1)
        imitation = join(np.nan_to_num(fake))
        data = join(real)
        gap = self._critic.train(data, imitation[good].reshape(-1, data.shape[1]))
        found = self._critic.statistics(np.nan_to_num(imitation))
        target = self._critic.statistics(data[None])[0]
        std = found[good].std(axis=0)
        # Units that are never active carry nothing and would divide by zero.
        alive = std > 1e-6 * max(float(std.max()), 1e-30)
        residual = (target[alive] - found[:, alive]) / std[alive]
        residual[~good] = np.nan
        return residual, gap


def _context(problem: Problem, data: WindowData) -> FloatArray:
    episode = problem.episodes[data.episode]
    at = episode.sample[data.windows.start]
    span = data.windows.length * data.windows.stride
    target = np.stack([episode.target[k : k + span].mean(axis=0) for k in at])
    return np.concatenate([data.start_position, data.start_velocity, target], axis=1)


def _scaled(values: FloatArray, scale: FloatArray) -> Samples:
    # Far members' windows run away by many scales; a critic that spends itself on them sees nothing near the middle.
    return (5.0 * np.tanh(values / (5.0 * scale))).astype(np.float32)


class _NoisyView:
    """Noisy recordings: one sample of the critic is one control period of whitened innovations, and its context."""

    def __init__(self, problem: Problem, settings: DealSettings, rng: np.random.Generator) -> None:
        self._problem, self._settings, self._rng = problem, settings, rng
        self._every = samples_per_tick(problem)
        self._windows = problem.windows(settings.noisy_ticks * self._every)
        context = np.concatenate([_tick_context(problem, data, self._every) for data in self._windows])
        self._context = _standardised(context)
        width = self._every * problem.joints + self._context.shape[1]
        self._critic = PenaltyCritic(width, settings.critic, rng)

    def residual(self, members: Members, centre: Members) -> tuple[FloatArray, float]:
        """Return the recording's statistics minus each member's, (N, F), whitened by the noise of the former."""
        real, fake = [], []
        wide = self._every * self._problem.joints
        for data in self._windows:
            whitening = linearise(self._problem, centre, data)
            predicted, _ = predict(self._problem, members, data)
            fake.append(whitening.apply(predicted - whitening.reference).reshape(len(predicted), -1, wide))
            real.append(whitening.apply((data.measured - whitening.reference)[None]).reshape(-1, wide))
        return self._statistics(np.concatenate(real), np.concatenate(fake, axis=1))

    def _statistics(self, real: FloatArray, fake: FloatArray) -> tuple[FloatArray, float]:
        good = np.isfinite(fake).all(axis=(1, 2))
        if not good.any() or not np.isfinite(real).all():
            return np.full((len(fake), 1), np.nan), float("nan")
        draws = self._rng.standard_normal((self._settings.noise_draws, *real.shape))
        fake = np.nan_to_num(fake)
        scale = np.sqrt(1.0 + np.mean(np.clip(fake[good], -1e6, 1e6) ** 2, axis=(0, 1)))
        noise = draws[self._rng.integers(len(draws), size=len(fake))]
        imitation = self._join(fake + noise, scale)
        data = self._join(real, scale)
        gap = self._critic.train(data, imitation[good].reshape(-1, data.shape[1]))
        found = np.mean(
            [self._critic.statistics(self._join(fake + d, scale)) for d in draws[: self._settings.smooth]], axis=0
        )
        target = self._critic.statistics(data[None])[0]
        floor = self._critic.statistics(self._join(draws, scale))
        covariance = np.cov(floor, rowvar=False)
        alive = np.diag(covariance) > 1e-12 * max(float(np.diag(covariance).max()), 1e-30)
        covariance = covariance[np.ix_(alive, alive)]
        # The covariance of F statistics from as many draws is singular: shrink it to its diagonal.
        covariance = 0.9 * covariance + 0.1 * np.diag(np.diag(covariance))
        factor = np.linalg.inv(np.linalg.cholesky(covariance))
        residual = (target[alive] - found[:, alive]) @ factor.T
        residual[~good] = np.nan
        return residual, gap

    def _join(self, values: FloatArray, scale: FloatArray) -> Samples:
        context = np.broadcast_to(self._context, (*values.shape[:-1], self._context.shape[1]))
        return np.concatenate([_scaled(values, scale), context], axis=-1)


def _tick_context(problem: Problem, data: WindowData, every: int) -> FloatArray:
    starts, episode = problem.starts[data.episode], problem.episodes[data.episode]
    row = (data.windows.start[:, None] + np.arange(0, data.windows.length, every)).ravel()
    return np.concatenate(
        [starts.position[row], starts.velocity[row], episode.target[episode.sample[row]]], axis=1
    )


def _standardised(values: FloatArray) -> Samples:
    spread = np.maximum(values.std(axis=0), 1e-9)
    return np.asarray((values - values.mean(axis=0)) / spread, dtype=np.float32)
