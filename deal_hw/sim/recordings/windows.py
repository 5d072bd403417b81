"""Prediction in short windows that restart from given states.

The replay of an unstable robot diverges from its own recording within a second, for any model. Predictions
over windows of some ticks do not. All members of a population predict all windows of an episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.laws.setpoints import delay, slew
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray, IntArray

SENT_MARGIN_S = 0.05
"""Least time between a window and a change of gains or limits before it [s]."""


Sent: TypeAlias = tuple[bytes, bytes, bytes]
"""Gains and limits that a host sends, to compare."""


@dataclass(frozen=True, slots=True)
class Windows:
    """W windows of H samples each.

    Attributes:
        start: Index of each window's start sample, (W,).
        length: Samples H predicted in each window, without the start.
        stride: Device periods from one sample to the next.
    """

    start: IntArray
    length: int
    stride: int

    def __len__(self) -> int:
        return len(self.start)

    def samples(self) -> IntArray:
        """Return the sample indices that are predicted, (W, H)."""
        return np.asarray(self.start[:, None] + 1 + np.arange(self.length))


def cut_windows(episode: SampledEpisode, length: int, first: int = 0, latest_s: float = 0.0) -> Windows:
    """Cut an episode into windows with usable samples and constant gains and limits.

    Args:
        episode: The episode.
        length: Samples a window predicts, H.
        first: First sample that may start a window.
        latest_s: The longest simulated latency [s], for which a change of gains or limits may still act.

    Returns:
        The windows, without gaps, lost frames or changes of gains or effort limit; no sample is used twice.

    Raises:
        InsufficientDataError: There is none.
    """
    stride = episode.stride
    sent = np.concatenate([episode.stiffness, episode.damping, episode.effort_limit], axis=1)
    changed = np.concatenate([[0], np.cumsum(np.any(sent[1:] != sent[:-1], axis=1))])
    last_step = len(changed) - 1
    starts: list[int] = []
    at = first
    while at + length < len(episode.sample):
        span = slice(at, at + length + 1)
        step = episode.sample[span]
        whole = bool(episode.usable[span].all()) and bool((np.diff(step) == stride).all())
        late = max(int(step[0]) - round(max(latest_s, SENT_MARGIN_S) / episode.step_s), 0)
        constant = changed[late] == changed[min(int(step[-1]), last_step)]
        if whole and constant:
            starts.append(at)
            at += length
        else:
            at += 1
    if not starts:
        raise InsufficientDataError(
            f"no window of {length} samples ({length * stride * episode.step_s:.2f} s) without a gap in "
            f"{len(episode.sample)} samples; record a longer episode"
        )
    return Windows(start=np.array(starts, dtype=np.int64), length=length, stride=stride)


def setpoints(
    batch: ServoBatch, episode: SampledEpisode, latency_s: FloatArray, target: FloatArray | None = None
) -> FloatArray:
    """Return each member's set-point over the whole episode, (N, S, A).

    Args:
        batch: The members; their speed limits, command delays and laws apply.
        episode: The episode.
        latency_s: Total latency of each member, (N,) [s].
        target: Targets of each member, (N, S, A); the episode's by default.
    """
    if batch.robot.description.actuation == "motor":
        # Efforts are not slewed; before the first one the motors are off.
        efforts = episode.target[None] if target is None else target
        member = np.zeros(batch.count, dtype=np.int64) if target is None else np.arange(batch.count)
        off = np.zeros((batch.count, efforts.shape[2]))
        late = _delayed(efforts, member, batch.lag_s(latency_s) / episode.step_s, off)
        return _acting(batch, late, off, episode.step_s)
    factors = batch.servo_factor("servo_speed_limit")
    if target is None:
        # Members with the same limit have the same set-point; most spaces have one limit for all.
        factors, member = np.unique(factors, axis=0, return_inverse=True)
        target = episode.target
    else:
        member = np.arange(batch.count)
    rate = factors[:, None] * episode.speed_limit[None] * episode.step_s
    path = slew(np.repeat(episode.start_setpoint[None], len(factors), axis=0), target, rate)
    start = np.repeat(episode.start_setpoint[None], batch.count, axis=0)
    path = _delayed(path, member.ravel(), batch.lag_s(latency_s) / episode.step_s, start)
    return _acting(batch, path, start, episode.step_s)


def _delayed(path: FloatArray, member: IntArray, latency_steps: FloatArray, before: FloatArray) -> FloatArray:
    """Return each member's delayed set-point, (N, S, A); equal ones are computed once.

    Args:
        path: Set-points, (U, S, A).
        member: Row of each member there, (N,).
        latency_steps: Latency of each member, (N,), or of each of its actuators, (N, A).
        before: Set-point of each member before the first step, (N, A).
    """
    each = latency_steps.reshape(len(member), -1)
    of = np.column_stack([member, each, before])
    _, first, same = np.unique(of, axis=0, return_index=True, return_inverse=True)
    return delay(path[member[first]], each[first], before[first])[same.ravel()]


def _acting(batch: ServoBatch, path: FloatArray, start: FloatArray, step_s: float) -> FloatArray:
    """Return what the drives make of commands, (N, S, A), after they have held ``start`` for long."""
    laws = batch.commands
    return laws.act(path, laws.memory(start), step_s)[0] if laws.any else path


def predict_windows(
    batch: ServoBatch,
    episode: SampledEpisode,
    windows: Windows,
    position: FloatArray,
    velocity: FloatArray,
    setpoint: FloatArray,
    force: FloatArray | None = None,
    effort: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Predict all windows with all members.

    Args:
        batch: The members, parameters set. With copies of all of them, which follow, as many windows are
            simulated at once.
        episode: The episode.
        windows: The windows.
        position: Positions at the windows' starts, (W, C) or (N, W, C).
        velocity: Velocities at the windows' starts, (W, C) or (N, W, C).
        setpoint: Set-points of the whole episode, (N, S, A), from :func:`setpoints`.
        force: Forces on the coordinates at the device periods of each window, (N, W, H * stride, C).
        effort: Filled with the efforts that the robot would report at these samples, (N, W, H, E).

    Returns:
        Positions and velocities at the samples after each start, (N, W, H, C) each, around each sample's
        reference orientation; NaN where a member diverged.
    """
    if batch.count > len(setpoint) or batch.engine.windows > 1:
        return _predict_at_once(batch, episode, windows, position, velocity, setpoint, force, effort)
    N, W, H = batch.count, len(windows), windows.length
    C = episode.position.shape[1]
    x = np.broadcast_to(position, (N, W, C))
    v = np.broadcast_to(velocity, (N, W, C))
    out_x, out_v = np.empty((N, W, H, C)), np.empty((N, W, H, C))
    reference = episode.reference
    steps = H * windows.stride
    per_step = episode.step_s / batch.robot.step_s
    repeat = round(per_step)
    sent: Sent | None = None
    for w, start in enumerate(windows.start):
        at = int(episode.sample[start])
        now = _sent(episode, at)
        if now != sent:
            batch.set_sent(episode.stiffness[at], episode.damping[at], episode.effort_limit[at])
            sent = now
        batch.set_state(x[:, w], v[:, w], reference=None if reference is None else reference[start])
        control = setpoint[:, at : at + steps]
        pushed = None if force is None else force[:, w]
        if repeat > 1:
            control = np.repeat(control, repeat, axis=1)
            pushed = None if pushed is None else np.repeat(pushed, repeat, axis=1)
        charts = None if reference is None else reference[start + 1 : start + 1 + H]
        out_x[:, w], out_v[:, w] = batch.advance(control, windows.stride * repeat, charts, pushed)
        if effort is not None:
            effort[:, w] = batch.effort
    return out_x, out_v


