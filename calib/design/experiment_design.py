"""Expected information of a recording before it is made: Fisher information of an excitation.

A candidate is run on simulated members drawn from the known distribution of the parameters. Its information
is the normal equations of multiple shooting (:class:`~deal_hw.calib.fit.residual.Shooting`) at the members'
own parameters. Windows, sensor noise, unknown start states and latency are those of the calibration itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.parts import longest_windows
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.design.closed_loop import Scenario, TrialRunner
from deal_hw.calib.fit.residual import Shooting, States
from deal_hw.description import RobotDescription
from deal_hw.errors import CalibrationError, InsufficientDataError
from deal_hw.motions.behaviours import Behaviour
from deal_hw.motions.excitation.plan import ExcitationBehaviour, ExcitationPlan
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

MakeBehaviour = Callable[[], Behaviour]
"""Makes one behaviour; every member has its own."""


WINDOW_S = 0.8
"""Window length of the information: the longest that the refinement uses [s]."""

START_STD = 5.0
"""Spread of start positions [standard deviations of the sensor]."""

INNER = (0.1, 0.9)
"""Part of each range from which members are drawn before a calibration: corners of the ranges are no real
robots."""

DRAWS_PER_MEMBER = 8
"""Number of draws per member that can be run."""


@dataclass(frozen=True, slots=True)
class ExpectedInformation:
    """Predicted information of an excitation.

    Attributes:
        std: Standard deviation of each parameter in its own scale, root mean square over members, (K,).
        gain: Information gain over the prior [nats], from the members' mean covariance.
        tripped: Why a member would have been stopped, or why nothing can be predicted; "" for neither.
        clipped: Commands that the safety filter changed, over all members.
        beaten: Whether it was abandoned because others have more information.
    """

    std: FloatArray
    gain: float
    tripped: str = ""
    clipped: int = 0
    beaten: bool = False

    @property
    def usable(self) -> bool:
        """Whether all members ran to the end and were evaluated."""
        return not self.tripped and not self.beaten


@dataclass(frozen=True, slots=True)
class Prior:
    """Information before the recording.

    Attributes:
        information: Of parameters in their own scale and latency [s], (K + 1, K + 1).
    """

    information: FloatArray

    @classmethod
    def of(cls, known: ParameterDistribution) -> Prior:
        """Return the prior of a distribution: Gaussian, or as wide as the ranges."""
        space, K = known.space, len(known.space)
        information = np.zeros((K + 1, K + 1))
        flat = np.diag(12.0 / space.width**2)
        if known.covariance is None:
            information[:K, :K] = flat
        else:
            # The small term keeps an exact covariance invertible.
            information[:K, :K] = np.linalg.inv(known.covariance + 1e-12 * np.eye(K))
        low, high = known.latency_s
        information[K, K] = 12.0 / max(high - low, 1e-4) ** 2
        return cls(information)

    def posterior(self, hessian: FloatArray) -> FloatArray:
        """Return the parameters' covariance, (K, K), after data of information (K + 1, K + 1)."""
        return np.asarray(np.linalg.inv(self.information + hessian)[:-1, :-1])

    def gain(self, covariance: FloatArray) -> float:
        """Return half the log ratio of determinants before and after [nats], for a covariance after, (K, K).

        It is the D-optimal criterion. Directions without information add nothing to it, so it needs no choice
        of an identifiable subspace.
        """
        before = np.linalg.inv(self.information)[:-1, :-1]
        return float(0.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(covariance)[1]))


def information(
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[SampledEpisode],
    theta: FloatArray,
    latency_s: float,
    window_s: float = WINDOW_S,
    threads: int | None = None,
    states: States | None = None,
) -> FloatArray:
    """Return the Fisher information of recordings with the nominal sensor's noise, start states eliminated.

    It is that of parameters in their own scale and latency [s], (K + 1, K + 1), at ``theta``, (K,), and
    ``latency_s``. ``states`` are the true ones; by default the smoothed ones. Windows are shorter where no
    recording holds one.
    """
    J = len(robot.description.joint_names)
    std = np.concatenate([robot.description.sensor.position_std, np.ones(J)])
    problem = Problem(robot, space, episodes, threads=threads, known_std=std)
    data = longest_windows(problem, window_s)
    shooting = Shooting(problem, data[0].windows.length, data)
    return shooting.normal(shooting.start(theta, latency_s, states)).hessian


