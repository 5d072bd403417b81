"""Sources of a walking policy's requested velocity: fixed, a script, the robot's remote, a keyboard."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.motions.time_script import read_script
from deal_hw.rotations import heading
from deal_hw.types import FloatArray, RobotState

AXES = ("x", "y", "yaw")
LARGEST = (1.0, 0.5, 1.0)
"""Largest velocity of remote and keyboard, and that of every policy: ahead, to the left [m/s], turning left
[rad/s]."""
FASTEST = (1.5, 0.5, 1.0)
"""Largest velocity of numbers and scripts. More than :data:`LARGEST` is only for a policy that was trained
for it: :func:`check_fast`."""
HEADING_GAIN = 2.0
"""Correction of the yaw rate by :class:`HeldHeading`, for an error of the heading [1/s].

With 1, 2 and 4 an early canter's heading was 0.15, 0.11 and 0.10 rad off after 5 m (median of five emulated
robots)."""
HEADING_TURN = 0.5
"""Its largest correction [rad/s]: that of the slowest training range of the shipped policies."""
KEY_LIFE_S = 0.6
"""How long a key counts after its last press [s]; longer than the delay before a terminal repeats a key."""
KEYS = {
    "w": (0.5, 0.0, 0.0),
    "s": (-0.5, 0.0, 0.0),
    "a": (0.0, 0.3, 0.0),
    "d": (0.0, -0.3, 0.0),
    "q": (0.0, 0.0, 0.6),
    "e": (0.0, 0.0, -0.6),
    " ": (0.0, 0.0, 0.0),
}
"""Keys and the velocities that they request while held."""
END_KEY = "p"
"""Ends the run as planned: the robot comes to a stand and lies down."""
_DEAD_ZONE = 0.05


class VelocitySource(Protocol):
    """A source of the base's requested velocity."""

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the requested velocity in the base's frame: ahead, left [m/s], turn [rad/s], (3,)."""
        ...


class BoundedSource(VelocitySource, Protocol):
    """A source with known bounds."""

    def reach(self) -> FloatArray:
        """Return the lowest and the highest velocity that it may request, (2, 3)."""
        ...


