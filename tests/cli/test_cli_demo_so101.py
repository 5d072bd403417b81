"""The SO-101's part of the demo, in virtual time: poses, a run of the shipped policy, and its errors."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.cli import demo_so101
from deal_hw.cli.calibrate import calibrate
from deal_hw.cli.demo import KINDS as DEMO
from deal_hw.cli.demo import demo
from deal_hw.cli.demo_so101 import POSE_S, POSES, reach_measures, write_poses
from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.drivers.so101.description import DRIVEN, JOINTS, WEIGHTED, emulated_space
from deal_hw.drivers.so101.emulator import so101_device
from deal_hw.drivers.so101.robot import so101_arm
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import DatasetError
from deal_hw.motions.joint_targets import make_targets
from deal_hw.motions.scores.reach import settled
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.sim.robots.simulated import SimulatedTruth
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.running.report import EpisodeReport, RunReport
from deal_hw.workflows.shipped import required_policy

BIAS = 0.03
SCRIPT = "time_s," + ",".join(JOINTS) + "\n0,0.4,-0.4,0.5,0.3,0.5,0.5\n2,-0.3,0.3,0.2,-0.5,-0.8,1.0\n"


@pytest.fixture(scope="module")
def reached(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, float], Path]:
    """A recording of the shipped policy over two poses, the hidden truth, and the script."""
    folder = tmp_path_factory.mktemp("reach")
    script, path = folder / "poses.csv", folder / "reach.mcap"
    script.write_text(SCRIPT, encoding="utf-8")
    truth = {p.name: p.nominal for p in emulated_space().parameters} | {"wrist_roll.encoder_bias": BIAS}
    clock = VirtualClock(10**12)
    device = so101_device(SimulatedTruth(parameters=truth, latency_s=0.005, seed=1))
    robot = so101_arm(VirtualTransport(device, clock), clock)
    plan = RunPlan(
        robot="so101", policy=str(required_policy("so101")), target=str(script), seconds=2 * POSE_S
    )
    with EpisodeRecorder(path, DRIVEN.to_json(), {}, clock) as recorder:

        def sink(record: CycleRecord) -> bool:
            recorder.write(record)
            return True

        config = LoopConfig(duration_s=plan.seconds)
        behaviour = make_behaviour(plan, DRIVEN)
        end = ControlLoop(robot, behaviour, Safety(DRIVEN), clock, sink, config).run()
    assert end.outcome is Outcome.FINISHED
    return path, truth, script


def test_the_shipped_policy_reaches_poses_behind_the_filter(
    reached: tuple[Path, dict[str, float], Path],
) -> None:
    """By its own encoders each joint is within 0.15 rad of both poses."""
    path, _, script = reached
    poses = make_targets(str(script), DRIVEN)
    for positions, pose in zip(settled(read_trajectory(path), poses.time_s), poses.poses, strict=True):
        assert len(positions) == pytest.approx(50, abs=2)
        assert np.abs(positions.mean(axis=0) - pose).max() < 0.15


def test_errors_are_of_true_positions(reached: tuple[Path, dict[str, float], Path]) -> None:
    """The hidden bias of one joint of six is in the joints' error, and not in that of those with weight."""
    path, truth, script = reached
    episode = EpisodeReport(
        path=path,
        outcome=Outcome.FINISHED,
        reason="",
        passive_confirmed=True,
        clipped={},
        cycles_sent=200,
        states_recorded=400,
        error="",
    )
    run = RunReport(dataset=path.parent, episodes=(episode,))
    poses = make_targets(str(script), DRIVEN)
    unbiased = {**truth, "wrist_roll.encoder_bias": 0.0}
    joint, heavy, tip = (m.values["udr"][0] for m in reach_measures({"udr": run}, poses, truth))
    joint_0, heavy_0, tip_0 = (m.values["udr"][0] for m in reach_measures({"udr": run}, poses, unbiased))
    assert 0.0 < abs(joint - joint_0) <= BIAS / 6 + 1e-9
    assert heavy == heavy_0
    # The tip lies nearly on wrist_roll's axis.
    assert 0.0 < tip < 0.06 and tip == pytest.approx(tip_0, abs=1e-6)


def test_a_recording_that_ended_early_is_not_judged(reached: tuple[Path, dict[str, float], Path]) -> None:
    """A pose whose end was not recorded has no error."""
    with pytest.raises(DatasetError, match=r"ended before all 3 poses"):
        settled(read_trajectory(reached[0]), np.array([0.0, 2.0, 3.9]))


def test_poses_are_drawn_by_the_seed_within_the_ranges(tmp_path: Path) -> None:
    """The same seed gives the same file, another one another, and each pose is allowed."""
    first, again, other = (write_poses(tmp_path / f"{k}.csv", seed) for k, seed in enumerate((1, 1, 2)))
    assert first.read_text() == again.read_text() != other.read_text()
    found = make_targets(str(first), DRIVEN)
    assert found.poses.shape == (POSES, 6) and found.time_s[-1] == (POSES - 1) * POSE_S


@pytest.mark.slow
@pytest.mark.real_time
def test_demo_runs_all_five_jobs_and_leaves_a_summary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All stages over the port, with fewer poses, a local fit and a short training."""
    monkeypatch.setattr(demo_so101, "POSES", 2)
    # Its searches are judged in tests/calib; the local fit explains this recording.
    monkeypatch.setattr(
        demo_so101, "calibrate", lambda config: calibrate(dataclasses.replace(config, method="local"))
    )
    folder = tmp_path / "demo"
    report = demo(DEMO.settings("so101", out=folder, profile="sensor", seed=1, steps=2000))
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary == json.loads(json.dumps(report.summary))
    printed = capsys.readouterr().out
    rows = summary["parameters"]
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    assert {name: row["truth"] for name, row in rows.items()}.items() <= truth["parameters"].items()
    assert summary["heldout_nrmse"]["calibrated"] < 0.5 * summary["heldout_nrmse"]["nominal"]
    as_it_is, calibrated = summary["median_error"].values()
    assert calibrated < as_it_is
    for joint in WEIGHTED:
        bias = rows[f"{joint}.encoder_bias"]
        # Two poses tell the wrist's bias by 0.02 to 0.07 rad. The interval is 3.3 standard deviations wide.
        assert abs(bias["estimate"] - bias["truth"]) < bias["high"] - bias["low"]
    assert summary["latency_s"]["found"] == pytest.approx(summary["latency_s"]["true"], abs=3e-3)
    for measure in ("joint_error_rad", "weighted_joint_error_rad", "tip_error_m"):
        assert set(summary[measure]) == {"udr", "retrained"}
    # The shipped policy reaches the poses; two thousand steps teach little.
    assert summary["weighted_joint_error_rad"]["udr"] < 0.15 and summary["tip_error_m"]["udr"] < 0.06
    assert OnnxPolicy(summary["paths"]["policy"]).spec.robot == "so101"
    assert mujoco.MjModel.from_xml_path(summary["paths"]["mjcf"]).nu == len(JOINTS)
    assert Path(summary["paths"]["rrd"]).stat().st_size > 10_000
    assert json.loads((folder / "run.json").read_text(encoding="utf-8"))["status"] == "finished"
    end = printed[printed.rindex("== inspect") :]
    assert "missed 2 poses by" in " ".join(end.split())
    assert "estimates of the calibration beside the hidden truth" in end
    assert end.count(".encoder_bias") == sum(name.endswith(".encoder_bias") for name in rows)
