"""`deal-paper`: DEAL's Algorithm 1, with every choice that the paper leaves open noted where it is made.

Generation t: roll every member out, train the critic (eq. 5), score each member's own rollout, turn scores
into probabilities and take one denoising step (eqs. 1, 2, 9, 10:
:mod:`deal_hw.calib.deal_paper.diffusion_evolution`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.deal_paper.diffusion_evolution import DiffusionEvolution, DiffusionSettings
from deal_hw.calib.deal_paper.fitness import FitnessSettings, make_fitness
from deal_hw.calib.deal_paper.rollouts import PopulationPolicy
from deal_hw.calib.search.base import Coordinates, Search, SearchLog, Stepper
from deal_hw.calib.search.critic import CriticSettings
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray

HALF_WIDTH = 3.0**0.5
"""The box is [-HALF_WIDTH, HALF_WIDTH]: a uniform start then has unit variance, as eq. 12 has it at t = T.

In [-1, 1] the unit noise of eq. 10 puts a third of all coordinates outside the range, where they are
simulated at its edge, and the search is drawn into the corners.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperSettings(FitnessSettings):
    r"""Choices of `deal-paper`; the paper names those that are marked with a section.

    Attributes:
        critic: Size (section 3.1: two layers of 256) and training of the critic. Learning rate, clip, updates
            n and batch M are not in the paper.
        diffusion: The search's choices; its number of generations is the budget's.
        normalise: Whether the search moves in the normalised range (section 3.2); off is the ablation
            DEAL\PN, which moves in raw SI units.
        fitness: Name of the fitness (`deal_hw.calib.deal_paper.fitness`). "critic" is the paper's; "flat"
            scores every member 0, a search that cannot see the data. Eq. 9 reads the fitness as it is,
            whatever its scale.
    """

    critic: CriticSettings = field(default_factory=CriticSettings)
    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    normalise: bool = True
    fitness: str = "critic"


class _Box:
    """The search's box: [-1, 1] in the normalised range, or raw SI units without normalisation."""

    def __init__(self, coordinates: Coordinates, *, normalise: bool) -> None:
        self.coordinates = coordinates
        self._normalise = normalise

    def from_unit(self, unit: FloatArray) -> FloatArray:
        """Map unit coordinates, (N, C), into the box."""
        if self._normalise:
            return HALF_WIDTH * (2 * unit - 1)
        members = self.coordinates.members(unit)
        if self.coordinates.fixed_latency_s is not None:
            return members.theta
        return np.concatenate([members.theta, members.latency_s[:, None]], axis=1)

    def members(self, x: FloatArray) -> Members:
        """Map the box to physical values; what left it is simulated at its edge (the paper does not say)."""
        if self._normalise:
            return self.coordinates.members(np.clip((x / HALF_WIDTH + 1) / 2, 0.0, 1.0))
        space = self.coordinates.space
        theta = np.clip(x[:, : len(space)], space.low, space.high)
        unit = space.normalize(theta)
        if self.coordinates.fixed_latency_s is None:
            unit = np.concatenate([unit, self.coordinates.latency_unit(x[:, len(space)])[:, None]], axis=1)
        return self.coordinates.members(unit)


class _DealPaper(Stepper):
    """A run of Algorithm 1: one denoising step a generation."""

    KEPT = ("_search", "_fitness")

    settings: PaperSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: DealPaper) -> None:
        super().__init__(log, rng, search)
        settings = self.settings
        self._box = _Box(self.coordinates, normalise=settings.normalise)
        self._search = DiffusionEvolution(
            # Line 1: theta^T from the search range, uniform in the normalised box.
            self._box.from_unit(self.coordinates.sample(rng, log.budget.population)),
            dataclasses.replace(settings.diffusion, generations=max(log.budget.generations, 1)),
            rng,
        )
        self._fitness = make_fitness(settings.fitness, self.problem, rng, settings, search.policy)

    @property
    def finished(self) -> bool:
        """Whether theta^0 has been reached."""
        return self._search.finished

    def step(self) -> None:
        """Lines 3 to 15: from theta^t to theta^(t - 1)."""
        members = self._box.members(self._search.ask())
        fitness = self._fitness.score(members)
        step = self._search.tell(fitness)
        finite = fitness[np.isfinite(fitness)]
        self.log.note(
            f"effective size {step.effective_size:.0f} of {len(fitness)}",
            members,
            {
                "fitness": float(finite.mean()) if finite.size else float("nan"),
                **self._fitness.values,
                "effective_size": step.effective_size,
                "effective_neighbours": step.effective_neighbours,
                "delta": step.delta,
                "sigma": step.sigma,
                "clamped": float(step.clamped),
            },
        )

    def result(self) -> CalibrationResult:
        final = self._search.ask()
        # The paper outputs a distribution theta^0; its mean is our estimate. The weighted mean and the best
        # member differ from it by less than the population's own error.
        return self.log.result(
            self._box.members(final.mean(axis=0, keepdims=True)),
            self._box.members(final),
            extra={"interval": "population spread, uncalibrated", "estimate": "mean of the last population"},
        )


@dataclass(frozen=True)
class DealPaper(Search):
    """DEAL as published; the budget's population is N, its generations are T.

    The latency, of which the paper knows nothing, is one more searched coordinate unless the problem gives
    it.

    Attributes:
        settings: How to run.
        policy: pi_0 to run in the loop; None replays its recorded actions.
        name: Name in results.
    """

    settings: PaperSettings = field(default_factory=PaperSettings)
    policy: PopulationPolicy | None = None
    name: str = "deal-paper"
    stepper = _DealPaper


def paper() -> DealPaper:
    """Return `deal-paper`: Algorithm 1, open choices made as well as we could."""
    return DealPaper()


def literal() -> DealPaper:
    """Return Algorithm 1 to the letter: raw softmax (eq. 22), distance summed over K (eq. 1)."""
    diffusion = DiffusionSettings(temperature=None, divide_distance=False)
    return DealPaper(PaperSettings(diffusion=diffusion), name="deal-paper-literal")


def without_noise_adaptation() -> DealPaper:
    r"""Return the paper's ablation DEAL\FN: no eq. 9."""
    return DealPaper(PaperSettings(diffusion=DiffusionSettings(adapt_noise=False)), name="deal-paper-fn")


def without_normalisation() -> DealPaper:
    r"""Return the paper's ablation DEAL\PN: the search moves in raw units."""
    return DealPaper(PaperSettings(normalise=False), name="deal-paper-pn")


def flat() -> DealPaper:
    """Return `deal-paper` with a constant fitness: whatever it finds, it did not find in the data."""
    return DealPaper(PaperSettings(fitness="flat"), name="deal-paper-flat")
