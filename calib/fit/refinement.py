"""The refinement: least squares on multiple shooting in growing windows, the latency one more unknown.

The first answer of a calibration is the refinement of the model's own values, without any search.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem, samples_in
from deal_hw.calib.fit.contacts import CONTACTS, settle, solve_contacts
from deal_hw.calib.fit.residual import Normal, Point, Shooting, States
from deal_hw.calib.fit.solver import SolverSettings, cauchy_windows, converged, huber_weights, solve
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementSettings:
    """Settings of :func:`refine`.

    Attributes:
        stages_s: Window lengths, short first: short windows have a wide basin, long ones the information [s].
        contact_stages_s: The same where feet touch the floor: longer windows add more kinks than information.
        given_stages_s: The same where start states are exact. Over a single sample predictions are nearly
            straight in the motors' gains and hardly a foot lands otherwise than it did, so the basin is about
            as wide as the range; windows of 0.1 s from the start ended in others (0.18 % off).
        worse: A longer window whose chi2 grows by more than this factor is not kept: its start states are in
            another basin, or the model is wrong in a way that adds up.
        explained: A chi2 below this is not worth other start states.
        shakes: Spreads of the start states that are drawn where contacts leave the solver stuck, in standard
            deviations.
        shake_count: Draws of each.
        shaken: Draws that leave more than this share of the cost are the last: it is the model that is wrong.
        robust_rounds: Rounds of Huber's weights, see :func:`refine_robust`.
        robust_iterations: Most steps of each.
        rounds: Most rounds of weights where start states are exact.
        round_iterations: Most steps of each.
        given_chi2: Where start states are exact the truth leaves no residual at all in most windows; a kink
            magnifies rounding in a few.
        given_still: A round of weights that moves no parameter by more, in its own scale, is the last.
        given_right: Where the chi2 of most of the shortest windows is below this the latency is the right
            whole step.
        most_windows: So many of the windows are most [-].
        local_s: The local fit finds its way on so much of the recordings [s].
        local_hopeless: Shortest windows whose chi2 stays above this are not explained by longer ones either.
    """

    stages_s: tuple[float, ...] = (0.2, 0.4, 0.8)
    contact_stages_s: tuple[float, ...] = (0.2, 0.4)
    given_stages_s: tuple[float, ...] = (0.02, 0.04, 0.1)
    worse: float = 1.2
    explained: float = 1.25
    shakes: tuple[float, ...] = (0.5, 0.25, 0.12)
    shake_count: int = 60
    shaken: float = 0.95
    robust_rounds: int = 3
    robust_iterations: int = 4
    rounds: int = 4
    round_iterations: int = 4
    given_chi2: float = 1e-9
    given_still: float = 1e-7
    given_right: float = 1.0
    most_windows: float = 0.75
    local_s: float = 8.0
    local_hopeless: float = 4.0


SETTINGS = RefinementSettings()


@dataclass(frozen=True, slots=True)
class Refined:
    """Where the refinement ended.

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


def refine(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    stages_s: Sequence[float] | None = None,
    iterations: int = 12,
    fixed_latency: bool = False,
    notify: Callable[[Refined], None] | None = None,
    states: States | None = None,
    shake: bool = True,
) -> Refined:
    """Refine parameters from a start.

    Args:
        problem: The problem.
        theta: Start, (K,).
        latency_s: Start latency [s].
        stages_s: Window lengths, in order [s]; the usual ones by default.
        iterations: Most iterations of the solver at a time.
        fixed_latency: Keep the latency.
        notify: Called with the fit after each window length that is kept.
        states: Where the first stage's windows start; the smoothed states by default.
        shake: Search other start states where contacts leave the solver stuck; where states are exact, let
            windows that no small step explains weigh less.

    Raises:
        InsufficientDataError: Not even the shortest window fits.
    """
    space, settings = problem.space, SETTINGS
    theta = np.clip(theta, space.low, space.high)
    if problem.noise_free:
        stages_s = stages_s or settings.given_stages_s
        if shake and not fixed_latency:
            theta, latency_s = _whole_step(problem, theta, latency_s, stages_s[0])
        # The latency of a simulated target is a whole number of steps.
        fixed_latency = True
    elif stages_s is None:
        stages_s = settings.contact_stages_s if problem.robot.base is not None else settings.stages_s
    result: Refined | None = None
    # Fixed: a refinement is part of the data's analysis, not of the search's luck.
    rng = np.random.default_rng(0)
    done = 0
    for seconds in stages_s:
        try:
            shooting = Shooting(problem, samples_in(problem, seconds))
        except InsufficientDataError:
            if result is None:
                raise
            break
        point = shooting.start(theta, latency_s, states)
        if shooting.contacts:
            point, normal, used = _with_contacts(shooting, point, iterations, fixed_latency, shake, rng)
        elif shooting.given:
            point, normal, used = _from_known_states(
                shooting, point, iterations, settings.rounds if shake else 0
            )
        else:
            point, normal, used = _solved(shooting, point, iterations, fixed_latency)
        done += used
        found = _refined(shooting, point, normal, done, fixed_latency)
        if result is not None and not shooting.given and found.chi2 > settings.worse * max(result.chi2, 1.0):
            break
        result, theta, latency_s = found, found.theta, found.latency_s
        if not shooting.given:
            states = shooting.states(point)
        if notify is not None and np.isfinite(found.chi2):
            notify(found)
    if result is None:
        raise InsufficientDataError("no window length was given")
    return result


