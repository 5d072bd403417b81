"""Multiple shooting: residuals of windows whose start states are unknowns, and their normal equations.

Each window's start state is eliminated (Schur complement), so what is left is a small system in the
parameters and the latency, and its inverse is their covariance with the start states' uncertainty already in
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.problem import Problem, WindowData
from deal_hw.types import FloatArray

PARAMETER_STEP = 1e-4
LATENCY_STEP_S = 2e-4
POSITION_STEP = 1e-6
VELOCITY_STEP = 1e-4
VELOCITY_PRIOR_STD = (3.0, 30.0)
"""Weak prior on start velocities, in m/s and rad/s: keeps windows of few samples solvable."""


States = list[tuple[FloatArray, FloatArray]]
"""Positions and velocities at every sample of each episode, (T, J) each."""


@dataclass(frozen=True, slots=True)
class Point:
    """Where the solver stands.

    Attributes:
        value: Parameters in their own scale, then the latency [s], (K + 1,).
        position: Start positions of each episode's windows, (W, J) each.
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
        back: Per episode what turns a parameter step into start-state steps: (W, 2J, K + 1) and (W, 2J).
        residual: Whitened residuals per episode, (W, H, J).
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
        J = problem.joints
        prior = np.array(
            [VELOCITY_PRIOR_STD[0] if unit == "m" else VELOCITY_PRIOR_STD[1] for unit in self._units()]
        )
        # Information on a start state from its own reported position, and the weak prior on its velocity.
        self._start_information = [
            np.concatenate([1 / d.start_std**2, np.broadcast_to(1 / prior**2, d.start_std.shape)], axis=1)
            for d in self.data
        ]
        self._state_step = np.concatenate([np.full(J, POSITION_STEP), np.full(J, VELOCITY_STEP)])

    def _units(self) -> tuple[str, ...]:
        return self.problem.robot.description.position_units

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
            predicted_x, predicted_v = self._predict(
                point.value[None], data, point.position[e][None], point.velocity[e][None]
            )
            x[data.windows.start], v[data.windows.start] = point.position[e], point.velocity[e]
            # The last sample of a window is the start of the next, where it has a state of its own.
            inner = data.windows.samples()[:, :-1]
            x[inner], v[inner] = predicted_x[0, :, :-1], predicted_v[0, :, :-1]
        return found

    def theta(self, point: Point) -> FloatArray:
        """Return the physical parameters at a point, (K,)."""
        return self.problem.space.from_scale(point.value[:-1])

    def normal(self, point: Point) -> Normal:
        """Return the normal equations at a point, derivatives by forward differences in one batch."""
        K, J = len(point.value) - 1, self.problem.joints
        members = 1 + K + 1 + 2 * J
        values = np.repeat(point.value[None], members, axis=0)
        values[1 : K + 1, :K] += PARAMETER_STEP * np.eye(K)
        values[K + 1, K] += LATENCY_STEP_S
        steps = np.concatenate([np.full(K, PARAMETER_STEP), [LATENCY_STEP_S], self._state_step])
        hessian, gradient = np.zeros((K + 1, K + 1)), np.zeros(K + 1)
        cost, count = 0.0, 0
        back: list[tuple[FloatArray, FloatArray]] = []
        residuals: list[FloatArray] = []
        for e, data in enumerate(self.data):
            x = np.repeat(point.position[e][None], members, axis=0)
            v = np.repeat(point.velocity[e][None], members, axis=0)
            for j in range(J):
                x[K + 2 + j, :, j] += POSITION_STEP
                v[K + 2 + J + j, :, j] += VELOCITY_STEP
            predicted, _ = self._predict(values, data, x, v)
            r = (predicted[0] - data.measured) / data.std
            jac = np.moveaxis((predicted[1:] - predicted[:1]) / data.std, 0, -1) / steps
            W = len(data.windows)
            r_flat, jac = r.reshape(W, -1), jac.reshape(W, -1, len(steps))
            jp, js = jac[..., : K + 1], jac[..., K + 1 :]
            start = np.concatenate([point.position[e] - data.reported_start, point.velocity[e]], axis=1)
            # The prior on velocities is centred on zero and so weak that it only guards the inverse.
            information = self._start_information[e]
            mss = np.einsum("wri,wrj->wij", js, js) + information[:, :, None] * np.eye(2 * J)
            gs = np.einsum("wri,wr->wi", js, r_flat) + information * start
            msp = np.einsum("wri,wrj->wij", js, jp)
            solved = np.linalg.solve(mss, np.concatenate([msp, gs[..., None]], axis=2))
            back.append((solved[..., :-1], solved[..., -1]))
            hessian += np.einsum("wri,wrj->ij", jp, jp) - np.einsum("wsi,wsj->ij", msp, solved[..., :-1])
            gradient += np.einsum("wri,wr->i", jp, r_flat) - np.einsum("wsi,ws->i", msp, solved[..., -1])
            cost += float(np.sum(r_flat**2) + np.sum(information * start**2))
            count += r_flat.size + W * J - W * 2 * J
            residuals.append(r)
        return Normal(cost, count, hessian, gradient, tuple(back), tuple(residuals))

    def moved(self, point: Point, normal: Normal, step: FloatArray) -> Point:
        """Return the point after a parameter step, (K + 1,), start states following it to first order."""
        J = self.problem.joints
        position, velocity = [], []
        for e, (gain, shift) in enumerate(normal.back):
            state = -(shift + gain @ step)
            position.append(point.position[e] + state[:, :J])
            velocity.append(point.velocity[e] + state[:, J:])
        return Point(point.value + step, tuple(position), tuple(velocity))

    def costs(self, points: Sequence[Point]) -> FloatArray:
        """Return the cost at each of several points, in one batch; infinite where a member diverged."""
        total = np.zeros(len(points))
        values = np.stack([p.value for p in points])
        for e, data in enumerate(self.data):
            x = np.stack([p.position[e] for p in points])
            v = np.stack([p.velocity[e] for p in points])
            predicted, _ = self._predict(values, data, x, v)
            r = (predicted - data.measured) / data.std
            start = np.concatenate([x - data.reported_start, v], axis=2)
            total += np.sum(r**2, axis=(1, 2, 3)) + np.sum(self._start_information[e] * start**2, axis=(1, 2))
        return np.where(np.isfinite(total), total, np.inf)

    def _predict(
        self, values: FloatArray, data: WindowData, x: FloatArray, v: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        theta = self.problem.space.from_scale(values[:, :-1])
        return self.problem.predict(theta, np.maximum(values[:, -1], 0.0), data, x, v)
