"""`bo`: Bayesian optimisation (BoTorch): a Gaussian process of the fitness, and batches that may improve it.

The first generation is a scrambled Sobol sequence. Each further one fits a Gaussian process to the scores
(BoTorch's own: one length scale per coordinate, whose prior grows with their number). It takes the batch of
the largest log expected improvement (qLogEI, Ament et al. 2023) in a trust region around the best point. The
region grows after successes and shrinks after failures (TuRBO, Eriksson et al. 2019). Over the whole range of
ten coordinates the batch is little better than a random one (measured: worse than the range's midpoint).

Scores have an arbitrary scale and long tails, so the process models their normal quantiles, which keep only
the order.

Cost: a Gaussian process of n points takes n^3 operations. So it sees at most `most_points`, the better half
by rank and the others by age, and a batch is small: `bo` simulates far fewer members than its budget allows.

Memory: points that the process can never see again are dropped. BoTorch's models refer to themselves in
cycles, and matrices of a new size each generation fragment the heap. So after each generation garbage is
collected, and malloc (glibc) returns free pages.
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
import scipy
from scipy.special import ndtri

from deal_hw.calib.baselines.scored import ScoredStepper
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.resume import Stateful
from deal_hw.calib.data.search import RangedSearch, Search, SearchLog
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.types import FloatArray, IntArray

FIT_ITERATIONS = 60
"""Most iterations of the process's fit."""

ACQUISITION_ITERATIONS = 30
"""Most iterations of the acquisition's optimiser."""

ACQUISITION_STARTS = 2
"""Starts of the acquisition's optimiser."""

ACQUISITION_DRAWS = 64
"""Draws from which these starts are chosen."""

