"""Fitness: one number per member, higher is better, for searches that need no more.

A search takes a fitness by name from a table and does not know its meaning. Numbers of different generations
are comparable for all but the critic, which keeps learning.
"""

from __future__ import annotations

import abc
import functools
import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist, pdist

from deal_hw.calib.data.innovations import Members, Whitening, cut, is_noisy, linearise, whitened_residual
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Stateful
from deal_hw.calib.data.search import Coordinates
from deal_hw.calib.data.start_states import drawn_start
from deal_hw.calib.paper.critic import PAPER_CRITIC, CriticSettings
from deal_hw.calib.paper.rollouts import (
    TransitionScale,
    control_ticks,
    demonstration,
    drawn_ticks,
    policy_of,
    rollout_population,
    transitions,
)
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.sim.recordings.imu_base import PLACE_STD
from deal_hw.types import FloatArray

Samples = npt.NDArray[np.float32]

FITNESSES: dict[str, str] = {
    "critic": "deal_hw.calib.paper.critic_fitness:CriticFitness",
    "trajectory": "deal_hw.calib.paper.fitness:TrajectoryFitness",
    "energy": "deal_hw.calib.paper.fitness:EnergyFitness",
    "mmd": "deal_hw.calib.paper.fitness:KernelFitness",
    "flat": "deal_hw.calib.paper.fitness:FlatFitness",
}
"""Name -> ``module:class``, imported on use: only the critic needs torch. ``flat`` ignores the data."""

USUAL_TRANSITIONS = 200
"""Most transitions of a rollout: the DEAL paper's Table 4 for cart-pole, ant and humanoid."""

TRANSITIONS = {"go2": 250, "allegro": 600}
"""Robots with another number there. A demonstration of 5 s (12 s) has as many, at 50 Hz."""

