"""Random errors of a model in a fit's residual, late commands and forces, and a fit that allows for them.

What a model lacks is often no larger than the sensors' noise, but alike over many samples. Least squares
takes such a residual for white noise: it follows the errors, and its intervals are too narrow. Here they are
Gaussian processes beside white noise, each pushing the motion as late commands or forces on the motors would.
Their sizes are the likeliest ones. Parameters have followed the errors, so the likelihood is the restricted
one (Patterson and Thompson 1971). Residuals that are whitened for the processes give the estimate of least
variance (generalised least squares, Aitken 1936).

Symbols: r, whitened residuals of a window, (H M,), H samples of M channels; C_k, effects of the unit
disturbances of a process, (H M, n); V = 1 + sum_k size_k C_k C_k^T, the covariance of r over the noise's
variance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.optimize import Bounds, minimize

from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.command_delays import FreeRows, command_times, delay_columns, free_rows
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, Uncertainty, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import Refined, refine_windows
from deal_hw.calib.fit.residual import Shooting, WindowRows
from deal_hw.calib.fit.solver import BURST_KURTOSIS, kurtosis
from deal_hw.calib.fit.unexplained import Unexplained
from deal_hw.calib.hypotheses.signatures import SignatureResponse, answers
from deal_hw.types import FloatArray

Process: TypeAlias = Literal["delay", "slow delay", "white", "slow"]
"""Late commands, each by itself or slowly changing; forces, white or slowly changing."""

FORCES: tuple[Process, ...] = ("white", "slow")

PROCESSES: tuple[Process, ...] = (*FORCES, "slow delay", "delay")

FEWEST_WINDOWS = 4
"""Fewest windows."""

MOST_ENTRIES = 2_000_000
"""Most entries of the windows' covariances; with more, windows are left out, spread over the recordings."""

ROWS = 320
"""Residuals of each window that are compared, from its start."""

MOST_WHITENED = 20_000_000
"""Most entries of all windows' whole covariances for which a fit is made [-]: 160 MB."""

SLOW_S = 0.1
"""Correlation time of the slow force, and of delays that change slowly [s]."""

VARIANCE_RATIO = (1e-5, 1e5)
"""Least and largest ratio of the mean variances of a process and the noise [-]."""

NO_VARIANCE = 1e-3
"""Variance of a direction over the noise's that needs no whitening [-]."""

FIT_ITERATIONS = 12
"""Most iterations of each fit that allows for random errors."""

FITS = 2
"""Such fits. The second one is whitened by what the first leaves: errors that a fit by least squares has
followed look smaller. On tuning seeds of realistic cart-poles it halves what two of ten are off by, and
leaves the others alone."""


