"""The paper's view of a population: each member's rollout as transitions (s, a, s') at the control rate."""

from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.innovations import Members, early_setpoints
from deal_hw.calib.data.population_policy import PopulationPolicy
from deal_hw.calib.data.problem import Problem
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import ClosedLoop, on_physics_steps
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_quaternion, to_vector
from deal_hw.sim.laws.setpoints import slew
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Ticks:
    """The control periods of one episode.

    Attributes:
        start: Grid index at which each tick starts, (T + 1,); the last one ends the last tick.
        sample: Index of the state sample at each of them, (T + 1,).
        changes: Ticks whose gains or limits differ from the tick before; starts with 0.
        lead: Device periods from the start of a tick, whose state the controller saw, to its command's
            effect.
        number: Commands of the recording before the first tick's.
        past: Index of the state sample at the start of each of the last ticks before the first, (h,).
    """

    start: IntArray
    sample: IntArray
    changes: tuple[int, ...]
    lead: int
    number: int
    past: IntArray

    def __len__(self) -> int:
        return len(self.start) - 1

    def part(self, first: int, length: int, history: int) -> Ticks:
        """Return ``length`` ticks from number ``first`` on, with at most ``history`` past ticks."""
        end = first + length
        known = np.concatenate([self.past, self.sample[:first]])
        return Ticks(
            self.start[first : end + 1],
            self.sample[first : end + 1],
            (0, *(tick - first for tick in self.changes if first < tick < end)),
            self.lead,
            self.number + first,
            known[max(len(known) - history, 0) :],
        )

    @property
    def action(self) -> IntArray:
        """Grid index at which each tick's action is read, (T,)."""
        return np.asarray(self.lead + (self.start[:-1] + self.start[1:]) // 2)

    @property
    def past_action(self) -> IntArray:
        """Grid index at which the action of each past tick is read, (h,)."""
        period = self.start[1] - self.start[0]
        return np.asarray(self.action[0] + period * np.arange(-len(self.past), 0))


def control_ticks(
    problem: Problem, index: int, most: int | None = None, history: int = 0, *, ran_before: bool = False
) -> Ticks:
    """Divide an episode into control periods, from its first usable sample to the first gap.

    A tick starts at the newest state that the controller can have seen: the last sample before its command
    acts. At most ``most`` ticks are returned. If the first usable sample comes after the policy's first
    command, ``history`` ticks are left out, so that the policy's past is known. With ``ran_before`` it does
    in any case.

    Raises:
        InsufficientDataError: There are fewer than two ticks.
    """
    episode, description = problem.episodes[index], problem.robot.description
    period = round(1.0 / (description.control_rate_hz * episode.step_s))
    row_of = {int(s): i for i, s in enumerate(episode.sample)}
    first = int(np.argmax(episode.usable))
    # Commands come once per period, at the phase at which most of them change the target.
    changed = np.flatnonzero(np.any(episode.target[1:] != episode.target[:-1], axis=1)) + 1
    phase = int(np.bincount(changed % period, minlength=period).argmax())
    lead = int((phase - episode.sample[first]) % episode.stride)
    at = int(episode.sample[first])
    at += (phase - lead - at) % period
    number = (at + lead - phase) // period
    start, sample = [], []
    last_usable = first
    skip = history if number > 0 or ran_before else 0
    while at <= episode.steps and at in row_of:
        row = row_of[at]
        if not episode.usable[last_usable : row + 1].all():
            break
        start.append(at)
        sample.append(row)
        last_usable = row
        at += period
        if most is not None and len(start) > most + skip:
            break
    if len(start) < 3 + skip:
        raise InsufficientDataError(
            f"episode {index} has {max(len(start) - 1, 0)} whole control periods, a rollout needs at least "
            f"{2 + skip}; record longer"
        )
    past, start, sample = sample[:skip], start[skip:], sample[skip:]
    sent = np.concatenate([episode.stiffness, episode.damping, episode.effort_limit], axis=1)
    sent = sent[np.array(start[:-1]) + lead]
    changes = [0, *(np.flatnonzero(np.any(sent[1:] != sent[:-1], axis=1)) + 1).tolist()]
    return Ticks(
        np.array(start), np.array(sample), tuple(changes), lead, number + skip, np.array(past, dtype=int)
    )


def drawn_ticks(
    problem: Problem,
    index: int,
    most: int,
    length: int,
    rng: np.random.Generator,
    history: int = 0,
    *,
    ran_before: bool = False,
) -> list[Ticks]:
    """Draw parts of ``length`` control periods from an episode, ``most`` periods in all, each with its past.

    One begins in each of as many equal stretches of the episode, anywhere in it. Errors and the other
    arguments are those of :func:`control_ticks`.
    """
    whole = control_ticks(problem, index, None, history, ran_before=ran_before)
    length = min(length, len(whole))
    count = max(round(min(most, len(whole)) / length), 1)
    edges = np.linspace(0, len(whole) - length + 1, count + 1)
    begins = (edges[:-1] + rng.random(count) * np.diff(edges)).astype(int)
    return [whole.part(int(begin), length, history) for begin in begins]


def _send(batch: ServoBatch, episode: SampledEpisode, at: int) -> None:
    batch.set_sent(episode.stiffness[at], episode.damping[at], episode.effort_limit[at])


def rollout_population(
    problem: Problem,
    members: Members,
    index: int,
    ticks: Ticks,
    *,
    replay: bool = False,
    moved: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roll all members out from the recording's initial state (Algorithm 1, line 3).

    With ``replay``, members get the recorded targets, pi_0's actions on the robot, instead of pi_0's new
    ones. ``moved`` is added to the start (position, velocity) of each member, (N, 2 C). The physics step may
    be longer than the device's period.

    Returns:
        Positions and velocities at the ticks, (N, T + 1, J) each, and the action of each tick, (N, T, A).
        Members that diverged are NaN from there on.

    Raises:
        InsufficientDataError: As :func:`policy_of`.
    """
    batches = problem.batches(len(members.theta), index)
    ends = np.cumsum([batch.count for batch in batches])

    def roll(batch: ServoBatch, end: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        mine = slice(end - batch.count, end)
        part = Members(members.theta[mine], members.latency_s[mine])
        own = None if moved is None else moved[mine]
        return _roll(problem, batch, part, index, ticks, own, replay=replay)

    if len(batches) == 1:
        return roll(batches[0], len(members.theta))
    with ThreadPoolExecutor(len(batches)) as pool:
        parts = list(pool.map(roll, batches, ends))
    position, velocity, action = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return position, velocity, action


def _roll(
    problem: Problem,
    batch: ServoBatch,
    members: Members,
    index: int,
    ticks: Ticks,
    moved: FloatArray | None,
    *,
    replay: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    episode = problem.episodes[index]
    batch.set_parameters(members.theta)
    starts, first = problem.starts[index], int(ticks.sample[0])
    position, velocity = starts.position[first], starts.velocity[first]
    if moved is not None:
        C = len(position)
        position, velocity = position + moved[:, :C], velocity + moved[:, C:]
    batch.set_state(
        position,
        velocity,
        reference=None if episode.reference is None else episode.reference[first],
    )
    if replay:
        return _replay(batch, episode, members, ticks)
    policy = copy.copy(policy_of(problem))
    seen = recorded_states(problem, index, ticks.past)
    policy.restart(batch.count, *seen, episode.target[ticks.past_action], ticks.number)
    return _closed_loop(batch, episode, members, ticks, policy)


def policy_of(problem: Problem) -> PopulationPolicy:
    """Return the policy that produced all commands of the recordings.

    Raises:
        InsufficientDataError: It is not known, or no policy did.
    """
    if problem.policy is None:
        raise InsufficientDataError(
            "a rollout in closed loop needs the policy that produced all commands of the recordings, and it "
            "is not known; record with `deal-hw collect --motion balance`, or use a method that needs no "
            "policy: eki, deal, deal-paper-replay"
        )
    return problem.policy


def _replay(
    batch: ServoBatch, episode: SampledEpisode, members: Members, ticks: Ticks
) -> tuple[FloatArray, FloatArray, FloatArray]:
    path = early_setpoints(batch, episode, members.latency_s)
    N, T, J = batch.count, len(ticks), episode.position.shape[1]
    position, velocity = np.empty((N, T + 1, J)), np.empty((N, T + 1, J))
    position[:, 0], velocity[:, 0] = batch.position, batch.velocity
    every = round((ticks.start[1] - ticks.start[0]) * episode.step_s / batch.robot.step_s)
    for begin, end in zip(ticks.changes, (*ticks.changes[1:], T), strict=True):
        _send(batch, episode, int(ticks.start[begin]) + ticks.lead)
        control = on_physics_steps(batch, path[:, ticks.start[begin] : ticks.start[end]], episode.step_s)
        moved = batch.advance(control, every)
        position[:, begin + 1 : end + 1], velocity[:, begin + 1 : end + 1] = moved
        # `advance` reports a divergence only in the stretch in which it happens.
        bad = ~np.isfinite(position[:, begin]).all(axis=1)
        position[bad, begin + 1 :], velocity[bad, begin + 1 :] = np.nan, np.nan
    action = np.broadcast_to(episode.target[ticks.action], (N, T, episode.target.shape[1]))
    return position, velocity, action


def _closed_loop(
    batch: ServoBatch, episode: SampledEpisode, members: Members, ticks: Ticks, policy: PopulationPolicy
) -> tuple[FloatArray, FloatArray, FloatArray]:
    N, T, J = batch.count, len(ticks), episode.position.shape[1]
    A, lead, first = episode.target.shape[1], ticks.lead, int(ticks.start[0])
    position, velocity = np.empty((N, T + 1, J)), np.empty((N, T + 1, J))
    action = np.empty((N, T, A))
    position[:, 0], velocity[:, 0] = batch.position, batch.velocity
    period = int(ticks.start[1] - ticks.start[0])
    speed = batch.servo_factor("servo_speed_limit") * episode.step_s
    loop = ClosedLoop(batch, period, episode.step_s)
    setpoint = np.repeat(episode.start_setpoint[None], N, axis=0)
    sent = setpoint
    if first + lead > 0:
        sent = np.repeat(episode.target[first + lead - 1][None], N, axis=0)
    if first > 0:
        rate = speed[:, None] * episode.speed_limit[None, :first]
        setpoint = slew(setpoint, episode.target[:first], rate)[:, -1]
    loop.restart(setpoint, members.latency_s)
    for t in range(T):
        at = int(ticks.start[t])
        if t in ticks.changes:
            _send(batch, episode, at + lead)
        action[:, t] = policy(position[:, t], velocity[:, t])
        target = np.repeat(action[:, t, None], period, axis=1)
        target[:, :lead] = sent[:, None]
        sent = action[:, t]
        rate = speed[:, None] * episode.speed_limit[None, at : at + period]
        moved = loop.advance(target, rate)
        position[:, t + 1], velocity[:, t + 1] = moved[0][:, 0], moved[1][:, 0]
        bad = ~np.isfinite(position[:, t]).all(axis=1)
        position[bad, t + 1], velocity[bad, t + 1] = np.nan, np.nan
    return position, velocity, action


@dataclass(frozen=True, slots=True)
class TransitionScale:
    """Standardises transitions by the recording's statistics.

    Attributes:
        mean: (2 J + A + 2 J,).
        std: Likewise.
        limit: Standardised inputs are cut at this. Otherwise a member whose pole spins dominates the critic's
            output, and with it the softmax.
    """

    mean: FloatArray
    std: FloatArray
    limit: float = 5.0

    @classmethod
    def of(cls, raw: FloatArray) -> TransitionScale:
        """Return the scale of raw transitions, (n, inputs)."""
        return cls(raw.mean(axis=0), np.maximum(raw.std(axis=0), 1e-9))

    def apply(self, raw: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Standardise in place, (..., inputs)."""
        raw -= self.mean.astype(np.float32)
        raw *= (1.0 / self.std).astype(np.float32)
        np.clip(raw, -self.limit, self.limit, out=raw)
        return raw


def transitions(
    position: FloatArray, velocity: FloatArray, action: FloatArray, *, difference: bool = False
) -> npt.NDArray[np.float32]:
    """Return (s, a, s') of rollouts, (N, T, 2 J + A + 2 J), not yet standardised; or (s, a, s' - s).

    Positions and velocities are (N, T + 1, J), actions (N, T, A).
    """
    state = np.concatenate([position, velocity], axis=2)
    after = np.diff(state, axis=1) if difference else state[:, 1:]
    return np.concatenate([state[:, :-1], action, after], axis=2, dtype=np.float32)


def demonstration(
    problem: Problem, index: int, ticks: Ticks, *, difference: bool = False
) -> npt.NDArray[np.float32]:
    """Return the recording's own transitions D_T, (T, inputs), as :func:`transitions` does.

    Noisy positions are smoothed first (:func:`deal_hw.calib.data.noise.smooth_states`), which helps the
    paper's method.
    """
    position, velocity = recorded_states(problem, index, ticks.sample)
    action = problem.episodes[index].target[ticks.action]
    seen = transitions(position[None], velocity[None], action[None], difference=difference)
    return np.asarray(seen[0])


def recorded_states(problem: Problem, index: int, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return smoothed positions and velocities of an episode's samples, (n, C) each.

    A rollout is far from the recording, so orientations of both are relative to the identity.
    """
    starts, episode = problem.starts[index], problem.episodes[index]
    position, velocity = starts.position[rows].copy(), starts.velocity[rows]
    if episode.reference is not None:
        turned = to_quaternion(position[:, problem.robot.rotation], episode.reference[rows])
        position[:, problem.robot.rotation] = to_vector(turned, IDENTITY)
    return position, velocity
