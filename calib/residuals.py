"""Multiple shooting: residuals of windows whose start states are unknowns, and their normal equations.

Each window's start state is eliminated (Schur complement), so what is left is a small system in the
parameters and the latency, and its inverse is their covariance with the start states' uncertainty already in
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.problem import Prediction, Problem, WindowData
from deal_hw.types import FloatArray

PARAMETER_STEP = 1e-4
LATENCY_STEP_S = 2e-4
POSITION_STEP = 1e-6
VELOCITY_STEP = 1e-4

States = list[tuple[FloatArray, FloatArray]]
"""Positions and velocities at every sample of each episode, (T, C) each."""


@dataclass(frozen=True, slots=True)
class Point:
    """Where the solver stands.

    Attributes:
        value: Parameters in their own scale, then the latency [s], (K + 1,).
        position: Start positions of each episode's windows, (W, C) each.
        velocity: Start velocities, likewise.
    """

    value: FloatArray
    position: tuple[FloatArray, ...]
    velocity: tuple[FloatArray, ...]


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations at a point, start states eliminated.

    Attributes:
        cost: Sum of squared whitened residuals.
        count: Residuals, not counting start states' unknowns.
        hessian: (K + 1, K + 1).
        gradient: (K + 1,).
        back: Per episode what turns a parameter step into start-state steps: (W, 2C, K + 1) and (W, 2C).
        residual: Whitened residuals per episode, (W, H, M).
    """

    cost: float
    count: int
    hessian: FloatArray
    gradient: FloatArray
    back: tuple[tuple[FloatArray, FloatArray], ...]
    residual: tuple[FloatArray, ...]


