"""What the report shows: a result and the series that only the recordings and the simulator can give."""

from __future__ import annotations

from dataclasses import dataclass

from deal_hw.calib.validation.split_half import HalvesRow
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlay:
    """One recording beside open-loop predictions that restart from the measured state.

    Attributes:
        title: Which recording.
        heldout: The search never saw it.
        names: The M measured channels.
        units: Unit of each channel, (M,).
        time_s: Time of each sample, (T,) [s].
        real: Measured values, (T, M).
        nominal: Predicted by the user's own model, (T, M); NaN where nothing was predicted.
        calibrated: Predicted by the calibrated model, likewise.
        window_s: The prediction restarts this often [s].
    """

    title: str
    heldout: bool
    names: tuple[str, ...]
    units: tuple[str, ...]
    time_s: FloatArray
    real: FloatArray
    nominal: FloatArray
    calibrated: FloatArray
    window_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Residuals:
    """Whitened prediction errors of the calibrated model: white and of unit variance where it is right.

    Attributes:
        title: Which recording.
        names: The M measured channels.
        time_s: Time at the end of each window's samples, (W, H) [s].
        whitened: Recording minus prediction, in standard deviations, (W, H, M); NaN where it diverged.
    """

    title: str
    names: tuple[str, ...]
    time_s: FloatArray
    whitened: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportInputs:
    """Everything on the page.

    Attributes:
        robot: The robot's name.
        result: What the calibration found.
        overlays: Recordings beside predictions.
        residuals: Whitened errors of the fitted recordings.
        tick_s: Device period, the unit of the latency scan [s]; None where unknown.
        telemetry: Verdicts of the telemetry checks, in words.
        halves: Agreement of disjoint halves of the data.
        left_out: What is not drawn, in words.
    """

    robot: str
    result: CalibrationResult
    overlays: tuple[Overlay, ...] = ()
    residuals: tuple[Residuals, ...] = ()
    tick_s: float | None = None
    telemetry: tuple[str, ...] = ()
    halves: tuple[HalvesRow, ...] = ()
    left_out: tuple[str, ...] = ()
