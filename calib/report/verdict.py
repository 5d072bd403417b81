"""What a result is worth, in words: the verdict in one colour, and the page's first sentence.

The error on held-out motion decides first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from deal_hw import calibration
from deal_hw.calibration import EXPLAINED_CHI2, CalibrationResult
from deal_hw.findings import Finding

Colour = Literal["green", "amber", "red"]

WORSE = 1.02
"""Ratio to the nominal model's held-out error above which a result is worse [-]: less is chance where the
nominal model was right."""

NEAR_NOISE = 2.0
"""Ratio to the sensor's noise up to which a held-out error counts as explained [-]: predictions from
smoothed states have up to twice its error from their starts."""

GIVEN = "motion that it was not given"


@dataclass(frozen=True, slots=True)
class Trust:
    """The verdict on the use of a calibration.

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
        """The verdict in one line."""
        return f"{self.seen} {self.means} {self.do}"


def trust(result: CalibrationResult) -> Trust:
    """Return whether a result can be used; of one whose checks were not made no more than is known."""
    if not result.unchecked:
        return _judged(result)
    first, *alarms = result.alarms
    found = _judged(dataclasses.replace(result, alarms=tuple(alarms)))
    colour: Colour = "red" if found.colour == "red" else "amber"
    seen = found.seen if colour == "red" else ""
    means = f"{found.means} {first.means}" if colour == "red" else first.means
    return Trust(colour, f"{first.seen} {seen}".strip(), means, first.do)


def _judged(result: CalibrationResult) -> Trust:
    nominal, calibrated = (result.heldout_nrmse.get(name) for name in ("nominal", "calibrated"))
    noise = (
        f"Residuals are {math.sqrt(result.chi2):.1f} times the sensor's noise." if result.chi2 >= 0 else ""
    )
    mismatch = result.chi2 > EXPLAINED_CHI2
    if "shared_error" in result.provenance:
        first = result.alarms[0]
        return Trust("red", first.seen, first.means, f"Do not use it. {first.do}")
    if result.provenance.get("compares") == "distributions" and (known := _of_distributions(result)):
        return known
    record = ""
    if nominal is None or calibrated is None:
        record = "Record one more motion and name it with --holdout."
        if mismatch:
            means = "The model does not explain them, and no held-out recording shows whether it is better."
            return Trust("red", noise, means, f"Do not use it. {record}")
        gain = "There is no held-out recording."
    elif not calibrated <= WORSE * nominal:
        return Trust(
            "red",
            f"On held-out motion the calibrated model errs by {calibration.percent(calibrated)} of the "
            f"signal's range, your own model by {calibration.percent(nominal)}.",
            "The calibrated model is worse.",
            "Do not use it. Check units, signs and joint order of the recordings, then the alarms.",
        )
    elif calibrated * WORSE >= nominal:
        error = calibration.percent(calibrated)
        gain = f"On held-out motion the model errs by {error} of the signal's range, as yours."
        if mismatch:
            return Trust(
                "red",
                f"{gain} {noise}",
                "The model predicts no better than yours, and it lacks something that the robot has.",
                "Keep your own model until that is found." + _first_cause(result),
            )
    else:
        smaller = nominal / max(calibrated, 1e-300)
        gain = f"On held-out motion the error is {smaller:.1f} times smaller than your own model's."
    if mismatch:
        return Trust(
            "amber",
            f"{gain} {noise}",
            "The model is better than yours, but it lacks something that the robot has.",
            "Use it, but trust predictions more than single values." + _first_cause(result),
        )
    if result.alarms:
        many = len(result.alarms)
        count, read = (
            (f"There are {many} alarms.", "Read them") if many > 1 else ("There is 1 alarm.", "Read it")
        )
        return Trust(
            "amber",
            f"{gain} {count}",
            "The result has a known weakness.",
            f"{read} before you use the result.",
        )
    if math.isnan(result.chi2):
        return Trust(
            "amber",
            gain,
            "The method does not test whether the model explains the recordings.",
            f"Compare the held-out error with the error that your task allows. {record}".strip(),
        )
    unidentified = result.verdicts.count("not identifiable")
    if result.null_directions or unidentified:
        advised = " Or record the motion advised below." if result.advice else ""
        if not unidentified:
            return Trust(
                "amber",
                f"{gain} {noise}",
                "The model explains the recordings, but they hardly tell some parameters apart.",
                f"Use it. To narrow intervals, measure one of the parameters named together below.{advised}",
            )
        return Trust(
            "amber",
            f"{gain} {noise} {unidentified} of {len(result.space)} parameters have no value.",
            "The model explains the recordings, but they do not identify all parameters.",
            f"Use it: training draws these parameters from their whole range.{advised}",
        )
    if record:
        return Trust(
            "amber", f"{gain} {noise}", "No recording shows whether the model holds on other motion.", record
        )
    means = "The remaining error is the sensor's noise."
    if result.prior_directions:
        means += " Where expected values say more than the recordings, that is named below."
    return Trust("green", f"{gain} {noise}", means, "Use it.")


def _of_distributions(result: CalibrationResult) -> Trust | None:
    """Return the verdict on values that only distributions of motion gave; None where they predict as noise.

    Such a search tests no prediction, and many values give nearly equal distributions.
    """
    error = result.heldout_nrmse.get("calibrated")
    noise = (result.provenance.get("heldout_rmse") or {}).get("noise", {}).get("nrmse")
    if error is None:
        seen = "The search compared distributions of motion, and no held-out recording tests its values."
    elif noise is not None and error <= NEAR_NOISE * noise:
        return None
    else:
        floor = "" if noise is None else f", {error / noise:.1f} times that of the sensor's noise"
        seen = f"On held-out motion the model errs by {calibration.percent(error)} of the range{floor}."
    return Trust(
        "red",
        seen,
        "Many values give nearly the same distributions, so these are not the robot's.",
        "Do not deploy a policy with it. Calibrate by the default, which compares predictions; where "
        "commands are missing, --policy gives them.",
    )


def _first_cause(result: CalibrationResult) -> str:
    """Return where a cause stands, if one was named."""
    return " The first alarm names the likely cause." if result.provenance.get("diagnosis") else ""


def grouped(alarms: Sequence[Finding]) -> list[list[Finding]]:
    """Return alarms with the same remedy as one group, in the order of their first ones, without doubles."""
    groups: dict[str, list[Finding]] = {}
    for alarm in dict.fromkeys(alarms):
        groups.setdefault(alarm.do, []).append(alarm)
    return list(groups.values())


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
    if ratio > WORSE:
        return f"{100 * (1 - 1 / ratio):.0f} % better than the nominal model"
    if ratio >= 1 / WORSE:
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
