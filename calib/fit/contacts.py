"""The polish's solver where feet touch the floor: window by window, start states follow the parameters.

Feet that stick and slip kink every prediction, so the full Gauss-Newton step of all start states at once
hardly ever helps, and a solver that insists on it stops with start states that explain nothing: measured on
sensed Go2 targets, windows started from smoothed states cost six times the noise at the true parameters, and
what was left hung together over 5 to 13 samples. Given the parameters, though, windows do not depend on each
other. So each has a damped step of its own (Levenberg-Marquardt), and after a step of the parameters each
takes that way of following which suits it best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.fit.residual import Normal, Point, Shooting, value_bounds
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactSettings:
    """Settings of the steps where feet touch the floor.

    Attributes:
        step_limit: Largest step of a parameter in its own scale (about a factor two).
        latency_step_limit_s: Largest step of the latency [s].
        start_dampings: Levenberg's damping of start states, in units of the smoothed states' standard
            deviations.
        step_dampings: Damping of the parameters' steps.
        follow: How far start states follow a parameter step: kinks make the derivative too long as often as
            right.
        stretches: Secants, in turns: forward, backward, far and near ones miss different kinks.
        gain: A cost that falls by less is noise of the kinks.
        patience: So many iterations without gain end the solver.
        worse: A step may cost this share more than the best point: its start states have not followed to the
            end.
        start_iterations: Most steps of start states alone.
    """

    step_limit: float = 0.7
    latency_step_limit_s: float = 0.005
    start_dampings: tuple[float, ...] = (1e-2, 1e-1, 1.0, 10.0, 100.0)
    step_dampings: tuple[float, ...] = (1e-3, 1e-1, 1.0, 10.0)
    follow: tuple[float, ...] = (0.0, 0.5, 1.0)
    stretches: tuple[float, ...] = (1.0, -1.0, 2.5, -0.4)
    gain: float = 1.0
    patience: int = 3
    worse: float = 0.01
    start_iterations: int = 4


CONTACTS = ContactSettings()


def solve_contacts(
    shooting: Shooting, point: Point, iterations: int, *, fixed_latency: bool
) -> tuple[Point, Normal, int]:
    """Solve for parameters and start states; the best point that was seen is handed back.

    Args:
        shooting: The windows.
        point: Where to start.
        iterations: Most steps of the parameters.
        fixed_latency: Keep the latency.
    """
    best, best_cost = settle(shooting, point, CONTACTS.start_iterations)
    here, waited, used = best, 0, 0
    for _ in range(iterations):
        used += 1
        normal = shooting.normal(
            here, keep=True, stretch=CONTACTS.stretches[waited % len(CONTACTS.stretches)]
        )
        here, gains, cost = _settled(shooting, here, normal)
        fell = best_cost - cost
        if fell > 0:
            best, best_cost = here, cost
        waited = 0 if fell > CONTACTS.gain else waited + 1
        if waited > CONTACTS.patience:
            break
        here, cost = _stepped(shooting, here, normal, gains, fixed_latency)
        if cost < best_cost:
            best, best_cost = here, cost
        elif cost > best_cost * (1 + CONTACTS.worse):
            here = best
    best, _ = settle(shooting, best, CONTACTS.start_iterations // 2)
    return best, shooting.normal(best), used


def settle(shooting: Shooting, point: Point, iterations: int) -> tuple[Point, float]:
    """Fit start states alone; parameters stay, and no window's cost grows.

    Args:
        shooting: The windows.
        point: Where to start.
        iterations: Most steps.

    Returns:
        The point and its cost.
    """
    cost = float(shooting.costs([point])[0])
    for number in range(iterations):
        stretch = CONTACTS.stretches[number % 2]
        point, _, after = _settled(shooting, point, shooting.normal(point, keep=True, stretch=stretch))
        if cost - after < CONTACTS.gain:
            break
        cost = after
    return point, float(shooting.costs([point])[0])


def _settled(shooting: Shooting, point: Point, normal: Normal) -> tuple[Point, list[FloatArray], float]:
    """Return the point after each window's best damped step, the gains there, (W, S, P) each, and the cost.

    A gain is by what start states follow the parameters.
    """
    scale = np.maximum(shooting.state_std, 1e-12)
    gains, moves = [], []
    for rows in normal.rows:
        js = rows.start * scale
        square = np.einsum("wri,wrj->wij", js, js)
        own = np.einsum("wri,wr->wi", js, rows.residual)[..., None]
        unit = np.eye(len(scale))
        steps = [np.linalg.solve(square + d * unit, own)[..., 0] * scale for d in CONTACTS.start_dampings]
        moves.append(-np.stack([np.zeros_like(steps[0]), *steps]))
        cross = np.einsum("wri,wrj->wij", js, rows.parameter)
        gains.append(np.linalg.solve(square, cross) * scale[:, None])
    found, costs = _best_windows(shooting, point, [np.zeros_like(point.value)], [moves])
    return found[0], gains, float(costs[0])


def _stepped(
    shooting: Shooting, point: Point, normal: Normal, gains: Sequence[FloatArray], fixed_latency: bool
) -> tuple[Point, float]:
    """Return where the best step of the parameters leads, and the cost there."""
    # Where start states are at their best the residual alone says where to go; the gradient with start
    # states eliminated also counts what their derivatives promise and kinks do not keep.
    plain = normal.gradient.copy()
    for rows, gain in zip(normal.rows, gains, strict=True):
        plain += np.einsum("wsp,ws->p", gain, np.einsum("wrs,wr->ws", rows.start, rows.residual))
    bounds = value_bounds(shooting.problem)
    steps = [
        damped_step(point.value, gradient, normal.hessian, damping, *bounds, fixed_latency)
        for gradient in (normal.gradient, plain)
        for damping in CONTACTS.step_dampings
    ]
    moves = [
        [np.stack([-share * (gain @ step) for share in CONTACTS.follow]) for gain in gains] for step in steps
    ]
    found, costs = _best_windows(shooting, point, steps, moves)
    best = int(np.argmin(costs))
    return found[best], float(costs[best])


def _best_windows(
    shooting: Shooting, point: Point, steps: Sequence[FloatArray], moves: Sequence[Sequence[FloatArray]]
) -> tuple[list[Point], FloatArray]:
    """Return the points after parameter steps, each window moved by the best of its ways, and their costs.

    Args:
        shooting: The windows.
        point: Where the steps begin.
        steps: Steps of the parameters, (K + 1,) each.
        moves: For each step and episode the ways that start states may move, (D, W, S).
    """
    C = shooting.problem.coordinates
    places = [
        Point(
            point.value + step,
            tuple(x + m[way, :, :C] for x, m in zip(point.position, each, strict=True)),
            tuple(v + m[way, :, C:] for v, m in zip(point.velocity, each, strict=True)),
        )
        for step, each in zip(steps, moves, strict=True)
        for way in range(len(each[0]))
    ]
    costs, ways = shooting.each_cost(places), len(moves[0][0])
    found, totals = [], []
    for i in range(len(steps)):
        mine, total = places[i * ways : (i + 1) * ways], 0.0
        position, velocity = [], []
        for e, of_episode in enumerate(costs):
            part = of_episode[i * ways : (i + 1) * ways]
            chosen, window = np.argmin(part, axis=0), np.arange(part.shape[1])
            total += float(part[chosen, window].sum())
            position.append(np.stack([p.position[e] for p in mine])[chosen, window])
            velocity.append(np.stack([p.velocity[e] for p in mine])[chosen, window])
        found.append(Point(mine[0].value, tuple(position), tuple(velocity)))
        totals.append(total)
    return found, np.array(totals) + shooting.prior_costs(found)


def damped_step(
    value: FloatArray,
    gradient: FloatArray,
    hessian: FloatArray,
    damping: float,
    low: FloatArray,
    high: FloatArray,
    fixed_latency: bool,
) -> FloatArray:
    """Return the Levenberg-Marquardt step inside the range, (K + 1,).

    Args:
        value: Parameters in their own scale, then the latency [s], (K + 1,).
        gradient: Half the cost's gradient there, (K + 1,).
        hessian: Half its Gauss-Newton Hessian, (K + 1, K + 1).
        damping: How much shorter than the Gauss-Newton step.
        low: Least values, (K + 1,).
        high: Greatest values, (K + 1,).
        fixed_latency: Keep the latency.
    """
    free = np.ones(len(value), dtype=bool)
    free[-1] = not fixed_latency
    # A parameter at its bound that wants to leave the range stays; the others are solved without it.
    free &= ~((value <= low) & (gradient > 0)) & ~((value >= high) & (gradient < 0))
    step = np.zeros(len(value))
    if not free.any():
        return step
    scale = np.append(np.ones(len(step) - 1), 100.0)  # 10 ms of latency count like a factor e.
    limit = np.append(np.full(len(step) - 1, CONTACTS.step_limit), CONTACTS.latency_step_limit_s)
    H = hessian[np.ix_(free, free)]
    # Levenberg's damping in units of the parameters' scale beside Marquardt's relative one: a parameter
    # that the data cannot see (a limit never reached) must not run away.
    weight = np.diag(H) + np.max(np.diag(H) / scale[free] ** 2) * 1e-9 * scale[free] ** 2 + scale[free] ** 2
    step[free] = -np.linalg.solve(H + damping * np.diag(weight), gradient[free])
    shrink = np.max(np.abs(step) / limit)
    if shrink > 1:
        step = step / shrink
    moved = np.asarray(np.clip(value + step, low, high) - value)
    if fixed_latency:
        moved[-1] = 0.0
    return moved
