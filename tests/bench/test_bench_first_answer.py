"""`bench first-answer`: when a fit was nearly as good as the last one, beside mujoco.sysid with a delay."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from deal_hw.bench import first_answer
from deal_hw.bench.first_answer import NEAR, FirstAnswerSettings, line, run_cell, summary
from deal_hw.bench.settings import FirstAnswer
from deal_hw.calibration import Budget
from deal_hw.cli.bench import bench
from deal_hw.errors import MissingExtraError, UnknownNameError
from deal_hw.sim.recordings.sysid_adapter import require_sysid
from deal_hw.testing.plain_robots import PlainRobot, write

SHORT = FirstAnswerSettings(window_s=0.8, sysid_window_s=0.8, sysid_iterations=10, seconds=2.5)


@pytest.mark.slow
def test_both_answer_on_the_double_pendulum() -> None:
    """Both end near the noise, the first answer not after the end, and the row says so."""
    try:
        require_sysid()
    except MissingExtraError as error:
        pytest.skip(str(error))
    row = run_cell(
        "double-pendulum", 0, real=None, budget=Budget(population=8, generations=2), threads=1, settings=SHORT
    )
    assert row["error"] == row["skipped"] == "" and row["parameters"] == 8
    for name in ("heldout_rmse", "heldout_rmse_sysid"):
        assert row[name] < 0.5 * row["heldout_rmse_nominal"] < row["heldout_rmse_null"]
    stages = {one["stage"]: one for one in row["shown"]}
    assert stages["end"]["heldout_rmse"] == row["heldout_rmse"]
    assert 0 < row["first_s"] <= row["seconds"] and 0 < row["first_cpu_s"] <= row["cpu_s"]
    assert stages[row["first_stage"]]["heldout_rmse"] <= NEAR * row["heldout_rmse"]
    assert row["seconds_ratio"] == row["first_s"] / row["sysid_s"]
    assert row["heldout_ratio"] == row["heldout_rmse"] / row["heldout_rmse_sysid"]
    assert row["latency_sysid"] == pytest.approx(row["latency_found"], abs=1e-3)
    assert "double-pendulum seed 0, 8 parameters: first answer after" in line(row)
    assert summary([row])[0].startswith("double-pendulum: 1 seeds; first answer / mujoco.sysid: ")


def test_motors_of_the_torque_arm_are_as_much_stronger_as_servos_were_stiffer(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The model's motors have gain 1; the robot's the ratio of its servo's stiffness to the model's."""
    made: list[PlainRobot] = []

    def keep(robot: PlainRobot, folder: Path, *, seconds: float) -> tuple[Path, list[Path], Path]:
        made.append(robot)
        return write(robot, folder, seconds=0.5)

    monkeypatch.setattr(first_answer, "write", keep)
    first_answer.PROBLEMS["torque-arm"](first_answer._Ask(tmp_path, 4, None, 0.5))
    model, robot = (mujoco.MjModel.from_xml_string(text) for text in (made[0].model, made[0].robot))
    assert list(model.actuator_gainprm[:, 0]) == [1.0, 1.0] and not model.actuator_biasprm.any()
    stiffness = [made[0].truth[f"{name}.servo_stiffness"] for name in ("shoulder", "elbow")]
    assert robot.actuator_gainprm[:, 0] == pytest.approx([stiffness[0] / 30.0, stiffness[1] / 15.0])


def test_real_robots_are_skipped_with_a_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without recordings the row says what to give; with a folder that lacks some, which."""
    out = tmp_path / "first.json"
    settings = FirstAnswer(problems=("so101", "go2-suspended"), seeds=(0, 1), out=out)
    assert bench(settings) == 0
    printed = capsys.readouterr().out
    assert "so101 seed 0: skipped: no real recordings: give --real DIR" in printed and "seed 1" not in printed
    assert "go2-suspended: not run" in printed
    row = run_cell("so101", 0, real=tmp_path, budget=Budget(), threads=1)
    assert "chirp_sweep.npz" in row["skipped"] and "docs/results/example-so101.md" in row["skipped"]


def test_the_go2s_files_are_those_that_its_page_makes(tmp_path: Path) -> None:
    """Four parts, of which the last judges; the page's command writes them to go2/."""
    folder = tmp_path / "go2"
    folder.mkdir()
    for name in ("columns.yaml", *(f"traj_0_part{k}.npz" for k in range(1, 5))):
        (folder / name).touch()
    config = first_answer.PROBLEMS["go2-suspended"](first_answer._Ask(tmp_path, 0, tmp_path, 1.0))
    assert [path.name for path in config.data] == [f"traj_0_part{k}.npz" for k in (1, 2, 3)]
    assert config.holdout == (folder / "traj_0_part4.npz",)
    page = (Path(__file__).parents[2] / "docs/results/example-go2-suspended.md").read_text(encoding="utf-8")
    assert "--out go2 --parts 4" in page and "traj_0_part4.npz" in page


def test_unknown_problems_are_refused() -> None:
    """The problems are listed."""
    with pytest.raises(UnknownNameError, match="torque-arm"):
        first_answer.table(FirstAnswer(problems=("humanoid",)))
