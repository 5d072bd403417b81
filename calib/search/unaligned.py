"""Searches that compare distributions of transitions (s, a, s') of closed-loop rollouts.

Where the motion diverges from any prediction within a few steps (contacts, falls), residuals of windows mean
nothing. Here each simulator runs the recordings' policy in closed loop, and statistics of its transitions are
compared with those of the recording. There are three kinds of statistics:

- `deal-unaligned`: the mean hidden activations and output of a critic that learns to separate the two.
- `mmd-unaligned`: means of random Fourier features, whose squared distance is the maximum mean discrepancy of
  Gaussian kernels (Rahimi and Recht 2007).
- `moments-unaligned`: means, second moments, and the coefficients of a linear regression of s' on (s, a)
  (indirect inference, Gourieroux, Monfort and Renault 1993).

The update is the ensemble Kalman step, as in `eki`: it regresses the parameters on all statistics. One number
per member with the paper's update loses most of what they say.

A transition enters as its innovation: s' minus the prediction from (s, a) by a regression over the whole
population. What every simulator does alike is then gone, and what remains depends on the parameters.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.resume import Stateful
from deal_hw.calib.data.search import Search, SearchLog
from deal_hw.calib.paper.critic import FEATURE_CRITIC, CriticSettings, PenaltyCritic
from deal_hw.calib.paper.fitness import FitnessSettings, RolloutView, Samples
from deal_hw.calib.search.eki import LogitStepper, spread_of
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray

FEATURES = 256
"""Number of random Fourier features; each is a cosine and a sine."""

MOST_GENERATIONS = 25
"""Search steps; never more than the budget's."""

KEPT_RESIDUAL = 0.3
"""Share of the residual that one step leaves."""

LEAST_SPREAD = 1e-3
"""Spread below which members cannot be separated and the search ends, in logits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnalignedSettings:
    """Settings of the searches by distributions.

    Attributes:
        statistics: What of a member's transitions is compared.
        critic: Size and training of the critic.
    """

    statistics: Literal["critic", "kernel", "moments"] = "critic"
    critic: CriticSettings = field(default_factory=lambda: FEATURE_CRITIC)


class _Statistics(Stateful, abc.ABC):
    """Turns samples into one vector; ``outputs`` is the width of s', ``values`` are for the trace.

    ``diverged`` counts trainings that were undone.
    """

    def __init__(
        self, width: int, outputs: int, settings: UnalignedSettings, rng: np.random.Generator
    ) -> None:
        self.outputs, self.settings, self.values = outputs, settings, dict[str, float]()
        self.diverged = 0
        self._prepare(width, rng)

    @abc.abstractmethod
    def _prepare(self, width: int, rng: np.random.Generator) -> None:
        """Set up for samples of that width."""

    @abc.abstractmethod
    def compare(self, real: Samples, fake: Samples) -> tuple[FloatArray, FloatArray]:
        """Return the statistics of the recording, (F,), and of N members, (N, F).

        Samples are (n, width) and (N, m, width).
        """


class _CriticMeans(_Statistics):
    """A critic's mean activations."""

    STATE = ("_critic",)

    def _prepare(self, width: int, rng: np.random.Generator) -> None:
        self._critic = PenaltyCritic(width, self.settings.critic, rng)

    def compare(self, real: Samples, fake: Samples) -> tuple[FloatArray, FloatArray]:
        """See :meth:`_Statistics.compare`."""
        gap = self._critic.train(real, fake.reshape(-1, fake.shape[-1]))
        self.diverged = self._critic.diverged
        self.values = {"wasserstein": gap, "diverged": float(self.diverged)}
        return self._critic.statistics(real[None])[0], self._critic.statistics(fake)


