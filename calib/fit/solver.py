"""The one solver of all fits: bounded Gauss-Newton steps over the parameters and the latency.

Each step is the exact minimum of the linear model in a box: the bounds cut by the trust region (scipy's
``lsq_linear``). scipy's own ``least_squares`` (dogbox) ends a step where the first parameter meets the box.
Of 92 parameters one always does at once: 9 such steps left 1.7 % of the cost, 9 exact ones 2e-11.

Unknown start states of windows follow the parameters (variable projection, Golub and Pereyra 1973), so the
solver sees the parameters alone. A robust loss is a weight per residual, computed from the previous fit
(iteratively reweighted least squares, Holland and Welsch 1977).

Symbols of :func:`minimise`, for n free unknowns:
    x: step from the start in units of the first trust region, (n,) [-].
    r(x), J: whitened residuals, (M + n,), with those of the hold last, and their derivatives, (M + n, n).
    D: half side of the trust region around the present x, a box [-] (``radius``).
    f(x) = |r(x)|^2, and its model m(d) = |r + J d|^2 for a step d.
The rule for D is algorithm 4.1 of Nocedal and Wright, Numerical Optimization (2006), with a box instead of a
ball; the bounded linear problem is solved by BVLS (Stark and Parker 1995). With ``secants`` J follows steps
by Broyden's update (1965), as in section 3.5 of Madsen, Nielsen and Tingleff, Methods for Non-Linear Least
Squares Problems (2004).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy
from scipy.optimize import lsq_linear

from deal_hw.calib.data.noise import MAD_TO_STD, Mask, autocorrelations, rows_by_value
from deal_hw.calib.data.parts import taken
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.residual import Normal, Point, Shooting, value_bounds
from deal_hw.types import FloatArray

BURST_KURTOSIS = 8.0
"""Least kurtosis of a residual that comes in bursts; noise has 3 [-]."""

FIRST_RADIUS = 0.7
"""Radius of the first trust region in the parameters' own scale; 0.7 is about a factor two."""

LATENCY_UNIT_S = 0.007
"""Latency change that counts like a factor e of a parameter [s]."""

SMALLEST_STEP = 1e-5
"""Relative step length below which a step is the last."""

GOOD = 0.75
"""Share of the predicted decrease above which the trust region may grow; it doubles."""

POOR = 0.25
"""Share of the predicted decrease below which the trust region shrinks."""

SHRUNK = 0.25
"""The shrunk radius as a share of the step."""

RESTART_GAIN = 3e-3
"""Relative decrease of the cost below which the solver is not started again."""

STATES_CONVERGED = 1e-4
"""Relative decrease of the cost below which a step of start states alone is the last."""

FALSE_RESTARTS = 1e-3
"""Chance that noise alone puts any window out of line [-]."""

