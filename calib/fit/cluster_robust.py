"""Variances clustered by blocks of time, for residuals that are neither white nor of equal size.

The usual covariance H^-1 assumes independent residuals of known variance. The cluster-robust one
H^-1 (sum_b s_b s_b^T) H^-1 only assumes independent blocks of residuals. s_b is the score of block b (its
part of half the cost's gradient), start states eliminated. The result is the ratio of both variances,
coordinate by coordinate.

Small samples: a sum over few blocks is too small even where the model is right, because the fit follows the
noise of each block. Under white noise a block's score has the covariance J_b^T (I - P_bb) J_b, with P the
projection on parameters and start states. The ratio is taken to the sum of those, so its mean is 1 for any
number of blocks. This is the bias reduction of Bell and McCaffrey (2002), applied to the sum instead of to
each block, which stays finite where one block alone determines a parameter. The effective number of blocks is
returned as well.

Symbols: J, derivatives of the whitened residuals by the P coordinates with start states that follow; B, their
covariance for independent residuals of unit variance, H^-1 with the priors in H, (P, P) (``bread``);
g_b = J_b^T r_b, score of block b, (P,); H_b = J_b^T J_b; F_b = J_b^T P_start J_b, the start states' part of
the projection. The estimate shifts by B g_b. Under independent residuals of unit variance this has the
covariance B (H_b - F_b - H_b B H_b) B. Sources: White (1980), Liang and Zeger (1986), Bell and McCaffrey
(2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deal_hw.calib.fit.residual import WindowRows
from deal_hw.types import FloatArray

FEWEST_BLOCKS = 8
"""Fewest blocks that show how residuals are correlated."""

ENOUGH_BLOCKS = 24
"""Blocks are as long as this number of them allows."""

PARTS = (8, 4, 2)
"""Parts into which a window is cut first."""

SHORTEST_PART = 4
"""Fewest samples of a part."""


@dataclass(frozen=True, slots=True)
class Clustered:
    """Blocks of one length, and the uncertainty of P coordinates that they show.

    Attributes:
        block_windows: Windows in a block, or its share of one.
        shift: Shift of the estimate by each block's score, (B, P).
        expected: Its variance under independent residuals of unit variance, (B, P).
        follows: Blocks that come right after the one before them, (B - 1,).
    """

    block_windows: float
    shift: FloatArray
    expected: FloatArray
    follows: npt.NDArray[np.bool_]

    @property
    def blocks(self) -> int:
        """Number of blocks B."""
        return len(self.shift)

    @property
    def ratio(self) -> FloatArray:
        """Variance over that of independent residuals of unit variance, (P,)."""
        # sum_b (B g_b)_p^2 over its mean under independent residuals.
        power, expected = np.sum(self.shift**2, axis=0), np.sum(self.expected, axis=0)
        return np.asarray(np.divide(power, expected, out=np.ones_like(power), where=expected > 0))

    @property
    def degrees(self) -> FloatArray:
        """Effective number of blocks that determine each coordinate, (P,)."""
        # (sum_b v_b)^2 / sum_b v_b^2, Satterthwaite's degrees of freedom of a sum of squares with means v_b.
        square, spread = np.sum(self.expected, axis=0) ** 2, np.sum(self.expected**2, axis=0)
        return np.asarray(np.divide(square, spread, out=np.ones_like(square), where=spread > 0))

    @property
    def autocorrelated(self) -> bool:
        """Whether neighbouring blocks are correlated."""
        power = np.sum(self.shift**2, axis=0)
        product = np.sum((self.shift[1:] * self.shift[:-1])[self.follows], axis=0)
        # White scores correlate by 0 with a standard error of 1 / sqrt(blocks).
        correlation = float(np.mean(product / np.maximum(power, 1e-300)))
        return bool(correlation > 2.0 / np.sqrt(self.blocks))


def clustered(
    rows: Sequence[WindowRows], bread: FloatArray, samples: Sequence[int], correlation_samples: float = 1.0
) -> Clustered | None:
    """Compare the cluster-robust covariance with ``bread``, that of independent residuals of unit variance.

    The latter, (P, P), has zero rows and columns for fixed coordinates. Windows have ``samples`` samples, one
    number an episode: they last equally long in all of them.
    Blocks are at least twice as long as the residuals' autocorrelation time. It is None where the recordings
    hold too few blocks.
    """
    if not rows:
        return None
    found: Clustered | None = None
    fewest = min(samples)
    for parts, group in _levels(rows, fewest):
        length = group * fewest // parts
        if length < max(SHORTEST_PART, 2 * correlation_samples) and parts > 1:
            continue
        level = _level(rows, bread, samples, parts, group)
        uncorrelated = found is not None and not found.autocorrelated
        if level.blocks < (ENOUGH_BLOCKS if uncorrelated else FEWEST_BLOCKS):
            break
        found = level
    return found


def _levels(rows: Sequence[WindowRows], samples: int) -> list[tuple[int, int]]:
    """Return (parts of a window, windows in a group) from the shortest block to the longest."""
    longest = max((len(r.residual) for r in rows), default=0)
    levels = [(parts, 1) for parts in (*PARTS, 1) if samples // parts >= 1]
    group = 2
    while group <= longest:
        levels.append((1, group))
        group *= 2
    return levels


def _level(
    rows: Sequence[WindowRows], bread: FloatArray, every: Sequence[int], parts: int, group: int
) -> Clustered:
    shifts, expected, follows = [], [], []
    for of_episode, samples in zip(rows, every, strict=True):
        J = of_episode.following
        W, R, P = J.shape
        S = of_episode.start.shape[2]
        channels = (R - S) // samples
        sample_part = np.minimum(np.arange(samples) * parts // samples, parts - 1)
        # The start state's prior goes with the first part.
        part = np.concatenate([np.repeat(sample_part, channels), np.zeros(S, dtype=np.int64)])
        score, information, start = (np.zeros((W, parts, *s)) for s in ((P,), (P, P), (P, P)))
        for p in range(parts):
            mine = part == p
            Jp, jsp = J[:, mine], of_episode.start[:, mine]
            score[:, p] = np.einsum("wrp,wr->wp", Jp, of_episode.residual[:, mine])
            information[:, p] = np.einsum("wrp,wrq->wpq", Jp, Jp)
            if S and parts > 1:
                cross = np.einsum("wrs,wrp->wsp", jsp, Jp)
                start[:, p] = np.einsum(
                    "wsp,wsq->wpq", cross, np.linalg.solve(of_episode.start_normal, cross)
                )
        blocks = [np.concatenate(list(x)) for x in (score, information, start)]
        if group > 1:
            edges = np.arange(0, max(W - group + 1, 1), group)
            blocks = [np.add.reduceat(x, edges, axis=0) for x in blocks]
        g, H, F = blocks
        # Score of a block under white noise: J_b^T (I - P_bb) J_b, P on start states and on parameters.
        spread = H - F - H @ bread @ H
        shifts.append(g @ bread)
        expected.append(np.maximum(np.einsum("pi,bij,jp->bp", bread, spread, bread), 0.0))
        follows.append(np.concatenate([[False], np.ones(len(g) - 1, dtype=bool)]))
    windows = group / parts
    return Clustered(windows, np.concatenate(shifts), np.concatenate(expected), np.concatenate(follows)[1:])
