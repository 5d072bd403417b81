"""Combinations of parameters that the data cannot see: a readable basis, and in words.

Any rotation of the directions of no information is as good as any other; the one with the fewest parameters
in each is the one that a person can act on ("measure one of them").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray

SEEN = 1.0
"""Information below this, relative to what the range itself says, is none."""

ROUNDING = 1e-13
"""So is what lies this far below the direction that is seen best: differences are not more exact."""

PART = 0.1
"""Parameters that move by less than this part of the one that moves most are not named."""


@dataclass(frozen=True, slots=True)
class NullSpace:
    """What the data cannot see.

    Attributes:
        directions: In each parameter's own scale, largest entry 1, few entries each, (D, K).
        std: Standard deviation that these directions alone leave each parameter, (K,).
    """

    directions: FloatArray
    std: FloatArray


def null_space(space: ParameterSpace, hessian: FloatArray) -> NullSpace:
    """Return the directions that the data see less than the range does.

    Args:
        space: The parameters.
        hessian: Information of the data in each parameter's own scale, (K, K).
    """
    root = space.width / np.sqrt(12.0)
    values, vectors = np.linalg.eigh(hessian * np.outer(root, root))
    blind = values < max(SEEN, ROUNDING * float(values[-1]))
    # Posterior variance along each of them, the range's own variance being the prior's.
    spread = vectors[:, blind] ** 2 @ (1.0 / (1.0 + np.maximum(values[blind], 0.0)))
    directions = sparse_basis(vectors[:, blind].T) * root
    if len(directions):
        directions = directions / np.max(np.abs(directions), axis=1, keepdims=True)
    return NullSpace(directions, root * np.sqrt(spread))


def sparse_basis(vectors: FloatArray) -> FloatArray:
    """Return other vectors that span the same, with small sums of absolute entries, (D, K).

    For each entry the vector with a 1 there and the least sum is a linear program; of those the smallest that
    are independent are taken.

    Args:
        vectors: Independent rows, (D, K).
    """
    D, K = vectors.shape
    if D < 2:
        return vectors
    # Unknowns: D weights, then K bounds of |entries|.
    cost = np.concatenate([np.zeros(D), np.ones(K)])
    below = np.block([[vectors.T, -np.eye(K)], [-vectors.T, -np.eye(K)]])
    found: list[tuple[float, FloatArray]] = []
    for k in range(K):
        if np.max(np.abs(vectors[:, k])) < 1e-6:
            continue
        pinned = np.concatenate([vectors[:, k], np.zeros(K)])[None]
        solved = linprog(
            cost, A_ub=below, b_ub=np.zeros(2 * K), A_eq=pinned, b_eq=[1.0],
            bounds=[(None, None)] * D + [(0, None)] * K,
        )  # fmt: skip
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
    """Name the combinations of parameters that the data cannot see."""
    return tuple(_words(space, direction) for direction in unseen.directions)


def _words(space: ParameterSpace, direction: FloatArray) -> str:
    parts = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > PART]
    lead = np.sign(direction[parts[0]])
    up = [space.names[k] for k in parts if np.sign(direction[k]) == lead]
    down = [space.names[k] for k in parts if np.sign(direction[k]) != lead]
    if len(parts) == 1:
        return f"{up[0]} leaves no trace in this recording: excite it or measure it by other means"
    if not down:
        return (
            f"{', '.join(up)} can only be told up to a common factor: measure one of them "
            "(a scale will do for a mass)"
        )
    return (
        f"{', '.join(up)} can be raised while {', '.join(down)} "
        f"{'is' if len(down) == 1 else 'are'} lowered without a trace: measure one of them"
    )