PROCESS_DRAWS = 64
"""Draws of the process for the mean improvement."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoSettings:
    """Settings of `bo`.

    Attributes:
        fitness: Name of the fitness. The paper uses the critic's return, but a critic changes every
            generation and a Gaussian process models one fixed function. So the default is the trajectory
            error. With a changing fitness each generation scores a part of the earlier members again beside
            the new ones (the budget's population in total), and the process sees only these.
        batch: New members of a generation after the first, q.
        most_points: Most points of the Gaussian process.
        elite: Size of the result's population, best first.
        linear: Whether the range is linear, as in the paper; off is uniform in each parameter's own scale.
        latency: Whether a latency that is not given is one more coordinate.
    """

    fitness: str = "trajectory"
    batch: int = 8
    most_points: int = 300
    elite: int = 10
    linear: bool = False
    latency: bool = True

    def __post_init__(self) -> None:
        if self.batch < 1 or self.elite < 2:
            raise ConfigurationError(
                f"batch must be at least 1 and elite at least 2, got {self.batch} and {self.elite}"
            )
        if self.most_points < 4:
            raise ConfigurationError(f"most_points must be at least 4, got {self.most_points}")


class TrustRegion(Stateful):
    """The side of the box for the next batch, in widths of the range (TuRBO, algorithm 1).

    It is halved after ``failures`` generations without a better point.
    """

    STATE = ("length", "_good", "_bad")
    LONGEST, FIRST, SHORTEST = 1.6, 0.8, 0.5**7
    SUCCESSES = 3
    """Consecutive better points after which the box is doubled."""

    def __init__(self, failures: int) -> None:
        self._failures = failures
        self.length, self._good, self._bad = self.FIRST, 0, 0

    def tell(self, *, better: bool) -> None:
        """Update with whether the batch held a better point than all before."""
        self._good, self._bad = (self._good + 1, 0) if better else (0, self._bad + 1)
        if self._good >= self.SUCCESSES:
            self.length, self._good = min(2 * self.length, self.LONGEST), 0
        elif self._bad >= self._failures:
            self.length, self._bad = self.length / 2, 0
        if self.length < self.SHORTEST:
            # TuRBO forgets all points here; the process is global, so only the box starts again.
            self.length = self.FIRST


class GaussianProcessSearch(Stateful):
    """Points in the unit cube, proposed from a Gaussian process of the scores of earlier ones.

    All draws come from one seed and the generation's number, so points and scores are the whole state. Unless
    the fitness is ``stationary``, each generation has the whole population and scores earlier points again.
    """

    STATE = ("_points", "_fitness", "_generation", "_seed", "scored", "fallbacks", "region")

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
        """Points with comparable scores, (n, C): the best and the newest."""
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
        """Add the scores, (n,), of the requested points; higher is better, and not finite is the worst."""
        asked = self.ask()
        if fitness.shape != (len(asked),):
            raise ValueError(f"fitness has shape {fitness.shape}, the requested points have {asked.shape}")
        if self._generation:
            # If the fitness changes, new points compete with those that were scored again.
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
        # A point only falls in rank and only ages: once dropped it would never be kept again.
        kept = self._kept(max(self._settings.most_points, 2 * self._settings.elite))
        self._points, self._fitness = self._points[kept], self._fitness[kept]

    def _sobol(self, count: int) -> FloatArray:
        seed = np.random.default_rng([self._seed, self._generation])
        # A power of two of points is balanced; a part of it is nearly so.
        power = max(int(np.ceil(np.log2(count))), 0)
        return np.asarray(scipy.stats.qmc.Sobol(self._count, rng=seed).random_base2(power)[:count])

    def _kept(self, count: int) -> IntArray:
        """Return the indices of ``count`` points: the better half by rank, then the newest of the others."""
        best = self.order[: (count + 1) // 2]
        rest = np.setdiff1d(np.arange(len(self._points)), best)
        return np.sort(np.concatenate([best, rest[::-1][: count - len(best)]]))

    def _propose(self, batch: int) -> FloatArray:
        kept = self._kept(self._settings.most_points)
        points, fitness = self._points[kept], self._fitness[kept]
        found = None
        if len(np.unique(fitness[np.isfinite(fitness)])) > 1:
            side = self.region.length
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
    return np.asarray(ndtri((scipy.stats.rankdata(_ranked(fitness)) - 0.5) / len(fitness)))


def _largest_improvement(
    points: FloatArray, value: FloatArray, batch: int, side: float, seed: int, settings: BoSettings
) -> FloatArray | None:
    """Return the batch of the largest qLogEI, (batch, C), or None where the process could not be fitted.

    Points, (n, C), are in the unit cube, with the modelled values (n,). ``side`` is the mean side of the box
    around the best point; None for the unit cube.
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

    from deal_hw.calib.paper.critic import torch_threads

    x, y = torch.from_numpy(points), torch.from_numpy(value)[:, None]
    # From 20 coordinates on BoTorch moves a part of them, and leaves the others where a good point has them,
    # also outside the box: then it refuses its own starts.
    moved = {"sample_around_best_prob_perturb": 1.0} if points.shape[1] >= 20 else {}
    # BoTorch draws its starts from torch's global generator; the fork restores it.
    with warnings.catch_warnings(), torch_threads(1), torch.random.fork_rng(devices=[]):
        warnings.simplefilter("ignore")
        torch.manual_seed(seed)
        try:
            model = SingleTaskGP(x, y, outcome_transform=None)
            likelihood = ExactMarginalLogLikelihood(model.likelihood, model)
            options = {"maxiter": FIT_ITERATIONS}
            fit_gpytorch_mll(likelihood, optimizer_kwargs={"options": options})
            sampler = SobolQMCNormalSampler(torch.Size([PROCESS_DRAWS]), seed=seed)
            acquisition = qLogExpectedImprovement(model, best_f=y.max(), sampler=sampler)
            found, _ = optimize_acqf(
                acquisition,
                bounds=torch.from_numpy(_box(points, value, model, side)),
                q=batch,
                num_restarts=ACQUISITION_STARTS,
                raw_samples=ACQUISITION_DRAWS,
                options={
                    "maxiter": ACQUISITION_ITERATIONS,
                    "seed": seed,
                    "sample_around_best": True,
                    **moved,
                },
            )
        except (ModelFittingError, NanError, NotPSDError):
            return None
    return np.asarray(found.detach().numpy(), dtype=float)


def _box(points: FloatArray, value: FloatArray, model: Any, side: float) -> FloatArray:
    """Return the bounds of the batch, (2, C): longer where the process varies less."""
    C = points.shape[1]
    scale = model.covar_module.lengthscale.detach().numpy().reshape(C)
    half = 0.5 * side * scale / np.exp(np.mean(np.log(scale)))
    best = points[np.argmax(value)]
    return np.asarray(np.clip(np.stack([best - half, best + half]), 0.0, 1.0))


class _Bo(ScoredStepper):
    INTERVAL = "spread of the best points, uncalibrated"

    settings: BoSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        # Fail now rather than after the first generation has been simulated.
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
    """Return `bo-critic`, the paper's baseline: Bayesian optimisation of the critic's return."""
    return BayesianOptimisation(BoSettings(fitness="critic", linear=True, latency=False), name="bo-critic")


@functools.cache
def _trimmer() -> Callable[[int], int]:
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    return trim or (lambda _: 0)


def _give_back() -> None:
    """Free what a Gaussian process leaves behind, and return free pages to the system where malloc can."""
    # Its model refers to itself: over a megabyte per generation that waits for the collector's last round.
    gc.collect()
    _trimmer()(0)


def _require_botorch() -> None:
    try:
        with warnings.catch_warnings():
            # It uses deprecated parts of torch.
            warnings.simplefilter("ignore")
            import botorch  # noqa: F401
    except ImportError as err:  # pragma: no cover - the extra is installed where the tests run
        raise MissingExtraError("botorch", "bench") from err
