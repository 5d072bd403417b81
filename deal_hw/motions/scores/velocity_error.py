"""How well a robot followed its requested velocity, from the positions of its base; numpy only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.motions.planned_end import ENDING_EVENT
from deal_hw.motions.velocity import AXES
from deal_hw.schema import plain
from deal_hw.types import Event, FloatArray, Trajectory

VELOCITY_EVENT = "velocity"
"""Kind of the event that sets the requested velocity from its time on."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Positions of a base at T times, seen from above.

    Attributes:
        time_s: (T,) [s], growing.
        place: x and y on the floor, (T, 2) [m].
        heading: Angle of the base's x axis, (T,) [rad].
    """

    time_s: FloatArray
    place: FloatArray
    heading: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Wanted:
    """E requested velocities, each valid from its time until the next one's.

    Attributes:
        time_s: (E,) [s], on the track's time.
        velocity: Ahead, left [m/s], turn [rad/s], (E, 3).
        end_s: End of the last one [s].
    """

    time_s: FloatArray
    velocity: FloatArray
    end_s: float


STEP_S: Final = 0.4
"""Velocities are averaged over this time, one step of the gait, within which the base sways [s]."""
EVERY_S: Final = 0.01
"""Time between two comparisons [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityErrorSettings:
    """How velocities are compared.

    Attributes:
        settle_s: Time after a change of the requested velocity that is not judged [s].
    """

    settle_s: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityError:
    """Mean errors of a walk.

    Attributes:
        velocity_m_s: Error of the horizontal velocity, without times of requested standing [m/s].
        yaw_rad_s: Error of the yaw rate in the same times [rad/s].
        seconds: Compared time, without standing [s].
        parts: For each requested velocity (its three numbers): both errors, and the mean velocity ahead, left
        and turning.
    """

    velocity_m_s: float
    yaw_rad_s: float
    seconds: float
    parts: Mapping[str, Sequence[float]]

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = plain(self)
        return values


def velocity_data(velocity: FloatArray) -> dict[str, float]:
    """Return the event data of a requested velocity, (3,)."""
    return dict(zip(AXES, map(float, velocity), strict=True))


def wanted_in(events: Sequence[Event], start_ns: int, seconds: float) -> Wanted | None:
    """Return the requested velocities in a recording's events; None if there are none.

    Args:
        events: The events.
        start_ns: Host time of the recording's time 0 [ns].
        seconds: How long the policy ran, without slowing down [s]; a planned end in the events shortens it.
    """
    noted = [event for event in events if event.kind == VELOCITY_EVENT]
    if not noted:
        return None
    times = np.array([(event.stamp_ns - start_ns) * 1e-9 for event in noted])
    velocity = np.array([[float(event.data[axis]) for axis in AXES] for event in noted])
    # While the robot slows down, no velocity is requested that it should keep.
    ended = [(event.stamp_ns - start_ns) * 1e-9 for event in events if event.kind == ENDING_EVENT]
    return Wanted(times, velocity, min([float(times[0]) + seconds, *ended]))


def wanted_velocity(trajectory: Trajectory) -> Wanted | None:
    """Return a recording's requested velocities, on the time base of ``receive_s``; None for none."""
    start_ns, seconds = trajectory.metadata.get("start_ns", 0), trajectory.metadata.get("seconds", np.inf)
    return wanted_in(trajectory.events, start_ns, seconds)


def velocity_error(
    track: Track, wanted: Wanted, settings: VelocityErrorSettings | None = None
) -> VelocityError | None:
    """Compare the motion of a base with the requested velocities.

    Args:
        track: The motion.
        wanted: The requested velocities.
        settings: How they are compared.

    Returns:
        The errors; None if no requested velocity lasted long enough to be judged.
    """
    settings = settings or VelocityErrorSettings()
    begin = np.arange(track.time_s[0], track.time_s[-1] - STEP_S, EVERY_S)
    turned = np.unwrap(track.heading)

    def at(time_s: FloatArray, values: FloatArray) -> FloatArray:
        return np.interp(time_s, track.time_s, values)

    def change(values: FloatArray) -> FloatArray:
        return np.asarray((at(begin + STEP_S, values) - at(begin, values)) / STEP_S)

    x, y = change(track.place[:, 0]), change(track.place[:, 1])
    middle = at(begin + 0.5 * STEP_S, turned)
    base = np.stack(
        (np.cos(middle) * x + np.sin(middle) * y, np.cos(middle) * y - np.sin(middle) * x, change(turned)),
        axis=1,
    )
    changes = np.flatnonzero(np.any(np.diff(wanted.velocity, axis=0, prepend=np.nan), axis=1))
    starts, asked = wanted.time_s[changes], wanted.velocity[changes]
    part = np.searchsorted(starts, begin, side="right") - 1
    judged = part >= 0
    ends = np.append(starts[1:], wanted.end_s)
    judged &= (begin >= starts[part] + settings.settle_s) & (begin + STEP_S <= ends[part])
    if not judged.any():
        return None
    part, base = part[judged], base[judged]
    off = np.hypot(*(base[:, :2] - asked[part, :2]).T), np.abs(base[:, 2] - asked[part, 2])
    rows = np.column_stack((*off, base))
    names = np.array([",".join(f"{value:g}" for value in asked[k]) for k in range(len(asked))])[part]
    moving = np.any(asked[part] != 0.0, axis=1)
    over = rows[moving].mean(axis=0) if moving.any() else np.full(5, np.nan)
    return VelocityError(
        velocity_m_s=float(over[0]),
        yaw_rad_s=float(over[1]),
        seconds=float(moving.sum() * EVERY_S),
        parts={str(n): rows[names == n].mean(axis=0).round(4).tolist() for n in dict.fromkeys(names)},
    )
