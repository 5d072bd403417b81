"""A calibration's state for tests of single stages: a brief search that nothing runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.search.eki import Eki
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget


def small_run(problem: Problem, **changes: Any) -> CalibrationRun:
    """Return the state of a calibration that begins, with all checks, and with these fields."""
    rng = np.random.default_rng(0)
    usual: dict[str, Any] = {
        "problem": problem,
        "budget": Budget(population=20, generations=4),
        "rng": rng,
        "attempts": Restarts(Eki(), rng, None),
        "settings": Validation(),
    }
    return CalibrationRun(**(usual | changes))
