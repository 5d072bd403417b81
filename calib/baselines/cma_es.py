"""`cma`: covariance matrix adaptation (pycma) with restarts of growing population, on a pluggable fitness.

It is the usual baseline of robot calibration (PACE, NVIDIA's extension). Restarts double the population
(IPOP, Auger and Hansen 2005) and begin at a uniform draw. The first run begins at the midpoint of the range.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.baselines.scored import ScoredStepper
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.resume import State, Stateful
from deal_hw.calib.data.search import Search, SearchLog
from deal_hw.errors import ConfigurationError, DatasetError, MissingExtraError
from deal_hw.types import FloatArray

GROWTH = 2
"""Factor of the population from one restart to the next (IPOP: 2)."""

FIRST_SIGMA = 0.3
"""First step size, in widths of the range."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CmaSettings:
    """Settings of `cma`.

    Attributes:
        fitness: Name of the fitness.
        population: Members of the first run; None for pycma's own 4 + 3 ln C, at most the budget's. With
            equally many simulated members, many small populations get far nearer than few large ones
            (measured, 10 coordinates, 1200 members: 28 and 13 against 78 and 30 in log_error_x100).
        least_step: A run ends when no coordinate moves more than this, in widths of the range.
    """

    fitness: str = "trajectory"
    population: int | None = None
    least_step: float = 1e-6

    def __post_init__(self) -> None:
        if self.population is not None and self.population < 2:
            raise ConfigurationError(f"population must be at least 2 or None, got {self.population}")
        if not self.least_step > 0:
            raise ConfigurationError(f"least_step must be above 0, got {self.least_step:g}")


class RestartedCma(Stateful):
    """CMA-ES in the unit cube, restarted when a run has ended; all randomness comes from one seed.

    pycma's state can only be stored by pickling. So the costs are stored, and replaying them restores the
    state.
    """

    def __init__(self, count: int, population: int, settings: CmaSettings, seed: int) -> None:
        if population < 2:
            raise ConfigurationError(f"cma needs a population of 2 or more, got {population}")
        self._count, self._first, self._settings, self._seed = count, population, settings, seed
        self._costs: list[FloatArray] = []
        self._asked: FloatArray | None = None
        self.restarts = -1
        self._begin()

    def _begin(self) -> None:
        self.restarts += 1
        # Each run has its own stream, so that the end of one does not shift the draws of the next.
        rng = np.random.default_rng([self._seed, self.restarts])
        start = np.full(self._count, 0.5) if self.restarts == 0 else rng.random(self._count)
        self.population = self._first * GROWTH**self.restarts
        options = {
            "bounds": [0.0, 1.0],
            "popsize": self.population,
            # The seed "not a number" leaves numpy's global generator alone; `randn` replaces that.
            "seed": np.nan,
            "randn": lambda *shape: rng.standard_normal(shape),
            "tolx": self._settings.least_step,
            "verbose": -10,
            "verb_log": 0,
            "verb_disp": 0,
        }
        self._strategy: Any = _pycma().CMAEvolutionStrategy(start, FIRST_SIGMA, options)

    @property
    def mean(self) -> FloatArray:
        """Mean of the present run's distribution, (C,), inside the unit cube."""
        return np.asarray(np.clip(np.asarray(self._strategy.result.xfavorite, dtype=float), 0.0, 1.0))

    @property
    def sigma(self) -> float:
        """Present step size, in widths of the range."""
        return float(self._strategy.sigma)

    def ask(self) -> FloatArray:
        """Return the next population, (population, C), inside the unit cube."""
        if self._asked is None:
            self._asked = np.clip(np.array(self._strategy.ask(), dtype=float), 0.0, 1.0)
        return self._asked

    def tell(self, cost: FloatArray) -> bool:
        """Update with costs, (population,), lower is better; return whether a new run began.

        Members that are not finite count as worse than the worst.
        """
        asked = self.ask()
        if cost.shape != (len(asked),):
            raise ValueError(f"cost has shape {cost.shape}, the requested population has {asked.shape}")
        self._costs.append(np.array(cost, dtype=float))
        self._strategy.tell(list(asked), _finite(cost).tolist())
        self._asked = None
        if not self._strategy.stop():
            return False
        self._begin()
        return True

    def save(self) -> State:
        """Return the costs so far, and the mean to which they lead."""
        flat = np.concatenate(self._costs) if self._costs else np.empty(0)
        return {"seed": self._seed, "first": self._first, "costs": flat, "mean": self.mean}

    def load(self, state: State) -> None:
        """Replay the saved costs.

        Raises:
            DatasetError: They lead to another mean, with another version of pycma or of the numerical
                libraries.
        """
        self._seed, self._first = int(state["seed"]), int(state["first"])
        self._costs, self._asked, self.restarts = [], None, -1
        self._begin()
        costs, at = np.asarray(state["costs"], dtype=float), 0
        while at < len(costs):
            # By its present size: `tell` may begin a run with a larger population.
            size = self.population
            self.tell(costs[at : at + size])
            at += size
        # A difference above rounding means other libraries than those of the saved run.
        if not np.allclose(self.mean, state["mean"], rtol=0.0, atol=1e-9):
            raise DatasetError(
                "the saved run of `cma` cannot be repeated here: its costs lead to another mean; resume it "
                "with the versions of cma and numpy that began it, or start again"
            )


