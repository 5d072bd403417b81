"""Spikes: one to three samples that jump away and come back, as no joint can.

An encoder that loses a bit, a bus that swaps two answers, or a driver that returns 0 before its first read
leave single samples radians off. A least-squares fit pays more for three of them than for all other samples
together, so they are left out, and it is said which.

The rule needs only the recording. A joint with speed v at most can be v (b - a) / 2 away from both the sample
before, at time a, and the one after, at b. One to three samples are a spike where each of them lies more than
``ratio`` times as far from both, v being the largest of

- the median speed of the samples around, so that chatter near half the sampling rate is no spike;
- the speed from the sample before to the one after, so that a jump for good is none;
- the joint's fastest motion elsewhere in the recording: the largest speed that two steps in a row reach.

Real motion, contacts and quantisation reach a ratio of 1 (18 joints of a real SO-101 and a real Go2, nine
recordings). A joint that hardly moves says nothing of its speed, therefore ``speed`` and ``least``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray, Trajectory

Mask = npt.NDArray[np.bool_]
_TOLD = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class SpikeSettings:
    """What counts as a spike."""

    ratio: float = 5.0
    """So many times farther than the joint's own motion takes it. Real recordings reach 1."""

    speed: Mapping[str, float] = field(default_factory=lambda: {"rad": 10.0, "m": 1.0})
    """A joint may be so fast although the recording does not show it [rad/s or m/s]: twice a hobby servo."""

    least: Mapping[str, float] = field(default_factory=lambda: {"rad": 0.1, "m": 0.01})
    """Smaller jumps stay in, however fast the sampling is [rad or m]: coarse encoders, noise."""

    longest: int = 3
    """Samples of the longest spike."""

    around: int = 6
    """Steps before, and as many after, whose median speed counts."""

    most: float = 0.02
    """Share of samples from which on the recording is refused: that sensor cannot be used."""


DEFAULT_SPIKES = SpikeSettings()


@dataclass(frozen=True, slots=True)
class Spike:
    """A run of samples of one joint that is not to be believed.

    Attributes:
        rows: Its samples.
        joint: Index of the joint.
        size: How far the farthest of them lies off the line between its neighbours [rad or m].
    """

    rows: tuple[int, ...]
    joint: int
    size: float


def find_spikes(
    time_s: FloatArray, position: FloatArray, units: Sequence[str], settings: SpikeSettings = DEFAULT_SPIKES
) -> tuple[Spike, ...]:
    """Return the spikes of a recording, in order of time.

    Args:
        time_s: Stamps, (T,) [s]. Samples with the stamp of the one before are not looked at.
        position: Measured positions, (T, J); samples with one that is not finite are not looked at.
        units: "rad" or "m" of each joint, (J,); joints of a damaged recording with another unit are not
            looked at.
        settings: What counts.
    """
    rows = np.flatnonzero(np.isfinite(time_s) & np.isfinite(position).all(axis=1))
    rows = rows[np.diff(time_s[rows], prepend=-np.inf) > 0]
    if rows.size < 2 * settings.longest + 2:
        return ()
    found = [
        Spike(tuple(int(rows[k]) for k in one.rows), joint, one.size)
        for joint, unit in enumerate(units)
        if unit in settings.least
        for one in _of_joint(time_s[rows], position[rows, joint], unit, settings)
    ]
    return tuple(sorted(found, key=lambda spike: (spike.rows, spike.joint)))


@dataclass(frozen=True, slots=True)
class _Run:
    """Samples that lie off: how far from the line through their neighbours, and the speed that it takes."""

    rows: range
    size: float
    speed: float


