"""Multiple shooting: residuals of windows whose start states are unknowns, and their normal equations.

Each window's start state is eliminated (Schur complement). The remaining small system in the parameters and
the latency has their covariance as inverse, with the start states' uncertainty included.

Symbols, with S = 2 C unknowns of a start state (0 where start states are given):
    p: parameters in their own scale (ln of positive ones), then the latency [s], (K + 1,).
    s_w: start state of window w, positions then velocities, (S,); m_w, L_w: its prior mean and information.
    r_w: whitened residuals of window w, (predicted - measured) / std, (R,) [-].
    J_p, J_s: their derivatives by p, (R, K + 1), and by s_w, (R, S).
    q, P: mean and information of the parameters' prior, (K + 1,) each; P is diagonal.
    cost: f(p, s) = (p - q)^T P (p - q) + sum_w [r_w^T r_w + (s_w - m_w)^T L_w (s_w - m_w)].
Gradients and Hessians here are half of those of f; f is twice a negative log-likelihood.

Sources: Gauss-Newton, Bjorck, Numerical Methods for Least Squares Problems (1996), chapter 9; multiple
shooting, Bock (1983); start states that follow are variable projection (Golub and Pereyra 1973) with the
simplified derivative of Kaufman (1975).
"""

from __future__ import annotations

import collections
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deal_hw.calib.data.noise import Mask
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import MemberPrediction, WindowData
from deal_hw.calib.fit.command_delays import with_command_delays
from deal_hw.sim.engine.trees import sharing
from deal_hw.sim.parameters.laws import SERVO_PUNCH, SERVO_RESOLUTION
from deal_hw.types import FloatArray

PARAMETER_STEP = 1e-4
"""Step of the differences that linearise predictions: of a parameter, in its own scale."""

CONTACT_PARAMETER_STEP = 2e-2
"""The same with feet on the floor. Sticking and slipping make kinks on every scale, and a secant describes
them better than a derivative."""

COUNTED_PARAMETER_STEP = 2e-2
"""The same where servos read their joints in counts. The motion follows these in jumps: a smaller step passes
too few of them, and its effect is chance."""

JUMP_PARAMETER_STEP, JUMP_POSITION_STEP, JUMP_VELOCITY_STEP = 5e-3, 1e-4, 1e-2
"""The steps where a servo's effort jumps at the edge of its dead zone. It does so at the beginning of a
physics step; a smaller change moves hardly any jump to another one."""

NOISE_FREE_PARAMETER_STEP = 1e-5
"""The same for noise-free states, where no noise hides a secant's error."""

LATENCY_STEP_S = 2e-4
"""The same of the latency [s]."""

POSITION_STEP = 1e-6
"""The same of a start position [rad or m]."""

VELOCITY_STEP = 1e-4
"""The same of a start velocity [rad/s or m/s]."""

CONTACT_STATE_STEP = 0.5
"""The same of start states with feet on the floor, in standard deviations of the smoothed ones."""

LEAST_INFORMATION = 1e-9
"""Least information on a start state [1 / unit²]: that of a standard deviation of 30,000 rad, or m, or a
second's."""

States = list[tuple[FloatArray, FloatArray]]
"""Positions and velocities at every sample of each episode, (T, C) each."""


@dataclass(frozen=True, slots=True)
class Point:
    """A point of the solver.

    Attributes:
        value: Parameters in their own scale, then the latency [s], (K + 1,).
        position: Start positions of each episode's windows, (W, C) each.
        velocity: Start velocities, likewise.
    """

    value: FloatArray
    position: tuple[FloatArray, ...]
    velocity: tuple[FloatArray, ...]


class _Kept:
    """Predictions at the last points, for all fits of the same windows.

    Of two points, as a step that is refused leads back to the one before it.
    """

    def __init__(self) -> None:
        self._last: collections.deque[tuple[Point, list[FloatArray]]] = collections.deque(maxlen=2)

    def at(self, point: Point) -> list[FloatArray] | None:
        """Return the predictions at a point, (W, H, M) an episode, if they are known."""
        starts = (*point.position, *point.velocity)
        for other, found in self._last:
            same = all(a is b for a, b in zip(starts, (*other.position, *other.velocity), strict=True))
            if same and np.array_equal(point.value, other.value):
                return found
        return None

    def keep(self, point: Point, found: list[FloatArray]) -> None:
        """Keep predictions at a point."""
        self._last.append((point, found))


