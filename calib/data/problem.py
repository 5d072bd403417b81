"""A calibration problem: recordings on the device's time grid, a batched simulator, and the parameter space.

Every method reads the data through this class. So all use the same simulator, the same start states and the
same count of simulated steps. A state has C tangent coordinates and C velocities. Of these, the M measured
channels are compared with predictions.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.noise import (
    FLOOR_STD,
    SMOOTHING_S,
    Mask,
    NoiseModel,
    StartStates,
    noise_model,
    smooth_states,
    white_noise_std,
)
from deal_hw.calib.data.population_policy import PopulationPolicy
from deal_hw.calib.data.window_data import MemberPrediction, WindowData
from deal_hw.calibration import LATENCY, LATENCY_RANGE_S
from deal_hw.description import EFFORT_UNITS
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.parameters import LONGEST_LATENCY_S, Parameter, ParameterSpace
from deal_hw.sim.engine.batch import BatchPool, ServoBatch
from deal_hw.sim.engine.effort import effort_joints
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.engine.model import RobotModel, fitted_step
from deal_hw.sim.engine.trees import independent_trees, reached
from deal_hw.sim.parameters import SENSOR_NOISE
from deal_hw.sim.parameters.effort import EFFORT_NOISE
from deal_hw.sim.recordings.episode import SampledEpisode, fill_gaps
from deal_hw.sim.recordings.own_setups import in_own_setups
from deal_hw.sim.recordings.windows import cut_windows, predict_windows, setpoints
from deal_hw.task_map import InThisProcess, TaskMap
from deal_hw.types import FloatArray, IntArray

Member = tuple[FloatArray, float]
"""Physical parameters, (K,), and latency [s]."""

LATENCY_ROOM = 2.0
"""Least end of a range of the latency that nobody chose, over the latency that the model has."""
NOISE_FREE_RESIDUAL = 1e-5
"""Residual scale of noise-free recordings [m or rad]: far above rounding, far below sensors."""

SLOWEST_JITTER_S = 0.01
"""Longest sampling period at which jitter of the sample times can be separated from the motion [s]."""

VELOCITY_PRIOR_STD: Mapping[str, float] = {"m": 3.0, "rad": 30.0}
"""Weak prior on start velocities [m/s and rad/s]; keeps windows of few samples solvable."""

SHORTEST_WINDOW = 4
"""Samples of a window at least: with fewer, start states that are fitted take all that it shows [-]."""

TOGETHER = 64
"""Members that are simulated together where laws act between the steps, by copies for several windows."""

UNSEEN_STD = 1e-6
"""Prior on an unmeasured place of the base on the floor [m]; no trajectory depends on it."""


@dataclass(frozen=True, slots=True)
class CommandDelays:
    """Random delays of commands around the latency; see :mod:`deal_hw.calib.fit.command_delays`.

    Attributes:
        std_s: Their standard deviation [s], where residuals have the size of the sensors' noise.
        theta: Parameters at which their effect is computed, (K,).
        latency_s: The latency there [s].
        shift: Device periods by which the episodes' commands were moved already, by the period at which each
            begins now; its effect is computed around these. One mapping per episode.
    """

    std_s: float
    theta: FloatArray
    latency_s: float
    shift: tuple[Mapping[int, int], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Recordings, their noise, a simulator, and parameters; none of them changes.

    A method that needs another problem makes one. ``dataclasses.replace`` begins anew: noise and start states
    are estimated from the recordings. :meth:`sharing`, and the methods that call it, estimate nothing again.
    Only the count of physics steps goes on, in an object that shared problems have in common.

    Attributes:
        robot: The nominal model.
        space: The searched parameters.
        episodes: Recordings with equal measured channels, each on its own grid. Short gaps are interpolated
            and not fitted.
        threads: Simulation threads; None for all CPUs.
        latency_range_s: Range of the total latency [s]; widened to include a given latency.
        fixed_latency_s: A given latency [s]; None to search it.
        known_std: Standard deviation of (position, velocity), (2 C,), where known or chosen; None to estimate
            it from the recordings.
        smoothing_s: Width over which start states are smoothed [s].
        policy: The policy that produced all commands; None for an unknown one, or no policy.
        start_std: Rollouts of the policy begin in states drawn from the whole recordings, moved by this
            standard deviation of (position, velocity), (2 C,); NaN: the recording's own uncertainty. None:
            they begin in the recorded first state.
        tasks: Does fits that do not depend on each other; see :mod:`deal_hw.calib.data.independent`.
        engine: What simulates the populations of searches; all else is simulated by MuJoCo, in float64.
        guessed: Parameters whose range nobody chose, "latency" too. It may grow where the data ask for it.
        command_delays: Random delays of commands that fits allow for; None for a constant delay. They belong
            to single commands of these recordings: a problem of others begins without.
        efforts: Columns of the joints whose recorded effort is compared, (E,).
        channels: Indices of the measured channels into (position, velocity, effort), (M,).
        noise_std: Noise of (position, velocity, effort) at all speeds, (2 C + E,); of measured ones only.
        noise: Noise at rest, and jitter of the sample times.
        starts: Smoothed states of each episode.
        trees: Number of each coordinate's tree, (C,) an episode; those that act on each other share it.
    """

    robot: RobotModel
    space: ParameterSpace
    episodes: Sequence[SampledEpisode]
    threads: int | None = None
    latency_range_s: tuple[float, float] = LATENCY_RANGE_S
    fixed_latency_s: float | None = None
    known_std: FloatArray | None = None
    smoothing_s: float = SMOOTHING_S
    policy: PopulationPolicy | None = None
    start_std: FloatArray | None = None
    tasks: TaskMap = field(default_factory=InThisProcess)
    command_delays: CommandDelays | None = field(init=False, default=None)
    efforts: tuple[int, ...] = field(init=False)
    channels: IntArray = field(init=False)
    noise_std: FloatArray = field(init=False)
    noise: NoiseModel = field(init=False)
    starts: tuple[StartStates, ...] = field(init=False)
    trees: tuple[IntArray, ...] = field(init=False)
    engine: EngineName = "mujoco"
    guessed: tuple[str, ...] = ()
    _batches: BatchPool = field(init=False)

    def __post_init__(self) -> None:
        robot, episodes = in_own_setups(self.robot, self.episodes, self.space)
        given = () if self.fixed_latency_s is None else (self.fixed_latency_s,)
        (low, high), longest = self.latency_range_s, LONGEST_LATENCY_S
        if not (0 <= low < high <= longest and all(0 <= latency_s <= longest for latency_s in given)):
            raise ConfigurationError(
                f"latency {' to '.join(f'{1e3 * v:g}' for v in given or (low, high))} ms: a range is two "
                f"different values, the lower one first; no robot is later than {1e3 * longest:g} ms"
            )
        if LATENCY in self.guessed:
            high = min(max(high, LATENCY_ROOM * robot.latency_s), longest)
        if not episodes:
            raise InsufficientDataError("no recording was given; record one with `deal-hw collect`")
        states = episodes[0].channels
        if any(not np.array_equal(e.channels, states) for e in episodes):
            raise ConfigurationError("the recordings measure different channels; calibrate them one by one")
        self._set(
            robot=robot,
            episodes=tuple(fill_gaps(e) for e in episodes),
            latency_range_s=(min((low, *given)), max((high, *given))),
            efforts=effort_joints(robot.description, self.space),
            _batches=BatchPool(robot, self.space, self.threads),
        )
        first = 2 * self.coordinates
        efforts = np.arange(first, first + len(self.efforts), dtype=states.dtype)
        self._set(channels=np.append(states, efforts))
        # Start states are smoothed with the noise, and the jitter of sample times shows where they move.
        std = self._white_noise()
        starts = tuple(smooth_states(e, std, robot.rotation, self.smoothing_s) for e in self.episodes)
        self._set(noise_std=std, starts=starts)
        self._set(noise=self._noise_model())
        models = [robot.in_setup(e.setup) for e in self.episodes]
        trees = (independent_trees(m, e.position) for m, e in zip(models, self.episodes, strict=True))
        self._set(trees=tuple(trees))

    def _set(self, **values: Any) -> None:
        """Set fields of a new problem, before anybody else has it."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def sharing(self, **changes: Any) -> Problem:
        """Return the problem with other values of some fields; nothing is estimated from recordings again.

        Noise, start states and simulators are shared. Another robot, space or number of threads makes other
        simulators, with the same count of steps.
        """
        other = copy.copy(self)
        other._set(**changes)
        if not changes.keys().isdisjoint({"robot", "space", "threads"}):
            counted = self._batches.counted
            other._set(_batches=BatchPool(other.robot, other.space, other.threads, counted=counted))
        return other

    def _white_noise(self) -> FloatArray:
        size, states = 2 * self.coordinates, self.episodes[0].channels
        if self.known_std is not None and self.known_std.shape == (size + len(self.efforts),):
            return np.maximum(self.known_std, FLOOR_STD)
        effort = self._effort_noise()
        if self.known_std is not None:
            if self.known_std.shape != (size,):
                raise ConfigurationError(
                    f"known_std has shape {self.known_std.shape}, expected ({size},): positions, then "
                    "velocities"
                )
            return np.append(np.maximum(self.known_std, FLOOR_STD), effort)
        if self.noise_free:
            return np.append(np.full(size, NOISE_FREE_RESIDUAL), effort)
        found = np.full(size, FLOOR_STD)
        values = [np.concatenate([e.position, e.velocity], axis=1)[:, states] for e in self.episodes]
        reported = [e.reported for e in self.episodes]
        found[states] = white_noise_std(values, reported)
        return np.append(self._with_given_noise(found, np.arange(size)), effort)

    def _effort_noise(self) -> FloatArray:
        """Return the noise of the compared efforts, (E,): the known one, else that of the recordings."""
        if not self.efforts:
            return np.empty(0)
        recorded = [e.effort[:, list(self.efforts)] for e in self.episodes if e.effort is not None]
        seen = [np.asarray(np.isfinite(values).all(axis=1)) for values in recorded]
        if not sum(map(np.count_nonzero, seen)):
            raise InsufficientDataError(
                "no recording has efforts of the joints whose effort is searched; name their columns as "
                "`effort` in the column map, or remove effort_gain, effort_bias and effort_delay"
            )
        found = white_noise_std([np.nan_to_num(values) for values in recorded], seen)
        joints = self.robot.description.joint_names
        for p in self.space.parameters:
            if p.kind == EFFORT_NOISE:
                found[[self.efforts.index(joints.index(name)) for name in p.elements]] = p.nominal
        return np.asarray(found)

    def _noise_model(self) -> NoiseModel:
        fast = [i for i, e in enumerate(self.episodes) if e.period_s <= SLOWEST_JITTER_S]
        if self.known_std is not None or self.noise_free or not fast:
            return NoiseModel(self.noise_std[self.channels], 0.0)
        C, rotation = self.coordinates, self.robot.rotation
        # Jitter of sample times shows in positions; a rotation about the smoothed orientation has none left.
        timed = [i for i, c in enumerate(self.channels) if c < C and not rotation.start <= c < rotation.stop]
        columns = self.channels[timed]
        positions = [self.episodes[i].position[:, columns] for i in fast]
        speeds = [self.starts[i].velocity[:, columns] for i in fast]
        reported = [self.episodes[i].reported for i in fast]
        moved = noise_model(positions, speeds, reported)
        std = self.noise_std[self.channels]
        std[timed] = moved.position_std
        return NoiseModel(self._with_given_noise(std, self.channels), moved.timing_std_s)

    def _with_given_noise(self, std: FloatArray, channels: IntArray) -> FloatArray:
        """Return standard deviations, (M,), with known sensor noise where it is given."""
        joints = self.robot.description.joint_names
        first = self.coordinates - len(joints)
        given = {
            first + joints.index(name): p.nominal
            for p in self.space.parameters
            if p.kind == SENSOR_NOISE
            for name in p.elements
        }
        return np.array([given.get(int(c), s) for c, s in zip(channels, std, strict=True)])

    @property
    def steps(self) -> int:
        """Physics steps simulated so far."""
        return self._batches.steps

    def count(self, steps: int) -> None:
        """Count physics steps that were simulated in another process."""
        self._batches.counted.steps += steps

    def part(self, chosen: Sequence[Mask]) -> Problem:
        """Return the problem with only the samples under one mask per recording, (T,), usable."""
        masked = zip(self.episodes, chosen, strict=True)
        return self.sharing(
            episodes=tuple(dataclasses.replace(e, usable=e.usable & mask) for e, mask in masked)
        )

    def on(self, episodes: Sequence[SampledEpisode], known_std: FloatArray | None) -> Problem:
        """Return the problem of other recordings; noise is estimated again, simulators are shared."""
        other = dataclasses.replace(self, episodes=episodes, known_std=known_std)
        return other.sharing(_batches=self._batches)

    def with_noise(self, scale: FloatArray) -> Problem:
        """Return the problem with the noise of each channel multiplied by ``scale``, (M,)."""
        return self.sharing(noise=NoiseModel(self.noise.position_std * scale, self.noise.timing_std_s))

    def with_command_delays(
        self, delays: CommandDelays | None, episodes: Sequence[SampledEpisode] | None = None
    ) -> Problem:
        """Return the problem with random delays of commands, whose fits allow for them.

        ``episodes`` are the same recordings with moved commands.
        """
        moved = self.episodes if episodes is None else tuple(episodes)
        return self.sharing(command_delays=delays, episodes=moved)

    def with_space(self, space: ParameterSpace) -> Problem:
        """Return the problem with other parameters or ranges; recordings and noise are shared."""
        robot, episodes = in_own_setups(self.robot, self.episodes, space)
        return self.sharing(space=space, robot=robot, episodes=tuple(episodes))

    def with_more(self, parameters: Sequence[Parameter]) -> Problem:
        """Return the problem with more parameters after its own."""
        other = self.with_space(ParameterSpace((*self.space.parameters, *parameters)))
        if self.command_delays is None:
            return other
        theta = np.append(self.command_delays.theta, [p.nominal for p in parameters])
        return other.sharing(command_delays=dataclasses.replace(self.command_delays, theta=theta))

    @property
    def first_latency_s(self) -> float:
        """Latency at which fits begin: the given one, else the model's, or the range's end next to it [s]."""
        if self.fixed_latency_s is not None:
            return self.fixed_latency_s
        return float(np.clip(self.robot.latency_s, *self.latency_range_s))

    @property
    def noise_free(self) -> bool:
        """Whether all states are known without error, so that start states need no fit."""
        return all(e.noise_free for e in self.episodes)

    @property
    def period_s(self) -> float:
        """Sampling period of the slowest recording, in which lengths of windows are counted [s]."""
        return max(e.period_s for e in self.episodes)

    @property
    def rates(self) -> int:
        """Number of different sampling rates of the recordings."""
        return len({e.period_s for e in self.episodes})

    @property
    def step_s(self) -> float:
        """Longest device period of the recordings [s]."""
        return max(e.step_s for e in self.episodes)

    @property
    def coordinates(self) -> int:
        """Tangent coordinates C of a state."""
        return int(self.episodes[0].position.shape[1])

    @property
    def independent(self) -> int:
        """Number of trees that do not act on each other, the least of all episodes."""
        return min(len(np.unique(trees)) for trees in self.trees)

    @property
    def commands(self) -> int:
        """Commands A of a control period."""
        return int(self.episodes[0].target.shape[1])

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the measured channels, (M,)."""
        names = self.robot.coordinates
        joints = self.robot.description.joint_names
        efforts = (f"{joints[j]}.effort" for j in self.efforts)
        every = (*names, *(f"{name}.velocity" for name in names), *efforts)
        return tuple(every[c] for c in self.channels)

    @property
    def channel_coordinates(self) -> IntArray:
        """The coordinate of each measured channel, (M,)."""
        first, every = self.coordinates - len(self.robot.description.joint_names), np.arange(self.coordinates)
        return np.concatenate([every, every, first + np.array(self.efforts, dtype=np.int64)])[self.channels]

    @property
    def channel_units(self) -> tuple[str, ...]:
        """Units of the measured channels, (M,)."""
        units = self.robot.coordinate_units
        joints = self.robot.description.position_units
        efforts = (EFFORT_UNITS[joints[j]] for j in self.efforts)
        every = (*units, *(f"{unit}/s" for unit in units), *efforts)
        return tuple(every[c] for c in self.channels)

    def batch(self, count: int, index: int, *, population: bool = False) -> ServoBatch:
        """Return the simulator of ``count`` members in the set-up of an episode; the last sizes are kept.

        Its physics step fits the episode's grid. The members of a search's ``population`` are simulated by
        the problem's engine.
        """
        engine = self.engine if population else "mujoco"
        return self._batches.get(count, self.episodes[index].setup, engine, self._physics_step_s(index))

    def _physics_step_s(self, index: int) -> float:
        return fitted_step(self.episodes[index].step_s, self.robot.step_s)

    def batches(self, count: int, index: int) -> list[ServoBatch]:
        """Return simulators of a search's population of ``count`` members: on a CPU one for each thread."""
        if self.engine != "mujoco":
            return [self.batch(count, index, population=True)]
        return self._batches.parts(count, self.episodes[index].setup, self._physics_step_s(index))

    def reach(self, index: int) -> Mask:
        """Return which coordinates each free parameter moves in an episode, (K, C); in other set-ups none."""
        here = self.robot.in_setup(self.episodes[index].setup)
        return reached(here, here.acting(self.space), self.trees[index])

    def measured(self, index: int) -> FloatArray:
        """Return the measured channels of an episode, (T, M)."""
        episode, columns = self.episodes[index], list(self.efforts)
        # An effort that was not recorded has no weight.
        effort = np.zeros((len(episode.sample), len(columns)))
        if columns and episode.effort is not None:
            effort = np.nan_to_num(episode.effort[:, columns])
        return np.concatenate([episode.position, episode.velocity, effort], axis=1)[:, self.channels]

    def _reported(self, index: int) -> Mask:
        """Return which channels of an episode were reported, (T, M)."""
        episode = self.episodes[index]
        found = np.ones((len(episode.sample), len(self.channels)), dtype=bool)
        if self.efforts:
            own = found[:, len(self.channels) - len(self.efforts) :]
            own[:] = False if episode.effort is None else np.isfinite(episode.effort[:, list(self.efforts)])
        return found if episode.reported is None else found & episode.reported[:, None]

    def windows(self, length: int, offset: int = 0, *, shorter: bool = True) -> list[WindowData]:
        """Cut all episodes into windows that predict ``length`` samples; none starts before ``offset``.

        Both count samples of the slowest recording. Windows of the others last as long, so they predict more
        samples, H. Beside recordings that hold such a window, a shorter one is one window as a whole, unless
        ``shorter`` is False.

        Raises:
            InsufficientDataError: No episode holds a window.
        """
        found: list[WindowData] = []
        problem, period_s, whole = "", self.period_s, False
        for index, episode in enumerate(self.episodes):
            faster = period_s / episode.period_s
            own, first = round(faster * length), round(faster * offset)
            holds = len(episode.sample) - 1 - first
            if shorter and round(faster * SHORTEST_WINDOW) <= holds < own:
                own = holds
            try:
                windows = cut_windows(episode, own, first, self.latency_range_s[1])
            except InsufficientDataError as err:
                problem = str(err)
                continue
            starts = self.starts[index]
            # A jitter of the sample times does not show in velocities.
            still = np.zeros((len(starts.velocity), self.coordinates + len(self.efforts)))
            speed = np.concatenate([starts.velocity, still], axis=1)
            std = self.noise.std(speed[:, self.channels])
            std = np.where(self._reported(index), std, np.inf)
            mean, spread, counts = self._prior(index, std)
            found.append(
                WindowData(
                    episode=index,
                    windows=windows,
                    measured=self.measured(index)[windows.samples()],
                    std=std[windows.samples()],
                    start_position=starts.position[windows.start],
                    start_velocity=starts.velocity[windows.start],
                    prior_mean=mean[windows.start],
                    prior_std=spread[windows.start],
                    prior_counts=counts,
                )
            )
            whole |= own == round(faster * length)
        if not whole:
            raise InsufficientDataError(
                problem
                or f"no recording holds a window of {length * period_s:.2f} s; record a longer episode"
            )
        return found

    def _prior(self, index: int, std: FloatArray) -> tuple[FloatArray, FloatArray, Mask]:
        """Return the prior of each state: mean and std, (T, 2 C), and which entries count as measurements."""
        episode, C = self.episodes[index], self.coordinates
        T = len(episode.sample)
        weak = np.array([VELOCITY_PRIOR_STD[unit] for unit in self.robot.coordinate_units])
        # The weak prior on velocities has mean zero; it only keeps the inverse finite.
        mean = np.concatenate([episode.position, np.zeros((T, C))], axis=1)
        spread = np.concatenate([np.full((T, C), UNSEEN_STD), np.repeat(weak[None], T, axis=0)], axis=1)
        counts = np.concatenate([np.ones(C, dtype=bool), np.zeros(C, dtype=bool)])
        if episode.estimate_std is not None:
            estimate = np.broadcast_to(episode.estimate_std, (T, 2 * C))
            known = np.isfinite(estimate).all(axis=0)
            states = np.concatenate([episode.position, episode.velocity], axis=1)
            mean[:, known], spread[:, known] = states[:, known], estimate[:, known]
            counts |= known
        states = self.channels[self.channels < 2 * C]
        mean[:, states], spread[:, states] = self.measured(index)[:, : len(states)], std[:, : len(states)]
        counts[states] = True
        return mean, spread, counts

    def predict(
        self,
        theta: FloatArray,
        latency_s: FloatArray,
        data: WindowData,
        position: FloatArray | None = None,
        velocity: FloatArray | None = None,
    ) -> MemberPrediction:
        """Predict windows with N parameter vectors, (N, K), and total latencies, (N,) [s], at least 0.

        Start positions and velocities are (W, C) or (N, W, C); the smoothed ones by default.
        """
        batch = self.batch(len(theta), data.episode)
        batch.set_parameters(theta)
        path = setpoints(batch, self.episodes[data.episode], np.maximum(latency_s, 0.0))
        # Few members leave threads without work, and array code between the steps costs as much for one.
        most = max(self._batches.threads, TOGETHER if batch.stepwise else 1)
        copies = min(most // len(theta), len(data.windows)) if self.robot.base is None else 1
        if copies > 1:
            batch = self.batch(copies * len(theta), data.episode)
            batch.set_parameters(np.tile(theta, (copies, 1)))
        return self.predict_along(batch, path, data, position, velocity)

    def predict_along(
        self,
        batch: ServoBatch,
        path: FloatArray,
        data: WindowData,
        position: FloatArray | None = None,
        velocity: FloatArray | None = None,
        force: FloatArray | None = None,
    ) -> MemberPrediction:
        """Predict windows with members whose parameters are set, along given set-points, (N, S, A).

        ``force`` acts on the coordinates in each device period, (N, W, H * stride, C).
        """
        shape = len(path), len(data.windows), data.windows.length, len(self.efforts)
        effort = np.empty(shape) if self.efforts else None
        x, v = predict_windows(
            batch,
            self.episodes[data.episode],
            data.windows,
            data.start_position if position is None else position,
            data.start_velocity if velocity is None else velocity,
            path,
            force,
            effort,
        )
        C, channels = x.shape[-1], self.channels
        if np.array_equal(channels, np.arange(C)):
            return MemberPrediction(x, x, v)
        speeds = channels[(channels >= C) & (channels < 2 * C)] - C
        parts = [x[..., channels[channels < C]], v[..., speeds], *([] if effort is None else [effort])]
        return MemberPrediction(np.concatenate(parts, axis=-1), x, v)
