"""The polish: Levenberg-Marquardt on multiple shooting in growing windows, the latency one more unknown."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem, samples_in
from deal_hw.calib.fit.contacts import START_ITERATIONS, settle, solve_contacts
from deal_hw.calib.fit.residual import Normal, Point, Shooting, States
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray

STAGES_S = (0.2, 0.4, 0.8)
"""Window lengths, short first: short windows have a wide basin, long ones the information."""

WORSE = 1.2
"""A longer window whose chi2 grows by more than this factor is not kept: its start states are in another
basin, or the model is wrong in a way that adds up."""

STEP_LIMIT = 0.7
"""Largest step of a parameter in its own scale (about a factor two)."""

LATENCY_STEP_LIMIT_S = 0.005
EXPLAINED = 1.25
"""A residual below this is not worth another basin."""

SHAKES = (0.5, 0.25, 0.12)
"""Spreads of the start states that are drawn where the solver got stuck, in standard deviations."""

SHAKE_COUNT = 60
SHAKEN = 0.95
"""Draws that leave more than this share of the cost are the last ones: it is the model that is wrong."""

CONTACT_STAGES_S = (0.2, 0.4)
"""Where feet touch the floor longer windows add more kinks than information."""


EXACT_STAGES_S = (0.02, 0.04, 0.1)
"""Window lengths where states are exact. Over a single sample predictions are nearly straight in the drives'
gains and hardly a foot lands otherwise than it did, so the basin is about as wide as the range; windows of
0.1 s from the start ended in others (0.18 % off, and whole searches were repeated)."""

EXACT_ITERATIONS = 12
EXACT_ROUNDS = 4
EXACT_ROUND_ITERATIONS = 4
EXACT_CHI2 = 1e-9
"""Where states are exact the truth leaves no residual at all in most windows; a kink magnifies rounding in a
few."""

EXACT_SHARE = 0.75
"""So many of the windows are most."""

EXACT_STILL = 1e-7
"""A round of weights that moves no parameter by more, in its own scale, is the last one."""

EXACT_RIGHT = 1.0
"""Where the chi2 of most of the shortest windows is below this the latency is the right whole step."""

DAMPINGS = 10.0 ** np.arange(-5.0, 4.0)
CONVERGED = 1e-4


@dataclass(frozen=True, slots=True)
class Polished:
    """Where the polish ended.

    Attributes:
        theta: Physical parameters, (K,).
        latency_s: Total latency [s].
        chi2: Cost over degrees of freedom; 1 where noise explains everything.
        normal: Normal equations there.
        point: The solver's point.
        shooting: The cut into windows that was used last.
        iterations: Iterations over all stages.
    """

    theta: FloatArray
    latency_s: float
    chi2: float
    normal: Normal
    point: Point
    shooting: Shooting
    iterations: int


def polish(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    stages_s: Sequence[float] | None = None,
    iterations: int = 12,
    fixed_latency: bool = False,
    notify: Callable[[int, float], None] | None = None,
    states: States | None = None,
    shake: bool = True,
    settle: bool = True,
) -> Polished:
    """Polish parameters from a start.

    Args:
        problem: The problem.
        theta: Start, (K,).
        latency_s: Start latency [s].
        stages_s: Window lengths, in order [s]; the usual ones by default.
        iterations: Most iterations of the solver at a time.
        fixed_latency: Keep the latency.
        notify: Called with iterations done and chi2.
        states: Where the first stage's windows start; the smoothed states by default.
        shake: Search other start states where contacts leave the solver stuck.
        settle: Move start states only where that helps their window.

    Raises:
        InsufficientDataError: Not even the shortest window fits.
    """
    space = problem.space
    theta = np.clip(theta, space.low, space.high)
    if problem.exact:
        if not shake:
            return _polish_stages(
                problem, theta, latency_s, stages_s or EXACT_STAGES_S, notify, iterations=iterations, rounds=0
            )
        return _polish_exact(problem, theta, latency_s, fixed_latency, notify)
    contacts = problem.robot.base is not None
    stages_s = stages_s or (CONTACT_STAGES_S if contacts else STAGES_S)
    result: Polished | None = None
    # Fixed: a polish is part of the data's analysis, not of the search's luck.
    rng = np.random.default_rng(0)
    done = 0
    for seconds in stages_s:
        try:
            shooting = Shooting(problem, samples_in(problem, seconds), settle=settle)
        except InsufficientDataError:
            if result is None:
                raise
            break
        start = shooting.start(theta, latency_s, states)
        free = len(space) + (0 if fixed_latency else 1)
        spreads = SHAKES if shake else ()
        point, normal, used = _solve_shaken(shooting, start, iterations, fixed_latency, free, rng, spreads)
        done += used
        chi2 = normal.cost / max(normal.count - free, 1)
        if result is not None and chi2 > WORSE * max(result.chi2, 1.0):
            break
        theta, latency_s = shooting.theta(point), float(point.value[-1])
        states = shooting.states(point)
        result = Polished(theta, latency_s, chi2, normal, point, shooting, done)
        if notify is not None:
            notify(done, chi2)
    if result is None:
        raise InsufficientDataError("no window length was given")
    return result


def _polish_exact(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    fixed_latency: bool,
    notify: Callable[[int, float], None] | None,
) -> Polished:
    """Polish from exact states at the whole step of latency that explains most windows.

    The latency of a simulated target is a whole number of steps; a search may end beside it.
    """
    step_s = problem.episodes[0].step_s
    nearest = round(latency_s / step_s)
    ticks = [nearest]
    if not fixed_latency:
        low, high = (round(v / step_s) for v in problem.latency_range_s)
        near = sorted((nearest - 1, nearest + 1), key=lambda t: abs(t * step_s - latency_s))
        ticks += [t for t in near if low <= t <= high]
    best: Polished | None = None
    done = 0
    for tick in ticks:
        found = _polish_stages(problem, theta, tick * step_s, EXACT_STAGES_S[:1], notify, done=done, rounds=1)
        done = found.iterations
        if best is None or _most(found.normal) < _most(best.normal):
            best = found
        if _most(best.normal) < EXACT_RIGHT:
            break
    if best is None:
        raise RuntimeError("unreachable: the nearest step is always tried")
    return _polish_stages(problem, best.theta, best.latency_s, EXACT_STAGES_S, notify, done=done)


def _polish_stages(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    stages_s: Sequence[float],
    notify: Callable[[int, float], None] | None,
    *,
    done: int = 0,
    iterations: int = EXACT_ITERATIONS,
    rounds: int = EXACT_ROUNDS,
) -> Polished:
    """Polish from exact states at one latency, in growing windows.

    Args:
        problem: The problem.
        theta: Start, (K,).
        latency_s: A whole number of steps [s].
        stages_s: Window lengths, in order [s].
        notify: Called with iterations done and chi2.
        done: Iterations before.
        iterations: Most iterations of each stage before its rounds.
        rounds: Most rounds of weights in each stage.
    """
    period_s = problem.episodes[0].period_s
    found: Polished | None = None
    for seconds in stages_s:
        shooting = Shooting(problem, max(round(seconds / period_s), 1))
        point, normal, more = _solve_exact(shooting, shooting.start(theta, latency_s), iterations, rounds)
        theta, done = shooting.theta(point), done + more
        chi2 = normal.cost / normal.count
        found = Polished(theta, latency_s, chi2, normal, point, shooting, done)
        if notify is not None:
            notify(done, chi2)
    if found is None:
        raise InsufficientDataError("no window length was given")
    return found


def _most(normal: Normal) -> float:
    """Return the chi2 that most windows stay below."""
    each = np.concatenate([np.mean(r**2, axis=(1, 2)) for r in normal.residual])
    return float(np.quantile(each, EXACT_SHARE))


def _solve_exact(plain: Shooting, point: Point, iterations: int, rounds: int) -> tuple[Point, Normal, int]:
    """Solve from exact states: most windows are predicted to rounding, so what others miss is a kink.

    A window in which feet slip at another moment than they did has a residual that no small step mends, and
    least squares would bend the parameters to it. So after a first, plain round each window weighs less the
    more it exceeds the median (Cauchy's weights), which leaves the solution to those that can be explained.
    """
    point, normal, used = _solve(plain, point, iterations, True, EXACT_CHI2)
    for _ in range(rounds):
        if _most(normal) < EXACT_CHI2:
            break
        costs = [np.sum(r**2, axis=(1, 2)) for r in normal.residual]
        median = max(float(np.median(np.concatenate(costs))), 1e-12)
        data = [
            dataclasses.replace(d, std=d.std * np.sqrt(1.0 + c / median)[:, None, None])
            for d, c in zip(plain.data, costs, strict=True)
        ]
        weighed, before = Shooting(plain.problem, plain.length, data=data), point.value
        point, _, more = _solve(weighed, point, EXACT_ROUND_ITERATIONS, True, EXACT_CHI2)
        used += more
        normal = plain.normal(point)
        if np.max(np.abs(point.value - before)) < EXACT_STILL:
            break
    return point, normal, used


def polish_windows(
    shooting: Shooting, point: Point, iterations: int = 6, fixed_latency: bool = False
) -> Polished:
    """Polish from a point in the windows it is of, such as a part of all windows or weighed ones.

    Args:
        shooting: The windows.
        point: Where to start.
        iterations: Most iterations.
        fixed_latency: Keep the latency.
    """
    point, normal, used = _solve(shooting, point, iterations, fixed_latency)
    free = len(shooting.problem.space) + (0 if fixed_latency else 1)
    chi2 = normal.cost / max(normal.count - free, 1)
    return Polished(shooting.theta(point), float(point.value[-1]), chi2, normal, point, shooting, used)


def mismatch(problem: Problem, theta: FloatArray, latency_s: float, seconds: float) -> Normal:
    """Return the residuals that fitted start states leave, all parameters fixed.

    A prediction from smoothed start states errs by what smoothing errs, which says nothing of the model.

    Args:
        problem: Recordings and simulator.
        theta: Physical parameters, (K,).
        latency_s: Total latency [s].
        seconds: Length of the windows [s].

    Raises:
        InsufficientDataError: No recording holds a window.
    """
    shooting = Shooting(problem, samples_in(problem, seconds))
    point = shooting.start(theta, latency_s)
    if problem.robot.base is not None:
        return shooting.normal(settle(shooting, point, START_ITERATIONS)[0])
    still = np.zeros_like(point.value)
    normal = shooting.normal(point)
    for _ in range(START_ITERATIONS):
        moved = shooting.moved(point, shooting.settled(point, normal), still)
        if not shooting.costs([moved])[0] < normal.cost * (1 - CONVERGED):
            break
        point, normal = moved, shooting.normal(moved)
    return normal


def value_bounds(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return the least and greatest parameters in their own scale, the latency [s] last, (K + 1,) each."""
    space = problem.space
    low, high = problem.latency_range_s
    return np.append(space.to_scale(space.low), low), np.append(space.to_scale(space.high), high)


def _solve_shaken(
    shooting: Shooting,
    point: Point,
    iterations: int,
    fixed_latency: bool,
    free: int,
    rng: np.random.Generator,
    spreads: Sequence[float],
) -> tuple[Point, Normal, int]:
    """Solve; while the residual is unexplained, search other start states and solve again."""
    point, normal, used = _solve(shooting, point, iterations, fixed_latency)
    if shooting.problem.robot.base is None or shooting.problem.exact:
        return point, normal, used
    for spread in spreads:
        if normal.cost / max(normal.count - free, 1) < EXPLAINED:
            break
        before = normal.cost
        point = shooting.shaken(point, spread, SHAKE_COUNT, rng)
        point, normal, more = _solve(shooting, point, iterations, fixed_latency)
        used += more
        if normal.cost > SHAKEN * before:
            break
    return point, normal, used


def _solve(
    shooting: Shooting, point: Point, iterations: int, fixed_latency: bool, enough: float = 0.0
) -> tuple[Point, Normal, int]:
    """Solve until nothing is gained, or until most windows' chi2 is below ``enough``."""
    low, high = value_bounds(shooting.problem)
    if shooting.problem.robot.base is not None and not shooting.problem.exact:
        return solve_contacts(
            shooting, point, iterations,
            lambda value, gradient, hessian, damping: damped_step(
                value, gradient, hessian, damping, low, high, fixed_latency
            ),
        )  # fmt: skip
    normal = shooting.normal(point)
    used = 0
    for _ in range(iterations):
        if enough and _most(normal) < enough:
            break
        used += 1
        steps = [
            damped_step(point.value, normal.gradient, normal.hessian, damping, low, high, fixed_latency)
            for damping in DAMPINGS
        ]
        settled = shooting.settled(point, normal)
        candidates = [shooting.moved(point, settled, step) for step in steps]
        costs = shooting.costs(candidates)
        best = int(np.argmin(costs))
        if not costs[best] < normal.cost:
            break
        gain = normal.cost - costs[best]
        point = candidates[best]
        normal = shooting.normal(point)
        if gain < CONVERGED * normal.cost and gain < 0.1:
            break
    return point, normal, used


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
    limit = np.append(np.full(len(step) - 1, STEP_LIMIT), LATENCY_STEP_LIMIT_S)
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
