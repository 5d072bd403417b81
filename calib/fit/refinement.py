"""The refinement: least squares on multiple shooting in growing windows; the latency is one more unknown.

A calibration first refines the nominal values, without any search.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from deal_hw.calib.data.parts import BEGIN_S, part_of, samples_in
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.contacts import START_ITERATIONS, fit_starts, solve_contacts
from deal_hw.calib.fit.residual import Normal, Point, Shooting, States
from deal_hw.calib.fit.solver import SolverSettings, cauchy_windows, converged, restarted, solve
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray

STAGES_S = (0.2, 0.4, 0.8)
"""Window lengths, short first [s]: short windows have a wide basin, long ones the information."""

CONTACT_STAGES_S = (0.2, 0.4)
"""The same for feet on the floor: longer windows add more kinks than information."""

GIVEN_STAGES_S = (0.02, 0.04, 0.1)
"""The same for exact start states. Over one sample, predictions are nearly linear in the motors' gains and
contacts hardly change, so the basin is about as wide as the range. Starting with windows of 0.1 s ended in
other minima (0.18 % off)."""

WORSE = 1.2
"""Largest growth of chi2 with the window length. Beyond it, start states are in another basin or model
errors add up, and the longer window is not kept."""

EXPLAINED = 1.25
"""Chi2 below which no other start states are drawn."""

PERTURBATIONS = (0.5, 0.25, 0.12)
"""Spreads of the drawn start states where contacts stop the solver, in standard deviations."""

PERTURBED_STARTS = 60
"""Draws of each."""

LAST_PERTURBATION = 0.95
"""Share of the cost above which a draw is the last one: then the model is wrong."""

WEIGHT_ROUNDS = 4
"""Most rounds of weights for exact start states."""

ROUND_ITERATIONS = 4
"""Most steps of each."""

GIVEN_CHI2 = 1e-9
"""Chi2 at the truth for exact start states, in most windows. A kink magnifies rounding in a few."""

GIVEN_STILL = 1e-7
"""Largest parameter change in a round of weights that ends the rounds, in its own scale."""

GIVEN_RIGHT = 1.0
"""Chi2 of most of the shortest windows below which the latency is the right whole step."""

MOST_WINDOWS = 0.75
"""Share of the windows that counts as most [-]."""

LOCAL_HOPELESS = 4.0
"""Chi2 of the shortest windows above which the local fit does not continue."""


@dataclass(frozen=True, slots=True)
class Refined:
    """Result of a refinement.

    Attributes:
        theta: Physical parameters, (K,).
        latency_s: Total latency [s].
        chi2: Cost over degrees of freedom; 1 where noise explains everything.
        normal: Normal equations there.
        point: The solver's point.
        shooting: The windows used last.
        iterations: Iterations over all stages.
        shorter: The fit in shorter windows from which it began, if there is one.
        refused: The fit in longer windows that was not kept because its chi2 had grown, if there is one. Not
            with contacts: there, start states in another basin are the usual reason.
    """

    theta: FloatArray
    latency_s: float
    chi2: float
    normal: Normal
    point: Point
    shooting: Shooting
    iterations: int
    shorter: Refined | None = None
    refused: Refined | None = None


def refine(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    stages_s: Sequence[float] | None = None,
    iterations: int = 12,
    notify: Callable[[Refined], None] | None = None,
    states: States | None = None,
    perturb: bool = True,
    hopeless: float = np.inf,
    notify_step: Callable[[Refined], None] | None = None,
) -> Refined:
    """Refine parameters from a start; a latency that the problem gives stays as it is.

    Args:
        problem: The problem.
        theta: Start, (K,).
        latency_s: Start latency [s].
        stages_s: Window lengths, in order [s]; those of :func:`window_stages` by default.
        iterations: Most iterations of each run of the solver.
        notify: Called with the fit after each window length that is kept.
        states: Start states of the first stage's windows; the smoothed states by default.
        perturb: With contacts, draw other start states where the solver stops early. With exact states,
            reduce the weight of windows that no small step explains.
        hopeless: Chi2 above which a fit that has used its iterations does not continue, without contacts.
        notify_step: Called with the fit after each step of the solver, without contacts.

    Raises:
        InsufficientDataError: Not even the shortest window fits.
    """
    space = problem.space
    theta = np.clip(theta, space.low, space.high)
    stages_s = stages_s or window_stages(problem)
    if problem.noise_free and perturb and problem.fixed_latency_s is None:
        theta, latency_s = _whole_step(problem, theta, latency_s, stages_s[0])
    result: Refined | None = None
    # Fixed: a refinement is analysis of the data and must not depend on the search's draws.
    rng = np.random.default_rng(0)
    done = 0
    for seconds in stages_s:
        try:
            # The latency of a simulated target is a whole number of steps.
            fixed = True if problem.noise_free else None
            shooting = Shooting(problem, samples_in(problem, seconds), fixed_latency=fixed)
        except InsufficientDataError:
            if result is None:
                raise
            break
        point = shooting.start(theta, latency_s, states)
        if shooting.contacts:
            point, normal, used = _with_contacts(shooting, point, iterations, perturb, rng)
        elif shooting.given:
            point, normal, used = _from_known_states(
                shooting, point, iterations, WEIGHT_ROUNDS if perturb else 0
            )
        else:
            on_step = None
            if notify_step is not None:
                on_step = partial(_report, notify_step, shooting, done)
            point, normal, used = _solved(shooting, point, iterations, hopeless, on_step)
        done += used
        found = refined_at(shooting, point, normal, done)
        if result is not None and not shooting.given and found.chi2 > WORSE * max(result.chi2, 1.0):
            if np.isfinite(found.chi2) and not shooting.contacts:
                result = dataclasses.replace(result, refused=found)
            break
        result = dataclasses.replace(found, shorter=result)
        theta, latency_s = found.theta, found.latency_s
        if not shooting.given:
            states = shooting.states(point)
        if notify is not None:
            _report(notify, shooting, done, point, normal)
        if not found.chi2 < hopeless:
            break
    if result is None:
        raise InsufficientDataError("no window length was given")
    return result


def from_start(
    problem: Problem,
    start: Member,
    stages_s: Sequence[float] | None = None,
    notify: Callable[[Refined], None] | None = None,
) -> Refined:
    """Refine from a start; a latency that the problem gives replaces the start's. See :func:`refine`."""
    given = problem.fixed_latency_s
    return refine(problem, start[0], start[1] if given is None else given, stages_s, notify=notify)