@dataclass(frozen=True)
class WindowRows:
    """Linearised residuals of one episode's windows; the last S rows are the prior of the start states.

    Attributes:
        residual: Whitened residuals, (W, R) with R = H M + S.
        parameter: Their derivatives by parameters and latency, (W, R, K + 1).
        start: By the start states, (W, R, S).
    """

    residual: FloatArray
    parameter: FloatArray
    start: FloatArray

    @cached_property
    def start_normal(self) -> FloatArray:
        """Normal matrices of the start states, (W, S, S)."""
        return np.asarray(np.einsum("wri,wrj->wij", self.start, self.start))

    def without_starts(self, columns: FloatArray) -> FloatArray:
        """Return columns, (W, R, n), without their projection on the start states."""
        # (1 - J_s (J_s^T J_s)^-1 J_s^T) columns: the projection beside the span of J_s.
        moved = np.linalg.solve(self.start_normal, np.einsum("wrs,wri->wsi", self.start, columns))
        return np.asarray(columns - np.einsum("wrs,wsi->wri", self.start, moved))

    @property
    def following(self) -> FloatArray:
        """Derivatives by parameters and latency with start states that follow, (W, R, K + 1)."""
        return self.without_starts(self.parameter)

    @property
    def rest(self) -> FloatArray:
        """The residual that no start state explains, (W, R)."""
        return np.asarray(self.without_starts(self.residual[..., None])[..., 0])


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations at a point, start states eliminated.

    Attributes:
        cost: Sum of squared whitened residuals.
        count: Residuals minus the start states' unknowns.
        hessian: (K + 1, K + 1).
        gradient: (K + 1,).
        residual: Whitened residuals per episode, (W, H, M).
        prior: Information of the parameters' priors in the hessian, (K + 1,).
        back: Per episode, gain from parameter steps to start-state steps, (W, 2C, K + 1), and the start
            states' own step, (W, 2C).
        rows: Linearised residuals per episode, if requested.
        periods_s: Sampling period of each episode [s]; empty: one rate.
    """

    cost: float
    count: int
    hessian: FloatArray
    gradient: FloatArray
    residual: tuple[FloatArray, ...]
    prior: FloatArray
    back: tuple[tuple[FloatArray, FloatArray], ...] = ()
    rows: tuple[WindowRows, ...] = ()
    periods_s: tuple[float, ...] = ()


class Shooting:
    """Residuals, normal equations and candidate steps for one cut into windows of ``length`` samples.

    ``length`` counts as that of :meth:`Problem.windows`.

    Start states are ``given``, the smoothed ones, or each is an unknown; exact states are always given.
    ``prior_share`` is the spread of parameters without a prior around their nominal values as a share of
    their range, in their own scale; infinite for none. A ``fixed_latency`` stays as it is in all steps;
    by default one that the problem gives.
    """

    def __init__(
        self,
        problem: Problem,
        length: int,
        data: Sequence[WindowData] | None = None,
        *,
        given: bool = False,
        prior_share: float = np.inf,
        fixed_latency: bool | None = None,
        kept: _Kept | None = None,
    ) -> None:
        self.problem = problem
        self.fixed_latency = problem.fixed_latency_s is not None if fixed_latency is None else fixed_latency
        self.given = given or problem.noise_free
        self.prior_share = prior_share
        self.data: Sequence[WindowData] = (
            with_command_delays(problem, problem.windows(length)) if data is None else data
        )
        self.length = length
        # Which coordinates each entry of (p, s_w) moves, (K + 1 + 2 C, C), and with which each channel moves.
        joined = [problem.trees[d.episode][:, None] == problem.trees[d.episode] for d in self.data]
        late = np.ones((1, problem.coordinates), dtype=bool)
        self._reach = [
            np.concatenate([problem.reach(d.episode), late, own, own])
            for d, own in zip(self.data, joined, strict=True)
        ]
        self._moved_with = problem.channel_coordinates
        self._kept = kept or _Kept()
        space = problem.space
        mean, std = space.prior
        own = 1 / std**2
        # A range says something only where nothing else does.
        around = np.where(np.isfinite(std), 0.0, 1 / (prior_share * space.width) ** 2)
        # The latency has no prior.
        self.prior_information = np.append(own + around, 0.0)
        self.prior_mean = np.append(space.to_scale(mean), 0.0)
        C = problem.coordinates
        # Where a window diverges whatever its start, nothing else is left to say where it starts.
        self.start_information = [np.maximum(1 / d.prior_std**2, LEAST_INFORMATION) for d in self.data]
        self.parameter_step = NOISE_FREE_PARAMETER_STEP if problem.noise_free else PARAMETER_STEP
        self._state_step = np.concatenate([np.full(C, POSITION_STEP), np.full(C, VELOCITY_STEP)])
        kinds = {p.kind for p in problem.space.parameters}
        if SERVO_PUNCH in kinds:
            self.parameter_step = JUMP_PARAMETER_STEP
            self._state_step = np.repeat([JUMP_POSITION_STEP, JUMP_VELOCITY_STEP], C)
        if SERVO_RESOLUTION in kinds:
            self.parameter_step = COUNTED_PARAMETER_STEP
        if self.contacts:
            self.parameter_step = CONTACT_PARAMETER_STEP
            self._state_step = np.maximum(CONTACT_STATE_STEP * self.state_std, self._state_step)

    @property
    def seconds(self) -> float:
        """Length of all windows together [s]."""
        cut = [(d.windows, self.problem.episodes[d.episode].step_s) for d in self.data]
        return sum(len(w) * w.length * w.stride * step_s for w, step_s in cut)

    @property
    def contacts(self) -> bool:
        """Whether sticking and slipping feet make kinks in the effect of start states."""
        return self.problem.robot.base is not None and not self.given

    def on(
        self,
        data: Sequence[WindowData],
        *,
        prior_share: float | None = None,
        fixed_latency: bool | None = None,
    ) -> Shooting:
        """Return the same fit of other windows, such as a part of these, or weighted ones."""
        share = self.prior_share if prior_share is None else prior_share
        fixed = self.fixed_latency if fixed_latency is None else fixed_latency
        pairs = zip(data, self.data, strict=False)
        # Weights change no prediction.
        same = len(data) == len(self.data) and all(a.windows is b.windows for a, b in pairs)
        return Shooting(
            self.problem,
            self.length,
            data,
            given=self.given,
            prior_share=share,
            fixed_latency=fixed,
            kept=self._kept if same else None,
        )

    def start(self, theta: FloatArray, latency_s: float, states: States | None = None) -> Point:
        """Return the point at parameters (K,) and latency [s].

        ``states`` gives the windows' start states; the smoothed ones by default.
        """
        source = states or self.smoothed()
        return Point(
            np.append(self.problem.space.to_scale(theta), latency_s),
            tuple(source[d.episode][0][d.windows.start] for d in self.data),
            tuple(source[d.episode][1][d.windows.start] for d in self.data),
        )

    def smoothed(self) -> States:
        """Return the smoothed states of all episodes."""
        return [(s.position, s.velocity) for s in self.problem.starts]

    def states(self, point: Point, *, handed_on: bool = False) -> States:
        """Return the fitted states at every sample of every episode; smoothed ones outside the windows.

        Where one window ends and the next starts, the start state counts, or, ``handed_on``, the prediction.
        """
        found = [(x.copy(), v.copy()) for x, v in self.smoothed()]
        for e, data in enumerate(self.data):
            x, v = found[data.episode]
            start_x, start_v = point.position[e][None], point.velocity[e][None]
            predicted = self._predict(point.value[None], data, start_x, start_v)
            x[data.windows.start], v[data.windows.start] = point.position[e], point.velocity[e]
            # The last sample of a window is the start of the next, where it has a state of its own.
            last = data.windows.length if handed_on else data.windows.length - 1
            inner = data.windows.samples()[:, :last]
            x[inner], v[inner] = predicted.position[0, :, :last], predicted.velocity[0, :, :last]
        return found

    def theta(self, point: Point) -> FloatArray:
        """Return the physical parameters at a point, (K,)."""
        return self.problem.space.from_scale(point.value[:-1])

    def normal(
        self,
        point: Point,
        keep: bool = False,
        stretch: float = 1.0,
        *,
        central: bool = False,
        states_only: bool = False,
    ) -> Normal:
        """Return the normal equations at a point; derivatives by forward differences in one batch.

        With ``keep`` the linearised residuals, which take much memory, are returned, too. ``stretch`` is a
        factor on the differences' steps; negative for backward ones. ``central`` differences cost twice as
        much: the truncation error of one-sided ones looks like information where there is none. With
        ``states_only`` parameters have no derivatives: enough for a step of the start states, and cheaper.
        """
        K, C = len(point.value) - 1, self.problem.coordinates
        moved = 0 if self.given else C
        members = K + 1 + 2 * moved
        steps = np.concatenate([np.full(K, self.parameter_step), [LATENCY_STEP_S], self._state_step])
        steps = stretch * steps[:members]
        # A negative latency or friction is no model: there, differences are taken inwards.
        low, high = value_bounds(self.problem)
        outside = (point.value + steps[: K + 1] < low) | (point.value + steps[: K + 1] > high)
        steps[: K + 1] *= np.where(outside, -1.0, 1.0)
        before = point.value - steps[: K + 1]
        one_sided = np.concatenate([outside | (before < low) | (before > high), np.zeros(2 * moved, bool)])
        # The prior's part: H = P, g = P (p - q).
        expected = point.value - self.prior_mean
        hessian, gradient = np.diag(self.prior_information), self.prior_information * expected
        cost, count = float(np.sum(self.prior_information * expected**2)), 0
        rows: list[WindowRows] = []
        back: list[tuple[FloatArray, FloatArray]] = []
        residuals: list[FloatArray] = []
        base = self._observed(point)
        for e, data in enumerate(self.data):
            acting = np.asarray(self._reach[e][:members].any(axis=1))
            acting[: K + 1] &= not states_only
            r = data.whitened(base[e] - data.measured)
            difference = self._changes(e, point, steps, acting)
            if central:
                two = ~one_sided[acting]
                # (y(p + h) - y(p - h)) / 2; divided by h below, as y(p + h) - y(p) is.
                difference[two] = (difference - self._changes(e, point, -steps, acting))[two] / 2
            jac = np.moveaxis(data.whitened(difference), 0, -1) / steps[acting]
            if not acting.all():
                # Parameters of other set-ups change nothing here, and are not simulated.
                every = np.zeros((*r.shape, members))
                every[..., acting] = jac
                jac = every
            if np.isfinite(r).all():
                # A column that diverges beside a finite base gives no direction.
                jac = np.nan_to_num(jac, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
            W = len(data.windows)
            r_flat, jac = r.reshape(W, -1), jac.reshape(W, -1, len(steps))
            jp, js = jac[..., : K + 1], jac[..., K + 1 :]
            residuals.append(r)
            # H += J_p^T J_p, g += J_p^T r: Gauss-Newton, without the residuals' second derivatives.
            hessian += np.einsum("wri,wrj->ij", jp, jp)
            gradient += np.einsum("wri,wr->i", jp, r_flat)
            cost += float(np.sum(r_flat**2))
            if self.given:
                count += int(np.count_nonzero(data.reported))
                back.append((np.zeros((W, 2 * C, K + 1)), np.zeros((W, 2 * C))))
                if keep:
                    rows.append(WindowRows(r_flat, jp, js))
                continue
            start = np.concatenate([point.position[e], point.velocity[e]], axis=1) - data.prior_mean
            information = self.start_information[e]
            if keep:
                rows.append(_rows(r_flat, jp, js, np.sqrt(information), start))
            # The blocks of window w: H_ss = J_s^T J_s + L, g_s = J_s^T r + L (s - m), H_sp = J_s^T J_p.
            # Their elimination leaves the Schur complement H -= H_sp^T H_ss^-1 H_sp, g -= H_sp^T H_ss^-1 g_s.
            # A step dp takes the start state along by ds = -H_ss^-1 (g_s + H_sp dp); `back` has both parts.
            mss = np.einsum("wri,wrj->wij", js, js) + information[:, :, None] * np.eye(2 * C)
            gs = np.einsum("wri,wr->wi", js, r_flat) + information * start
            msp = np.einsum("wri,wrj->wij", js, jp)
            solved = np.linalg.solve(mss, np.concatenate([msp, gs[..., None]], axis=2))
            back.append((solved[..., :-1], solved[..., -1]))
            hessian -= np.einsum("wsi,wsj->ij", msp, solved[..., :-1])
            gradient -= np.einsum("wsi,ws->i", msp, solved[..., -1])
            cost += float(np.sum(information * start**2))
            count += int(np.sum(data.freedom))
        periods_s = tuple(self.problem.episodes[d.episode].period_s for d in self.data)
        found = tuple(residuals), self.prior_information, tuple(back), tuple(rows), periods_s
        return Normal(cost, count, hessian, gradient, *found)

    def followed(self, point: Point, normal: Normal, step: FloatArray) -> Point:
        """Return the point after a parameter step, (K + 1,), each window's start state moved as fits it best.

        Beside a kink (stick-slip, a pole that passes the top) the derivative of a window's start state may
        point uphill. One such window would stop all parameters. So each takes the best of four ways: stay,
        take its own step, follow the parameter step, or both.
        """
        value = point.value + step
        if self.given:
            return Point(value, point.position, point.velocity)
        ways = []
        for gain, shift in normal.back:
            stay = np.zeros_like(shift)
            follow = gain @ step
            # Without a step two of the ways are the others.
            more = [follow, shift + follow] if step.any() else []
            ways.append(-np.stack([stay, shift, *more]))
        return self.moved(point, value, ways)

    def moved(self, point: Point, value: FloatArray, ways: Sequence[FloatArray]) -> Point:
        """Return the point at other parameters, each window's start state moved by its best step.

        ``value``, (K + 1,), holds parameters and latency, ``ways`` the steps to choose from, (D, W, 2 C) per
        episode.
        """
        C, position, velocity, observed = self.problem.coordinates, [], [], []
        for e, way in enumerate(ways):
            x, v = point.position[e] + way[..., :C], point.velocity[e] + way[..., C:]
            predicted = self._predict(np.repeat(value[None], len(x), axis=0), self.data[e], x, v).observed
            best = np.argmin(self._window_costs(e, predicted, x, v), axis=0)
            window = np.arange(x.shape[1])
            position.append(x[best, window])
            velocity.append(v[best, window])
            observed.append(predicted[best, window])
        found = Point(value, tuple(position), tuple(velocity))
        self._kept.keep(found, observed)
        return found

    def vector(self, point: Point) -> FloatArray:
        """Return all whitened residuals at a point, priors last, (M,)."""
        # Its squared length is f: r_w, then L_w^(1/2) (s_w - m_w) of each window, then P^(1/2) (p - q).
        found = []
        for e, residual in enumerate(self.residuals(point)):
            flat = residual.reshape(len(residual), -1)
            if not self.given:
                start = np.concatenate([point.position[e], point.velocity[e]], axis=1)
                known = np.sqrt(self.start_information[e]) * (start - self.data[e].prior_mean)
                flat = np.concatenate([flat, known], axis=1)
            found.append(flat.ravel())
        return np.concatenate([*found, np.sqrt(self.prior_information) * (point.value - self.prior_mean)])

    def derivative(self, normal: Normal) -> FloatArray:
        """Return the derivative of :meth:`vector` with start states that follow, (M, K + 1).

        ``normal`` holds the normal equations at the point, with their rows.
        """
        found = []
        for rows, (gain, _) in zip(normal.rows, normal.back, strict=True):
            # J_p - J_s H_ss^-1 H_sp. The change of H_ss^-1 with p is left out (Kaufman 1975).
            by = rows.parameter
            if not self.given:
                by = by - np.einsum("wrs,wsp->wrp", rows.start, gain)
            found.append(by.reshape(-1, by.shape[-1]))
        return np.concatenate([*found, np.diag(np.sqrt(self.prior_information))])

    @property
    def state_std(self) -> FloatArray:
        """Typical standard deviation of smoothed start states, the largest of all episodes, (2 C,)."""
        return np.asarray(np.max([self.problem.starts[d.episode].typical_std for d in self.data], axis=0))

    def cost(self, point: Point) -> float:
        """Return the sum of all squared whitened residuals at a point; infinite where it diverged."""
        # f(p, s), see the module's text.
        prior = ((point.value - self.prior_mean)[None] ** 2 @ self.prior_information)[0]
        return float(prior + np.sum([c.sum() for c in self.window_costs(point)]))

    def window_costs(self, point: Point) -> list[FloatArray]:
        """Return each window's cost at a point, (W,) per episode."""
        starts = enumerate(zip(self._observed(point), point.position, point.velocity, strict=True))
        return [self._window_costs(e, y[None], x[None], v[None])[0] for e, (y, x, v) in starts]

    def _window_costs(self, e: int, predicted: FloatArray, x: FloatArray, v: FloatArray) -> FloatArray:
        """Return the cost of each window of an episode, (N, W); infinite where a member diverged."""
        data = self.data[e]
        cost = np.sum(data.whitened(predicted - data.measured) ** 2, axis=(2, 3))
        if not self.given:
            start = np.concatenate([x, v], axis=2) - data.prior_mean
            cost = cost + np.sum(self.start_information[e] * start**2, axis=2)
        return np.where(np.isfinite(cost), cost, np.inf)

    def residuals(self, point: Point) -> list[FloatArray]:
        """Return the whitened residuals at a point, (W, H, M) an episode."""
        predicted = self._observed(point)
        return [data.whitened(y - data.measured) for y, data in zip(predicted, self.data, strict=True)]

    def _observed(self, point: Point) -> list[FloatArray]:
        """Return the predictions at a point, (W, H, M) an episode; those of the last points are kept."""
        found = self._kept.at(point)
        if found is None:
            starts = zip(self.data, point.position, point.velocity, strict=True)
            found = [self._predict(point.value[None], d, x[None], v[None]).observed[0] for d, x, v in starts]
            self._kept.keep(point, found)
        return found

    def perturbed(self, point: Point, spread: float, count: int, rng: np.random.Generator) -> Point:
        """Return the point with, window by window, the best of ``count`` drawn start states.

        Given the parameters, windows are independent, so one batch searches them all. It frees windows whose
        feet stick where they should slip, which no derivative shows. Half of the draws are around the
        smoothed states instead of the point's; ``spread`` is in the smoothed states' standard deviations.
        """
        std, ways = spread * self.state_std, []
        for e, data in enumerate(self.data):
            draw = std * rng.standard_normal((count, len(data.windows), len(std)))
            draw[0] = 0.0
            smoothed = np.concatenate([data.start_position, data.start_velocity], axis=1)
            draw[1::2] += smoothed - np.concatenate([point.position[e], point.velocity[e]], axis=1)
            ways.append(draw)
        return self.moved(point, point.value, ways)

    def _changes(self, e: int, point: Point, steps: FloatArray, chosen: Mask) -> FloatArray:
        """Return what n changes do to an episode's predictions at a point, (n, W, H, M).

        Each is of one entry of (p, s_w), in all windows at once: windows do not share start states. Changes
        that move different coordinates are made in one simulation.

        Args:
            e: The episode.
            point: The point.
            steps: The step of each entry, (K + 1 + S,).
            chosen: The n entries, likewise.
        """
        entries, reach = np.flatnonzero(chosen), self._reach[e][: len(chosen)][chosen]
        number, P, C = sharing(reach), len(point.value), self.problem.coordinates
        together = np.zeros((number.max(initial=-1) + 1, P + 2 * C))
        together[number, entries] = steps[chosen]
        x = point.position[e] + together[:, None, P : P + C]
        v = point.velocity[e] + together[:, None, P + C :]
        # y(p + h_i e_i) - y(p) of each entry i; entries of one simulation move different coordinates.
        predicted = self._predict(point.value + together[:, :P], self.data[e], x, v).observed
        found = predicted[number] - self._observed(point)[e]
        return np.asarray(np.where(reach[:, self._moved_with][:, None, None], found, 0.0))

    def _predict(
        self, values: FloatArray, data: WindowData, x: FloatArray, v: FloatArray
    ) -> MemberPrediction:
        theta = self.problem.space.from_scale(values[:, :-1])
        return self.problem.predict(theta, values[:, -1], data, x, v)


def value_bounds(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper bounds of the parameters in their own scale and of the latency [s], (K + 1,)."""
    space = problem.space
    low, high = problem.latency_range_s
    return np.append(space.to_scale(space.low), low), np.append(space.to_scale(space.high), high)


def _rows(
    residual: FloatArray, jp: FloatArray, js: FloatArray, root: FloatArray, start: FloatArray
) -> WindowRows:
    """Append to each window the rows of its start state's prior."""
    W, _, S = js.shape
    return WindowRows(
        np.concatenate([residual, root * start], axis=1),
        np.concatenate([jp, np.zeros((W, S, jp.shape[2]))], axis=1),
        np.concatenate([js, root[:, :, None] * np.eye(S)], axis=1),
    )
