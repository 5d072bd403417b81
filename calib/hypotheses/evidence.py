"""Evidence on the causes of a residual: regressions on signatures beside the parameters.

Fitted on some windows, they predict the others. Their statistic is the held-out deviance: twice the logarithm
of the likelihood ratio, with an estimated noise level.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from deal_hw.calib.data.folds import fold_numbers
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import ended_at_bound
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.fit.solver import independent_samples
from deal_hw.calib.hypotheses.cause_words import SearchedKinds
from deal_hw.calib.hypotheses.random_delay import most_delay_std_s
from deal_hw.calib.hypotheses.signatures import (
    Signature,
    SignatureResponse,
    answers,
    by_recording,
    signatures,
)
from deal_hw.calib.hypotheses.thresholds import EVIDENCE, OWN_EFFECT
from deal_hw.sim.recordings.own_setups import recordings_of
from deal_hw.types import FloatArray

FOLDS = 4
"""Number of folds over the windows."""

ROUNDS = 2
"""Stretches of consecutive windows that each fold leaves out."""

PARAMETER_PRIOR = 0.5
"""Spread of parameters in the regression, as a share of their range [-]."""

LATENCY_PRIOR_S = 0.02
"""Spread of the latency in the regression [s]."""


@dataclass(frozen=True)
class Evidence:
    """Evidence for a diagnosis; regressions on it leave the start states free.

    Attributes:
        rows: Linearised residuals, per episode.
        prior: Information on the parameters and the latency, (P,).
        found: Signatures of the causes.
        periods_s: Sampling period of each episode [s].
        answers: Responses of the windows to commands, per episode; empty if unknown, or if each command's
            delay was an unknown of the fit.
        time_s: Time of each sample in its recording, per episode (W, H) [s].
        names: Names of the recordings, per episode.
        searched: What the fit searched.
        most_delay_std_s: Largest standard deviation of delays [s].
    """

    rows: Sequence[WindowRows]
    prior: FloatArray
    found: Sequence[Signature]
    periods_s: Sequence[float]
    answers: Sequence[SignatureResponse] = ()
    time_s: Sequence[FloatArray] = ()
    names: Sequence[str] = ()
    searched: SearchedKinds = field(default_factory=SearchedKinds)
    most_delay_std_s: float = np.inf
    _costs: dict[tuple[int, ...], float] = field(init=False, repr=False, default_factory=dict)
    _left: dict[int, tuple[Signature, list[FloatArray]]] = field(init=False, repr=False, default_factory=dict)

    @property
    def recordings(self) -> list[str]:
        """Names of the recordings, each once; parts between gaps are of one."""
        return recordings_of(self.names)

    @cached_property
    def _following(self) -> list[FloatArray]:
        return [rows.following for rows in self.rows]

    @cached_property
    def _rest(self) -> list[FloatArray]:
        return [rows.rest for rows in self.rows]

    @cached_property
    def _information(self) -> FloatArray:
        """Information on the parameters, the prior's included, (P, P)."""
        data = [np.tensordot(x, x, axes=((0, 1), (0, 1))) for x in self._following]
        return np.asarray(np.sum(data, axis=0) + np.diag(self.prior))

    def _columns(self, signature: Signature) -> list[FloatArray]:
        """Return a signature's columns without what start states explain."""

        def left(rows: WindowRows, x: FloatArray) -> FloatArray:
            # Rows of the start states' prior are 0.
            return rows.without_starts(np.pad(x, ((0, 0), (0, rows.start.shape[2]), (0, 0))))

        if id(signature) not in self._left:
            # The signature is kept, so that no later one has its identity.
            self._left[id(signature)] = signature, list(map(left, self.rows, signature.columns))
        return self._left[id(signature)][1]

    def _design(self, taken: Sequence[Signature]) -> list[FloatArray]:
        """Return derivatives by the parameters and by signatures, (W, R, P + n) per episode."""
        columns = list(map(self._columns, taken))
        return [np.concatenate(parts, axis=2) for parts in zip(self._following, *columns, strict=True)]

    def _normal(self, taken: Sequence[Signature]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return each window's normal matrix, (W, n, n), and vector, (W, n), squares, (W,), and the prior."""
        design = self._design(taken)
        matrix = np.concatenate([np.einsum("wri,wrj->wij", x, x) for x in design])
        vector = np.concatenate(
            [np.einsum("wri,wr->wi", x, r) for x, r in zip(design, self._rest, strict=True)]
        )
        squares = np.concatenate([np.sum(r**2, axis=1) for r in self._rest])
        own = np.einsum("wii->i", matrix)
        prior = np.append(self.prior, 1e-6 * own[len(self.prior) :] + 1e-12)
        return matrix, vector, squares, prior

    def coefficients(self, taken: Sequence[Signature]) -> FloatArray:
        """Return the regression's coefficients on all windows, parameters first, (P + n,)."""
        matrix, vector, _, prior = self._normal(taken)
        return np.asarray(np.linalg.solve(matrix.sum(axis=0) + np.diag(prior), vector.sum(axis=0)))

    def distinct(self, signature: Signature) -> Signature | None:
        """Return a signature without columns that are the parameters' own effect; None if nothing is left."""
        pairs = list(zip(self._following, self._columns(signature), strict=True))
        across = np.sum([np.tensordot(x, c, axes=((0, 1), (0, 1))) for x, c in pairs], axis=0)
        own = np.sum([np.sum(c**2, axis=(0, 1)) for _, c in pairs], axis=0)
        left = own - np.sum(across * np.linalg.solve(self._information, across), axis=0)
        keep = left > OWN_EFFECT * own
        if keep.all():
            return signature
        columns = tuple(c[..., keep] for c in signature.columns)
        return dataclasses.replace(signature, columns=columns) if keep.any() else None

    def residual(self, taken: Sequence[Signature]) -> list[FloatArray]:
        """Return the residual after the regression, (W, R) per episode."""
        found = self.coefficients(taken)
        return [r - x @ found for x, r in zip(self._design(taken), self._rest, strict=True)]

    def without(self, taken: Sequence[Signature]) -> list[WindowRows]:
        """Return the rows without what signatures explain beside the parameters; start states stay free."""
        found = self.coefficients(taken)[len(self.prior) :]
        left = []
        for e, rows in enumerate(self.rows):
            residual, first = rows.residual.copy(), 0
            for signature in taken:
                columns = signature.columns[e]
                n = columns.shape[2]
                residual[:, : columns.shape[1]] -= columns @ found[first : first + n]
                first += n
            left.append(dataclasses.replace(rows, residual=residual))
        return left

    def by_sample(self, residual: Sequence[FloatArray]) -> list[FloatArray]:
        """Return residuals, (W, R) per episode, as (W, H, M), without the rows of the start states' prior."""
        return [
            r[:, : r.shape[1] - rows.start.shape[2]].reshape(*time_s.shape, -1)
            for time_s, rows, r in zip(self.time_s, self.rows, residual, strict=True)
        ]

    @cached_property
    def count(self) -> float:
        """Number of independent residuals: degrees of freedom over the residuals' correlation time."""
        # A missing sample has a residual of 0.
        degrees = [
            int(np.count_nonzero(rest)) - len(rows.start) * int(rows.start.shape[2])
            for rest, rows in zip(self._rest, self.rows, strict=True)
        ]
        return max(independent_samples(self.by_sample(self.residual([])), degrees, self.periods_s), 1.0)

    def held_out(self, taken: Sequence[Signature]) -> float:
        """Return the total cost of each fold's windows with the regression fitted to the others."""
        key = tuple(map(id, taken))
        if key not in self._costs:
            self._costs[key] = self._held_out(taken)
        return self._costs[key]

    def _held_out(self, taken: Sequence[Signature]) -> float:
        matrix, vector, squares, prior = self._normal(taken)
        P, total = len(self.prior), matrix.sum(axis=0) + np.diag(prior)
        # All windows fit the parameters, with signatures and without (Frisch and Waugh 1933). What a part of
        # them hardly shows would else predict the rest worse than no change, and a signature would gain by
        # undoing that. What is left out is for the signatures alone.
        own = np.linalg.solve(total[:P, :P], vector.sum(axis=0)[:P])
        moved = np.linalg.solve(total[:P, :P], total[:P, P:])
        left = vector - matrix[:, :, :P] @ own
        squares = squares - (vector[:, :P] + left[:, :P]) @ own
        half = matrix[:, P:] - moved.T @ matrix[:, :P]
        vector, matrix = left[:, P:] - left[:, :P] @ moved, half[:, :, P:] - half[:, :, :P] @ moved
        # So that no fold leaves out a whole recording, which may have a zero of its own.
        fold = fold_numbers(len(squares), FOLDS, max(ROUNDS, len(self.recordings)))
        cost = 0.0
        for k in range(FOLDS):
            mine, others = fold == k, fold != k
            found = np.linalg.solve(
                matrix[others].sum(axis=0) + np.diag(prior[P:]), vector[others].sum(axis=0)
            )
            each = squares - 2 * vector @ found + np.einsum("i,wij,j->w", found, matrix, found)
            cost += float(each[mine].sum())
        return cost

    def gain(self, taken: Sequence[Signature], more: Sequence[Signature]) -> float:
        """Return the held-out deviance that ``more`` signatures gain in addition to ``taken``."""
        return self.count * float(np.log(self.held_out(taken) / self.held_out([*taken, *more])))

    def places(
        self, taken: Sequence[Signature], group: Sequence[Signature], least: float = EVIDENCE
    ) -> list[str]:
        """Return the joints or bodies whose signatures gain beside ``taken`` and the others of a group."""
        found = []
        for place in dict.fromkeys(s.where for s in group):
            rest = [s for s in group if s.where != place]
            if self.gain([*taken, *rest], [s for s in group if s.where == place]) > least:
                found.append(place)
        return found


def evidence(problem: Problem, refined: Refined, *, answered: bool = True) -> Evidence:
    """Return the evidence for :func:`deal_hw.calib.hypotheses.diagnosis.diagnose`.

    Args:
        problem: The problem.
        refined: Its fit, with linearised residuals.
        answered: Whether to simulate the answers to commands, which only a delay that varies needs.
    """
    space, data = problem.space, refined.shooting.data
    # A parameter at the end of its range cannot explain more.
    free = np.append(~ended_at_bound(space, refined.theta), problem.fixed_latency_s is None)
    episodes = [problem.episodes[d.episode] for d in data]
    names = [e.name for e in episodes]
    return Evidence(
        rows=[dataclasses.replace(r, parameter=r.parameter * free) for r in refined.normal.rows],
        prior=parameter_prior(problem),
        found=by_recording(signatures(problem, refined), names),
        answers=answers(problem, refined) if answered and problem.command_delays is None else (),
        periods_s=[e.period_s for e in episodes],
        time_s=[
            np.asarray((e.origin + e.sample[d.windows.samples()]) * e.step_s)
            for e, d in zip(episodes, data, strict=True)
        ],
        names=names,
        searched=SearchedKinds.of(problem, refined.theta),
        most_delay_std_s=most_delay_std_s(problem),
    )


def parameter_prior(problem: Problem) -> FloatArray:
    """Return a regression's information on the parameters and the latency before any data, (K + 1,)."""
    width = np.append(PARAMETER_PRIOR * problem.space.width, LATENCY_PRIOR_S)
    return np.asarray(1 / width**2)


def unsure_shift(gains: Sequence[float], shifts: Sequence[FloatArray]) -> FloatArray:
    """Return how far causes that are not named may have moved the estimates, (P,), as a standard deviation.

    What is no better than chance to be named may still be there. Each cause alone, and none, weighs as much
    as it makes the left-out motion likely (pseudo-BMA: Yao, Vehtari, Simpson and Gelman 2018), w_i
    proportional to exp(D_i / 2) with the gain in deviance D_i, 0 for none. The estimates keep their place, so
    the mean square of their shifts s_i, sum_i w_i s_i^2, adds to their variance.

    Args:
        gains: D_i of each cause [-].
        shifts: s_i of each, (P,): of the parameters in their own scales, and of the latency [s].
    """
    every = np.array([0.0, *gains])
    weights = np.exp((every - every.max()) / 2)
    return np.asarray(np.sqrt((weights / weights.sum())[1:] @ np.square(shifts)))


def groups_of(found: Sequence[Signature]) -> list[list[Signature]]:
    """Return the units of the selection: a cause at all joints, or the mass of one body."""
    causes = dict.fromkeys(s.cause for s in found if s.cause != "mass")
    return [
        *([s for s in found if s.cause == cause] for cause in causes),
        *([s] for s in found if s.cause == "mass"),
    ]
