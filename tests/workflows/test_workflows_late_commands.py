"""A log that has each command one row late: named by a fit, and moved by the column map."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import refine
from deal_hw.calibration import CalibrationResult
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.late_commands import late_commands
from deal_hw.workflows.calibration.settings import FilesSettings

ARM = """
<mujoco><option timestep="0.005"/><worldbody>
<body><joint name="j" axis="0 1 0" damping="{damping}" frictionloss="0.05" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8"/></body>
</worldbody><actuator><position name="j" joint="j" kp="30" kv="1"/></actuator></mujoco>"""
MAP = "time: time\njoints: [{name: j, position: j_pos, target: j_cmd}]\n"
ROWS, PERIOD_S, NOISE_RAD = 400, 0.01, 3e-4


@dataclasses.dataclass
class Ended:
    """The part of a result that is looked at."""

    latency_s: float
    chi2: float


def record(folder: Path, late_rows: int, shift_s: float = 0.0) -> FilesSettings:
    """Write a recording whose commands stand so many rows late, with its model and map."""
    model = mujoco.MjModel.from_xml_string(ARM.format(damping=0.3))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    time = np.arange(ROWS) * PERIOD_S
    command = 0.5 * np.sin(4 * time) + 0.3 * np.sin(11 * time + 1)
    position = np.empty(ROWS)
    for row in range(ROWS):
        position[row] = data.qpos[0] + rng.normal(0, NOISE_RAD)
        data.ctrl[0] = command[row]
        mujoco.mj_step(model, data, round(PERIOD_S / model.opt.timestep))
    logged = np.concatenate([np.repeat(command[:1], late_rows), command[: ROWS - late_rows]])
    np.savez(folder / "r.npz", time=time, j_pos=position, j_cmd=logged)
    (folder / "columns.yaml").write_text(f"{MAP}command_shift_s: {shift_s}\n")
    (folder / "arm.xml").write_text(ARM.format(damping=0.2))
    return FilesSettings(model=folder / "arm.xml", data=(folder / "r.npz",), columns=folder / "columns.yaml")


def ended(settings: FilesSettings) -> tuple[Problem, CalibrationResult]:
    """Return the problem of a recording, and its local fit as a result."""
    work = calibration_input(settings)
    problem = Problem(work.robot, work.space, work.episodes, threads=1, guessed=work.guessed)
    fit = refine(problem, work.space.nominal, 0.0)
    return problem, Ended(fit.latency_s, fit.chi2)  # type: ignore[return-value]


def test_commands_one_row_late_are_named_and_moved(tmp_path: Path) -> None:
    """The latency ends at zero, and earlier commands explain all; moved by the map, they do."""
    problem, result = ended(record(tmp_path, 1))
    assert result.latency_s < 1e-3 and result.chi2 > 5
    (alarm,) = late_commands(problem, result)
    assert alarm.seen.startswith(
        "The motion begins one row before its command: with the commands 10 ms earlier"
    )
    assert "command_shift_s: -0.01 " in alarm.do
    problem, result = ended(record(tmp_path, 1, -0.01))
    assert result.chi2 < 1.5 and late_commands(problem, result) == ()


@pytest.mark.parametrize("chi2", [1.0, 30.0])
def test_commands_in_their_rows_are_not_accused(tmp_path: Path, chi2: float) -> None:
    """Neither with an explained residual, nor with one of another cause."""
    problem, result = ended(record(tmp_path, 0))
    assert late_commands(problem, dataclasses.replace(result, latency_s=0.0, chi2=chi2)) == ()