def window_stages(problem: Problem) -> tuple[float, ...]:
    """Return the lengths of the refinement's windows, short first [s]."""
    if problem.noise_free:
        return GIVEN_STAGES_S
    return CONTACT_STAGES_S if problem.robot.base is not None else STAGES_S


def refine_windows(shooting: Shooting, point: Point, iterations: int) -> Refined:
    """Refine from a point in its own windows, such as a part of all windows or weighted ones."""
    point, normal, used = _solved(shooting, point, iterations)
    return refined_at(shooting, point, normal, used)


def _clear_gains(notify: Callable[[Refined], None]) -> Callable[[Refined], None]:
    """Return a callback that passes on a fit if it is the first of its window length, or halves chi2.

    Whoever is notified may simulate held-out recordings, which takes as long as a step.
    """
    least: dict[int, float] = {}

    def report(fit: Refined) -> None:
        if fit.chi2 < 0.5 * least.get(fit.shooting.length, np.inf):
            least[fit.shooting.length] = fit.chi2
            notify(fit)

    return report


def _report(
    notify: Callable[[Refined], None], shooting: Shooting, done: int, point: Point, normal: Normal
) -> None:
    """Report an intermediate fit; a diverged one is none."""
    found = refined_at(shooting, point, normal, done)
    if np.isfinite(found.chi2):
        notify(found)


def _solved(
    shooting: Shooting,
    point: Point,
    iterations: int,
    hopeless: float = np.inf,
    notify: Callable[[Point, Normal], None] | None = None,
) -> tuple[Point, Normal, int]:
    if shooting.contacts:
        return solve_contacts(shooting, point, iterations)
    solver = SolverSettings(iterations=iterations, hopeless=hopeless)
    return solve(shooting, point, solver, notify)


def refined_at(shooting: Shooting, point: Point, normal: Normal, used: int = 0) -> Refined:
    """Return a point with its normal equations as a fit, after so many iterations."""
    chi2 = normal.cost / _degrees(shooting, normal)
    return Refined(shooting.theta(point), float(point.value[-1]), chi2, normal, point, shooting, used)


def _degrees(shooting: Shooting, normal: Normal) -> int:
    """Return the residuals' degrees of freedom; at least 1."""
    return max(normal.count - len(shooting.problem.space) - (not shooting.fixed_latency), 1)


def at_parameters(
    problem: Problem, theta: FloatArray, latency_s: float, length: int, states: States | None = None
) -> Refined:
    """Return given parameters with start states fitted from ``states``, as if the refinement had ended there.

    A prediction from smoothed start states contains the smoother's error, which says nothing about the model.
    Windows have ``length`` samples.

    Raises:
        InsufficientDataError: No recording holds a window.
    """
    shooting = Shooting(problem, length)
    point = shooting.start(theta, latency_s, states)
    if shooting.contacts:
        point = fit_starts(shooting, point, START_ITERATIONS)[0]
        normal = shooting.normal(point)
    else:
        point, normal = converged(shooting, point, START_ITERATIONS)
        point, normal = restarted(shooting, point, normal)
    return dataclasses.replace(refined_at(shooting, point, normal, 0), theta=theta, latency_s=latency_s)


