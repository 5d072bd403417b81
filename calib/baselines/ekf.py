"""`ekf`: parameters as additional states of an extended Kalman filter that runs along the recording.

It is the filter of the paper's Table 6. The paper does not say how often it ran along the recording:
`ekf-one-pass` runs once, `ekf` several times, with noise that falls to the sensors' own. The state is
(positions, velocities, parameters in their own scale, latency). The model is one sample of simulation, and
its Jacobian comes from forward differences in one batch. The filter is extended, not unscented or ensemble:
nonlinearity within the uncertainty is ignored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.parts import taken
from deal_hw.calib.data.search import Search, SearchLog, Stepper
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.intervals import intervals
from deal_hw.calib.fit.residual import (
    LATENCY_STEP_S,
    PARAMETER_STEP,
    POSITION_STEP,
    VELOCITY_STEP,
    value_bounds,
)
from deal_hw.calibration import Z90, CalibrationResult
from deal_hw.findings import Finding
from deal_hw.types import FloatArray


class ExtendedKalman:
    """An extended Kalman filter with numeric Jacobians; it knows no simulator.

    The first n of its D states move; the others, the parameters, stay. :meth:`ask` returns the points to
    simulate for one step, and :meth:`tell` takes the results. It begins at a mean, (D,), and a covariance,
    (D, D). ``step`` is that of the forward differences, (D,), ``noise`` the variance that is added before
    each step, (D,).
    """

    def __init__(
        self, mean: FloatArray, covariance: FloatArray, moving: int, step: FloatArray, noise: FloatArray
    ) -> None:
        self.mean, self.covariance = mean.copy(), covariance.copy()
        self._moving, self._step, self._noise = moving, step, noise

    def ask(self) -> FloatArray:
        """Return the mean and, for each state, the mean with that state changed: (1 + D, D)."""
        return np.concatenate([self.mean[None], self.mean + np.diag(self._step)])

    def tell(self, moved: FloatArray, observed: FloatArray, measured: FloatArray, std: FloatArray) -> float:
        """Predict and update; return the innovation's squared length in its own covariance over the channels.

        It is 1 on average for a consistent filter. ``moved`` are the moving states of each point after the
        step, (1 + D, n), ``observed`` the predicted measurements of each, (1 + D, M). The measurements are
        (M,), their standard deviations (M,) too; infinite for missing ones.
        """
        n, D = self._moving, len(self.mean)
        known = np.isfinite(std)
        # Noise enters at the start of a step, so that one set of points gives both Jacobians.
        prior = self.covariance + np.diag(self._noise)
        F = np.eye(D)
        F[:n] = (moved[1:] - moved[0]).T / self._step
        G = ((observed[1:] - observed[0]).T / self._step)[known]
        self.mean[:n] = moved[0]
        self.covariance = F @ prior @ F.T
        if not known.any():
            return math.nan
        S = G @ prior @ G.T + np.diag(std[known] ** 2)
        gain = np.linalg.solve(S, G @ prior @ F.T).T
        innovation = measured[known] - observed[0, known]
        self.mean += gain @ innovation
        P = self.covariance - gain @ S @ gain.T
        self.covariance = 0.5 * (P + P.T)
        return float(innovation @ np.linalg.solve(S, innovation)) / int(known.sum())

    def restart(self, mean: FloatArray, std: FloatArray) -> None:
        """Reset the moving states, (n,) each, and their correlation with the parameters."""
        n = self._moving
        self.mean[:n] = mean
        self.covariance[:n], self.covariance[:, :n] = 0.0, 0.0
        self.covariance[:n, :n] = np.diag(std**2)


DIVERGED = 3.0
"""Ratio of the innovations to their own variance above which the filter does not follow the recording."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfSettings:
    """Settings of `ekf`.

    Attributes:
        passes: Runs along all recordings, at most the budget's generations. Each starts at the last one's
            parameters and with the first one's covariance, so that no sample counts twice.
        parameter_drift: Standard deviation of a parameter's drift in one second, in parts of its range.
        first_noise_factor: Factor on the sensors' standard deviations in the first pass. It falls by equal
            ratios to 1 in the last. Far from the truth, nonlinearity outweighs the noise.
    """

    passes: int = 8
    parameter_drift: float = 1e-3
    first_noise_factor: float = 30.0


