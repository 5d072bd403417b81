"""Parameters that the data cannot separate: combinations of them, and whole kinds.

Any rotation of the directions without information is equally valid. Those with the fewest parameters tell a
user what to do ("measure one of them"). Pairs of single parameters often hide what is confounded: a delay
goes with the armatures of all joints together. So whole kinds are compared.

Symbols, for K parameters in their own scale:
    A: information of the data, half the Hessian of the cost, (K, K).
    R: diagonal; of the range's standard deviations, w_k / 12^(1/2), or of those of the priors, (K,).
    l_i, v_i: eigenvalues [-] and eigenvectors, (K,), of R A R.

Sources: what is not asked is eliminated by a Schur complement, Boyd and Vandenberghe, Convex Optimization
(2004), appendix A.5.5; variances inflated by other parameters, Belsley, Kuh and Welsch, Regression
Diagnostics (1980), chapter 3.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from deal_hw.calib.data.problem import Problem
from deal_hw.calibration import LATENCY, Z90, listed, percent
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray

LEAST_INFORMATION = 1.0
"""Information below this, relative to that of the range itself, counts as none [-]."""

ROUNDING = 1e-13
"""The same relative to the direction with most information [-]: differences are no more exact."""

NAMED_PART = 0.1
"""Smallest part in a direction, relative to the largest, of a parameter that is named [-]."""

WEAK_PRIOR = 10.0
"""Standard deviation of a weak prior that keeps matrices invertible, in search ranges. With the range
itself as prior, a kind that the data leave open would look known, and its partner would not be named."""

NARROWER = 1.25
"""Kinds are named where fixing one makes the other's interval narrower by this factor [-]: a third of its
variance comes from the other."""

MOSTLY = 2.0
"""From this factor on, three quarters of the variance, they are confounded; below it partly [-]."""

ALIKE = 0.8
"""Least change, as a share of the largest, of a parameter that scales with others [-]."""

FEWEST_OF_A_SCALE = 3
"""Fewest parameters whose common factor is called a scale."""

MOST_COMBINED = 8
"""Most combinations that are described of those that a prior decides: whole inertias have dozens."""


@dataclass(frozen=True, slots=True)
class NullSpace:
    """Directions without information.

    Attributes:
        directions: In each parameter's own scale, largest entry 1, few entries each, (D, K).
        std: Standard deviation that these directions alone leave each parameter, (K,).
    """

    directions: FloatArray
    std: FloatArray


def null_space(space: ParameterSpace, hessian: FloatArray) -> NullSpace:
    """Return the directions in which the data have less information, (K, K), than the range."""
    # In units of the range's own standard deviation, w / sqrt(12), the range has information 1 in each
    # direction: an eigenvalue below 1 is a direction that the data determine less than the range does.
    root = space.width / np.sqrt(12.0)
    values, vectors = np.linalg.eigh(hessian * np.outer(root, root))
    blind = values < max(LEAST_INFORMATION, ROUNDING * float(values[-1]))
    # Along v_i the posterior variance is 1 / (1 + l_i) of the range's: informations add. So these directions
    # alone leave parameter k the variance R_kk^2 sum_i v_ik^2 / (1 + l_i).
    spread = vectors[:, blind] ** 2 @ (1.0 / (1.0 + np.maximum(values[blind], 0.0)))
    directions = sparse_basis(vectors[:, blind].T) * root
    if len(directions):
        directions = directions / np.max(np.abs(directions), axis=1, keepdims=True)
    return NullSpace(directions, root * np.sqrt(spread))


def sparse_basis(vectors: FloatArray) -> FloatArray:
    """Return vectors with the same span as ``vectors``, (D, K), and small sums of absolute entries.

    For each entry, the vector with a 1 there and the least sum is a linear program. The smallest independent
    ones are taken.
    """
    D, K = vectors.shape
    if D < 2:
        return vectors
    # min |v|_1 for v = u^T vectors with v_k = 1 (basis pursuit: Chen, Donoho and Saunders 1998).
    # Unknowns: D weights u, then K bounds b of |entries|, -b <= v <= b.
    cost = np.concatenate([np.zeros(D), np.ones(K)])
    below = np.block([[vectors.T, -np.eye(K)], [-vectors.T, -np.eye(K)]])
    found: list[tuple[float, FloatArray]] = []
    for k in range(K):
        if np.max(np.abs(vectors[:, k])) < 1e-6:
            continue
        pinned = np.concatenate([vectors[:, k], np.zeros(K)])[None]
        solved = linprog(
            cost,
            A_ub=below,
            b_ub=np.zeros(2 * K),
            A_eq=pinned,
            b_eq=[1.0],
            bounds=[(None, None)] * D + [(0, None)] * K,
        )
        if solved.success and solved.x is not None:
            vector = solved.x[:D] @ vectors
            largest = np.max(np.abs(vector))
            found.append((float(np.sum(np.abs(vector)) / largest), vector / largest))
    chosen: list[FloatArray] = []
    for _, vector in sorted(found, key=lambda pair: pair[0]):
        trial = np.stack([*chosen, vector / np.linalg.norm(vector)])
        if np.linalg.svd(trial, compute_uv=False)[-1] > 1e-3:
            chosen.append(trial[-1])
        if len(chosen) == D:
            return np.stack(chosen)
    return vectors


def null_directions(space: ParameterSpace, unseen: NullSpace) -> tuple[str, ...]:
    """Describe the combinations of parameters without effect on the recordings, each once.

    Single parameters come last, in one sentence. Directions that differ in parts too small to be named have
    one description.
    """
    named = [
        [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > NAMED_PART]
        for direction in unseen.directions
    ]
    combined = zip(named, unseen.directions, strict=True)
    words = dict.fromkeys(
        _describe(space, direction, parts) for parts, direction in combined if len(parts) > 1
    )
    alone = dict.fromkeys(space.names[parts[0]] for parts in named if len(parts) == 1)
    if not alone:
        return tuple(words)
    leave, them = ("leaves", "it") if len(alone) == 1 else ("leave", "them")
    ask = f"excite {them} or measure {them} by other means"
    return (*words, f"{', '.join(alone)} {leave} no trace in this recording: {ask}")


def expected_directions(space: ParameterSpace, data: FloatArray, covariance: FloatArray) -> tuple[str, ...]:
    """Describe the combinations of parameters of which a prior says more than the data.

    Of the ten inertial parameters of each link of a robot on a fixed base, some act only together with those
    of other links, and some not at all. With a CAD model as prior each has a value nevertheless. And no
    motion shows the common scale of all masses, frictions and gains.

    Args:
        space: The parameters.
        data: Information of the data alone in each parameter's own scale, (K, K).
        covariance: Of the estimate, in the same scale, (K, K).
    """
    std = space.prior[1]
    known, free = np.flatnonzero(np.isfinite(std)), np.flatnonzero(~np.isfinite(std))
    if not known.size:
        return ()
    # What the parameters without a prior, f, follow says nothing of the others, k. Their range keeps it
    # invertible: A_k|f = A_kk - A_fk^T (A_ff + 12 / w_f^2)^-1 A_fk.
    inner = data[np.ix_(free, free)] + np.diag(12.0 / space.width[free] ** 2)
    cross = data[np.ix_(free, known)]
    left = data[np.ix_(known, known)] - cross.T @ np.linalg.solve(inner, cross)
    # Eigenvalues of R A_k|f R, with the priors' R: below 1 the data say less of a direction than its prior.
    values, vectors = np.linalg.eigh(left * np.outer(std[known], std[known]))
    combined: dict[str, None] = {}
    alone: list[str] = []
    for direction in sparse_basis(vectors[:, values < 1.0].T):
        moved = np.zeros(len(space))
        moved[known] = direction * std[known]
        if (words := _common_scale(space, moved, covariance)) is not None:
            combined[words] = None
            continue
        share = direction / np.max(np.abs(direction))
        parts = [int(k) for k in np.argsort(-np.abs(share)) if abs(share[k]) > 2 * NAMED_PART]
        names = [space.names[known[k]] for k in parts]
        if len(parts) == 1:
            alone.append(names[0])
        elif len(combined) < MOST_COMBINED:
            signs = ["-" if share[k] * share[parts[0]] < 0 else "+" for k in parts]
            together = " ".join(f"{sign} {name}" for sign, name in zip(signs, names, strict=True))
            combined[f"{together.removeprefix('+ ')}: the prior says more than the recordings"] = None
    if not alone:
        return tuple(combined)
    return (*combined, f"{', '.join(dict.fromkeys(alone))}: the prior says more than the recordings")


def _common_scale(space: ParameterSpace, moved: FloatArray, covariance: FloatArray) -> str | None:
    """Describe a direction, (K,) in each parameter's own scale, that is a common factor; else return None."""
    share = moved / moved[np.argmax(np.abs(moved))]
    together = np.flatnonzero((share > ALIKE) & space.log_scale)
    if len(together) < FEWEST_OF_A_SCALE or np.any(np.abs(np.delete(share, together)) > NAMED_PART):
        return None
    # For y = ln of the n parameters, with covariance C: the scale is their mean, of variance 1^T C 1 / n^2,
    # and the ratios are y less that mean, (1 - 1 1^T / n) y. A half width z s of ln is the share e^(z s) - 1.
    ratios = np.eye(len(together)) - 1 / len(together)
    of_them = covariance[np.ix_(together, together)]
    spread = np.diag(ratios @ of_them @ ratios)
    reach = np.expm1(Z90 * float(np.sqrt(np.mean(of_them))))
    # What shows the scale best is what is known best beside it; a mass is the easiest to measure.
    names = [space.names[k] for k in together]
    masses = [i for i, k in enumerate(together) if space.free[k].kind == "body_mass"]
    best = min(masses or range(len(together)), key=lambda i: spread[i])
    measure = f"weigh {space.free[together[best]].elements[0]}" if masses else f"measure {names[best]}"
    return (
        f"the common scale of {listed(names)}: no motion shows it, so what was expected holds it, to "
        f"+-{percent(reach)}. The recordings show the ratios. To know the scale, {measure} (--known "
        f"{names[best]} VALUE)"
    )