def _whole_step(
    problem: Problem, theta: FloatArray, latency_s: float, seconds: float
) -> tuple[FloatArray, float]:
    """Return the latency, in whole steps, that explains most of the shortest windows, and its parameters.

    A search may end one step beside it.
    """
    step_s = problem.step_s
    low, high = (round(v / step_s) for v in problem.latency_range_s)
    nearest = round(latency_s / step_s)
    beside = sorted((nearest - 1, nearest + 1), key=lambda tick: abs(tick * step_s - latency_s))
    shooting = Shooting(problem, samples_in(problem, seconds), fixed_latency=True)
    best, least = (theta, nearest * step_s), np.inf
    for tick in (nearest, *(t for t in beside if low <= t <= high)):
        start = shooting.start(theta, tick * step_s)
        point, normal, _ = _from_known_states(shooting, start, SolverSettings().iterations, 1)
        if _most(normal.residual) < least:
            best, least = (shooting.theta(point), tick * step_s), _most(normal.residual)
        if least < GIVEN_RIGHT:
            break
    return best


def _most(residuals: Sequence[FloatArray]) -> float:
    """Return the quantile of the windows' chi2 at ``most_windows``; residuals are (W, H, M) each."""
    each = np.concatenate([np.mean(r**2, axis=(1, 2)) for r in residuals])
    return float(np.quantile(each, MOST_WINDOWS))


def _from_known_states(
    plain: Shooting, point: Point, iterations: int, rounds: int
) -> tuple[Point, Normal, int]:
    """Solve from exact states: most windows are predicted to rounding, and only kinks leave a residual.

    If feet slip at another moment than recorded, no small step removes the residual, and least squares would
    bend the parameters to it. So after a first, plain round a window weighs less the more it exceeds the
    median (Cauchy's weights). The solution then rests on windows that can be explained.
    """
    point, last, used = solve(plain, point, SolverSettings(iterations=iterations))
    normal: Normal | None = last
    left: Sequence[FloatArray] = last.residual
    for _ in range(rounds):
        if _most(left) < GIVEN_CHI2:
            break
        weighed, before = plain.on(cauchy_windows(plain.data, left)), point.value
        point, _, more = solve(weighed, point, SolverSettings(iterations=ROUND_ITERATIONS))
        used += more
        # Weights need residuals alone. Derivatives cost as many simulations as there are parameters.
        normal, left = None, plain.residuals(point)
        if np.max(np.abs(point.value - before)) < GIVEN_STILL:
            break
    return point, normal or plain.normal(point), used


def _with_contacts(
    shooting: Shooting, point: Point, iterations: int, perturb: bool, rng: np.random.Generator
) -> tuple[Point, Normal, int]:
    """Solve; while the residual is unexplained, draw other start states and solve again."""
    point, normal, used = _solved(shooting, point, iterations)
    for spread in PERTURBATIONS if perturb else ():
        if normal.cost / _degrees(shooting, normal) < EXPLAINED:
            break
        before = normal.cost
        point = shooting.perturbed(point, spread, PERTURBED_STARTS, rng)
        point, normal, more = _solved(shooting, point, iterations)
        used += more
        if normal.cost > LAST_PERTURBATION * before:
            break
    return point, normal, used


def local_fit(
    problem: Problem, notify: Callable[[Refined], None] | None = None, start: Refined | None = None
) -> Refined | None:
    """Refine the nominal values, or those of another fit; return None where simulations from there diverge.

    It costs a small part of a search. Where the sensors' noise explains its residual, no search is needed. It
    fits a part of the recordings first, and all of them only where that part can be explained. ``notify``
    gets the fit after the first step of each window length, each that halves chi2, and the last: on a damped
    robot an early one is often nearly the result, in a third of the time.
    """
    hopeless = np.inf if problem.noise_free else LOCAL_HOPELESS
    fit = partial(
        refine,
        notify=notify,
        perturb=problem.noise_free,
        hopeless=hopeless,
        notify_step=_clear_gains(notify) if notify is not None else None,
    )
    part = part_of(problem, BEGIN_S)
    theta, latency_s = problem.space.nominal, problem.first_latency_s
    if start is not None:
        theta, latency_s = start.theta, start.latency_s
    if part is problem or problem.noise_free:
        found = fit(problem, theta, latency_s)
        return found if np.isfinite(found.chi2) else None
    short, *longer = window_stages(problem)
    found = fit(part, theta, latency_s, (short,))
    if not found.chi2 < hopeless:
        return found if np.isfinite(found.chi2) else None
    try:
        return fit(problem, found.theta, found.latency_s, longer)
    except InsufficientDataError:
        # No recording holds a longer window.
        return fit(problem, found.theta, found.latency_s, (short,))
