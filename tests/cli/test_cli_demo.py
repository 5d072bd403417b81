"""The whole loop over a real pty, as a newcomer runs it, with a short training."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import pytest

from deal_hw.cli.demo import Demo, demo
from deal_hw.errors import ConfigurationError
from deal_hw.policies.onnx_runtime import OnnxPolicy


@pytest.mark.slow
def test_demo_runs_all_five_jobs_and_leaves_a_summary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every stage leaves its file, parameters are found within 5 % on average, the table is printed."""
    folder = tmp_path / "demo"
    report = demo(Demo(out=folder, profile="sensor", seed=1, episodes=1, steps=2000))
    summary = json.loads((folder / "summary.json").read_text())
    assert summary == json.loads(json.dumps(report.summary))
    rows = summary["parameters"].values()
    assert len(rows) == 9
    assert sum(abs(r["estimate"] / r["truth"] - 1) for r in rows) / 9 < 0.05
    assert sum(r["low"] <= r["truth"] <= r["high"] for r in rows) >= 6
    assert summary["latency_s"]["found"] == pytest.approx(summary["latency_s"]["true"], abs=2.1e-3)
    assert summary["heldout_nrmse"]["calibrated"] < 0.5 * summary["heldout_nrmse"]["nominal"]
    assert set(summary["angle_error_rad"]) == set(summary["cart_speed_m_s"]) == {"udr", "retrained"}
    assert {"period_p50", "period_p99", "period_max", "overruns"} <= set(summary["cadence"])
    assert summary["cadence"]["period_p50"] == pytest.approx(0.02, abs=1e-3)
    assert {"collect", "calibrate", "train", "inspect"} <= set(summary["seconds"])
    assert mujoco.MjModel.from_xml_path(summary["paths"]["mjcf"]).nq == 2
    assert OnnxPolicy(summary["paths"]["policy"]).spec.robot == "cartpole"
    assert Path(summary["paths"]["rrd"]).stat().st_size > 10_000
    assert json.loads((folder / "run.json").read_text())["status"] == "finished"
    printed = capsys.readouterr().out
    assert "cart.mass" in printed and "retrained" in printed and "held-out error" in printed


def test_demo_does_not_touch_a_folder_that_is_not_its_own(tmp_path: Path) -> None:
    """Somebody else's files stay."""
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigurationError, match="name another folder"):
        demo(Demo(out=tmp_path))
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
