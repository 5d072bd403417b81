"""Can a calibration be used? One colour and one sentence; held-out motion is asked first."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from deal_hw.calib.uncertainty.intervals import MISMATCH_CHI2
from deal_hw.calibration import CalibrationResult

Colour = Literal["green", "amber", "red"]

WORSE = 1.02
"""A held-out error above the nominal model's by more than this factor is worse: less is chance where the
nominal model was right."""


@dataclass(frozen=True, slots=True)
class Trust:
    """Whether a calibration can be used.

    Attributes:
        colour: Green: use it. Amber: it has a known weakness. Red: do not use it.
        seen: What was seen.
        means: What it means.
        do: What to do.
    """

    colour: Colour
    seen: str
    means: str
    do: str

    @property
    def sentence(self) -> str:
        """All of it in one line."""
        return f"{self.seen} {self.means} {self.do}"


def trust(result: CalibrationResult) -> Trust:
    """Return whether a result can be used."""
    nominal, calibrated = (result.heldout_nrmse.get(name) for name in ("nominal", "calibrated"))
    noise = (
        f"Residuals are {math.sqrt(result.chi2):.1f} times the sensor's noise." if result.chi2 >= 0 else ""
    )
    mismatch = result.chi2 > MISMATCH_CHI2
    if nominal is None or calibrated is None:
        record = "Record one more motion and name it with --holdout."
        if mismatch:
            means = "The model does not explain them, and no held-out recording says whether it is better."
            return Trust("red", noise, means, f"Do not use it. {record}")
        gain = "There is no held-out recording."
    elif not calibrated <= WORSE * nominal:
        return Trust(
            "red",
            f"On held-out motion the calibrated model errs by {100 * calibrated:.2g} % of the signal's "
            "range, your "
            f"own model by {100 * nominal:.2g} %.",
            "The calibrated model is worse.",
            "Do not use it. Check units, signs and joint order of the recordings, then the alarms.",
        )
    else:
        record = ""
        smaller = nominal / max(calibrated, 1e-300)
        gain = f"On held-out motion the error is {smaller:.1f} times smaller than your own model's."
    if mismatch:
        return Trust(
            "amber",
            f"{gain} {noise}",
            "The model is better than yours, and lacks something that the robot has.",
            "Use it, but trust predictions more than single values.",
        )
    if result.alarms:
        count = f"There {'is 1 alarm' if len(result.alarms) == 1 else f'are {len(result.alarms)} alarms'}."
        return Trust(
            "amber", f"{gain} {count}", "The result has a known weakness.", "Read them before you use it."
        )
    if math.isnan(result.chi2):
        return Trust(
            "amber", gain, "No test was made of whether the model explains the recordings.",
            f"Compare the held-out error with what your task can bear. {record}".strip(),
        )  # fmt: skip
    untold = result.verdicts.count("not identifiable")
    if result.null_directions or untold:
        return Trust(
            "amber",
            f"{gain} {noise}"
            + (f" {untold} of {len(result.space)} parameters have no value." if untold else ""),
            "The model explains the recordings, but they do not tell all parameters.",
            "Use it: training keeps the whole range of those. Or record what is advised below.",
        )
    if record:
        return Trust(
            "amber", f"{gain} {noise}", "Nothing says whether the model holds on other motion.", record
        )
    return Trust("green", f"{gain} {noise}", "What is left is the sensor's noise.", "Use it.")