class _Cma(ScoredStepper):
    STATE = ("_search", "_fitness", "_scored", "_best")

    settings: CmaSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        settings = self.settings
        usual = min(4 + int(3 * np.log(self.coordinates.count)), log.budget.population)
        first = settings.population or usual
        self._search = RestartedCma(self.coordinates.count, first, settings, int(rng.integers(2**62)))
        self._scored = 0
        self._best = Best(self.coordinates.count)

    @property
    def finished(self) -> bool:
        """Whether the next population would exceed the rest of the budget."""
        budget = self.log.budget
        return bool(self._scored + self._search.population > budget.population * budget.generations)

    def step(self) -> None:
        """Ask, score and tell, until the share of one generation of the budget is used up."""
        share = (len(self.log.trace) + 1) * self.log.budget.population
        scored = diverged = 0.0
        while True:
            unit, restarts, sigma = self._search.ask(), self._search.restarts, self._search.sigma
            members = self.coordinates.members(unit)
            fitness, values = self.score(members)
            self._search.tell(-fitness)
            self._scored += len(unit)
            scored, diverged = scored + values["scored"], diverged + values["diverged"]
            self._best.tell(unit, fitness, restarts, keep=self.stationary)
            if self.finished or self._scored + self._search.population > share:
                break
        self.log.note(
            f"run {restarts + 1} of {len(unit)} members: step {sigma:.2g} of the range",
            members,
            {
                **values,
                "scored": scored,
                "diverged": diverged,
                "found": self._best.fitness,
                "restarts": float(restarts),
                "sigma": sigma,
            },
        )

    def found(self) -> tuple[Members, Members]:
        """Return the best member of all runs, and the population of its run.

        With a changing fitness, the best of the last generation.
        """
        best = self._best
        return self.coordinates.members(best.unit[None]), self.coordinates.members(best.population)

    def facts(self) -> dict[str, Any]:
        return {"restarts": self._search.restarts}


@dataclass(frozen=True)
class Cma(Search):
    """CMA-ES with restarts, inside the budget's population times generations."""

    name = "cma"
    stepper = _Cma
    settings: CmaSettings = field(default_factory=CmaSettings)


class Best(Stateful):
    """The best member so far; before any score, the midpoint of the range.

    Attributes:
        unit: Its unit coordinates, (C,).
        fitness: Its fitness.
        run: The run it belongs to.
        population: The last population of that run, (n, C).
    """

    STATE = ("unit", "fitness", "run", "population")

    def __init__(self, count: int) -> None:
        self.unit, self.fitness, self.run = np.full(count, 0.5), -float("inf"), 0
        self.population = np.stack([np.zeros(count), np.ones(count)])

    def tell(self, unit: FloatArray, fitness: FloatArray, run: int, *, keep: bool) -> None:
        """Update with a population of a run, (n, C), and its fitness, (n,); -inf where a member diverged.

        ``keep`` says whether earlier fitness is comparable with this one.
        """
        top = int(np.argmax(fitness))
        if fitness[top] > self.fitness or (not keep and np.isfinite(fitness[top])):
            self.unit, self.fitness, self.run = unit[top], float(fitness[top]), run
        if run == self.run:
            self.population = unit


def _finite(cost: FloatArray) -> FloatArray:
    """Return costs, (N,), with members that are not finite worse than all others."""
    usable = np.isfinite(cost)
    if not usable.any():
        return np.zeros(len(cost))
    worst = float(cost[usable].max())
    return np.where(usable, cost, worst + max(abs(worst), 1.0))


def _pycma() -> Any:
    try:
        with warnings.catch_warnings():
            # It warns about missing plotting packages.
            warnings.simplefilter("ignore")
            import cma
    except ImportError as err:  # pragma: no cover - the extra is installed where the tests run
        raise MissingExtraError("cma", "bench") from err
    return cma
