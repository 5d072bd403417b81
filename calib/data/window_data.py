"""Windows of a recording with their measured samples, and what simulators predict of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.noise import Mask
from deal_hw.sim.recordings.windows import Windows
from deal_hw.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class WindowData:
    """Windows of one episode with their measured samples.

    Attributes:
        episode: Index of the episode.
        windows: W windows of H samples.
        measured: Measured channels at the predicted samples, (W, H, M).
        std: Standard deviation of the measured channels, (W, H, M); infinite for missing samples.
        start_position: Smoothed start positions, (W, C).
        start_velocity: Smoothed start velocities, (W, C).
        prior_mean: Prior of the start states: a measurement, an estimate or a weak guess, (W, 2 C).
        prior_std: Its standard deviation, (W, 2 C).
        prior_counts: Entries of the prior that count as measurements, (2 C,).
        late: Scaled directions in which delays move whitened predictions, (W, H M, P); None: constant delays.
        by_delay: Change of whitened predictions by each command's delay, (W, H M, P) [1/s]; likewise None.
    """

    episode: int
    windows: Windows
    measured: FloatArray
    std: FloatArray
    start_position: FloatArray
    start_velocity: FloatArray
    prior_mean: FloatArray
    prior_std: FloatArray
    prior_counts: Mask
    late: FloatArray | None = None
    by_delay: FloatArray | None = None

    def whitened(self, error: FloatArray) -> FloatArray:
        """Return prediction errors or their changes, (..., W, H, M), in units of their standard deviation.

        Those of samples that were not measured are 0.
        """
        alone = error / self.std
        if self.late is None:
            return np.asarray(alone)
        flat = alone.reshape(*alone.shape[:-2], -1)
        # The symmetric root keeps each residual at its sample.
        shared = np.einsum("wrp,...wr->...wp", self.late, flat)
        return np.asarray((flat - np.einsum("wrp,...wp->...wr", self.late, shared)).reshape(alone.shape))

    @property
    def reported(self) -> Mask:
        """Which samples were measured, (W, H, M); the others filled a gap."""
        return np.asarray(np.isfinite(self.std))

    @property
    def freedom(self) -> IntArray:
        """Measurements minus unknowns of the start state, (W,); priors that count are measurements."""
        priors = np.sum(np.isfinite(self.prior_std) & self.prior_counts, axis=1)
        return np.asarray(np.sum(self.reported, axis=(1, 2)) + priors - self.prior_mean.shape[1])


@dataclass(frozen=True, slots=True)
class MemberPrediction:
    """Predictions of W windows of H samples by N members; NaN where a member diverged.

    Attributes:
        observed: Measured channels, (N, W, H, M).
        position: Tangent coordinates, (N, W, H, C).
        velocity: (N, W, H, C).
    """

    observed: FloatArray
    position: FloatArray
    velocity: FloatArray