RESTART_ITERATIONS = 6
"""Most steps of a start state from each other start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverSettings:
    """Settings of :func:`minimise`.

    Attributes:
        iterations: Most steps.
        converged: Relative decrease of the cost, reached or expected, below which a step is the last.
        reach: Width of a prior around the start, in the parameters' own scale, which holds insensitive
            parameters. It is as wide as a range of ratio 5, and moves with each new start.
        hopeless: Mean squared residual above which the solver is not started again.
        secants: Most steps in a row with derivatives that follow from the last ones (Broyden's update), not
            from simulations.
    """

    iterations: int = 12
    converged: float = 1e-4
    reach: float = 1.0
    hopeless: float = np.inf
    secants: int = 0


class LeastSquares(Protocol):
    """A fit, as the solver needs it."""

    def residual(self, value: FloatArray) -> FloatArray:
        """Return the whitened residuals, (M,), at parameters in their own scale and latency, (K + 1,)."""

    def jacobian(self, value: FloatArray) -> FloatArray:
        """Return their derivatives, (M, K + 1)."""


def minimise(
    fit: LeastSquares,
    value: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    settings: SolverSettings,
    *,
    fixed_latency: bool,
) -> tuple[FloatArray, int]:
    """Minimise the sum of squared residuals inside bounds, (K + 1,) each.

    Values are parameters in their own scale, then the latency [s], (K + 1,). Return the solution and the
    number of derivatives.
    """
    low, high = bounds
    free = high > low
    free[-1] &= not fixed_latency
    start: FloatArray = np.where(free, np.clip(value, low, high), value)
    # A solution at a bound may come back beside it by rounding.
    for bound in bounds:
        start = np.where(free & (np.abs(start - bound) < 1e-9 * (high - low)), bound, start)
    if settings.iterations < 1 or not free.any():
        return start, 0
    # The hold: x has a normal prior around 0 whose standard deviation is ``reach`` in the parameters' own
    # scale, reach / FIRST_RADIUS in x. So x adds the residuals FIRST_RADIUS / reach * x.
    unit = np.full(len(value), FIRST_RADIUS)
    unit[-1] *= LATENCY_UNIT_S
    hold = FIRST_RADIUS / settings.reach
    lower, upper = (low - start)[free] / unit[free], (high - start)[free] / unit[free]

    def at(step: FloatArray) -> FloatArray:
        found: FloatArray = start.copy()
        found[free] = np.clip(start[free] + step * unit[free], low[free], high[free])
        return found

    def residual(step: FloatArray) -> FloatArray:
        return np.concatenate([fit.residual(at(step)), hold * step])

    def jacobian(step: FloatArray) -> FloatArray:
        # Beside parameters whose simulation diverges, a difference may not be finite: it gives no direction.
        rows = np.nan_to_num(fit.jacobian(at(step))[:, free] * unit[free], nan=0.0, posinf=0.0, neginf=0.0)
        return np.concatenate([rows, hold * np.eye(len(step))])

    here = np.zeros(int(free.sum()))
    left = residual(here)
    if not np.isfinite(left).all():
        return start, 0
    cost, radius, used, carried = float(left @ left), 1.0, 0, 0
    by: FloatArray | None = None
    triangle: FloatArray | None = None
    for _ in range(settings.iterations * (1 + settings.secants)):
        if by is None:
            if used == settings.iterations:
                break
            by, triangle, carried = jacobian(here), None, 0
            used += 1
        if triangle is None:
            # [J, -r] = Q R: |r + J d|^2 = |R_J d - R_r|^2, with n + 1 rows instead of M + n.
            triangle = np.asarray(np.linalg.qr(np.column_stack([by, -left]), mode="r"))
        rows, wanted = triangle[:, :-1], triangle[:, -1]
        box = np.maximum(lower - here, -radius), np.minimum(upper - here, radius)
        step = lsq_linear(rows, wanted, box, method="bvls", max_iter=10 * len(here)).x
        # The decrease that the model predicts, f(x) - m(d), against the one that comes, f(x) - f(x + d).
        expected = cost - float(np.sum((rows @ step - wanted) ** 2))
        # Carried derivatives do not show that nothing is left to gain. A step with them does, for little.
        if not expected > (0.0 if carried else settings.converged * cost):
            if carried:
                by = None
                continue
            break
        new, moved = residual(here + step), float(np.abs(step).max())
        gained = cost - float(new @ new) if np.isfinite(new).all() else -np.inf
        # A step that uses nearly all of the box may be cut by it: the box grows only then.
        if gained < POOR * expected:
            # Carried derivatives may be the reason: a step with new ones comes before a smaller one.
            radius = SHRUNK * moved if carried == 0 else radius
        elif gained > GOOD * expected and moved > 0.95 * radius:
            radius *= 2.0
        small = SMALLEST_STEP * (SMALLEST_STEP + float(np.linalg.norm(here)))
        ends = float(np.linalg.norm(step)) < small
        if gained > 0:
            ends |= POOR * expected < gained < settings.converged * cost
            if carried < settings.secants and gained > GOOD * expected:
                # Broyden (1965): the smallest change of J after which J d = r(x + d) - r(x).
                by += np.outer((new - left - by @ step) / (step @ step), step)
                carried += 1
            else:
                by = None
            here, left, cost, triangle = here + step, new, cost - gained, None
        elif carried:
            by = None
        if ends:
            break
    return at(here), used


def solve(
    shooting: Shooting,
    point: Point,
    settings: SolverSettings,
    notify: Callable[[Point, Normal], None] | None = None,
) -> tuple[Point, Normal, int]:
    """Solve for parameters and start states.

    Return the solution, the normal equations there, and the number of derivatives. ``notify`` gets each
    accepted step.
    """
    bounds, used, before = value_bounds(shooting.problem), 0, shooting.cost(point)
    normal: Normal | None = None
    # Beside a kink, steps shrink to nothing. A new trust region around the updated start states continues, or
    # shows that this is the end.
    while True:
        fit = Following(shooting, point, normal, notify)
        value, more = minimise(fit, point.value, bounds, settings, fixed_latency=shooting.fixed_latency)
        point, normal = converged(shooting, fit.at(value), 1, fit.normal_at(value))
        point, normal = restarted(shooting, point, normal)
        used += max(more, 1)
        gained = normal.cost < before * (1 - RESTART_GAIN)
        if used >= settings.iterations or not gained or normal.cost > settings.hopeless * normal.count:
            break
        before = normal.cost
    # The rows are large and one-sided; uncertainty uses central differences at the end.
    return point, dataclasses.replace(normal, rows=()), used


def solve_parameters(shooting: Shooting, point: Point, settings: SolverSettings) -> tuple[Point, int]:
    """Solve for parameters alone, from given start states.

    Return the solution and the number of derivatives. There are none at the solution: they cost as many
    simulations as a step.
    """
    fit = Following(shooting, point)
    bounds = value_bounds(shooting.problem)
    value, used = minimise(fit, point.value, bounds, settings, fixed_latency=shooting.fixed_latency)
    return fit.at(value), used


def converged(
    shooting: Shooting, point: Point, iterations: int, normal: Normal | None = None
) -> tuple[Point, Normal]:
    """Fit start states alone, without contacts, from a point and, if known, the normal equations there.

    Parameters stay, and no window's cost grows.
    """
    point, known = _with_states(shooting, point, iterations, normal)
    return point, known or shooting.normal(point, keep=normal is not None and bool(normal.rows))


def _with_states(
    shooting: Shooting, point: Point, iterations: int, normal: Normal | None = None
) -> tuple[Point, Normal | None]:
    """Return a point with fitted start states, and the given normal equations if it has not moved."""
    for _ in range(0 if shooting.given else iterations):
        here = normal or shooting.normal(point, states_only=True)
        moved = shooting.followed(point, here, np.zeros_like(point.value))
        if not shooting.cost(moved) < here.cost * (1 - STATES_CONVERGED):
            break
        point, normal = moved, None
    return point, normal


def restarted(shooting: Shooting, point: Point, normal: Normal) -> tuple[Point, Normal]:
    """Fit start states out of line again from other starts, without contacts, and keep each window's best.

    While parameters are far off, start states follow them. One that crosses a kink (a velocity that changes
    its sign against dry friction) can stay behind it: no derivative leads back, and its window bends all
    parameters. Given the parameters, windows are independent. So a window that fits much worse than the
    others starts again from the smoothed state, and from where the window before it ends.
    """
    chosen = [] if shooting.given else out_of_line(shooting, point)
    if not any(mine.any() for mine in chosen):
        return point, normal
    place = [(e, np.flatnonzero(mine)) for e, mine in enumerate(chosen) if mine.any()]
    part = shooting.on([taken(shooting.data[e], windows) for e, windows in place])
    position, velocity = list(point.position), list(point.velocity)
    for states in (shooting.smoothed(), shooting.states(point, handed_on=True)):
        start = part.start(shooting.theta(point), float(point.value[-1]), states)
        tried, _ = _with_states(part, start, RESTART_ITERATIONS)
        here = Point(point.value, *(tuple(s[e][w] for e, w in place) for s in (position, velocity)))
        costs = zip(part.window_costs(tried), part.window_costs(here), strict=True)
        for k, ((e, windows), (new, old)) in enumerate(zip(place, costs, strict=True)):
            lower = new < old * (1 - STATES_CONVERGED)
            for states_of, found in ((position, tried.position), (velocity, tried.velocity)):
                states_of[e] = states_of[e].copy()
                states_of[e][windows[lower]] = found[k][lower]
    moved = Point(point.value, tuple(position), tuple(velocity))
    if not shooting.cost(moved) < normal.cost * (1 - STATES_CONVERGED):
        return point, normal
    moved, _ = _with_states(shooting, moved, 1)
    return moved, shooting.normal(moved, keep=bool(normal.rows))


def out_of_line(shooting: Shooting, point: Point) -> list[Mask]:
    """Return which windows fit worse than noise of the others' size would let them, (W,) per episode."""
    costs = shooting.window_costs(point)
    freedom = [np.maximum(d.freedom, 1) for d in shooting.data]
    size = max(float(np.median(np.concatenate([c / f for c, f in zip(costs, freedom, strict=True)]))), 1.0)
    # A window's cost over its size is chi-square with its degrees of freedom; Bonferroni over the windows.
    chance = FALSE_RESTARTS / sum(map(len, costs))
    return [c > size * scipy.stats.chi2.isf(chance, f) for c, f in zip(costs, freedom, strict=True)]


class Following:
    """The residual as a function of the parameters alone, for any solver; start states follow.

    It starts at a point and, if known, the normal equations there with their rows. ``notify`` gets the later
    ones.
    """

    def __init__(
        self,
        shooting: Shooting,
        point: Point,
        normal: Normal | None = None,
        notify: Callable[[Point, Normal], None] | None = None,
    ) -> None:
        self._shooting, self._here, self._normal = shooting, point, normal
        self._last, self._notify = point, notify

    def at(self, value: FloatArray) -> Point:
        """Return the point at parameters and latency, (K + 1,)."""
        if not np.array_equal(self._last.value, value):
            if self._normal is None:
                self._last = Point(value, self._here.position, self._here.velocity)
            else:
                self._last = self._shooting.followed(self._here, self._normal, value - self._here.value)
        return self._last

    def residual(self, value: FloatArray) -> FloatArray:
        """See :class:`LeastSquares`."""
        return self._shooting.vector(self.at(value))

    def jacobian(self, value: FloatArray) -> FloatArray:
        """See :class:`LeastSquares`."""
        return self._shooting.derivative(self.normal_at(value))

    def normal_at(self, value: FloatArray) -> Normal:
        """Return the normal equations at parameters and latency, (K + 1,); kept for the last ones."""
        point = self.at(value)
        if self._normal is None or point is not self._here:
            moved = point is not self._here
            self._normal, self._here = self._shooting.normal(point, keep=True), point
            if moved and self._notify is not None:
                self._notify(point, self._normal)
        return self._normal


HUBER = 1.345
"""Residuals beyond this many standard deviations weigh less; 95 % as efficient as least squares on noise
(Huber 1964)."""

LEAST_SCALE = 1e-9
"""Smallest residual scale; smaller residuals of noise-free recordings are rounding [rad or m]."""


def huber_weights(residual: FloatArray) -> FloatArray:
    """Return the weight of each whitened residual, in its shape; 1 for all but the large ones.

    Their spread is the scaled median, and at least that of the noise: small noise in a model that explains
    nothing is no outlier.
    """
    # w = min(1, k s / |r|), s = 1.4826 median |r| (Huber 1964).
    size = np.abs(residual)
    spread = max(MAD_TO_STD * float(np.median(size)), 1.0)
    return np.asarray(np.minimum(1.0, HUBER * spread / np.maximum(size, 1e-300)))


def cauchy_windows(data: Sequence[WindowData], residuals: Sequence[FloatArray]) -> list[WindowData]:
    """Return windows with less weight the more their residual, (W, H, M), exceeds the median's (Cauchy)."""
    costs = [np.sum(r**2, axis=(1, 2)) for r in residuals]
    # Cauchy's weight of a window with cost c is 1 / (1 + c / median); a standard deviation has its root.
    median = max(float(np.median(np.concatenate(costs))), 1e-12)
    return [
        dataclasses.replace(d, std=d.std * np.sqrt(1.0 + c / median)[:, None, None])
        for d, c in zip(data, costs, strict=True)
    ]


def kurtosis(residuals: Sequence[FloatArray]) -> float:
    """Return the fourth moment over the squared second; 3 for noise. A 0 is a missing sample."""
    values = np.concatenate([r.ravel() for r in residuals])
    # n sum r^4 / (sum r^2)^2
    count = np.count_nonzero(values)
    return float(count * np.sum(values**4) / max(float(np.sum(values**2)) ** 2, 1e-300))


def channel_scale(errors: Sequence[FloatArray], seen: Sequence[np.ndarray], robust: bool) -> FloatArray:
    """Return the scale of each channel's errors where the sensors' noise does not give it, (M,).

    Errors, (W, H, M) per episode, count where they were ``seen``. A robust scale is limited by the median, so
    that a local failure does not devalue the channel.
    """
    squares = np.sum(
        [np.sum(np.where(s, r, 0.0) ** 2, axis=(0, 1)) for r, s in zip(errors, seen, strict=True)], axis=0
    )
    counts = np.sum([np.sum(s, axis=(0, 1)) for s in seen], axis=0)
    # s_j = (sum e_j^2 / n_j)^(1/2), at most 1.4826 median |e_j| (Huber, Robust Statistics, 1981, chapter 5).
    scale = np.sqrt(squares / np.maximum(counts, 1))
    if robust:
        size = np.concatenate([np.abs(r).reshape(-1, r.shape[-1]) for r in errors])
        scale = np.minimum(scale, MAD_TO_STD * np.median(size, axis=0))
    return np.asarray(np.maximum(scale, LEAST_SCALE))


def correlated_samples(residuals: Sequence[FloatArray], longest: int) -> float:
    """Return one plus twice the sum of the residuals' correlations up to their first zero, at least 1.

    Residuals are whitened, (W, H, M) per episode of one rate, and 0 for missing samples; lags end at
    ``longest`` samples.
    """
    # tau = 1 + 2 sum_k rho_k (Madras and Sokal 1988), up to the first rho_k <= 0.
    positive = itertools.takewhile(lambda found: found[0] > 0, autocorrelations(residuals, longest))
    return sum((2 * correlation for correlation, _ in positive), 1.0)


def independent_samples(
    residuals: Sequence[FloatArray], counts: Sequence[float], periods_s: Sequence[float]
) -> float:
    """Return how many samples are independent: at each rate their number over their correlation time.

    Args:
        residuals: Of each episode, as in :func:`correlated_samples`; lags end with the windows.
        counts: Samples of each episode.
        periods_s: Sampling period of each episode [s].
    """
    found = 0.0
    for rows in rows_by_value(periods_s):
        of_rate = [residuals[e] for e in rows]
        longest = max(r.shape[1] for r in of_rate)
        found += sum(counts[e] for e in rows) / correlated_samples(of_rate, longest)
    return found