def refine_windows(
    shooting: Shooting, point: Point, iterations: int = 6, fixed_latency: bool = False
) -> Refined:
    """Refine from a point in the windows it is of, such as a part of all windows or weighed ones.

    Args:
        shooting: The windows.
        point: Where to start.
        iterations: Most iterations.
        fixed_latency: Keep the latency.
    """
    point, normal, used = _solved(shooting, point, iterations, fixed_latency)
    return _refined(shooting, point, normal, used, fixed_latency)


def _solved(
    shooting: Shooting, point: Point, iterations: int, fixed_latency: bool
) -> tuple[Point, Normal, int]:
    if shooting.contacts:
        return solve_contacts(shooting, point, iterations, fixed_latency=fixed_latency)
    return solve(shooting, point, SolverSettings(iterations=iterations), fixed_latency=fixed_latency)


def _refined(shooting: Shooting, point: Point, normal: Normal, used: int, fixed_latency: bool) -> Refined:
    free = len(shooting.problem.space) + (0 if fixed_latency else 1)
    chi2 = normal.cost / max(normal.count - free, 1)
    return Refined(shooting.theta(point), float(point.value[-1]), chi2, normal, point, shooting, used)


def refine_robust(refined: Refined, fixed_latency: bool) -> Refined:
    """Refine on from where a refinement ended, large residuals weighing less.

    The windows' standard deviations are divided by the weights' roots, so that normal equations, intervals
    and start states all see the same weights. ``chi2`` stays that of all residuals alike, or the loss would
    hide that the model is wrong.

    Args:
        refined: Where to start; its windows are kept.
        fixed_latency: Keep the latency.
    """
    plain, found, iterations = refined.shooting, refined, refined.iterations
    for _ in range(SETTINGS.robust_rounds):
        data = [
            dataclasses.replace(d, std=d.std / np.sqrt(huber_weights(r)))
            for d, r in zip(plain.data, plain.residuals(found.point), strict=True)
        ]
        found = refine_windows(
            plain.on(data), found.point, SETTINGS.robust_iterations, fixed_latency=fixed_latency
        )
        iterations += found.iterations
    free = len(plain.problem.space) + (0 if fixed_latency else 1)
    chi2 = plain.cost(found.point) / max(found.normal.count - free, 1)
    return dataclasses.replace(found, chi2=chi2, iterations=iterations)


def at_parameters(
    problem: Problem, theta: FloatArray, latency_s: float, length: int, states: States | None = None
) -> Refined:
    """Return parameters with start states fitted to them, as if the refinement had ended there.

    A prediction from smoothed start states errs by what smoothing errs, which says nothing of the model.

    Args:
        problem: The problem.
        theta: Physical parameters, (K,).
        latency_s: Total latency [s].
        length: Samples of a window.
        states: Where start states begin; the smoothed states by default.

    Raises:
        InsufficientDataError: No recording holds a window.
    """
    shooting = Shooting(problem, length)
    point = shooting.start(theta, latency_s, states)
    if shooting.contacts:
        point = settle(shooting, point, CONTACTS.start_iterations)[0]
        normal = shooting.normal(point)
    else:
        point, normal = converged(shooting, point, shooting.normal(point), CONTACTS.start_iterations)
    found = _refined(shooting, point, normal, 0, problem.fixed_latency_s is not None)
    return dataclasses.replace(found, theta=theta, latency_s=latency_s)


def _whole_step(
    problem: Problem, theta: FloatArray, latency_s: float, seconds: float
) -> tuple[FloatArray, float]:
    """Return the whole step of latency that explains most of the shortest windows, and parameters there.

    A search may end beside it.
    """
    step_s = problem.episodes[0].step_s
    low, high = (round(v / step_s) for v in problem.latency_range_s)
    nearest = round(latency_s / step_s)
    beside = sorted((nearest - 1, nearest + 1), key=lambda tick: abs(tick * step_s - latency_s))
    shooting = Shooting(problem, samples_in(problem, seconds))
    best, least = (theta, nearest * step_s), np.inf
    for tick in (nearest, *(t for t in beside if low <= t <= high)):
        start = shooting.start(theta, tick * step_s)
        point, normal, _ = _from_known_states(shooting, start, SolverSettings().iterations, 1)
        if _most(normal) < least:
            best, least = (shooting.theta(point), tick * step_s), _most(normal)
        if least < SETTINGS.given_right:
            break
    return best


