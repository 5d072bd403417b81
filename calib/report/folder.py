"""The result folder of a calibration: numbers, trace, report and the calibrated model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.calib.report.inputs import ReportInputs
from deal_hw.calibration import RESULT_FILE, CalibrationResult
from deal_hw.data.files import published_together, write_json
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.mjcf.calibrated import require_other, write_calibrated_mjcf

DISTRIBUTION = "distribution.json"
MODEL = "calibrated.xml"
TRACE = "trace.npz"
REPORT = "report.html"


def write_result(
    folder: Path, robot: RobotModel, result: CalibrationResult, report: ReportInputs | None = None
) -> dict[str, Path]:
    """Write everything a calibration found; all of it appears, or none.

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
        KeyboardInterrupt: Ctrl-C; nothing was changed, or all files are there.
    """
    unwritable: ConfigurationError | None = None
    try:
        with published_together(folder) as waiting:
            names = [RESULT_FILE, DISTRIBUTION, TRACE]
            write_json(waiting / RESULT_FILE, result.to_json())
            write_json(waiting / DISTRIBUTION, result.distribution().to_json())
            np.savez(waiting / TRACE, **_trace(result))
            if report is not None:
                # Only here: matplotlib takes half a second to load.
                from deal_hw.calib.report.page import write_report

                write_report(waiting / REPORT, report)
                names.append(REPORT)
            source = f"method {result.method}, distribution {result.distribution().digest()}"
            try:
                require_other(folder / MODEL, robot.description.mjcf)
                written = write_calibrated_mjcf(
                    robot, result.space, result.estimate, waiting / MODEL, result.latency_s, source
                )
                names += [file.name for file in written]
            except ConfigurationError as err:
                # A model that cannot be written must not cost the numbers.
                unwritable = ConfigurationError(str(err).replace(str(waiting), str(folder)))
    except OSError as err:
        raise DatasetError(f"{folder} cannot be written: {err.strerror}") from err
    if unwritable is not None:
        raise unwritable
    return {name: folder / name for name in names}


def _trace(result: CalibrationResult) -> dict[str, Any]:
    keys = sorted({key for row in result.trace for key in row})
    columns: dict[str, Any] = {key: np.array([row.get(key, np.nan) for row in result.trace]) for key in keys}
    if result.population is not None:
        columns["population"] = result.population
    return columns
