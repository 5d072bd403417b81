"""What a drive makes of its commands before they act; it depends on commands and time, not on the state.

Motors: a dead zone, unlike gains to both sides, a saturation, then a first-order lag of the effort. Servos: a
first-order lag of the set-point, then play. What is not set leaves commands as they are.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deal_hw.sim.laws.setpoints import changes, play
from deal_hw.types import FloatArray

_LAG, _PLAY = 0, 1

NEUTRAL = {"dead_zone": 0.0, "asymmetry": 0.0, "saturation": np.inf, "lag_s": 0.0, "play": 0.0}
"""For each law the value that leaves commands as they are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Filters:
    """How MuJoCo steps the filters of an MJCF, (A,) each: a lag has these properties in the file.

    Attributes:
        lag_s: Time constants in the file [s]; 0 without a filter.
        euler: Whether a step is Euler's (dyntype filter), not exact.
        late: Whether the output acts one step later (no actearly).
        low: Lowest command that is filtered (ctrlrange) [unit of the command].
        high: Highest one.
    """

    lag_s: FloatArray
    euler: npt.NDArray[np.bool_]
    late: npt.NDArray[np.bool_]
    low: FloatArray
    high: FloatArray


@dataclass(slots=True)
class CommandLaws:
    """Laws of the commands of N members; (N, A) each, None where no parameter sets it.

    Attributes:
        dead_zone: Commands up to this size have no effect, and larger ones lose it [unit of the command].
        asymmetry: Share by which positive commands do more and negative ones less [-].
        saturation: Largest size of a command that acts [unit of the command].
        lag_s: Time constant of a first-order lag [s].
        play: Width of the play between an actuator and its joint [rad or m].
        filters: Filters of the MJCF, whose time constants are in ``lag_s``; None without one.
    """

    dead_zone: FloatArray | None = None
    asymmetry: FloatArray | None = None
    saturation: FloatArray | None = None
    lag_s: FloatArray | None = None
    play: FloatArray | None = None
    filters: Filters | None = None

    @property
    def any(self) -> bool:
        """Whether any law is set."""
        return any(getattr(self, law) is not None for law in NEUTRAL)

    def memory(self, command: FloatArray) -> FloatArray:
        """Return the memory (M, 2, A) of drives that have held a command, (M, A), for long."""
        start = self._static(command[:, None])[:, 0]
        return np.stack([start, start], axis=1)

    def act(self, command: FloatArray, memory: FloatArray, step_s: float) -> tuple[FloatArray, FloatArray]:
        """Return what acts, (N, S, A), and the memory after it, (N, 2, A).

        Args:
            command: Command in force at each step, (N, S, A).
            memory: Memory before the first step, (N, 2, A).
            step_s: Length of a step [s].
        """
        out = self._static(command)
        late = out[:, -1]
        if self.lag_s is not None:
            filters, before = self.filters, memory[:, _LAG]
            out = lag(before, out, self.lag_s, step_s, None if filters is None else filters.euler)
            late = out[:, -1]
            if filters is not None and filters.late.any():
                earlier = np.concatenate([before[:, None], out[:, :-1]], axis=1)
                out = np.where(filters.late, earlier, out)
        if self.play is not None:
            out = play(memory[:, _PLAY], out, self.play)
        return out, np.stack([late, out[:, -1]], axis=1)

    def _static(self, command: FloatArray) -> FloatArray:
        if self.filters is not None:
            command = np.clip(command, self.filters.low, self.filters.high)
        if self.dead_zone is not None:
            command = np.sign(command) * np.maximum(np.abs(command) - self.dead_zone[:, None], 0.0)
        if self.asymmetry is not None:
            command = command * (1 + np.sign(command) * self.asymmetry[:, None])
        if self.saturation is not None:
            most = self.saturation[:, None]
            command = np.clip(command, -most, most)
        return command


def lag(
    start: FloatArray,
    command: FloatArray,
    lag_s: FloatArray,
    step_s: float,
    euler: npt.NDArray[np.bool_] | None = None,
) -> FloatArray:
    """Return the output of first-order lags, ``lag_s y' = command - y``, exact for held commands.

    Args:
        start: Output before the first step, (N, A).
        command: Command in force during each step, (N, S, A).
        lag_s: Time constants, (N, A) [s]; 0 passes the command.
        step_s: Length of a step [s].
        euler: Lags with Euler's steps instead of exact ones, (A,); None for none.

    Returns:
        Output at the end of each step, (N, S, A).
    """
    out = np.empty_like(command)
    with np.errstate(divide="ignore"):
        rate = step_s / lag_s
        if euler is not None:
            # What is left after n of Euler's steps is (1 - rate)^n. Lags below one step arrive in it.
            rate = np.where(euler, -np.log1p(-np.minimum(rate, 1.0)), rate)
    now = start
    # A held command is approached along one exponential.
    for begin, end in itertools.pairwise(changes(command.shape[1], command)):
        held = command[:, begin]
        left = np.exp(-rate[:, None] * np.arange(1, end - begin + 1)[:, None])
        out[:, begin:end] = held[:, None] + left * (now - held)[:, None]
        now = out[:, end - 1]
    return out