def _sent(episode: SampledEpisode, at: int) -> Sent:
    """Return the gains and limits in force at a device period."""
    return episode.stiffness[at].tobytes(), episode.damping[at].tobytes(), episode.effort_limit[at].tobytes()


def _predict_at_once(
    batch: ServoBatch,
    episode: SampledEpisode,
    windows: Windows,
    position: FloatArray,
    velocity: FloatArray,
    setpoint: FloatArray,
    force: FloatArray | None,
    effort: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Predict as :func:`predict_windows`, several windows at once: as the engine takes them, or by copies."""
    N, W, H = len(setpoint), len(windows), windows.length
    C = episode.position.shape[1]
    x, v = np.broadcast_to(position, (N, W, C)), np.broadcast_to(velocity, (N, W, C))
    out_x, out_v = np.empty((N, W, H, C)), np.empty((N, W, H, C))
    copies, reference = batch.count // N, episode.reference
    first = episode.sample[windows.start]
    period = first[:, None] + np.arange(H * windows.stride)
    repeat = round(episode.step_s / batch.robot.step_s)
    for rows in _groups([_sent(episode, int(at)) for at in first], max(copies, batch.engine.windows)):
        at, starts = int(first[rows[0]]), windows.start[rows]
        batch.set_sent(episode.stiffness[at], episode.damping[at], episode.effort_limit[at])
        state = x[:, rows], v[:, rows]
        control = np.repeat(setpoint[:, period[rows]], repeat, axis=2)
        pushed = None if force is None else np.repeat(force[:, rows], repeat, axis=2)
        if copies > 1:
            found = _advance_copies(batch, state, control, windows.stride * repeat, pushed)
        else:
            found = (
                *batch.advance_windows(
                    state,
                    control,
                    windows.stride * repeat,
                    None if reference is None else reference[starts],
                    None if reference is None else reference[starts[:, None] + 1 + np.arange(H)],
                    pushed,
                ),
                batch.effort,
            )
        for out, values in zip((out_x, out_v, effort), found, strict=True):
            if out is not None:
                out[:, rows] = values
    return out_x, out_v


def _advance_copies(
    batch: ServoBatch,
    state: tuple[FloatArray, FloatArray],
    control: FloatArray,
    every: int,
    force: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Simulate each window by another copy of the members; for a fixed base.

    Args:
        batch: The members and their copies.
        state: Positions and velocities at the starts of at most as many windows, (N, G, C) each.
        control: Set-points, (N, G, S, A).
        every: Steps from one sample to the next.
        force: Forces on the coordinates, (N, G, S, C); none by default.

    Returns:
        Positions, velocities and efforts at the samples, (N, G, H, ...) each.
    """
    N, G, steps = control.shape[:3]
    copies = batch.count // N
    # Copies without a window of their own repeat the last one.
    used = np.minimum(np.arange(copies), G - 1)

    def by_copy(values: FloatArray) -> FloatArray:
        # The count is written out: commands of a robot without actuators have no entries to count by.
        return np.moveaxis(values[:, used], 1, 0).reshape(copies * N, *values.shape[2:])

    batch.set_state(by_copy(state[0]), by_copy(state[1]))
    x, v = batch.advance(by_copy(control), every, force=None if force is None else by_copy(force))
    batch.discount((copies - G) * N * steps)

    def by_window(values: FloatArray) -> FloatArray:
        return np.moveaxis(values.reshape(copies, N, *values.shape[1:])[:G], 0, 1)

    return by_window(x), by_window(v), by_window(batch.effort)


def _groups(sent: Sequence[Sent], most: int) -> Iterator[IntArray]:
    """Yield windows with equal gains and limits, at most so many at once, in equal parts."""
    values: dict[Sent, list[int]] = {}
    for window, value in enumerate(sent):
        values.setdefault(value, []).append(window)
    for rows in values.values():
        yield from np.array_split(np.array(rows), -(-len(rows) // most))
