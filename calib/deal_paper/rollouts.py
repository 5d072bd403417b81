"""The paper's view of a population: each member's rollout as transitions (s, a, s') at the control rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.innovations import Members, early_setpoints
from deal_hw.calib.data.problem import Problem
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import ClosedLoop, on_physics_steps
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_quaternion, to_vector
from deal_hw.sim.recordings.episode import Episode
from deal_hw.types import FloatArray, IntArray

PopulationPolicy = Callable[[FloatArray, FloatArray, int], FloatArray]
"""pi_0 in the loop: position (N, J), velocity (N, J), tick -> position target (N, A)."""


@dataclass(frozen=True, slots=True)
class Ticks:
    """The control periods of one episode.

    Attributes:
        start: Grid index at which each tick starts, (T + 1,); the last one ends the last tick.
        sample: Index of the state sample at each of them, (T + 1,).
        changes: Ticks at which what is sent (gains, limits) differs from the tick before; starts with 0.
    """

    start: IntArray
    sample: IntArray
    changes: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def action(self) -> IntArray:
        """Grid index at which each tick's action is read, (T,): commands arrive some periods into a tick."""
        return np.asarray((self.start[:-1] + self.start[1:]) // 2)


def control_ticks(problem: Problem, index: int, most: int | None = None) -> Ticks:
    """Divide an episode into control periods, from its first usable sample to the first gap.

    Args:
        problem: Gives the episodes and the control rate.
        index: Which episode.
        most: Most ticks to return.

    Raises:
        InsufficientDataError: There are fewer than two ticks.
    """
    episode, description = problem.episodes[index], problem.robot.description
    period = round(1.0 / (description.control_rate_hz * episode.step_s))
    first = int(np.argmax(episode.usable))
    row_of = {int(s): i for i, s in enumerate(episode.sample)}
    start, sample = [], []
    at = int(episode.sample[first])
    last_usable = first
    while at <= episode.steps and at in row_of:
        row = row_of[at]
        if not episode.usable[last_usable : row + 1].all():
            break
        start.append(at)
        sample.append(row)
        last_usable = row
        at += period
        if most is not None and len(start) > most:
            break
    if len(start) < 3:
        raise InsufficientDataError(
            f"episode {index} has {max(len(start) - 1, 0)} whole control periods; a rollout needs 2 or more"
        )
    sent = np.concatenate([episode.stiffness, episode.damping, episode.effort_limit], axis=1)[start[:-1]]
    changes = [0, *(np.flatnonzero(np.any(sent[1:] != sent[:-1], axis=1)) + 1).tolist()]
    return Ticks(np.array(start), np.array(sample), tuple(changes))


def _send(batch: ServoBatch, episode: Episode, at: int) -> None:
    batch.set_sent(episode.stiffness[at], episode.damping[at], episode.effort_limit[at])


def rollout_population(
    problem: Problem,
    members: Members,
    index: int,
    ticks: Ticks,
    policy: PopulationPolicy | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roll all members out from the recording's initial state (Algorithm 1, line 3).

    Without a policy the recorded targets are sent: pi_0's actions on the robot. Closed loop needs pi_0
    itself.

    Args:
        problem: Data and simulator; its physics step may be longer than the device's period.
        members: The N simulators.
        index: Which episode.
        ticks: Its control periods.
        policy: pi_0, or None.

    Returns:
        Positions and velocities at the ticks, (N, T + 1, J) each, and the action of each tick, (N, T, A).
        Members that diverged are NaN from there on.
    """
    episode = problem.episodes[index]
    batch = problem.batch(len(members.theta))
    batch.set_parameters(members.theta)
    starts, first = problem.starts[index], int(ticks.sample[0])
    batch.set_state(
        starts.position[first],
        starts.velocity[first],
        reference=None if episode.reference is None else episode.reference[first],
    )
    if policy is None:
        return _replay(batch, episode, members, ticks)
    return _closed_loop(batch, episode, members, ticks, policy)


def _replay(
    batch: ServoBatch, episode: Episode, members: Members, ticks: Ticks
) -> tuple[FloatArray, FloatArray, FloatArray]:
    path = early_setpoints(batch, episode, members.latency_s)
    N, T, J = batch.count, len(ticks), episode.position.shape[1]
    position, velocity = np.empty((N, T + 1, J)), np.empty((N, T + 1, J))
    position[:, 0], velocity[:, 0] = batch.position, batch.velocity
    every = round((ticks.start[1] - ticks.start[0]) * episode.step_s / batch.robot.step_s)
    for begin, end in zip(ticks.changes, (*ticks.changes[1:], T), strict=True):
        _send(batch, episode, int(ticks.start[begin]))
        control = on_physics_steps(batch, path[:, ticks.start[begin] : ticks.start[end]], episode.step_s)
        moved = batch.advance(control, every)
        position[:, begin + 1 : end + 1], velocity[:, begin + 1 : end + 1] = moved
        # `advance` sees a divergence only in the stretch in which it happens.
        bad = ~np.isfinite(position[:, begin]).all(axis=1)
        position[bad, begin + 1 :], velocity[bad, begin + 1 :] = np.nan, np.nan
    action = np.broadcast_to(episode.target[ticks.action], (N, T, episode.target.shape[1]))
    return position, velocity, action


def _closed_loop(
    batch: ServoBatch, episode: Episode, members: Members, ticks: Ticks, policy: PopulationPolicy
) -> tuple[FloatArray, FloatArray, FloatArray]:
    N, T, J = batch.count, len(ticks), episode.position.shape[1]
    A = episode.target.shape[1]
    position, velocity = np.empty((N, T + 1, J)), np.empty((N, T + 1, J))
    action = np.empty((N, T, A))
    position[:, 0], velocity[:, 0] = batch.position, batch.velocity
    period = int(ticks.start[1] - ticks.start[0])
    loop = ClosedLoop(batch, period, episode.step_s)
    loop.restart(np.repeat(episode.start_setpoint[None], N, axis=0), members.latency_s)
    speed = batch.servo_factor("servo_speed_limit") * episode.step_s
    for t in range(T):
        at = int(ticks.start[t])
        if t in ticks.changes:
            _send(batch, episode, at)
        action[:, t] = policy(position[:, t], velocity[:, t], t)
        rate = speed[:, None] * episode.speed_limit[None, at : at + period]
        moved = loop.advance(action[:, t], rate)
        position[:, t + 1], velocity[:, t + 1] = moved[0][:, 0], moved[1][:, 0]
        bad = ~np.isfinite(position[:, t]).all(axis=1)
        position[bad, t + 1], velocity[bad, t + 1] = np.nan, np.nan
    return position, velocity, action


@dataclass(frozen=True, slots=True)
class TransitionScale:
    """Standardises transitions by the recording's statistics.

    The paper feeds (s, a, s'). This feeds (s, a, s' - s), each with mean 0 and variance 1 over the recording:
    the same information in coordinates in which a first layer can see the change at all, as s and s' differ
    by a hundredth of their range. The paper says nothing of input scaling.

    Attributes:
        mean: (2 J + A + 2 J,).
        std: Likewise.
        limit: Standardised inputs are cut to this. A member whose pole spins would own the critic's output,
            and with it the softmax.
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


def transitions(position: FloatArray, velocity: FloatArray, action: FloatArray) -> npt.NDArray[np.float32]:
    """Return (s, a, s' - s) of rollouts, (N, T, 2 J + A + 2 J), not yet standardised.

    Args:
        position: (N, T + 1, J).
        velocity: (N, T + 1, J).
        action: (N, T, A).
    """
    N, T, A = action.shape
    J = position.shape[2]
    out = np.empty((N, T, 4 * J + A), dtype=np.float32)
    out[..., :J], out[..., J : 2 * J] = position[:, :-1], velocity[:, :-1]
    out[..., 2 * J : 2 * J + A] = action
    out[..., 2 * J + A : 3 * J + A] = np.diff(position, axis=1)
    out[..., 3 * J + A :] = np.diff(velocity, axis=1)
    return out


def demonstration(problem: Problem, index: int, ticks: Ticks) -> npt.NDArray[np.float32]:
    """Return the recording's own transitions D_T, (T, inputs), not yet standardised.

    Noisy positions are smoothed first (:func:`deal_hw.calib.data.noise.smooth_states`), which helps the
    paper's method.
    """
    starts, episode = problem.starts[index], problem.episodes[index]
    position, velocity = starts.position[ticks.sample].copy(), starts.velocity[ticks.sample]
    if episode.reference is not None:
        # A rollout is far from the recording: both are put in one chart, that of the identity.
        turned = to_quaternion(position[:, problem.robot.rotation], episode.reference[ticks.sample])
        position[:, problem.robot.rotation] = to_vector(turned, IDENTITY)
    return np.asarray(transitions(position[None], velocity[None], episode.target[ticks.action][None])[0])