def _most(normal: Normal) -> float:
    """Return the chi2 that most windows stay below."""
    each = np.concatenate([np.mean(r**2, axis=(1, 2)) for r in normal.residual])
    return float(np.quantile(each, SETTINGS.most_windows))


def _from_known_states(
    plain: Shooting, point: Point, iterations: int, rounds: int
) -> tuple[Point, Normal, int]:
    """Solve from exact states: most windows are predicted to rounding, so what others miss is a kink.

    A window in which feet slip at another moment than they did has a residual that no small step mends, and
    least squares would bend the parameters to it. So after a first, plain round each window weighs less the
    more it exceeds the median (Cauchy's weights), which leaves the solution to those that can be explained.
    """
    settings = SETTINGS
    point, normal, used = solve(plain, point, SolverSettings(iterations=iterations), fixed_latency=True)
    for _ in range(rounds):
        if _most(normal) < settings.given_chi2:
            break
        weighed, before = plain.on(cauchy_windows(plain.data, normal.residual)), point.value
        solver = SolverSettings(iterations=settings.round_iterations)
        point, _, more = solve(weighed, point, solver, fixed_latency=True)
        used += more
        normal = plain.normal(point)
        if np.max(np.abs(point.value - before)) < settings.given_still:
            break
    return point, normal, used


def _with_contacts(
    shooting: Shooting,
    point: Point,
    iterations: int,
    fixed_latency: bool,
    shake: bool,
    rng: np.random.Generator,
) -> tuple[Point, Normal, int]:
    """Solve; while the residual is unexplained, draw other start states and solve again."""
    settings = SETTINGS
    free = len(shooting.problem.space) + (0 if fixed_latency else 1)
    point, normal, used = _solved(shooting, point, iterations, fixed_latency)
    for spread in settings.shakes if shake else ():
        if normal.cost / max(normal.count - free, 1) < settings.explained:
            break
        before = normal.cost
        point = shooting.shaken(point, spread, settings.shake_count, rng)
        point, normal, more = _solved(shooting, point, iterations, fixed_latency)
        used += more
        if normal.cost > settings.shaken * before:
            break
    return point, normal, used


def local_fit(problem: Problem, notify: Callable[[Refined], None] | None = None) -> Refined | None:
    """Refine the model's own values; return None where they are too far to be refined.

    Costs a small part of a search. Where its residual is explained by the sensors' noise nothing is left to
    search for. A part of the recordings says where the fit goes; all of them are fitted only where that part
    can be explained.

    Args:
        problem: The problem.
        notify: Called with the fit after each window length; on a damped robot the first is often nearly the
            end, at a third of the time.
    """
    fixed = problem.fixed_latency_s is not None
    latency_s = problem.first_latency_s

    def fit(part: Problem, theta: FloatArray, latency_s: float, stages_s: Sequence[float] | None) -> Refined:
        return refine(
            part, theta, latency_s, stages_s, fixed_latency=fixed, notify=notify, shake=problem.noise_free
        )

    part, nominal = part_of(problem, SETTINGS.local_s), problem.space.nominal
    if part is problem or problem.noise_free:
        found = fit(problem, nominal, latency_s, None)
        return found if np.isfinite(found.chi2) else None
    stages_s = SETTINGS.contact_stages_s if problem.robot.base is not None else SETTINGS.stages_s
    short, *longer = stages_s
    found = fit(part, nominal, latency_s, (short,))
    if not found.chi2 < SETTINGS.local_hopeless:
        return found if np.isfinite(found.chi2) else None
    try:
        return fit(problem, found.theta, found.latency_s, longer)
    except InsufficientDataError:
        # No recording holds a longer window.
        return fit(problem, found.theta, found.latency_s, (short,))


def part_of(problem: Problem, seconds: float) -> Problem:
    """Return the problem with pieces of a second, evenly spread, that add up to about so many seconds."""
    lengths = [len(e.sample) for e in problem.episodes]
    period_s = problem.episodes[0].period_s
    piece = max(round(1.0 / period_s), 1)
    every = max(math.floor(sum(lengths) * period_s / seconds), 1)
    number = np.arange(sum(lengths)) // piece
    kept = np.split(number % every == 0, np.cumsum(lengths)[:-1])
    return problem.part(kept) if every > 1 else problem
