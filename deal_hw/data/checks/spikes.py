"""Spikes: one to three samples that jump away and come back, faster than the joint can move.

An encoder that loses a bit, a bus that swaps two answers, or a driver that returns 0 before its first read
leave single samples that are wrong by radians. Three of them can change a least-squares fit more than all
other samples together. So they are left out, and reported.

The rule needs only the recording. A joint whose speed is at most v can be at most v (b - a) / 2 away from
both the sample before, at time a, and the one after, at time b. One to three samples are a spike if each is
more than ``ratio`` times as far from both. Here v is the largest of

- the median speed of the samples around, so that oscillation near half the sampling rate is not a spike;
- the speed from the sample before to the one after, so that a permanent jump is not a spike;
- the joint's fastest motion elsewhere in the recording: the largest speed that two steps in a row reach.

Real motion, contacts and quantisation reach a ratio of 1 (18 joints of a real SO-101 and a real Go2, nine
recordings). A joint that hardly moves does not show its speed. Therefore ``speed`` and ``least`` are limits
of their own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.data.table import position_units
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray, Trajectory

Mask = npt.NDArray[np.bool_]
_TOLD = 5


LONGEST: Final = 3
"""Number of samples of the longest spike."""
AROUND: Final = 6
"""Number of steps before, and after, for the median speed."""
MOST: Final = 0.02
"""With a larger share of spikes the recording is refused: that sensor cannot be used."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpikeSettings:
    """Definition of a spike."""

    ratio: float = 5.0
    """Distance from both neighbours, over the largest distance that the joint's own motion reaches; more is a
    spike. Real recordings reach 1."""

    speed: Mapping[str, float] = field(default_factory=lambda: {"rad": 10.0, "m": 1.0})
    """Speed that is always possible, even if the recording does not show it [rad/s or m/s]: twice that of a
    hobby servo."""

    least: Mapping[str, float] = field(default_factory=lambda: {"rad": 0.1, "m": 0.01})
    """Smaller jumps are never spikes, at any sampling rate [rad or m]: coarse encoders, noise."""


DEFAULT_SPIKES = SpikeSettings()


@dataclass(frozen=True, slots=True)
class Spike:
    """Successive samples of one joint that cannot be true.

    Attributes:
        rows: Its samples.
        joint: Index of the joint.
        size: Largest distance of its samples from the line between its neighbours [rad or m].
    """

    rows: tuple[int, ...]
    joint: int
    size: float


def find_spikes(
    time_s: FloatArray, position: FloatArray, units: Sequence[str], settings: SpikeSettings = DEFAULT_SPIKES
) -> tuple[Spike, ...]:
    """Return the spikes of a recording, in order of time.

    Args:
        time_s: Stamps, (T,) [s]. Samples with the stamp of the one before are ignored.
        position: Measured positions, (T, J); samples with one that is not finite are ignored.
        units: "rad" or "m" of each joint, (J,); joints of a damaged recording with another unit are ignored.
        settings: Definition of a spike.
    """
    rows = np.flatnonzero(np.isfinite(time_s) & np.isfinite(position).all(axis=1))
    rows = rows[np.diff(time_s[rows], prepend=-np.inf) > 0]
    if rows.size < 2 * LONGEST + 2:
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
    """Successive suspect samples: distance from the line between their neighbours, and the needed speed."""

    rows: range
    size: float
    speed: float


def _of_joint(time_s: FloatArray, position: FloatArray, unit: str, settings: SpikeSettings) -> list[_Run]:
    # Mirrored at both ends, so that a wrong first sample has neighbours on two sides, too.
    pad = LONGEST
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
            # Pairs of steps that touch the run, from the step before the one into it.
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
    """Yield the runs of a given length whose jump the samples around them do not explain."""
    before, after = x[: -length - 1], x[length + 1 :]
    run = np.stack([x[1 + k : x.size - length + k] for k in range(length)])
    off = np.min(np.minimum(np.abs(run - before), np.abs(run - after)), axis=0)
    half = (t[length + 1 :] - t[: -length - 1]) / 2
    needed = off / half
    through = np.abs(after - before) / (2 * half)
    far = (off > settings.least[unit]) & (needed > settings.speed[unit]) & (needed > settings.ratio * through)
    for at in np.flatnonzero(far):
        beside = (speed[max(at - AROUND, 0) : at], speed[at + length + 1 :][:AROUND])
        if needed[at] > settings.ratio * float(np.median(np.concatenate(beside))):
            share = (t[at + 1 : at + length + 1] - t[at]) / (2 * half[at])
            deviation = run[:, at] - before[at] - share * (after[at] - before[at])
            size = float(deviation[np.argmax(np.abs(deviation))])
            yield _Run(range(at + 1, at + length + 1), size, float(needed[at]))


def describe(spikes: Sequence[Spike], time_s: FloatArray, joints: Sequence[str], units: Sequence[str]) -> str:
    """Return text with joint, size, time and number of samples of each spike."""
    found_lines = [
        f"{joints[s.joint]} {s.size:+.3g} {units[s.joint]} at {time_s[s.rows[0]]:.3f} s"
        + (f" ({len(s.rows)} samples)" if len(s.rows) > 1 else "")
        for s in spikes[:_TOLD]
    ]
    more = f" and {len(spikes) - _TOLD} more" if len(spikes) > _TOLD else ""
    return ", ".join(found_lines) + more


def check_spikes(
    found: Sequence[Spike], time_s: FloatArray, joints: Sequence[str], units: Sequence[str]
) -> Finding:
    """Judge the spikes of a recording; stamps, joints and units as of :func:`find_spikes`."""
    if not found:
        return Finding("spikes", Severity.OK, "no position jumps away and comes back")
    count = len({row for spike in found for row in spike.rows})
    text = (
        f"{count} samples jump and come back, faster than the joint ever moves otherwise: "
        f"{describe(found, time_s, joints, units)}"
    )
    if count > MOST * time_s.size:
        text += f"; that is {count / time_s.size:.1%} of all samples: the sensor or its cable fails."
        return Finding("spikes", Severity.FAIL, text, "Repair it and record again")
    text += ". Calibration leaves them out (--spike-ratio)"
    return Finding("spikes", Severity.WARN, text, "check the sensor and its cable")


def sound(spikes: Sequence[Spike], count: int) -> Mask:
    """Return which samples belong to no spike, (T,)."""
    kept = np.ones(count, dtype=bool)
    kept[[row for spike in spikes for row in spike.rows]] = False
    return kept


def without_spikes(trajectory: Trajectory, settings: SpikeSettings = DEFAULT_SPIKES) -> Trajectory:
    """Return a recording without the samples of spikes."""
    spikes = find_spikes(trajectory.device_s, trajectory.position, position_units(trajectory), settings)
    return with_samples(trajectory, sound(spikes, trajectory.device_s.size))


def with_samples(trajectory: Trajectory, kept: Mask) -> Trajectory:
    """Return a recording with these samples only, (T,), as if the others had been lost on the wire."""
    if kept.all():
        return trajectory
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