class Shooting:
    """Residuals, normal equations and candidate steps for one cut into windows.

    Args:
        problem: The problem.
        length: Samples a window predicts.
        offset: First sample that may start a window.
    """

    def __init__(self, problem: Problem, length: int, offset: int = 0) -> None:
        self.problem = problem
        self.data: Sequence[WindowData] = problem.windows(length, offset=offset)
        self.length = length
        C = problem.coordinates
        self._start_information = [1 / d.prior_std**2 for d in self.data]
        self._state_step = np.concatenate([np.full(C, POSITION_STEP), np.full(C, VELOCITY_STEP)])

    def start(self, theta: FloatArray, latency_s: float, states: States | None = None) -> Point:
        """Return the point at parameters (K,) and latency.

        Args:
            theta: Physical parameters, (K,).
            latency_s: Total latency [s].
            states: Where to take the windows' start states from; the smoothed ones by default.
        """
        value = np.append(self.problem.space.to_scale(theta), latency_s)
        source = states or self.smoothed()
        return Point(
            value,
            tuple(x[d.windows.start] for d, (x, _) in zip(self.data, self._of_data(source), strict=True)),
            tuple(v[d.windows.start] for d, (_, v) in zip(self.data, self._of_data(source), strict=True)),
        )

    def smoothed(self) -> States:
        """Return the smoothed states of all episodes."""
        return [(s.position, s.velocity) for s in self.problem.starts]

    def _of_data(self, states: States) -> States:
        return [states[d.episode] for d in self.data]

    def states(self, point: Point) -> States:
        """Return the fitted states at every sample of every episode; smoothed ones outside the windows."""
        found = [(x.copy(), v.copy()) for x, v in self.smoothed()]
        for e, data in enumerate(self.data):
            x, v = found[data.episode]
            predicted = self._predict(point.value[None], data, point.position[e][None], point.velocity[e][None])
            x[data.windows.start], v[data.windows.start] = point.position[e], point.velocity[e]
            # The last sample of a window is the start of the next, where it has a state of its own.
            inner = data.windows.samples()[:, :-1]
            x[inner], v[inner] = predicted.position[0, :, :-1], predicted.velocity[0, :, :-1]
        return found

    def theta(self, point: Point) -> FloatArray:
        """Return the physical parameters at a point, (K,)."""
        return self.problem.space.from_scale(point.value[:-1])

    def normal(self, point: Point) -> Normal:
        """Return the normal equations at a point, derivatives by forward differences in one batch."""
        K, C = len(point.value) - 1, self.problem.coordinates
        moved = 0 if self.problem.exact else C
        members = 1 + K + 1 + 2 * moved
        values = np.repeat(point.value[None], members, axis=0)
        values[1 : K + 1, :K] += PARAMETER_STEP * np.eye(K)
        values[K + 1, K] += LATENCY_STEP_S
        steps = np.concatenate([np.full(K, PARAMETER_STEP), [LATENCY_STEP_S], self._state_step])[: members - 1]
        hessian, gradient = np.zeros((K + 1, K + 1)), np.zeros(K + 1)
        cost, count = 0.0, 0
        back: list[tuple[FloatArray, FloatArray]] = []
        residuals: list[FloatArray] = []
        for e, data in enumerate(self.data):
            x = np.repeat(point.position[e][None], members, axis=0)
            v = np.repeat(point.velocity[e][None], members, axis=0)
            for c in range(moved):
                x[K + 2 + c, :, c] += POSITION_STEP
                v[K + 2 + C + c, :, c] += VELOCITY_STEP
            predicted = self._predict(values, data, x, v).observed
            r = (predicted[0] - data.measured) / data.std
            jac = np.moveaxis((predicted[1:] - predicted[:1]) / data.std, 0, -1) / steps
            W = len(data.windows)
            r_flat, jac = r.reshape(W, -1), jac.reshape(W, -1, len(steps))
            jp, js = jac[..., : K + 1], jac[..., K + 1 :]
            residuals.append(r)
            hessian += np.einsum("wri,wrj->ij", jp, jp)
            gradient += np.einsum("wri,wr->i", jp, r_flat)
            cost += float(np.sum(r_flat**2))
            count += r_flat.size
            if self.problem.exact:
                back.append((np.zeros((W, 2 * C, K + 1)), np.zeros((W, 2 * C))))
                continue
            start = np.concatenate([point.position[e], point.velocity[e]], axis=1) - data.prior_mean
            information = self._start_information[e]
            mss = np.einsum("wri,wrj->wij", js, js) + information[:, :, None] * np.eye(2 * C)
            gs = np.einsum("wri,wr->wi", js, r_flat) + information * start
            msp = np.einsum("wri,wrj->wij", js, jp)
            solved = np.linalg.solve(mss, np.concatenate([msp, gs[..., None]], axis=2))
            back.append((solved[..., :-1], solved[..., -1]))
            hessian -= np.einsum("wsi,wsj->ij", msp, solved[..., :-1])
            gradient -= np.einsum("wsi,ws->i", msp, solved[..., -1])
            cost += float(np.sum(information * start**2))
            count += W * int(data.prior_counts.sum()) - W * 2 * C
        return Normal(cost, count, hessian, gradient, tuple(back), tuple(residuals))

    def moved(self, point: Point, normal: Normal, step: FloatArray) -> Point:
        """Return the point after a parameter step, (K + 1,), start states following it to first order."""
        C = self.problem.coordinates
        position, velocity = [], []
        for e, (gain, shift) in enumerate(normal.back):
            state = -(shift + gain @ step)
            position.append(point.position[e] + state[:, :C])
            velocity.append(point.velocity[e] + state[:, C:])
        return Point(point.value + step, tuple(position), tuple(velocity))

    def costs(self, points: Sequence[Point]) -> FloatArray:
        """Return the cost at each of several points, in one batch; infinite where a member diverged."""
        total = np.zeros(len(points))
        values = np.stack([p.value for p in points])
        for e, data in enumerate(self.data):
            x = np.stack([p.position[e] for p in points])
            v = np.stack([p.velocity[e] for p in points])
            predicted = self._predict(values, data, x, v).observed
            r = (predicted - data.measured) / data.std
            total += np.sum(r**2, axis=(1, 2, 3))
            if not self.problem.exact:
                start = np.concatenate([x, v], axis=2) - data.prior_mean
                total += np.sum(self._start_information[e] * start**2, axis=(1, 2))
        return np.where(np.isfinite(total), total, np.inf)

    def _predict(self, values: FloatArray, data: WindowData, x: FloatArray, v: FloatArray) -> Prediction:
        theta = self.problem.space.from_scale(values[:, :-1])
        return self.problem.predict(theta, np.maximum(values[:, -1], 0.0), data, x, v)