class _KernelMeans(_Statistics):
    """Random Fourier features of Gaussian kernels of three widths."""

    STATE = ("_frequency",)

    def _prepare(self, width: int, rng: np.random.Generator) -> None:
        scale = np.repeat([0.3, 1.0, 3.0], -(-FEATURES // 3))[:FEATURES]
        # Standardised inputs: two samples are about sqrt(2 width) apart.
        self._frequency = rng.standard_normal((width, len(scale))) / (scale * np.sqrt(2 * width))

    def compare(self, real: Samples, fake: Samples) -> tuple[FloatArray, FloatArray]:
        """See :meth:`_Statistics.compare`."""
        return self._means(real), np.stack([self._means(member) for member in fake])

    def _means(self, samples: Samples) -> FloatArray:
        angle = samples @ self._frequency
        return np.concatenate([np.cos(angle).mean(axis=0), np.sin(angle).mean(axis=0)])


class _Moments(_Statistics):
    """Means, second moments, and the coefficients of a regression of the outputs on the inputs."""

    def _prepare(self, width: int, rng: np.random.Generator) -> None:
        self._pairs = np.triu_indices(width)

    def compare(self, real: Samples, fake: Samples) -> tuple[FloatArray, FloatArray]:
        """See :meth:`_Statistics.compare`."""
        return self._of(real), np.stack([self._of(member) for member in fake])

    def _of(self, samples: Samples) -> FloatArray:
        x = samples.astype(np.float64)
        inputs, outputs = x[:, : -self.outputs], x[:, -self.outputs :]
        coefficients = _ridge(inputs, outputs)
        return np.concatenate([x.mean(axis=0), (x.T @ x / len(x))[self._pairs], coefficients.ravel()])


_KINDS: dict[str, type[_Statistics]] = {
    "critic": _CriticMeans,
    "kernel": _KernelMeans,
    "moments": _Moments,
}


def _ridge(inputs: FloatArray, outputs: FloatArray, weight: float = 1e-4) -> FloatArray:
    """Return the coefficients of a regression with a constant, (C + 1, D), lightly regularised."""
    x = np.concatenate([inputs, np.ones((len(inputs), 1))], axis=1)
    gram = x.T @ x + weight * len(x) * np.eye(x.shape[1])
    return np.asarray(np.linalg.solve(gram, x.T @ outputs))


class _Unaligned(LogitStepper):
    """A run: rollouts, statistics and one Kalman step a generation."""

    STATE = ("kalman", "_statistics", "_spread")

    settings: UnalignedSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        # Before anything else: without a policy nothing can be simulated.
        self._view = RolloutView(log.problem, FitnessSettings(difference=True), rng)
        super().__init__(log, rng, search)
        settings = self.settings
        width, outputs = self._view.real.shape[1], self._view.outputs
        self._statistics = _KINDS[settings.statistics](width, outputs, settings, rng)
        self._most = min(MOST_GENERATIONS, log.budget.generations)
        self._spread = float("inf")

    @property
    def finished(self) -> bool:
        """Whether the budget is used up, or members cannot be separated any more."""
        return len(self.log.trace) >= self._most or not self._spread > LEAST_SPREAD

    def step(self) -> None:
        """One round of rollouts and one Kalman step."""
        members, _ = self.population(self.kalman.ask())
        fake, usable = self._view.rollouts(members)
        residual = np.full((len(fake), 1), np.nan)
        if usable.sum() > 1:
            target, found = self._statistics.compare(*self._samples(fake[usable]))
            alive, std = spread_of(found)
            residual = np.full((len(fake), len(std)), np.nan)
            residual[usable] = (target - found)[:, alive] / std
        step = self.kalman.tell(residual, keep=KEPT_RESIDUAL)
        self._spread = step.spread
        words = f"misfit {step.misfit:.3g}, spread {step.spread:.3g}"
        if not np.isfinite(self._statistics.values.get("wasserstein", 0.0)):
            words = f"the critic diverged, its last weights go on, {words}"
        self.log.note(
            words,
            members,
            {
                "misfit": step.misfit,
                "spread": step.spread,
                "inflation": step.inflation,
                **self._statistics.values,
            },
        )

    def _samples(self, fake: Samples) -> tuple[Samples, Samples]:
        """Return the recording's and the members' transitions as the statistics see them."""
        fake = self._view.as_sensed(fake, self.rng)
        real = self._view.real
        D = self._view.outputs
        pooled = fake.reshape(-1, fake.shape[-1]).astype(np.float64)
        mean = _ridge(pooled[:, :-D], pooled[:, -D:])
        scale = np.maximum((pooled[:, -D:] - _line(pooled, mean, D)).std(axis=0), 1e-9)

        def innovations(samples: Samples) -> Samples:
            flat = samples.reshape(-1, samples.shape[-1])
            # A limit: otherwise distant members decide the scale of everything.
            late = 5.0 * np.tanh((flat[:, -D:] - _line(flat, mean, D)) / (5.0 * scale))
            both = np.concatenate([flat[:, :-D], late], axis=1, dtype=np.float32)
            return both.reshape(samples.shape)

        return innovations(real), innovations(fake)

    def result(self) -> CalibrationResult:
        members, centre = self.population(self.kalman.ask())
        return self.log.result(
            centre,
            members,
            alarms=self.log.critic_diverged(self._statistics.diverged),
            extra={"interval": "ensemble spread, uncalibrated", "compares": "distributions"},
        )


def _line(samples: npt.NDArray[Any], coefficients: FloatArray, outputs: int) -> FloatArray:
    return np.asarray(samples[:, :-outputs] @ coefficients[:-1] + coefficients[-1])


@dataclass(frozen=True)
class Unaligned(Search):
    """Statistics of closed-loop transitions, and an ensemble Kalman step."""

    settings: UnalignedSettings = field(default_factory=UnalignedSettings)
    name: str = "deal-unaligned"
    stepper = _Unaligned

    @property
    def adversarial(self) -> bool:
        """Whether the statistics are those of a critic, which learns."""
        return self.settings.statistics == "critic"


def by_critic() -> Unaligned:
    """Return `deal-unaligned`: a critic's features."""
    return Unaligned()


def by_kernel() -> Unaligned:
    """Return `mmd-unaligned`: random Fourier features."""
    return Unaligned(UnalignedSettings(statistics="kernel"), "mmd-unaligned")


def by_moments() -> Unaligned:
    """Return `moments-unaligned`: moments and regression coefficients."""
    return Unaligned(UnalignedSettings(statistics="moments"), "moments-unaligned")