def _describe(space: ParameterSpace, direction: FloatArray, parts: list[int]) -> str:
    lead = np.sign(direction[parts[0]])
    up = [space.names[k] for k in parts if np.sign(direction[k]) == lead]
    down = [space.names[k] for k in parts if np.sign(direction[k]) != lead]
    if not down:
        return (
            f"{', '.join(up)} can only be determined up to a common factor: measure one of them "
            "(a scale will do for a mass)"
        )
    return (
        f"{', '.join(up)} can be raised while {', '.join(down)} "
        f"{'is' if len(down) == 1 else 'are'} lowered without a trace: measure one of them"
    )


@dataclass(frozen=True, slots=True)
class Confounded:
    """Two kinds of parameters that the data hardly separate.

    Attributes:
        first: A kind, or ``latency``.
        second: Another kind.
        factor: How much narrower the first's intervals would be with the second known (median over elements).
    """

    first: str
    second: str
    factor: float

    @property
    def words(self) -> str:
        """The pair in a sentence."""
        degree = "" if self.factor >= MOSTLY else "partly "
        return (
            f"{self.first} and {self.second} are {degree}confounded: with {self.second} known the interval "
            f"of {self.first} would be {self.factor:.1f} times narrower"
        )


def confounded(problem: Problem, information: FloatArray) -> tuple[Confounded, ...]:
    """Return the confounded pairs of kinds, the worst first.

    ``information`` is that of the data on parameters, in their own scale, and latency, (K + 1, K + 1);
    without priors.
    """
    space = problem.space
    low, high = problem.latency_range_s
    weak = 12.0 / (WEAK_PRIOR * np.append(space.width, high - low)) ** 2
    precision = information + np.diag(weak)
    kinds = {
        kind: [k for k, p in enumerate(space) if p.kind == kind]
        for kind in dict.fromkeys(p.kind for p in space)
    }
    if problem.fixed_latency_s is None:
        kinds[LATENCY] = [len(space)]
    # Latency first, so that a pair with it names it first.
    names = sorted(kinds, key=lambda name: (name != LATENCY, name))
    whole = _free_std(precision, [i for members in kinds.values() for i in members])
    found = []
    for a, b in itertools.combinations(names, 2):
        without = [i for name, members in kinds.items() if name != b for i in members]
        alone = _free_std(precision, without)
        # sigma_i / sigma_i|b, the root of the variance inflation by kind b.
        factor = float(np.median([whole[i] / alone[i] for i in kinds[a]]))
        if factor >= NARROWER:
            found.append(Confounded(a, b, factor))
    return tuple(sorted(found, key=lambda pair: -pair.factor))


def _free_std(precision: FloatArray, free: list[int]) -> dict[int, float]:
    """Return standard deviations of the free entries, the others fixed."""
    # Entries that are left out are known: their rows and columns go before the inverse, not after.
    variance = np.diag(np.linalg.inv(precision[np.ix_(free, free)]))
    return {i: float(np.sqrt(v)) for i, v in zip(free, variance, strict=True)}
