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
        sentence: What was seen, what it means, what to do.
    """

    colour: Colour
    sentence: str


def trust(result: CalibrationResult) -> Trust:
    """Return whether a result can be used."""
    errors = result.heldout_nrmse
    nominal, calibrated = errors.get("nominal"), errors.get("calibrated")
    judged = nominal is not None and calibrated is not None
    gain = ""
    if nominal is not None and calibrated is not None:
        if not calibrated <= WORSE * nominal:
            return Trust(
                "red",
                f"On held-out motion the calibrated model errs by {100 * calibrated:.2g} % of the signal's "
                f"range, your own model by {100 * nominal:.2g} %: it is worse. Do not use it; check units, "
                "signs and joint order of the recordings, then the alarms.",
            )
        gain = f"On held-out motion the error is {nominal / max(calibrated, 1e-300):.1f} times smaller than "
        gain += "your own model's."
    mismatch = result.chi2 > MISMATCH_CHI2
    if mismatch and not judged:
        return Trust(
            "red",
            f"Residuals are {math.sqrt(result.chi2):.1f} times the sensor's noise and no held-out recording "
            "says whether the model is better all the same. Record one (--holdout) and calibrate again.",
        )
    if mismatch:
        return Trust(
            "amber",
            f"{gain} Residuals are {math.sqrt(result.chi2):.1f} times the sensor's noise: the model lacks "
            "something that the robot has. Use it, but trust predictions more than single parameters.",
        )
    if result.alarms:
        return Trust("amber", f"{gain} There are alarms: read them before you use it.".strip())
    if math.isnan(result.chi2):
        return Trust("amber", f"{gain} No test was made of whether the model explains the recording.".strip())
    if result.null_directions or "not identifiable" in result.verdicts:
        return Trust(
            "amber",
            f"{gain} The model explains the recordings, but they do not tell all parameters: those without a "
            "value keep their whole range in training.".strip(),
        )
    if not judged:
        return Trust(
            "amber",
            "The model explains the recordings, but no held-out recording says whether it holds on other "
            "motion. Record one (--holdout).",
        )
    return Trust("green", f"{gain} What is left has the size of the sensor's noise.")
