"""A search with a result that a test chooses, to test the steps after a search."""

from __future__ import annotations

from typing import Any

import numpy as np

from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback, StateStore
from deal_hw.types import FloatArray


class FixedSearch(CalibrationMethod[Any]):
    """Ends at a given point, or near it, with the whole range as its interval.

    Attributes:
        budgets: Budget of each run.

    Args:
        theta: The result, (K,).
        latency_s: The latency that it finds [s].
        spread: Standard deviation of the logarithm of each parameter's error.
    """

    name = "fixed"

    def __init__(self, theta: FloatArray, latency_s: float, spread: float = 0.0) -> None:
        self._theta, self._latency_s, self._spread = theta, latency_s, spread
        self.budgets: list[Budget] = []

    def run(
        self,
        problem: Any,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Return the given point."""
        self.budgets.append(budget)
        return CalibrationResult(
            method=self.name,
            space=problem.space,
            estimate=self._theta * np.exp(rng.normal(0.0, self._spread, len(self._theta))),
            interval=np.stack([problem.space.low, problem.space.high], axis=1),
            latency_s=self._latency_s,
        )