@dataclass(frozen=True, slots=True)
class SeenErrors:
    """Linearised residuals of a fit, and how its windows answer to late commands and forces.

    Attributes:
        rows: Per episode.
        answers: Per episode.
        periods_s: Sampling period of each episode [s].
        columns: Changes by the delay of each command, per episode (W, H M, P) [1/s]. Without them each
            sample's change of a set-point has a delay.
        times: Times of these commands, (W, P) [s].
    """

    rows: Sequence[WindowRows]
    answers: Sequence[SignatureResponse]
    periods_s: Sequence[float]
    columns: Sequence[FloatArray] | None = None
    times: Sequence[FloatArray] | None = None

    @classmethod
    def of(cls, fit: Refined, plain: Shooting | None = None) -> SeenErrors | None:
        """Return those of a fit; None where delays of single commands do not show in its windows.

        ``plain`` are the fit's windows, whitened for the sensors' noise alone; by default the fit's own.
        """
        shooting = plain or fit.shooting
        problem, columns = shooting.problem, []
        for data in shooting.data:
            if (column := delay_columns(problem, fit.theta, fit.latency_s, data)) is None:
                return None
            columns.append(column)
        pairs = zip(shooting.data, columns, strict=True)
        return cls(
            list(shooting.normal(fit.point, keep=True).rows),
            answers(problem, dataclasses.replace(fit, shooting=shooting)),
            [problem.episodes[data.episode].period_s for data in shooting.data],
            columns,
            [command_times(problem, data, column.shape[2]) for data, column in pairs],
        )

    @property
    def free(self) -> list[FreeRows]:
        """The rows without start states, with the columns of delays."""
        pairs = zip(self.rows, self.columns or (), strict=True)
        return [free_rows(r.residual, r.parameter, r.start, c) for r, c in pairs]

    @property
    def enough(self) -> bool:
        """Whether there are enough windows, and commands."""
        windows = sum(len(r.residual) for r in self.rows)
        return windows >= FEWEST_WINDOWS and any(np.any(a.change) for a in self.answers)

    def compared(self) -> list[ErrorWindow]:
        """Return the first residuals of the windows that are compared."""
        entries = sum(len(r.residual) * min(r.residual.shape[1], ROWS) ** 2 for r in self.rows)
        return self._windows(ROWS)[:: max(-(-entries // MOST_ENTRIES), 1)]

    def whole(self) -> list[ErrorWindow] | None:
        """Return all residuals of all windows; None where they are too many."""
        if sum(len(r.residual) * r.residual.shape[1] ** 2 for r in self.rows) > MOST_WHITENED:
            return None
        return self._windows(None)

    def _windows(self, most: int | None) -> list[ErrorWindow]:
        change = np.concatenate([a.change.reshape(-1, a.change.shape[2]) for a in self.answers])
        rms = np.sqrt(np.mean(change**2, axis=0))
        return [
            ErrorWindow.of(self, e, w, rms, most)
            for e, rows in enumerate(self.rows)
            for w in range(len(rows.residual))
        ]


@dataclass(frozen=True, slots=True)
class ErrorWindow:
    """The first residuals of a window without their projection on the start state.

    Attributes:
        residual: In the remaining directions, (D,).
        parameter: Their derivatives by parameters and latency, (D, K + 1).
        basis: These directions, (H M, D).
        response: Whitened response to a set-point, (A, H, M).
        change: Changes of the set-points, (H, A).
        rms: Their root mean square over all windows, (A,).
        period_s: Sampling period [s].
        late: Changes by the delay of each command, if known, (P, H M) [1/s].
        time_s: Times of these commands, (P,) [s].
    """

    residual: FloatArray
    parameter: FloatArray
    basis: FloatArray
    response: FloatArray
    change: FloatArray
    rms: FloatArray
    period_s: float
    late: FloatArray | None
    time_s: FloatArray | None

    @classmethod
    def of(cls, seen: SeenErrors, e: int, w: int, rms: FloatArray, most: int | None) -> ErrorWindow:
        """Return the window ``w`` of episode ``e``, with at most so many residuals."""
        rows, answer = seen.rows[e], seen.answers[e]
        R, S, M = rows.residual.shape[1], rows.start.shape[2], answer.response.shape[3]
        H = answer.response.shape[2]
        if most is not None:
            H = min(H, max(most // M, 4))
        # The start state's prior comes last.
        kept = np.concatenate([np.arange(H * M), np.arange(R - S, R)])
        basis = np.linalg.qr(rows.start[w][kept], mode="complete")[0][:, S:] if S else np.eye(len(kept))
        return cls(
            residual=basis.T @ rows.residual[w][kept],
            parameter=basis.T @ rows.parameter[w][kept],
            basis=basis[: H * M],
            response=answer.response[:, w, :H],
            change=answer.change[w, :H],
            rms=rms,
            period_s=seen.periods_s[e],
            late=None if seen.columns is None else seen.columns[e][w, : H * M].T,
            time_s=None if seen.times is None else seen.times[e][w],
        )

    def effects(self, process: Process) -> FloatArray:
        """Return the effects of a process' unit disturbances on the residuals, (n, H M).

        Forces are as large as the changes of commands are, (A,) rms.
        """
        A, H, M = self.response.shape
        late = process in ("delay", "slow delay")
        moved: FloatArray
        time_s: FloatArray
        if late and self.late is not None and self.time_s is not None:
            moved, time_s = self.late[None], self.time_s
        else:
            later = np.zeros((A, H, H, M))
            for k in range(H):
                later[:, k, k:] = self.response[:, : H - k]
            if late:
                # A command is late for all actuators.
                moved = np.asarray(np.einsum("ka,akhm->khm", self.change, later)).reshape(1, H, H * M)
            else:
                moved = (self.rms[:, None, None, None] * later).reshape(A, H, H * M)
            time_s = np.arange(H, dtype=np.float64) * self.period_s
        if process in ("slow", "slow delay"):
            apart = np.abs(np.subtract.outer(time_s, time_s))
            root = np.linalg.cholesky(np.exp(-apart / SLOW_S) + 1e-9 * np.eye(len(time_s)))
            moved = np.asarray(np.einsum("lk,alr->akr", root, moved))
        return moved.reshape(-1, H * M)


@dataclass(frozen=True, slots=True)
class Covariance:
    """Covariance of the windows' residuals by one process.

    Attributes:
        each: For a mean variance of 1, (W, D, D).
        intensity: Mean variance of unit disturbances.
    """

    each: FloatArray
    intensity: float

    @classmethod
    def of(cls, windows: Sequence[ErrorWindow], process: Process) -> Covariance:
        """Return that of a process."""
        columns = _padded([window.effects(process) @ window.basis for window in windows])
        every = np.stack([c.T @ c for c in columns])
        scale = max(float(np.mean(np.einsum("wdd->wd", every))), 1e-300)
        return cls(every / scale, scale)


@dataclass(frozen=True, slots=True)
class RandomErrors:
    """The likeliest sizes of processes beside white noise.

    Attributes:
        deviance: Minus twice the restricted log-likelihood, without constants.
        sizes: The mean variance of each over that of the white noise [-].
        level: The noise's variance over that of the sensors [-].
    """

    deviance: float
    sizes: dict[Process, float]
    level: float

    @property
    def shares(self) -> dict[Process, float]:
        """Share of each in the residual's variance."""
        total = 1.0 + sum(self.sizes.values())
        return {name: size / total for name, size in self.sizes.items()}


@dataclass(frozen=True, slots=True)
class ComparedErrors:
    """Windows in which processes are compared.

    Attributes:
        windows: The windows.
        covariances: Of each process.
    """

    windows: Sequence[ErrorWindow]
    covariances: dict[Process, Covariance]

    @classmethod
    def of(cls, seen: SeenErrors) -> ComparedErrors:
        """Return those of a fit's residuals."""
        windows = seen.compared()
        return ComparedErrors(windows, {process: Covariance.of(windows, process) for process in PROCESSES})

    def with_these(self, *processes: Process) -> RandomErrors:
        """Return the likeliest sizes of some of the processes beside white noise."""
        return likely_errors(self.windows, {process: self.covariances[process] for process in processes})


@dataclass(frozen=True, slots=True)
class LikelyErrors:
    """The likeliest sizes of all processes in a residual.

    Attributes:
        covariances: Of each process.
        found: The sizes.
        gain: Gain in deviance over white noise.
    """

    covariances: dict[Process, Covariance]
    found: RandomErrors
    gain: float

    @classmethod
    def of(cls, compared: ComparedErrors) -> LikelyErrors:
        """Compare all processes beside white noise with white noise."""
        found = compared.with_these(*PROCESSES)
        return cls(compared.covariances, found, compared.with_these().deviance - found.deviance)


@dataclass(frozen=True, slots=True)
class ErrorFit:
    """A fit that allows for random errors of the model.

    Attributes:
        fit: The fit; its residuals are whitened for the errors.
        before: The fit by least squares.
        errors: The likeliest errors.
        gain: Their gain in deviance over white noise.
    """

    fit: Refined
    before: Refined
    errors: RandomErrors
    gain: float

    def widened(self, known: Uncertainty, latency_s: float) -> Uncertainty:
        """Return the fit's uncertainty, at least that of least squares, with the alarms of its residual.

        Errors of a model are not as random as processes are. So they make no interval narrower.
        """
        means = "Commands may jitter, too, and the residual is correlated: the fit allows for random errors."
        alarms = [a for a in _plain_uncertainty(self.before).alarms if isinstance(a, Unexplained)]
        return at_least(known, self.before, latency_s, means).with_alarms(last=alarms)


def _plain_uncertainty(before: Refined) -> Uncertainty:
    """Return the uncertainty of a fit that another one continues."""
    before = with_rows(before)
    return uncertainty_at(before.shooting.problem, before)


def at_least(known: Uncertainty, before: Refined, latency_s: float, jitter: str) -> Uncertainty:
    """Return the uncertainty of a fit that continues another one, and at least that one's.

    The latency is the fit's, and ``jitter`` what intervals have of sample times that jitter, in words.
    """
    wide = _plain_uncertainty(before)
    problem = before.shooting.problem
    std = np.zeros(len(known.space))
    std[: len(wide.space)] = np.sqrt(np.diag(wide.covariance))
    reach_s = wide.latency_reach_s(before.latency_s)
    known = known.with_jitter(problem.noise.timing_std_s, jitter)
    return known.widened_to(std).latency_widened_to(reach_s, latency_s, problem.latency_range_s)


def fit_errors(before: Refined) -> ErrorFit | None:
    """Return the fit that allows for the likeliest random errors of a fit by least squares.

    It is None where there are too many residuals, where they come in bursts (a contact, commands that are not
    in the recording), or where not even such errors explain them.
    """
    if kurtosis(before.normal.residual) >= BURST_KURTOSIS:
        # Processes are as large at all times.
        return None
    plain, fit, found = before.shooting, before, None
    for _ in range(FITS):
        seen = SeenErrors.of(fit, plain)
        if seen is None or (windows := seen.whole()) is None:
            return None
        likely = LikelyErrors.of(ComparedErrors.of(seen))
        data = whitened_for(plain.data, windows, likely.found, likely.covariances)
        again = refine_windows(plain.on(data), fit.point, FIT_ITERATIONS)
        fit = dataclasses.replace(again, iterations=fit.iterations + again.iterations)
        found = ErrorFit(fit, before, likely.found, likely.gain)
    if found is None or not fit.chi2 <= MISMATCH_CHI2:
        return None
    return found


def likely_errors(windows: Sequence[ErrorWindow], covariances: dict[Process, Covariance]) -> RandomErrors:
    """Return the likeliest sizes of processes beside white noise; none of them is white noise alone."""
    # What pads a window is no error of any process, and white noise without a residual: it says nothing.
    residual = np.stack(_padded([window.residual for window in windows]))
    followed = np.stack([np.transpose(x) for x in _padded([window.parameter.T for window in windows])])
    W, D = residual.shape
    unit = np.broadcast_to(np.eye(D), (W, D, D))
    power = np.einsum("wdp,wdp->p", followed, followed)
    # Where the windows show nothing of a parameter, it follows nothing.
    seen = power > 0
    followed, weak = followed[..., seen] / np.sqrt(power[seen]), 1e-9 * np.eye(int(seen.sum()))
    count = sum(window.residual.size for window in windows) - int(seen.sum())

    def likelihood(log_ratios: FloatArray) -> tuple[float, FloatArray, float]:
        """Return deviance, its gradient, and the noise's variance."""
        pairs = zip(np.exp(log_ratios), covariances.values(), strict=True)
        parts = [ratio * c.each for ratio, c in pairs]
        inverse = np.linalg.inv(sum(parts, unit))
        across = inverse @ followed
        information = np.einsum("wdp,wdq->pq", followed, across) + weak
        shift = np.linalg.solve(information, np.einsum("wdp,wd->p", across, residual))
        whitened = np.einsum("wij,wj->wi", inverse, residual - followed @ shift)
        level = max(float(np.sum(residual * whitened)) / count, 1e-300)
        deviance = count * np.log(level) - float(np.sum(np.linalg.slogdet(inverse)[1]))
        deviance += float(np.linalg.slogdet(information)[1])
        slope = []
        for part in parts:
            moved = np.einsum("wdp,wde,weq->pq", across, part, across, optimize=True)
            trace = np.sum(inverse * part) - np.trace(np.linalg.solve(information, moved))
            slope.append(trace - np.einsum("wi,wij,wj->", whitened, part, whitened, optimize=True) / level)
        return float(deviance), np.array(slope), level

    def cost(log_ratios: FloatArray) -> tuple[float, FloatArray]:
        return likelihood(log_ratios)[:2]

    found = np.zeros(len(covariances))
    if covariances:
        least, most = np.log(VARIANCE_RATIO)
        found = minimize(cost, found, jac=True, bounds=Bounds(least, most)).x
    deviance, _, level = likelihood(found)
    return RandomErrors(deviance, dict(zip(covariances, map(float, np.exp(found)), strict=True)), level)


def whitened_for(
    data: Sequence[WindowData],
    windows: Sequence[ErrorWindow],
    errors: RandomErrors,
    covariances: dict[Process, Covariance],
) -> list[WindowData]:
    """Return a fit's windows with residuals whitened for random errors.

    ``windows`` are all of them, whole; ``covariances`` are those of the windows that were compared.
    """
    roots = []
    for window in windows:
        effects = [
            np.sqrt(size / covariances[process].intensity) * window.effects(process)
            for process, size in errors.sizes.items()
        ]
        both = np.concatenate(effects)
        # V^(-1/2) = 1 - late late^T with late = U (1 - (1 + g)^(-1/2))^(1/2), for the eigenvectors U and
        # values g of V - 1.
        g, U = np.linalg.eigh(both.T @ both)
        kept = g > NO_VARIANCE
        roots.append(U[:, kept] * np.sqrt(1.0 - 1.0 / np.sqrt(1.0 + g[kept])))
    padded = _padded(roots)
    found, at = [], 0
    for each in data:
        W = len(each.windows)
        found.append(dataclasses.replace(each, late=np.stack(padded[at : at + W]), by_delay=None))
        at += W
    return found


def _padded(arrays: Sequence[FloatArray]) -> list[FloatArray]:
    """Return arrays, (..., n) each, with zeros up to the longest last axis; windows differ in samples."""
    most = max(a.shape[-1] for a in arrays)
    return [np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, most - a.shape[-1])]) for a in arrays]