DRAWN_TICKS = 25
"""Control periods of a rollout from a drawn start state. Longer ones show slow effects, shorter ones diverge
less from the recording. Half a second at 50 Hz is a choice; it was not tuned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitnessSettings:
    """Settings of a fitness; each kind reads its own.

    Attributes:
        window_ticks: Window length of `trajectory` in control periods.
        ticks: Most transitions of a rollout (`critic`, `energy`, `mmd`); None for the robot's own number in
            `TRANSITIONS`.
        replay: Roll out with the recorded commands, not with the policy in closed loop (Algorithm 1, line 3).
        difference: Score (s, a, s' - s) instead of the paper's (s, a, s'). The information is the same. But s
            and s' differ by only a hundredth of their range, which a first layer hardly sees.
        standardise: Scale transitions to mean 0 and variance 1 over the recording; the paper has no input
            scaling. Standardised inputs are cut at five standard deviations: otherwise a member whose pole
            spins dominates the critic's output, and with it the softmax.
        critic: Size and training of the critic.
        replay_generations: Number of generations of rollouts D_S in the critic's training; None for all.
            Algorithm 1 stores rollouts and does not say whether it forgets. A critic that is still trained
            against old populations pushes the present one away with them (measured: no better than the
            centre), so the default forgets.
    """

    window_ticks: int = 10
    ticks: int | None = None
    replay: bool = False
    difference: bool = False
    standardise: bool = True
    critic: CriticSettings = PAPER_CRITIC
    replay_generations: int | None = 1

    def __post_init__(self) -> None:
        for name in ("window_ticks", "ticks"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {value}")
        if self.replay_generations is not None and self.replay_generations < 1:
            raise ConfigurationError(
                f"replay_generations must be at least 1 or None, got {self.replay_generations}"
            )

    def most_transitions(self, robot: str) -> int:
        """Return the most transitions of a rollout of this robot."""
        return self.ticks or TRANSITIONS.get(robot, USUAL_TRANSITIONS)


class Fitness(Stateful, abc.ABC):
    """A score of members; ``values`` are further values of the last call of `score`, for the trace."""

    def __init__(
        self,
        problem: Problem,
        settings: FitnessSettings,
        rng: np.random.Generator,
    ) -> None:
        self._problem, self._settings = problem, settings
        self.values: dict[str, float] = {}
        self._prepare(rng)

    @abc.abstractmethod
    def _prepare(self, rng: np.random.Generator) -> None:
        """Set up scoring."""

    @abc.abstractmethod
    def score(self, members: Members) -> FloatArray:
        """Return one number per member, (N,): higher is better, -inf where the simulation diverged."""


def make_fitness(
    name: str,
    problem: Problem,
    rng: np.random.Generator,
    settings: FitnessSettings | None = None,
) -> Fitness:
    """Return a new fitness; see :class:`Fitness`.

    Raises:
        UnknownNameError: The name is not in `FITNESSES`.
        InsufficientDataError: The recording is too short for it, or its policy is needed and not known.
    """
    if name not in FITNESSES:
        raise UnknownNameError("fitness", name, FITNESSES)
    module, _, attribute = FITNESSES[name].partition(":")
    made: Fitness = getattr(importlib.import_module(module), attribute)(
        problem, settings or FitnessSettings(), rng
    )
    return made


class FlatFitness(Fitness):
    """The same number for every member: a baseline without data."""

    def _prepare(self, rng: np.random.Generator) -> None:
        # Draws the critic's seed, so that search and no-data baseline use the same random numbers.
        rng.integers(2**62)

    def score(self, members: Members) -> FloatArray:
        """See :meth:`Fitness.score`."""
        return np.zeros(len(members.theta))


class TrajectoryFitness(Fitness):
    """Prediction error in windows: minus the logarithm of the mean squared whitened window innovation.

    Errors of distant members span many decades: a softmax of the errors themselves could not separate the
    good ones. All members and generations use the metric of the range's midpoint, so scores are comparable.
    """

    def _prepare(self, rng: np.random.Generator) -> None:
        self._windows = cut(self._problem, self._settings.window_ticks)
        self._midpoint = Coordinates(self._problem).midpoint
        # Made on first use: a small population's call costs less than its metric.
        self._whitenings: list[Whitening] | None = None

    def score(self, members: Members) -> FloatArray:
        """See :meth:`Fitness.score`."""
        if self._whitenings is None:
            self._whitenings = [linearise(self._problem, self._midpoint, data) for data in self._windows]
        residual = whitened_residual(
            self._problem, members, self._midpoint, self._windows, whitenings=self._whitenings
        )
        # f = -ln(mean_m r_m^2) over the M whitened innovations r.
        with np.errstate(over="ignore"):
            error = np.mean(residual**2, axis=1)
        return np.where(np.isfinite(error), -np.log(np.maximum(error, 1e-300)), -np.inf)


class RolloutView:
    """Transitions (s, a, s') of the recording and of rollouts.

    With drawn start states (:attr:`Problem.start_std`) rollouts are shorter and begin in states drawn from
    the whole recordings; the recording's transitions are then those behind these states. All generations
    share the draws, so that they are comparable.

    Args:
        problem: The recordings.
        settings: What of them is compared.
        rng: Draws start states; not used without.

    Raises:
        InsufficientDataError: A recording is too short, or its policy is not known.
    """

    def __init__(self, problem: Problem, settings: FitnessSettings, rng: np.random.Generator) -> None:
        self._problem, self._settings = problem, settings
        most = settings.most_transitions(problem.robot.description.name)
        past: dict[str, Any] = {}
        if not settings.replay:
            policy = policy_of(problem)
            past = {"history": policy.history, "ran_before": policy.ran_before}
        every = range(len(problem.episodes))
        self._seed = 0
        if problem.start_std is None:
            self._parts = [(index, control_ticks(problem, index, most, **past)) for index in every]
        else:
            self._seed = int(rng.integers(2**62))
            self._parts = [
                (index, ticks)
                for index in every
                for ticks in drawn_ticks(problem, index, most, DRAWN_TICKS, rng, **past)
            ]
        shown = self._shown()
        self._columns = np.flatnonzero(np.concatenate([shown, np.ones(problem.commands, dtype=bool), shown]))
        self.outputs = int(np.count_nonzero(shown))
        """Width of s', the last entries of a transition."""
        raw = np.concatenate(
            [
                demonstration(problem, index, ticks, difference=settings.difference)
                for index, ticks in self._parts
            ]
        )[:, self._columns]
        width = raw.shape[1]
        self._scale = TransitionScale(np.zeros(width), np.ones(width), np.inf)
        if settings.standardise:
            self._scale = TransitionScale.of(raw.astype(np.float64))
        self.real: Samples = self._scale.apply(raw)
        """The recording's transitions, (n, inputs)."""

    def _shown(self) -> npt.NDArray[np.bool_]:
        """Return which entries of (position, velocity) the recordings show at all, (2 C,).

        The others are the place of a base on the floor that no sensor reports: it is 0 in the recording.
        """
        shown = np.ones(2 * self._problem.coordinates, dtype=bool)
        for episode in self._problem.episodes:
            if episode.estimate_std is not None:
                std = np.broadcast_to(episode.estimate_std, (len(episode.sample), len(shown)))
                unseen = np.asarray(np.all(std <= PLACE_STD, axis=0))
                unseen[episode.channels] = False
                shown &= ~unseen
        return shown

    @functools.cached_property
    def _noise(self) -> FloatArray:
        """The noise of smoothed states in a transition, standardised, (inputs,)."""
        C = self._problem.coordinates
        rows = [self._problem.starts[index].std[ticks.sample] for index, ticks in self._parts]
        # Smoothed states count with twice their noise, for kinks that are no polynomials.
        std = 0.5 * np.sqrt(np.mean(np.concatenate(rows) ** 2, axis=0))
        std[~np.isfinite(std)] = 0.0
        noise = np.zeros(4 * C + self._problem.commands)
        noise[: 2 * C] = std
        noise[-2 * C :] = std * (np.sqrt(2.0) if self._settings.difference else 1.0)
        return np.asarray(noise[self._columns] / self._scale.std)

    def as_sensed(self, rollouts: Samples, rng: np.random.Generator) -> Samples:
        """Return simulators' transitions with the noise of smoothed measurements, (N, n, inputs)."""
        if not is_noisy(self._problem):
            return rollouts
        draws = rng.standard_normal(rollouts.shape, dtype=np.float32)
        return rollouts + draws * self._noise.astype(np.float32)

    def rollouts(self, members: Members) -> tuple[Samples, npt.NDArray[np.bool_]]:
        """Return each member's transitions, (N, n, inputs), and which members did not diverge, (N,)."""
        blocks = []
        for number, (index, ticks) in enumerate(self._parts):
            moved = rollout_population(
                self._problem,
                members,
                index,
                ticks,
                replay=self._settings.replay,
                moved=self._draws(len(members.theta), number),
            )
            found = transitions(*moved, difference=self._settings.difference)
            blocks.append(found if found.shape[-1] == len(self._columns) else found[..., self._columns])
        raw = blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=1)
        usable = np.asarray(np.isfinite(raw).all(axis=(1, 2)))
        return self._scale.apply(raw), usable

    def _draws(self, count: int, number: int) -> FloatArray | None:
        """Return how far the start state of each member lies from a part's own one, (N, 2 C)."""
        given = self._problem.start_std
        if given is None:
            return None
        index, ticks = self._parts[number]
        middle, std = drawn_start(self._problem, index, int(ticks.sample[0]), given)
        draws = np.random.default_rng([self._seed, number]).standard_normal((count, len(std)))
        return np.asarray(middle + draws * std)


class EnergyFitness(Fitness):
    """Minus the energy distance between the recording's transitions and the member's own."""

    def _prepare(self, rng: np.random.Generator) -> None:
        self._view = RolloutView(self._problem, self._settings, rng)
        self._real = self._view.real.astype(np.float64)

    def score(self, members: Members) -> FloatArray:
        """See :meth:`Fitness.score`."""
        rollouts, usable = self._view.rollouts(members)
        found = np.full(len(rollouts), -np.inf)
        for i in np.flatnonzero(usable):
            found[i] = -self._distance(rollouts[i].astype(np.float64))
        return found

    def _distance(self, samples: FloatArray) -> float:
        return energy_distance(self._real, samples)


class KernelFitness(EnergyFitness):
    """Minus the squared maximum mean discrepancy (Gaussian kernel) between the same transitions."""

    def _prepare(self, rng: np.random.Generator) -> None:
        super()._prepare(rng)
        # In standardised units: the usual choice for a kernel two-sample test (Gretton et al. 2012).
        self._bandwidth = float(np.median(pdist(self._real)))

    def _distance(self, samples: FloatArray) -> float:
        return squared_mmd(self._real, samples, self._bandwidth)


def energy_distance(x: FloatArray, y: FloatArray) -> float:
    """Return the energy distance 2 E|x - y| - E|x - x'| - E|y - y'| of two samples (Szekely and Rizzo 2013).

    Samples are (n, d) and (m, d). Expectations run over all pairs, a sample with itself included.
    """
    between = float(cdist(x, y).mean())
    # pdist holds each pair once and not the zeros on the diagonal.
    within = sum(2.0 * float(pdist(z).sum()) / len(z) ** 2 for z in (x, y))
    return max(2.0 * between - within, 0.0)


def squared_mmd(x: FloatArray, y: FloatArray, bandwidth: float) -> float:
    """Return the squared maximum mean discrepancy of samples (n, d) and (m, d) (Gretton et al. 2012, eq. 5).

    It is the biased estimate, over all pairs, with the kernel exp(-|x - y|^2 / (2 h^2)) of ``bandwidth`` h.
    """

    def mean(a: FloatArray, b: FloatArray) -> float:
        return float(np.exp(cdist(a, b, "sqeuclidean") / (-2.0 * bandwidth**2)).mean())

    return max(mean(x, x) + mean(y, y) - 2.0 * mean(x, y), 0.0)