def _of_joint(time_s: FloatArray, position: FloatArray, unit: str, settings: SpikeSettings) -> list[_Run]:
    # Mirrored at both ends, so that a first sample that was never read has neighbours on two sides.
    pad = settings.longest
    t = np.pad(time_s, pad, mode="reflect", reflect_type="odd")
    x = np.pad(position, pad, mode="reflect")
    with np.errstate(over="ignore", invalid="ignore"):
        velocity = np.diff(x) / np.diff(t)
        speed = np.abs(velocity)
        runs = [
            run
            for length in range(1, pad + 1)
            for run in _runs(t, x, speed, length, unit, settings)
            if 0 <= run.rows.start - pad and run.rows.stop - pad <= position.size
        ]
        if not runs:
            return []
        onward = np.where(velocity[1:] * velocity[:-1] > 0, np.minimum(speed[1:], speed[:-1]), 0.0)
        for run in runs:
            # Two steps that touch the run: from the one before the step into it on.
            onward[max(run.rows.start - 2, 0) : run.rows.stop] = 0.0
        fastest = float(np.max(onward))
    return [
        _Run(range(run.rows.start - pad, run.rows.stop - pad), run.size, run.speed)
        for run in runs
        if run.speed > settings.ratio * fastest
    ]


def _runs(
    t: FloatArray, x: FloatArray, speed: FloatArray, length: int, unit: str, settings: SpikeSettings
) -> Iterator[_Run]:
    """Yield the runs of so many samples that lie off by what the samples around them do not explain."""
    before, after = x[: -length - 1], x[length + 1 :]
    run = np.stack([x[1 + k : x.size - length + k] for k in range(length)])
    off = np.min(np.minimum(np.abs(run - before), np.abs(run - after)), axis=0)
    half = (t[length + 1 :] - t[: -length - 1]) / 2
    needed = off / half
    through = np.abs(after - before) / (2 * half)
    far = (off > settings.least[unit]) & (needed > settings.speed[unit]) & (needed > settings.ratio * through)
    for at in np.flatnonzero(far):
        beside = (speed[max(at - settings.around, 0) : at], speed[at + length + 1 :][: settings.around])
        if needed[at] > settings.ratio * float(np.median(np.concatenate(beside))):
            share = (t[at + 1 : at + length + 1] - t[at]) / (2 * half[at])
            deviation = run[:, at] - before[at] - share * (after[at] - before[at])
            size = float(deviation[np.argmax(np.abs(deviation))])
            yield _Run(range(at + 1, at + length + 1), size, float(needed[at]))


def describe(spikes: Sequence[Spike], time_s: FloatArray, joints: Sequence[str], units: Sequence[str]) -> str:
    """Return what was found in words: joint, size, time and number of samples of each."""
    told = [
        f"{joints[s.joint]} {s.size:+.3g} {units[s.joint]} at {time_s[s.rows[0]]:.3f} s"
        + (f" ({len(s.rows)} samples)" if len(s.rows) > 1 else "")
        for s in spikes[:_TOLD]
    ]
    more = f" and {len(spikes) - _TOLD} more" if len(spikes) > _TOLD else ""
    return ", ".join(told) + more


def sound(spikes: Sequence[Spike], count: int) -> Mask:
    """Return which of so many samples belong to no spike, (T,)."""
    kept = np.ones(count, dtype=bool)
    kept[[row for spike in spikes for row in spike.rows]] = False
    return kept


def without_spikes(trajectory: Trajectory, settings: SpikeSettings = DEFAULT_SPIKES) -> Trajectory:
    """Return a recording without the samples of spikes, as if they had been lost on the wire."""
    spikes = find_spikes(trajectory.device_s, trajectory.position, position_units(trajectory), settings)
    if not spikes:
        return trajectory
    kept = sound(spikes, trajectory.device_s.size)
    sampled = (
        "receive_s",
        "device_s",
        "position",
        "velocity",
        "effort",
        "status",
        "command_sequence",
        "command_age_s",
    )
    body = trajectory.body
    if body is not None:
        body = dataclasses.replace(
            body, **{f.name: getattr(body, f.name)[kept] for f in dataclasses.fields(body)}
        )
    return dataclasses.replace(
        trajectory, body=body, **{name: getattr(trajectory, name)[kept] for name in sampled}
    )


def position_units(trajectory: Trajectory) -> tuple[str, ...]:
    """Return the unit of each position, "rad" where the recording does not say, (J,)."""
    units = trajectory.metadata.get("description", {}).get("position_units")
    return tuple(units) if units else ("rad",) * len(trajectory.joint_names)
