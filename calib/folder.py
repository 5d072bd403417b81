"""The result folder of a calibration: numbers, trace, report and the calibrated model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.calib.report.inputs import ReportInputs
from deal_hw.calibration import RESULT_FILE, CalibrationResult
from deal_hw.data.files import write_json
from deal_hw.errors import DatasetError
from deal_hw.sim.calibrated_mjcf import write_calibrated_mjcf
from deal_hw.sim.model import RobotModel

DISTRIBUTION = "distribution.json"
MODEL = "calibrated.xml"
TRACE = "trace.npz"
REPORT = "report.html"


def write_result(
    folder: Path, robot: RobotModel, result: CalibrationResult, report: ReportInputs | None = None
) -> dict[str, Path]:
    """Write everything a calibration found; each file appears whole or not at all.

    Args:
        folder: Where to write; made if need be.
        robot: The nominal model.
        result: What was found.
        report: What the report shows; None to write none.

    Returns:
        The files by name; included files of the model that changed are among them.

    Raises:
        DatasetError: The folder cannot be written.
        ConfigurationError: A calibrated value cannot be written into the model; all other files are there.
    """
    files = {name: folder / name for name in (RESULT_FILE, DISTRIBUTION, TRACE)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(files[RESULT_FILE], result.to_json())
        write_json(files[DISTRIBUTION], result.distribution().to_json())
        keys = sorted({key for row in result.trace for key in row})
        columns: dict[str, Any] = {
            key: np.array([row.get(key, np.nan) for row in result.trace]) for key in keys
        }
        if result.population is not None:
            columns["population"] = result.population
        np.savez(files[TRACE], **columns)
        if report is not None:
            # Only here: matplotlib takes half a second to load.
            from deal_hw.calib.report.page import write_report

            files[REPORT] = folder / REPORT
            write_report(files[REPORT], report)
        # Last: a model that cannot be written must not cost the numbers.
        source = f"method {result.method}, distribution {result.distribution().digest()}"
        written = write_calibrated_mjcf(
            robot, result.space, result.estimate, folder / MODEL, result.latency_s, source
        )
        files.update({file.name: file for file in written})
    except OSError as err:
        raise DatasetError(f"{folder} cannot be written: {err.strerror}") from err
    return files
