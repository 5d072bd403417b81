"""Coordinates in which the searches move: a problem's parameters and, where it is not given, the latency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True)
class Members:
    """A population in physical units.

    Attributes:
        theta: Parameter values, (N, K).
        latency_s: Total latency of each member, (N,) [s]; may be negative by less than the margin.
    """

    theta: FloatArray
    latency_s: FloatArray


class Coordinates:
    """The map between a unit cube of K parameters (and the latency) and physical values.

    Parameters are equal steps of their own scale, log for positive ones; the latency is linear.

    Args:
        problem: Gives the space and the range of the latency, or the latency.
        margin_s: The latency's coordinate reaches so far beyond its range, or a latency of zero would sit at
            infinity [s]; less than :func:`~deal_hw.calib.data.innovations.early_setpoints` can undo.
    """

    def __init__(self, problem: Problem, margin_s: float = 0.004) -> None:
        self.space = problem.space
        self.fixed_latency_s = problem.fixed_latency_s
        self._range = problem.latency_range_s
        self._low = self._range[0] - margin_s
        self._width = self._range[1] - self._range[0] + 2 * margin_s

    @property
    def count(self) -> int:
        """Coordinates: K, and one more where the latency is searched."""
        return len(self.space) + (self.fixed_latency_s is None)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return self.space.names + (("latency_s",) if self.fixed_latency_s is None else ())

    def members(self, unit: FloatArray) -> Members:
        """Map unit coordinates, (N, C), to physical values; parameters are clipped to their range."""
        K = len(self.space)
        theta = np.clip(self.space.unnormalize(unit[:, :K]), self.space.low, self.space.high)
        if self.fixed_latency_s is not None:
            return Members(theta, np.full(len(unit), self.fixed_latency_s))
        latency = self._low + self._width * np.clip(unit[:, K], 0.0, 1.0)
        return Members(theta, latency)

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw unit coordinates, (count, C), over all ranges; the latency's without its margin."""
        unit = rng.random((count, self.count))
        if self.fixed_latency_s is None:
            inner = self._range[0] + (self._range[1] - self._range[0]) * unit[:, -1]
            unit[:, -1] = (inner - self._low) / self._width
        return unit

    def latency_unit(self, latency_s: FloatArray) -> FloatArray:
        """Return the unit coordinate of latencies, (N,)."""
        return np.asarray((latency_s - self._low) / self._width)

    def clip_latency(self, latency_s: float) -> float:
        """Return the latency inside the range that was asked for [s]."""
        if self.fixed_latency_s is not None:
            return self.fixed_latency_s
        return float(np.clip(latency_s, *self._range))


def logit(unit: FloatArray, edge: float = 1e-9) -> FloatArray:
    """Map the unit interval, but for its edges, to the real line: unbounded steps then stay inside."""
    inside = np.clip(unit, edge, 1 - edge)
    return np.asarray(np.log(inside) - np.log1p(-inside))


def logistic(z: FloatArray) -> FloatArray:
    """Undo :func:`logit`."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * z)))
