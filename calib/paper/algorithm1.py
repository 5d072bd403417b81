"""`deal-paper`: DEAL's Algorithm 1 as published; every choice that the paper leaves open is a setting.

Generation t: roll pi_0 out in every simulator (line 3), train the critic (eq. 5), score each member's own
rollout, turn scores into probabilities and take one denoising step (eqs. 1, 2, 9, 10:
:mod:`deal_hw.calib.paper.diffusion_evolution`). The range is linear and no latency is searched.
docs/explanation/deal-paper.md lists our choices.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.search import Coordinates, RangedSearch, SearchLog, Stepper
from deal_hw.calib.paper.diffusion_evolution import DiffusionEvolution, DiffusionSettings
from deal_hw.calib.paper.fitness import FitnessSettings, make_fitness
from deal_hw.calibration import CalibrationResult
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperSettings(FitnessSettings):
    r"""Choices of `deal-paper`; section numbers are the paper's.

    Attributes:
        diffusion: The search's choices; its number of generations is the budget's.
        normalise: Whether the search moves in the normalised range (section 3.2). Off is the ablation
            DEAL\PN, which moves in SI units.
        centred: Whether SI units, without normalisation, count from the middle of each range. Off is SI units
            from zero, as the paper's words say: then the factors sqrt(alpha) pull every parameter to zero.
        box: Low and high end of the normalised range. It is centred: with a flat fitness, a box [0, 1] drifts
            to its lower corner. A uniform start has unit variance, as in eq. 12 at t = T. In [-1, 1] the unit
            noise of eq. 10 puts a third of all coordinates outside the range, where they are simulated at its
            edge.
        linear: Whether the range is linear ("within the search range", section 3.2); off is uniform in each
            parameter's own scale.
        fitness: Name of the fitness (`deal_hw.calib.paper.fitness`). "critic" is the paper's. "flat"
            scores every member 0, so the search does not depend on the data. Eq. 9 reads the raw fitness,
            whatever its scale.
    """

    latency: ClassVar[bool] = False  # The paper searches no latency.

    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    normalise: bool = True
    centred: bool = True
    box: tuple[float, float] = (-(3.0**0.5), 3.0**0.5)
    linear: bool = True
    fitness: str = "critic"

    def __post_init__(self) -> None:
        # With slots, the decorated class differs from the one that `super()` sees.
        FitnessSettings.__post_init__(self)
        if not self.box[0] < self.box[1]:
            raise ConfigurationError(f"box {self.box}: give the lower end first")
        if not (self.normalise or self.linear):
            raise ConfigurationError("without normalisation the range is linear; set linear or normalise")


class _Box:
    """The search's box: the normalised range, or SI units from the middle of each range or from zero."""

    def __init__(self, coordinates: Coordinates, settings: PaperSettings) -> None:
        self._coordinates = coordinates
        low, high = np.full((2, coordinates.count), [[settings.box[0]], [settings.box[1]]])
        if not settings.normalise:
            ends = coordinates.members(np.repeat([[0.0], [1.0]], coordinates.count, axis=1))
            low, high = ends.theta
            if coordinates.count > len(low):
                low, high = np.append(low, ends.latency_s[0]), np.append(high, ends.latency_s[1])
            if settings.centred:
                half = 0.5 * (high - low)
                low, high = -half, half
        self._low, self._width = low, high - low

    def from_unit(self, unit: FloatArray) -> FloatArray:
        """Map unit coordinates, (N, C), into the box."""
        return np.asarray(self._low + self._width * unit)

    def members(self, x: FloatArray) -> Members:
        """Map the box to physical values, clipped at its edge (the paper does not say)."""
        return self._coordinates.members(np.clip((x - self._low) / self._width, 0.0, 1.0))


class _DealPaper(Stepper):
    """A run of Algorithm 1: one denoising step a generation."""

    STATE = ("_search", "_fitness")

    settings: PaperSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: DealPaper) -> None:
        super().__init__(log, rng, search)
        settings = self.settings
        self._box = _Box(self.coordinates, settings)
        self._search = DiffusionEvolution(
            # Line 1: theta^T from the search range, uniform in the normalised box.
            self._box.from_unit(self.coordinates.sample(rng, log.budget.population)),
            dataclasses.replace(settings.diffusion, generations=max(log.budget.generations, 1)),
            rng,
        )
        self._fitness = make_fitness(settings.fitness, self.problem, rng, settings)

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
class DealPaper(RangedSearch):
    """DEAL as published; the budget's population is N, its generations are T."""

    settings: PaperSettings = field(default_factory=PaperSettings)
    name: str = "deal-paper"
    stepper = _DealPaper

    @property
    def adversarial(self) -> bool:
        """Whether the fitness is the critic's."""
        return self.settings.fitness == "critic"


def paper() -> DealPaper:
    """Return `deal-paper`: Algorithm 1 with our best choice where the paper leaves one."""
    return DealPaper()


def without_noise_adaptation() -> DealPaper:
    r"""Return the paper's ablation DEAL\FN: without eq. 9."""
    return DealPaper(PaperSettings(diffusion=DiffusionSettings(adapt_noise=False)), name="deal-paper-fn")


def without_normalisation() -> DealPaper:
    r"""Return the paper's ablation DEAL\PN: the search moves in raw units."""
    return DealPaper(PaperSettings(normalise=False), name="deal-paper-pn")


def flat() -> DealPaper:
    """Return `deal-paper` with a constant fitness: a baseline without data."""
    return DealPaper(PaperSettings(fitness="flat"), name="deal-paper-flat")


def replayed() -> DealPaper:
    """Return `deal-paper` for recordings without their policy: it replays the commands in open loop."""
    return DealPaper(PaperSettings(replay=True), name="deal-paper-replay")


def _literal(
    name: str, *, adapt_noise: bool = True, normalise: bool = True, fitness: str = "critic"
) -> DealPaper:
    return DealPaper(
        PaperSettings(
            diffusion=DiffusionSettings(temperature=None, divide_distance=False, adapt_noise=adapt_noise),
            normalise=normalise,
            centred=False,
            box=(0.0, 1.0),
            fitness=fitness,
            standardise=False,
            replay_generations=None,
        ),
        name=name,
    )


def literal() -> DealPaper:
    """Return `deal-paper-literal`: Algorithm 1 with the paper's words taken literally.

    Raw softmax (eq. 22), distance summed over K (eq. 1), range normalised to [0, 1], raw inputs, and a critic
    trained against all rollouts so far (line 3 stores them).
    """
    return _literal("deal-paper-literal")


def literal_without_noise_adaptation() -> DealPaper:
    r"""Return the literal DEAL\FN: without eq. 9."""
    return _literal("deal-paper-literal-fn", adapt_noise=False)


def literal_without_normalisation() -> DealPaper:
    r"""Return the literal DEAL\PN: the search moves in SI units, counted from zero."""
    return _literal("deal-paper-literal-pn", normalise=False)


def literal_flat() -> DealPaper:
    """Return `deal-paper-literal` with a constant fitness: what its update does without data."""
    return _literal("deal-paper-literal-flat", fitness="flat")


def by_energy() -> DealPaper:
    """Return `deal-paper-energy`: minus the energy distance as fitness, without a critic."""
    return DealPaper(PaperSettings(fitness="energy"), name="deal-paper-energy")


def by_kernel() -> DealPaper:
    """Return `deal-paper-mmd`: minus the squared maximum mean discrepancy as fitness, without a critic."""
    return DealPaper(PaperSettings(fitness="mmd"), name="deal-paper-mmd")
