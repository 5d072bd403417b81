"""The page's first sentence: how well the calibrated simulator predicts unseen motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from deal_hw import calibration
from deal_hw.calib.validation.verdict import SETTINGS as VERDICT
from deal_hw.calibration import CalibrationResult

GIVEN = "motion that it was not given"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One bar of an error.

    Attributes:
        name: "nominal", "calibrated".
        words: The error with its unit.
        share: Length, share of the longest [%].
    """

    name: str
    words: str
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Story:
    """The beginning of the page.

    Attributes:
        sentence: The result.
        bars: Held-out errors; empty if nothing was held out.
        floor: The sensor's noise on the bars' scale [%]; None where it is not known.
        floor_words: The same with its unit.
        in_units: The errors in rad or m, if all joints have the same unit.
    """

    sentence: str
    bars: tuple[Bar, ...] = ()
    floor: float | None = None
    floor_words: str = ""
    in_units: str = ""


def make_story(result: CalibrationResult) -> Story:
    """Return the story of a result, in the measure of its verdict: the error over the signal's range."""
    errors = result.heldout_nrmse
    if "nominal" not in errors or "calibrated" not in errors:
        noise = ""
        if result.chi2 >= 0:
            size = f"{math.sqrt(result.chi2):.1f} times the sensor's noise"
            noise = f" On the fitted recordings its residuals are {size}."
        return Story(
            sentence=f"It is not known how well the calibrated simulator predicts {GIVEN}: no recording was "
            f"held out.{noise}"
        )
    nominal, calibrated = errors["nominal"], errors["calibrated"]
    rmse = result.provenance.get("heldout_rmse") or {}
    sentence = f"The calibrated simulator predicts {GIVEN} {compared(nominal, calibrated)}"
    if math.isfinite(nominal) and math.isfinite(calibrated):
        sentence += f": its error is {percent(calibrated)} of the motion's range against {percent(nominal)}"
    longest = max((v for v in (nominal, calibrated) if math.isfinite(v)), default=1.0) or 1.0
    bars = tuple(
        Bar(
            name=name,
            words=percent(value) if math.isfinite(value) else "diverged",
            share=100.0 * min(value / longest, 1.0) if math.isfinite(value) else 100.0,
        )
        for name, value in (("nominal", nominal), ("calibrated", calibrated))
    )
    noise = rmse.get("noise", {}).get("nrmse")
    known = noise is not None and noise < longest
    return Story(
        sentence=f"{sentence}.",
        bars=bars,
        floor=100.0 * noise / longest if known else None,
        floor_words=percent(noise) if known else "",
        in_units=_in_units(rmse),
    )


def compared(nominal: float, calibrated: float) -> str:
    """Return in words how the calibrated error compares with the nominal one, in the same unit."""
    if not math.isfinite(calibrated):
        return "worse than the nominal model: it diverges"
    if not math.isfinite(nominal):
        return "better than the nominal model, which diverges"
    ratio = nominal / max(calibrated, 1e-300)
    if ratio >= 2:
        return f"{_times(ratio)} better than the nominal model"
    if ratio > VERDICT.worse:
        return f"{100 * (1 - 1 / ratio):.0f} % better than the nominal model"
    if ratio >= 1 / VERDICT.worse:
        return "no better than the nominal model"
    return f"worse than the nominal model, with {_times(1 / ratio)} its error"


def _times(ratio: float) -> str:
    return "more than 1000 times" if ratio > 1000 else f"{ratio:.{1 if ratio < 9.95 else 0}f} times"


def percent(share: float) -> str:
    """Return a share in percent, without a line break inside."""
    return calibration.percent(share).replace(" ", "\u00a0")


def _in_units(rmse: Mapping[str, Any]) -> str:
    """Return the errors in rad or m if all joints have one unit, else nothing."""
    units = set((rmse.get("unit") or {}).values())
    mean = rmse.get("mean") or {}
    nominal, calibrated = mean.get("nominal"), mean.get("calibrated")
    if len(units) != 1 or nominal is None or calibrated is None:
        return ""
    unit = units.pop()
    return f"In {unit}, mean over the joints: nominal {nominal:.2g}, calibrated {calibrated:.2g}."
