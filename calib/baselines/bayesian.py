"""`bo`: Bayesian optimisation (BoTorch): a Gaussian process of the fitness, and batches that may improve it.

The first generation is a scrambled Sobol sequence. Each further one fits a Gaussian process (BoTorch's own:
one length scale a coordinate, whose prior grows with their number) to what was scored and takes the batch of
the largest log expected improvement (qLogEI, Ament et al. 2023) inside a trust region around the best point,
which grows after successes and shrinks after failures (TuRBO, Eriksson et al. 2019). Over the whole range of
ten coordinates the batch is little better than a random one (measured: worse than the range's midpoint).

Scores have an arbitrary scale and long tails, so the process models their normal quantiles, which keep
nothing but the order.

Cost: a Gaussian process of n points takes n^3 operations, so it sees `most_points` at most, the better half
by rank and the others by age, and a batch is small: `bo` simulates far fewer members than its budget allows.

Memory: points that the process can never see again are forgotten. BoTorch's models hold themselves in cycles,
and its matrices are of another size each generation and leave holes between what stays; so after each one
garbage is collected and malloc (glibc) is asked to hand free pages back.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata
from scipy.stats.qmc import Sobol

from deal_hw.calib.baselines.scored import ScoredStepper
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.deal_paper.fitness import FitnessSettings
from deal_hw.calib.search.base import RangedSearch, Search, SearchLog
from deal_hw.calib.search.resume import Kept
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class BoSettings:
    """Settings of `bo`.

    Attributes:
        fitness: Name of the fitness. The paper's row has the critic's return, but a critic changes every
            generation and a Gaussian process models one fixed function, so the default is the trajectory
            error. With a fitness that changes, each generation scores a part of the earlier members again
            beside the new ones (the budget's population in all), and the process sees only these.
        batch: New members of a generation after the first, q.
        trust_region: Whether batches are taken near the best point; off is the textbook's search of the whole
            range.
        most_points: Most points of the Gaussian process.
        elite: Members that make the population of the result, best first.
        fit_iterations: Most iterations of the process's fit.
        acquisition_iterations: Most iterations of the acquisition's optimiser.
        acquisition_starts: From how many starts it is optimised.
        acquisition_draws: Draws that these starts are chosen from.
        process_draws: Draws of the process of which the improvement is the mean.
        scoring: How the fitness scores.
        linear: Whether the range is linear, as in the paper; off takes equal steps of each parameter's scale.
        latency: Whether the latency is one more coordinate where it is not given.
    """

    fitness: str = "trajectory"
    batch: int = 8
    trust_region: bool = True
    most_points: int = 300
    elite: int = 10
    fit_iterations: int = 60
    acquisition_iterations: int = 30
    acquisition_starts: int = 2
    acquisition_draws: int = 64
    process_draws: int = 64
    scoring: FitnessSettings = field(default_factory=FitnessSettings)
    linear: bool = False
    latency: bool = True

    def __post_init__(self) -> None:
        if self.batch < 1 or self.elite < 2:
            raise ConfigurationError(
                f"batch must be at least 1 and elite at least 2, got {self.batch} and {self.elite}"
            )
        if self.most_points < 4:
            raise ConfigurationError(f"most_points must be at least 4, got {self.most_points}")


class TrustRegion(Kept):
    """The side of the box in which the next batch is taken, in widths of the range (TuRBO, algorithm 1).

    Args:
        failures: Generations without a better point after which the box is halved.
    """

    KEPT = ("length", "_good", "_bad")
    LONGEST, FIRST, SHORTEST = 1.6, 0.8, 0.5**7
    SUCCESSES = 3
    """Better points in a row after which the box is doubled."""

    def __init__(self, failures: int) -> None:
        self._failures = failures
        self.length, self._good, self._bad = self.FIRST, 0, 0

    def tell(self, *, better: bool) -> None:
        """Say whether the batch held a better point than all before."""
        self._good, self._bad = (self._good + 1, 0) if better else (0, self._bad + 1)
        if self._good >= self.SUCCESSES:
            self.length, self._good = min(2 * self.length, self.LONGEST), 0
        elif self._bad >= self._failures:
            self.length, self._bad = self.length / 2, 0
        if self.length < self.SHORTEST:
            # TuRBO forgets all points here; the process is global, so that only the box starts again.
            self.length = self.FIRST


class GaussianProcessSearch(Kept):
    """Points in the unit cube, proposed from a Gaussian process of the scores of earlier ones.

    Knows no simulator: it is asked for points and told their fitness. All draws are those of one seed and the
    generation's number, so that points and scores are the whole state.

    Args:
        count: Coordinates C.
        population: Points of the first generation, and of all of them where the fitness changes.
        settings: Sizes.
        seed: Decides all draws.
        stationary: Whether a point's fitness stays what it was; if not, earlier points are scored again.
    """

    KEPT = ("_points", "_fitness", "_generation", "_seed", "scored", "fallbacks", "region")

    def __init__(
        self, count: int, population: int, settings: BoSettings, seed: int, *, stationary: bool
    ) -> None:
        if population < 2:
            raise ConfigurationError(f"bo needs a population of 2 or more, got {population}")
        self._count, self._population, self._settings = count, population, settings
        self._seed, self._stationary = seed, stationary
        self._points, self._fitness = np.empty((0, count)), np.empty(0)
        self._asked: FloatArray | None = None
        self._batch = min(settings.batch, max(population - 2, 1))
        self._generation = 0
        self.scored = 0
        self.region = TrustRegion(int(np.ceil(max(4, count) / self._batch)))
        self.fallbacks = 0

    @property
    def points(self) -> FloatArray:
        """Points with scores that compare, (n, C); the best and the newest of them."""
        return self._points

    @property
    def best(self) -> float:
        """Best fitness among the points."""
        return float(_ranked(self._fitness).max(initial=-np.inf))

    @property
    def order(self) -> IntArray:
        """Indices of the points, best first, (n,)."""
        return np.asarray(np.argsort(-_ranked(self._fitness), kind="stable"))

    def ask(self) -> FloatArray:
        """Return the points to score next, (n, C)."""
        if self._asked is None:
            if not len(self._points):
                self._asked = self._sobol(self._population)
            elif self._stationary:
                self._asked = self._propose(self._batch)
            else:
                again = self._points[self._kept(self._population - self._batch)]
                self._asked = np.concatenate([again, self._propose(self._batch)])
        return self._asked

    def tell(self, fitness: FloatArray) -> None:
        """Add the scores of the points that were asked for.

        Args:
            fitness: Higher is better, (n,); points that are not finite count as the worst.
        """
        asked = self.ask()
        if fitness.shape != (len(asked),):
            raise ValueError(
                f"fitness has shape {fitness.shape}, the points that were asked for {asked.shape}"
            )
        if self._generation:
            # Where the fitness changes, the points that were scored again are the ones to be better than.
            earlier = self._fitness if self._stationary else fitness[: -self._batch]
            new = _ranked(fitness[-self._batch :]).max()
            self.region.tell(better=bool(new > _ranked(earlier).max()))
        before = len(self._points) if self._stationary else 0
        self._points = np.concatenate([self._points[:before], asked])
        self._fitness = np.concatenate([self._fitness[:before], fitness])
        if self._stationary:
            self._forget()
        self.scored += len(asked)
        self._asked = None
        self._generation += 1

    def _forget(self) -> None:
        # A point only falls in rank and only ages, so that what is not kept now never would be again.
        kept = self._kept(max(self._settings.most_points, 2 * self._settings.elite))
        self._points, self._fitness = self._points[kept], self._fitness[kept]

    def _sobol(self, count: int) -> FloatArray:
        seed = np.random.default_rng([self._seed, self._generation])
        # A power of two of points is balanced; a part of it is the next best thing, not an error.
        power = max(int(np.ceil(np.log2(count))), 0)
        return np.asarray(Sobol(self._count, rng=seed).random_base2(power)[:count])

    def _kept(self, count: int) -> IntArray:
        """Return the indices of so many points: the better half by rank, the others by age, newest first."""
        best = self.order[: (count + 1) // 2]
        rest = np.setdiff1d(np.arange(len(self._points)), best)
        return np.sort(np.concatenate([best, rest[::-1][: count - len(best)]]))

    def _propose(self, batch: int) -> FloatArray:
        kept = self._kept(self._settings.most_points)
        points, fitness = self._points[kept], self._fitness[kept]
        found = None
        if len(np.unique(fitness[np.isfinite(fitness)])) > 1:
            side = self.region.length if self._settings.trust_region else None
            seed = self._seed + self._generation
            found = _largest_improvement(points, _quantiles(fitness), batch, side, seed, self._settings)
        if found is None:
            self.fallbacks += 1
            return self._sobol(batch)
        return np.clip(found, 0.0, 1.0)


def _ranked(fitness: FloatArray) -> FloatArray:
    return np.where(np.isfinite(fitness), fitness, -np.inf)


def _quantiles(fitness: FloatArray) -> FloatArray:
    """Return the normal quantiles of the ranks of scores, (n,); equal scores are equal."""
    return np.asarray(ndtri((rankdata(_ranked(fitness)) - 0.5) / len(fitness)))


def _largest_improvement(
    points: FloatArray, value: FloatArray, batch: int, side: float | None, seed: int, settings: BoSettings
) -> FloatArray | None:
    """Return the batch of the largest qLogEI, (batch, C), or None where the process could not be fitted.

    Args:
        points: (n, C) in the unit cube.
        value: What the process models, (n,).
        batch: Points to return.
        side: Mean side of the box around the best point in which to look; None for the unit cube.
        seed: Decides all draws.
        settings: Iterations and draws.
    """
    _require_botorch()
    import torch
    from botorch.acquisition.logei import qLogExpectedImprovement
    from botorch.exceptions.errors import ModelFittingError
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.optim.optimize import optimize_acqf
    from botorch.sampling.normal import SobolQMCNormalSampler
    from gpytorch.mlls import ExactMarginalLogLikelihood
    from linear_operator.utils.errors import NanError, NotPSDError

    from deal_hw.calib.search.critic import torch_threads

    x, y = torch.from_numpy(points), torch.from_numpy(value)[:, None]
    # BoTorch draws its starts from torch's global generator; the fork gives the caller's back.
    with warnings.catch_warnings(), torch_threads(1), torch.random.fork_rng(devices=[]):
        warnings.simplefilter("ignore")
        torch.manual_seed(seed)
        try:
            model = SingleTaskGP(x, y, outcome_transform=None)
            likelihood = ExactMarginalLogLikelihood(model.likelihood, model)
            options = {"maxiter": settings.fit_iterations}
            fit_gpytorch_mll(likelihood, optimizer_kwargs={"options": options})
            sampler = SobolQMCNormalSampler(torch.Size([settings.process_draws]), seed=seed)
            acquisition = qLogExpectedImprovement(model, best_f=y.max(), sampler=sampler)
            found, _ = optimize_acqf(
                acquisition,
                bounds=torch.from_numpy(_box(points, value, model, side)),
                q=batch,
                num_restarts=settings.acquisition_starts,
                raw_samples=settings.acquisition_draws,
                options={
                    "maxiter": settings.acquisition_iterations,
                    "seed": seed,
                    "sample_around_best": True,
                },
            )
        except (ModelFittingError, NanError, NotPSDError):
            return None
    return np.asarray(found.detach().numpy(), dtype=float)


def _box(points: FloatArray, value: FloatArray, model: Any, side: float | None) -> FloatArray:
    """Return the bounds in which the batch is taken, (2, C): longer where the process varies less."""
    C = points.shape[1]
    if side is None:
        return np.stack([np.zeros(C), np.ones(C)])
    scale = model.covar_module.lengthscale.detach().numpy().reshape(C)
    half = 0.5 * side * scale / np.exp(np.mean(np.log(scale)))
    best = points[np.argmax(value)]
    return np.asarray(np.clip(np.stack([best - half, best + half]), 0.0, 1.0))


class _Bo(ScoredStepper):
    INTERVAL = "spread of the best points, uncalibrated"

    settings: BoSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        # Now rather than after the first generation has been simulated.
        _require_botorch()
        self._search = GaussianProcessSearch(
            self.coordinates.count,
            log.budget.population,
            self.settings,
            int(rng.integers(2**31)),
            stationary=self.stationary,
        )

    def step(self) -> None:
        """Ask, score and tell."""
        unit = self._search.ask()
        members = self.coordinates.members(unit)
        fitness, values = self.score(members)
        self._search.tell(fitness)
        _give_back()
        found = self._search.best
        self.log.note(
            f"best {found:.3g} of {self._search.scored} points",
            members,
            {
                **values,
                "found": found,
                "fallbacks": float(self._search.fallbacks),
                "side": self._search.region.length,
            },
        )

    def found(self) -> tuple[Members, Members]:
        """Return the best point and the best few."""
        found = self._search.points[self._search.order] if self.log.trace else self._search.ask()
        elite = self.coordinates.members(found[: self.settings.elite])
        return Members(elite.theta[:1], elite.latency_s[:1]), elite


@dataclass(frozen=True)
class BayesianOptimisation(RangedSearch):
    """Bayesian optimisation of a pluggable fitness."""

    stepper = _Bo
    settings: BoSettings = field(default_factory=BoSettings)
    name: str = "bo"


def critic_return() -> BayesianOptimisation:
    """Return the paper's row, `bo-critic`: Bayesian optimisation of the critic's return."""
    return BayesianOptimisation(BoSettings(fitness="critic", linear=True, latency=False), name="bo-critic")


@functools.cache
def _trimmer() -> Callable[[int], int]:
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    return trim or (lambda _: 0)


def _give_back() -> None:
    """Free what a Gaussian process leaves behind and hand free pages back to the system where malloc can."""
    # Its model refers to itself: a megabyte and more a generation that waits for the collector's last round.
    gc.collect()
    _trimmer()(0)


def _require_botorch() -> None:
    try:
        with warnings.catch_warnings():
            # It uses parts of torch that are on their way out.
            warnings.simplefilter("ignore")
            import botorch  # noqa: F401
    except ImportError as err:  # pragma: no cover - the extra is installed where the tests run
        raise MissingExtraError("botorch", "bench") from err
