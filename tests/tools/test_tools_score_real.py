"""Held-out motion of real robots: one page of least squares, and the table of methods."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import score_real

from deal_hw.bench import first_answer
from deal_hw.errors import ConfigurationError
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.calibration.settings import FilesSettings


@pytest.fixture
def pendulum(tmp_path: Path) -> score_real.Robot:
    """Return a simulated pendulum with a hidden truth, in the place of a real robot."""
    robot = make_robot("pendulum", 3)

    def inputs(folder: Path, made: Path) -> FilesSettings:
        model, fit, held_out = write(robot, made, seconds=6.0)
        return FilesSettings(model=model, data=fit, holdout=held_out)

    return score_real.Robot(inputs, 1.0, 1.0, "pendulum")


def test_one_page_of_least_squares_predicts_held_out_motion_to_the_noise(
    pendulum: score_real.Robot, tmp_path: Path
) -> None:
    """Where MuJoCo explains the robot, only the encoder's noise of 1 mrad is left."""
    before = score_real.score(pendulum, tmp_path, "nominal", 0)
    after = score_real.score(pendulum, tmp_path, "one-page", 0)
    assert after["rmse"] < 0.0012 < before["rmse"] / 5
    assert after["rmse_null"] == before["rmse_null"] > before["rmse"] / 10
    assert after["window_s"] == 1.0
    assert set(after["estimate"]) == set(before["estimate"])
    assert not after["at_bound"]


def test_a_missing_recording_is_named_with_the_way_to_make_it(tmp_path: Path) -> None:
    """The message has the file and where the converter is named."""
    with pytest.raises(ConfigurationError, match=r"v1_0\.npz.* missing: --help names the converter"):
        score_real.score(score_real.ROBOTS["cartpole"], tmp_path, "nominal", 0)


def test_the_table_compares_the_default_with_and_without_laws() -> None:
    """A ratio below 1 is a gain; a method with an error has an empty cell."""
    rows: list[dict[str, Any]] = [
        {"robot": "so101", "method": "no-laws", "error": "", "share": 0.02, "rmse": 0.004},
        {
            "robot": "so101",
            "method": "default",
            "error": "",
            "share": 0.018,
            "rmse": 0.0036,
            "laws": [{"law": "friction"}, {"law": "play"}],
        },
        {"robot": "so101", "method": "mujoco-sysid", "error": "no"},
    ]
    last = score_real.table(rows).splitlines()[-1]
    assert last == "| so101 | | | | 2.000 | 1.800 | 0.900 | friction, play |"
    assert score_real.laws_of({"law": {"law": "friction"}}) == ["friction"]
    assert score_real.laws_of({"law": None}) == score_real.laws_of({"laws": None}) == []


def test_unknown_robots_and_methods_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """The message has what was given and what there is."""
    with pytest.raises(SystemExit):
        score_real.main([str(tmp_path), "--robots", "so101,g1", "--methods", "deal"])
    assert "unknown: g1, deal; robots: so101, so101-other, go2" in capsys.readouterr().err


@pytest.mark.parametrize("name", score_real.ROBOTS)
def test_no_recording_is_both_fitted_and_held_out(name: str, tmp_path: Path) -> None:
    """Each of the two splits of a robot fits what the other one judges by."""
    for stem in (
        *first_answer.SO101_FAST,
        *first_answer.SO101_SLOW,
        *(f"traj_0_part{number}" for number in range(1, 5)),
        *(f"v1_{number}" for number in (0, 1, 5, 800, 1200, 1700)),
        *(f"kp{kp}-{motion}" for kp in (100, 200, 400, 800) for motion in score_real.XL330_MOTIONS),
        *score_real.UR10E_FITTED,
        *score_real.UR10E_HELD_OUT,
        *("sac", "direct_collocation", "energy_shaping", "ddp"),
    ):
        (tmp_path / f"{stem}.npz").touch()
    for number in range(7):
        (tmp_path / f"trajectory_{number:02}.csv").touch()
    (tmp_path / "columns.yaml").touch()
    (tmp_path / "cartpole.xml").write_text('<joint name="cart" armature="1.4"/>')
    made = tmp_path / "made"
    made.mkdir()
    config = score_real.ROBOTS[name].inputs(tmp_path, made)
    held_out = config.holdout if isinstance(config.holdout, list | tuple) else [config.holdout]
    assert held_out
    assert not set(held_out) & set(config.data)
    assert all(path.exists() for path in (*config.data, *held_out))
    assert name != "cartpole-bare" or Path(config.model).read_text() == '<joint name="cart"/>'