class FixedVelocity:
    """One velocity all the time.

    Raises:
        ConfigurationError: It is not finite or too fast.
    """

    def __init__(self, velocity: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        self._velocity = _checked(velocity, "the velocity")

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity."""
        return self._velocity

    def reach(self) -> FloatArray:
        """Return this velocity as lowest and highest, (2, 3)."""
        return np.stack([self._velocity, self._velocity])


class ScriptVelocity:
    """Velocities from a CSV file with columns time_s, x, y, yaw; each is valid until the next line's.

    Raises:
        ConfigurationError: The file cannot be read, or a line is wrong; the message names the line.
    """

    def __init__(self, path: Path) -> None:
        lines = read_script(path, AXES)
        for number, row in lines:
            _checked(row[1:], f"{path}: line {number}")
        rows = np.array([row for _, row in lines])
        self._time_s, self._velocity = rows[:, 0], rows[:, 1:]

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity of the last line up to this time; zero before the first."""
        row = int(np.searchsorted(self._time_s, time_s, side="right")) - 1
        return self._velocity[row] if row >= 0 else np.zeros(3)

    def reach(self) -> FloatArray:
        """Return the lowest and highest velocity of its lines, (2, 3)."""
        return np.stack([self._velocity.min(axis=0), self._velocity.max(axis=0)])


class RemoteVelocity:
    """The sticks of the robot's own remote: left for ahead and sideways, right for turning.

    Without a remote the requested velocity is zero.
    """

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity that the sticks request."""
        body = state.body
        if body is None or body.buttons < 0 or not np.isfinite(body.sticks).all():
            return np.zeros(3)
        left_x, left_y, right_x, _ = np.clip(body.sticks, -1.0, 1.0)
        wish = np.array([left_y, -left_x, -right_x])
        return np.asarray(np.where(np.abs(wish) < _DEAD_ZONE, 0.0, wish) * LARGEST)

    def reach(self) -> FloatArray:
        """Return the velocities at the sticks' ends, (2, 3)."""
        return np.outer([-1.0, 1.0], LARGEST)


@dataclass(slots=True)
class KeyboardVelocity:
    """Keys held on the operator's terminal; a released key counts for :data:`KEY_LIFE_S`.

    The terminal belongs to another process, which passes keys on: :meth:`press`. Keys pressed before the
    first request for a velocity, such as while the robot stood up, do not count.
    """

    _wish: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _since_s: float = -math.inf
    _now_s: float = -math.inf

    def press(self, key: str) -> None:
        """Note a pressed or repeating key; unknown keys are ignored."""
        if key in KEYS:
            self._wish, self._since_s = KEYS[key], self._now_s

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity of the last key while it counts."""
        self._now_s = time_s
        return np.array(self._wish if time_s - self._since_s <= KEY_LIFE_S else (0.0, 0.0, 0.0))

    def reach(self) -> FloatArray:
        """Return the lowest and highest velocity of the keys, (2, 3)."""
        keys = np.array(list(KEYS.values()))
        return np.stack([keys.min(axis=0), keys.max(axis=0)])


class SlowedVelocity:
    """A source that can be slowed to zero for good.

    Args:
        source: The source; it is not asked any more once it is slowed.
    """

    def __init__(self, source: VelocitySource) -> None:
        self._source = source
        self._last: FloatArray = np.zeros(3)
        self._begin_s, self._seconds = math.inf, 1.0

    def slow(self, time_s: float, seconds: float) -> None:
        """Go from the last velocity to zero, evenly.

        Args:
            time_s: When this begins, on the source's time [s].
            seconds: Its duration [s].
        """
        self._begin_s, self._seconds = time_s, seconds

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the source's velocity, or what is left of the last one."""
        if time_s < self._begin_s:
            self._last = self._source.velocity(state, time_s)
            return self._last
        return self._last * max(0.0, 1.0 - (time_s - self._begin_s) / self._seconds)


class HeldHeading:
    """A source whose turn keeps the base on the heading that its yaw rates add up to.

    A policy that follows a yaw rate with a small error turns away in a minute: it does not observe where it
    looks. The heading is that of the robot's own inertial sensor, and begins where the robot first moves.
    While the source requests standing, the robot may be turned by hand.

    Args:
        source: The source.
        gain: Correction of the yaw rate for an error of the heading [1/s].
    """

    def __init__(self, source: VelocitySource, gain: float = HEADING_GAIN) -> None:
        self._source, self._gain = source, gain
        self._wanted: float | None = None
        self._last_s = 0.0

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the source's velocity with a corrected yaw rate; unchanged without an inertial sensor."""
        wish = self._source.velocity(state, time_s)
        passed_s, self._last_s = time_s - self._last_s, time_s
        if state.body is None or not wish.any() or not np.isfinite(state.body.orientation).all():
            self._wanted = None
            return wish
        now = float(heading(state.body.orientation))
        if self._wanted is None:
            self._wanted = now
        else:
            self._wanted += float(wish[2]) * passed_s
        error = math.remainder(self._wanted - now, 2.0 * math.pi)
        correction = float(np.clip(self._gain * error, -HEADING_TURN, HEADING_TURN))
        turn = float(np.clip(wish[2] + correction, -FASTEST[2], FASTEST[2]))
        return np.array([wish[0], wish[1], turn])


class NotedVelocity:
    """A source whose changes are reported.

    Args:
        source: The source.
        note: Called with each velocity that differs from the one before, (3,).
    """

    def __init__(self, source: VelocitySource, note: Callable[[FloatArray], None]) -> None:
        self._source, self._note = source, note
        self._last: FloatArray | None = None

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the source's velocity."""
        wanted = self._source.velocity(state, time_s)
        if self._last is None or not np.array_equal(wanted, self._last):
            self._last = wanted
            self._note(wanted)
        return wanted


def limited_axes(source: BoundedSource, command_range: Sequence[tuple[float, float]]) -> list[str]:
    """Return a text for each axis of a source that a policy's range limits.

    Args:
        source: The source.
        command_range: Lowest and highest velocity in the policy's training, for each axis; () for no limit.
    """
    asked = source.reach().T
    return [
        f"{axis} {low:g}{f' to {high:g}' if high > low else ''}, limited to {least:g} to {most:g}"
        for axis, (low, high), (least, most) in zip(AXES, asked, command_range or (), strict=False)
        if low < least or high > most
    ]


def check_fast(source: BoundedSource, command_range: Sequence[tuple[float, float]]) -> None:
    """Check that a policy was trained for the velocities of a source beyond :data:`LARGEST`.

    Args:
        source: The source.
        command_range: Lowest and highest velocity in the policy's training, for each axis; () if not known.

    Raises:
        ConfigurationError: It was not, or that is not known.
    """
    trained = command_range or [(-most, most) for most in LARGEST]
    for axis, (low, high), (least, most), usual in zip(AXES, source.reach().T, trained, LARGEST, strict=True):
        slowest, fastest = min(least, -usual), max(most, usual)
        if low < slowest or high > fastest:
            raise ConfigurationError(
                f"the requested velocity is up to {max(high, -low):g} in {axis}, and the policy was trained "
                f"for {least:g} to {most:g}; allowed with it: {slowest:g} to {fastest:g}"
            )


def make_source(text: str) -> BoundedSource:
    """Return the source that an option names.

    Args:
        text: "remote", "keyboard", three numbers "x,y,yaw", or the path of a script (.csv).

    Raises:
        ConfigurationError: It is none of these.
    """
    if text == "remote":
        return RemoteVelocity()
    if text == "keyboard":
        return KeyboardVelocity()
    if text.endswith(".csv"):
        return ScriptVelocity(Path(text))
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len(AXES):
        raise ConfigurationError(
            f"--velocity {text!r}: give x,y,yaw [m/s, m/s, rad/s] such as 0.3,0,0, or remote, keyboard, or a "
            "CSV file with the columns time_s,x,y,yaw"
        )
    return FixedVelocity(numbers)


def _checked(values: Sequence[float], where: str) -> FloatArray:
    for axis, value, most in zip(AXES, values, FASTEST, strict=True):
        if not abs(value) <= most:
            raise ConfigurationError(f"{where}: {axis} is {value!r}, allowed: -{most:g} to {most:g}")
    return np.array(values, dtype=float)
