"""`deal-paper`: DEAL's Algorithm 1, with every choice that the paper leaves open noted where it is made.

Generation t: roll every member out, train the critic (eq. 5), score each member's own rollout, turn scores
into probabilities and take one denoising step (eqs. 1, 2, 9, 10: :mod:`deal_hw.calib.diffusion_evolution`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from deal_hw.calib.coordinates import Coordinates, Members
from deal_hw.calib.critic import ClippedCritic, CriticSettings, Samples, torch_threads
from deal_hw.calib.diffusion_evolution import DiffusionEvolution, DiffusionSettings
from deal_hw.calib.outcome import Run
from deal_hw.calib.problem import Problem
from deal_hw.calib.rollouts import (
    PopulationPolicy,
    Ticks,
    TransitionScale,
    control_ticks,
    demonstration,
    rollout_population,
    transitions,
)
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback
from deal_hw.types import FloatArray

HALF_WIDTH = 3.0**0.5
"""The box is [-HALF_WIDTH, HALF_WIDTH]: a uniform start then has unit variance, as eq. 12 has it at t = T.

In [-1, 1] the unit noise of eq. 10 puts a third of all coordinates outside the range, where they are
simulated at its edge, and the search is drawn into the corners.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperSettings:
    r"""Choices of `deal-paper`; the paper names those that are marked with a section.

    Attributes:
        critic: Size (section 3.1: two layers of 256) and training of the critic. Learning rate, clip, updates
            n and batch M are not in the paper.
        diffusion: The search's choices; its number of generations is the budget's.
        normalise: Whether the search moves in the normalised range (section 3.2); off is the ablation
            DEAL\PN, which moves in raw SI units.
        constant_fitness: Score every member 0: a search that cannot see the data.
        replay_generations: How many generations' rollouts D_S holds, None for all. Algorithm 1 stores
            rollouts and does not say whether it forgets; a critic that is still trained against populations
            of long ago pushes the present one along with them (measured: no better than the centre), so the
            default forgets.
        ticks: Most transitions of a rollout (Table 4: 200).
        torch_threads: Threads of the critic's arithmetic.
    """

    critic: CriticSettings = field(default_factory=CriticSettings)
    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    normalise: bool = True
    constant_fitness: bool = False
    replay_generations: int | None = 1
    ticks: int = 200
    torch_threads: int = 1


class DealPaper(CalibrationMethod[Problem]):
    """DEAL as published.

    The latency, of which the paper knows nothing, is one more searched coordinate unless the problem gives
    it.

    Args:
        settings: How to run.
        policy: pi_0 to run in the loop; None replays its recorded actions.
        name: Name in results.
    """

    def __init__(
        self,
        settings: PaperSettings | None = None,
        policy: PopulationPolicy | None = None,
        name: str = "deal-paper",
    ) -> None:
        self.settings = settings or PaperSettings()
        self.policy = policy
        self.name = name

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
    ) -> CalibrationResult:
        """Calibrate: the budget's population N and generations T."""
        run = Run(self.name, problem, budget, progress)
        box = _Box(Coordinates(problem), normalise=self.settings.normalise)
        search = DiffusionEvolution(
            # Line 1: theta^T from the search range, uniform in the normalised box.
            box.from_unit(box.coordinates.sample(rng, budget.population)),
            _with_generations(self.settings.diffusion, budget.generations),
            rng,
        )
        view = _PaperView(problem, self.settings, self.policy, rng)
        with torch_threads(self.settings.torch_threads):
            while not search.finished:
                members = box.members(search.ask())
                if self.settings.constant_fitness:
                    fitness, gap = np.zeros(budget.population), 0.0
                else:
                    fitness, gap = view.fitness(members)
                step = search.tell(fitness)
                finite = fitness[np.isfinite(fitness)]
                run.note(
                    f"effective size {step.effective_size:.0f} of {budget.population}",
                    members.theta,
                    {
                        "fitness": float(finite.mean()) if finite.size else float("nan"),
                        "wasserstein": gap,
                        "effective_size": step.effective_size,
                        "effective_neighbours": step.effective_neighbours,
                        "delta": step.delta,
                        "sigma": step.sigma,
                        "clamped": float(step.clamped),
                    },
                )
        final = search.ask()
        # The paper outputs a distribution theta^0; its mean is our estimate. The weighted mean and the best
        # member differ from it by less than the population's own error.
        return run.result(
            box.coordinates,
            box.members(final.mean(axis=0, keepdims=True)),
            box.members(final),
            settings=self.settings,
            extra={"interval": "population spread, uncalibrated", "estimate": "mean of the last population"},
        )


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
    return DealPaper(PaperSettings(constant_fitness=True), name="deal-paper-flat")


def _with_generations(settings: DiffusionSettings, generations: int) -> DiffusionSettings:
    return dataclasses.replace(settings, generations=max(generations, 1))


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


class _PaperView:
    """Rollouts, replay and critic: lines 3 to 9 of Algorithm 1."""

    def __init__(
        self,
        problem: Problem,
        settings: PaperSettings,
        policy: PopulationPolicy | None,
        rng: np.random.Generator,
    ) -> None:
        self._problem, self._settings, self._policy = problem, settings, policy
        self._ticks: list[Ticks] = [
            control_ticks(problem, index, settings.ticks) for index in range(len(problem.episodes))
        ]
        raw = np.concatenate([demonstration(problem, i, ticks) for i, ticks in enumerate(self._ticks)])
        self._scale = TransitionScale.of(raw.astype(np.float64))
        self._real: Samples = self._scale.apply(raw)
        self._critic = ClippedCritic(raw.shape[1], settings.critic, rng)
        self._replay: list[Samples] = []

    def fitness(self, members: Members) -> tuple[FloatArray, float]:
        """Return each member's mean critic output, (N,), and the critic's Wasserstein estimate."""
        rollouts, usable = self._rollouts(members)
        N, _, width = rollouts.shape
        self._replay.append(rollouts[usable].reshape(-1, width))
        if self._settings.replay_generations is not None:
            del self._replay[: -self._settings.replay_generations]
        gap = self._critic.train_on_blocks(self._real, self._replay)
        # Line 9: the expectation over the member's own rollout.
        score = self._critic.score(rollouts.reshape(-1, width)).reshape(N, -1).mean(axis=1).astype(np.float64)
        return np.where(usable, score, -np.inf), gap

    def _rollouts(self, members: Members) -> tuple[Samples, npt.NDArray[np.bool_]]:
        blocks = []
        for index, ticks in enumerate(self._ticks):
            moved = rollout_population(self._problem, members, index, ticks, self._policy)
            blocks.append(transitions(*moved))
        raw = blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=1)
        usable = np.asarray(np.isfinite(raw).all(axis=(1, 2)))
        return self._scale.apply(raw), usable