class _Passes(Stepper):
    """One run: a generation is one pass along all recordings."""

    settings: EkfSettings
    STATE = ("_value", "_covariance", "_lost", "_misfit")

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self._samples: Sequence[WindowData] = log.problem.windows(1)
        self._low, self._high = value_bounds(log.problem)
        space = log.problem.space
        self._free_latency = log.problem.fixed_latency_s is None
        # A range is a flat prior: its midpoint and standard deviation, where a parameter has no own prior.
        expected, spread = space.prior
        known = np.isfinite(spread)
        self._drift = np.append(space.width, self._high[-1] - self._low[-1])
        self._prior_std = self._drift / math.sqrt(12.0)
        self._prior_std[:-1] = np.where(known, spread, self._prior_std[:-1])
        middle = 0.5 * (self._low[-1] + self._high[-1])
        start = space.to_scale(np.where(known, expected, space.center))
        self._value = np.append(start, self.coordinates.clip_latency(float(middle)))
        if not self._free_latency:
            self._prior_std = self._prior_std[:-1]
        self._covariance = np.diag(self._prior_std**2)
        self._lost, self._misfit = 0, math.nan

    @property
    def finished(self) -> bool:
        """Whether all passes are done, or the budget is used up."""
        return len(self.log.trace) >= self._passes

    @property
    def _passes(self) -> int:
        return max(min(self.settings.passes, self.log.budget.generations), 1)

    def step(self) -> None:
        """Run along all recordings once."""
        filter_ = self._filter()
        left = 1.0 - len(self.log.trace) / max(self._passes - 1, 1)
        factor = self.settings.first_noise_factor ** max(left, 0.0)
        misfits: list[float] = []
        self._lost = 0
        for data in self._samples:
            misfits += self._along(filter_, data, factor)
        n = 2 * self.problem.coordinates
        self._value[: len(self._prior_std)] = filter_.mean[n:]
        self._covariance = filter_.covariance[n:, n:]
        usable = np.array(misfits)[np.isfinite(misfits)]
        self._misfit = float(usable.mean()) if len(usable) else math.inf
        members = self._members(self._value[None])
        self.log.note(
            f"innovations {self._misfit:.3g} times their variance, {self._lost} steps lost",
            members,
            {"misfit": self._misfit, "lost": float(self._lost)},
        )

    def _filter(self) -> ExtendedKalman:
        problem, settings = self.problem, self.settings
        C, P = problem.coordinates, len(self._prior_std)
        n = 2 * C
        covariance = np.zeros((n + P, n + P))
        covariance[n:, n:] = np.diag(self._prior_std**2)
        steps = np.concatenate(
            [
                np.full(C, POSITION_STEP),
                np.full(C, VELOCITY_STEP),
                np.append(np.full(len(problem.space), PARAMETER_STEP), LATENCY_STEP_S)[:P],
            ]
        )
        drift = settings.parameter_drift * self._drift[:P] * math.sqrt(problem.period_s)
        # Q: the simulation of one sample counts as exact, so only the parameters drift.
        noise = np.append(np.zeros(n), drift) ** 2
        return ExtendedKalman(np.append(np.zeros(n), self._value[:P]), covariance, n, steps, noise)

    def _along(self, filter_: ExtendedKalman, data: WindowData, factor: float) -> Iterator[float]:
        """Run along one recording with the sensors' standard deviations multiplied by a factor."""
        problem = self.problem
        C, P = problem.coordinates, len(self._prior_std)
        std = problem.starts[data.episode].std
        before = None
        for w, start in enumerate(data.windows.start):
            if before is None or start != before + 1:
                filter_.restart(np.concatenate([data.start_position[w], data.start_velocity[w]]), std[start])
            before = start
            points = filter_.ask()
            values = np.repeat(self._value[None], len(points), axis=0)
            values[:, :P] = points[:, 2 * C :]
            members = self._members(values)
            predicted = problem.predict(
                members.theta,
                members.latency_s,
                taken(data, np.array([w])),
                points[:, None, :C],
                points[:, None, C : 2 * C],
            )
            moved = np.concatenate([predicted.position[:, 0, 0], predicted.velocity[:, 0, 0]], axis=1)
            if not np.isfinite(moved).all():
                # The next step starts from the recording again.
                self._lost, before = self._lost + 1, None
                continue
            noise = factor * data.std[w, 0]
            yield filter_.tell(moved, predicted.observed[:, 0, 0], data.measured[w, 0], noise)
            inside = np.clip(filter_.mean[2 * C :], self._low[:P], self._high[:P])
            filter_.mean[2 * C :] = inside

    def _members(self, values: FloatArray) -> Members:
        theta = self.problem.space.from_scale(values[:, :-1])
        return Members(theta, np.maximum(values[:, -1], 0.0))

    def result(self) -> CalibrationResult:
        """Return the last pass's parameters and the filter's own covariance."""
        space = self.problem.space
        K = len(space)
        centre = self._members(self._value[None])
        covariance = self._covariance[:K, :K]
        latency, clip = float(self._value[-1]), self.coordinates.clip_latency
        alarms = []
        if not self._misfit < DIVERGED:
            alarms.append(
                Finding.alarm(
                    f"The filter's innovations are {self._misfit:.1f} times their own variance.",
                    "The filter diverged: its covariance is not valid.",
                    "Use another method, or narrower ranges (--range NAME LOW HIGH).",
                )
            )
        spread = Z90 * math.sqrt(max(self._covariance[K, K], 0.0)) if self._free_latency else 0.0
        return self.log.result(
            centre,
            centre,
            chi2=self._misfit,
            alarms=alarms,
            extra={"lost_steps": self._lost, "interval": "the filter's own covariance of the last pass"},
            interval=intervals(space, centre.theta[0], covariance),
            covariance=covariance,
            latency_interval_s=(clip(latency - spread), clip(latency + spread)),
        )


@dataclass(frozen=True)
class Ekf(Search):
    """Augmented extended Kalman filter; it draws nothing."""

    stepper = _Passes
    settings: EkfSettings = field(default_factory=EkfSettings)
    name: str = "ekf"


def one_pass() -> Ekf:
    """Return `ekf-one-pass`: the filter runs along the recordings once, with the sensors' own noise."""
    return Ekf(EkfSettings(passes=1, first_noise_factor=1.0), name="ekf-one-pass")