class Experiment:
    """Predicts the information of candidates, all on the same members.

    The D members, ``draws`` of them, are drawn from what is ``known``. ``rest`` is a behaviour that hardly
    moves the robot: members that leave the limits even under it are drawn again. Without it the first draws
    are taken. ``prior`` is the information before the recording; that of ``known`` by default.

    Raises:
        CalibrationError: Hardly any draw can be run.
    """

    def __init__(
        self,
        robot: RobotModel,
        known: ParameterDistribution,
        seconds: float,
        draws: int,
        rng: np.random.Generator,
        rest: MakeBehaviour | None = None,
        threads: int | None = None,
        prior: Prior | None = None,
    ) -> None:
        self.robot, self.space, self.known = robot, known.space, known
        self.seconds, self.threads = seconds, threads
        self.prior = prior or Prior.of(known)
        self.refused = 0
        """Number of draws that could not be run."""
        self._runner: TrialRunner | None = None
        self._order = list(range(draws))
        self._rest = rest
        drawn = _draw(robot.description, known, rng, draws)
        self.scenario = drawn.part(range(draws)) if rest is None else self._runnable(drawn, draws, rest)

    def _runnable(self, drawn: Scenario, draws: int, rest: MakeBehaviour) -> Scenario:
        trials = self._on(drawn).run([rest() for _ in range(len(drawn))])
        kept = [n for n, trial in enumerate(trials) if not trial.tripped][:draws]
        if len(kept) < draws:
            raise CalibrationError(
                f"only {len(kept)} of {len(drawn)} draws from the parameters' ranges keep the limits of "
                f"{self.robot.description.name!r} at rest; give narrower ranges (--range-ratio), a "
                "calibration, or a policy that balances"
            )
        self.refused = (kept[-1] + 1) - draws
        return drawn.part(kept)

    def _on(self, scenario: Scenario) -> TrialRunner:
        return TrialRunner(self.robot, self.space, scenario, self.seconds, self.threads)

    def afresh(self, draws: int, rng: np.random.Generator) -> Experiment:
        """Return the same experiment on other members, for an independent evaluation."""
        return Experiment(
            self.robot, self.known, self.seconds, draws, rng, self._rest, self.threads, self.prior
        )

    def playing(self, plan: ExcitationPlan, balance: MakeBehaviour | None) -> MakeBehaviour:
        """Return the factory of a plan's behaviour, after ``balance`` if given."""
        description = self.robot.description
        return lambda: ExcitationBehaviour(plan, description, balance() if balance is not None else None)

    def predict(
        self, make: MakeBehaviour, bar: Callable[[ExpectedInformation], bool] | None = None
    ) -> ExpectedInformation:
        """Predict a behaviour's information.

        Args:
            make: Makes the behaviour.
            bar: Decides after each member whether to continue. Its argument is an upper bound: the prediction
                if the remaining members were known exactly. Members with the least information in the last
                finished behaviour come first, so most others end after one or two.
        """
        D, K = len(self.scenario), len(self.space)
        if self._runner is None:
            self._runner = self._on(self.scenario)
        trials = self._runner.run([make() for _ in range(D)], until_trip=True)
        clipped = sum(trial.clipped for trial in trials)
        nothing = ExpectedInformation(np.full(K, np.nan), -np.inf, clipped=clipped)
        tripped = next((trial.tripped for trial in trials if trial.tripped), "")
        if tripped:
            return dataclasses.replace(nothing, tripped=tripped)
        covariances = np.zeros((D, K, K))
        found = nothing
        for n in self._order:
            theta, latency_s = self.scenario.theta[n], float(self.scenario.latency_s[n])
            episode = trials[n].episode
            try:
                hessian = information(
                    self.robot,
                    self.space,
                    [episode],
                    theta,
                    latency_s,
                    WINDOW_S,
                    self.threads,
                    [(episode.position, episode.velocity)],
                )
                covariances[n] = self.prior.posterior(hessian)
            except InsufficientDataError as err:
                return dataclasses.replace(nothing, tripped=str(err))
            if not np.isfinite(covariances[n]).all():
                return dataclasses.replace(nothing, tripped="a member diverged in its windows")
            # Covariances are averaged, not gains: a parameter without effect on one robot in eight must not
            # be compensated by a little more information on the other seven.
            mean = np.mean(covariances, axis=0)
            found = ExpectedInformation(np.sqrt(np.diag(mean)), self.prior.gain(mean), clipped=clipped)
            if bar is not None and not bar(found):
                return dataclasses.replace(nothing, beaten=True)
        dark = np.einsum("nkk,kk->n", covariances, self.prior.information[:K, :K])
        self._order = np.argsort(-dark).tolist()
        return found


def _draw(
    description: RobotDescription,
    known: ParameterDistribution,
    rng: np.random.Generator,
    draws: int,
) -> Scenario:
    cubes_of_draws, (least, most) = DRAWS_PER_MEMBER, INNER
    count = draws * cubes_of_draws
    if known.covariance is None:
        # Latin hypercubes: each parameter is at its low and at its high end on some member, because effects
        # vanish at the ends, as that of a high effort limit does.
        K = len(known.space)
        cubes = [rng.permuted(np.tile(np.arange(draws), (K, 1)), axis=1).T for _ in range(cubes_of_draws)]
        unit = (np.concatenate(cubes) + rng.random((count, K))) / draws
        theta = known.space.unnormalize(least + (most - least) * unit)
    else:
        theta = known.sample(rng, count)
    low, high = known.latency_s
    # Half of the searched range: few robots have a delay at its end.
    latency = rng.uniform(low, 0.5 * (low + high) if known.covariance is None else high, count)
    default = np.array(description.default_position)
    spread = START_STD * description.sensor.position_std
    return Scenario(theta, latency, default + rng.standard_normal((count, len(default))) * spread)
