"""An arm that nothing but its robot.yaml describes: emulated in its own process, driven by each verb."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from arm_rig import BUSES, arm_file, two_arms_file

import deal_hw
from deal_hw.cli.main import EXIT_OK, main
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.errors import PolicyError
from deal_hw.findings import Severity
from deal_hw.workflows.robot import carries_robot
from deal_hw.workflows.running.report import RunReport

pytestmark = pytest.mark.real_time


@pytest.fixture(params=[pytest.param("dynamixel", marks=pytest.mark.slow), "feetech"], scope="module")
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The arm's robot.yaml; a state comes twice a command, so that a busy computer's late one costs less."""
    folder = tmp_path_factory.mktemp(request.param)
    arm_file(folder, request.param)
    path = folder / "robot.yaml"
    text = path.read_text(encoding="utf-8").replace("state_rate_hz: 50.0", "state_rate_hz: 100.0")
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def port(robot: Path) -> Iterator[str]:
    """The port of the emulated arm."""
    with deal_hw.emulate(str(robot), profile="sensor", seed=1) as emulated:
        yield emulated.port
    assert set(emulated.truth["parameters"]) >= {"shoulder.frictionloss", "elbow.servo_stiffness"}


def undisturbed(run: Callable[[], RunReport]) -> RunReport:
    """Repeat a run, as a user would, that ended because a busy computer delayed a state by 100 ms: twice."""
    for _ in range(2):
        report = run()
        if report.episodes[-1].flags != ("state_stale",):
            return report
    return run()


def test_doctor_finds_the_servos_and_their_states(robot: Path, port: str) -> None:
    """No failure, and one phrase a servo."""
    # In 1 s, a pause of 10 ms of the emulator's process is a clock that is wrong by 1 %.
    report = deal_hw.doctor(str(robot), port=port, seconds=3.0)
    assert report.exit_code == 0, report
    found = [finding.seen for finding in report.findings if finding.code == "link"]
    assert len(found) == 1 and "shoulder: servo 1" in found[0] and "elbow: servo 2" in found[0]
    assert not [finding for finding in report.findings if finding.severity is Severity.FAIL]


def test_robot_check_compares_file_and_servos(
    robot: Path, port: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through a real port: all answer, none is wrong."""
    assert main(["robot", "check", str(robot), "--port", port]) == EXIT_OK
    table = capsys.readouterr().out
    assert f"all 2 answer on {port}" in table and "cycle: all servos answer after" in table


def test_collect_records_and_replay_repeats(robot: Path, port: str, tmp_path: Path) -> None:
    """The dataset holds the robot, by which calibrate finds its kind; the replay needs only the recording."""
    run = tmp_path / "run"
    report = undisturbed(lambda: deal_hw.collect(str(robot), port=port, out=run, motion="chirp", seconds=2.0))
    assert report.outcome is Outcome.FINISHED, report
    assert report.episodes[0].passive_confirmed and report.episodes[0].states_recorded > 150
    dataset = run / "dataset"
    kept = (dataset / "robot" / "robot.yaml").read_text(encoding="utf-8")
    assert "hardware:" in kept and "zero: 2000" in kept
    assert json.loads((dataset / "dataset.json").read_text())["description"]["name"] == "two joints"
    assert carries_robot(dataset)
    again = undisturbed(lambda: deal_hw.replay(report.paths[0], port=port, out=tmp_path / "again"))
    assert again.outcome is Outcome.FINISHED, again
    difference = again.episodes[0].replay
    assert difference is not None and difference.position.max() < 0.05


def test_random_set_points_need_no_policy(robot: Path, port: str, tmp_path: Path) -> None:
    """An arm stands without one; a policy that nobody named is asked for."""
    rich = tmp_path / "rich"
    report = undisturbed(lambda: deal_hw.collect(str(robot), port=port, out=rich, seconds=2.0, attempts=1))
    assert report.outcome is Outcome.FINISHED, report
    with pytest.raises(PolicyError, match="needs a policy"):
        deal_hw.deploy(str(robot), port=port, out=tmp_path / "deployed")


def test_stop_makes_it_passive(robot: Path, port: str, capsys: pytest.CaptureFixture[str]) -> None:
    """From any terminal, by the file's name."""
    assert main(["stop", str(robot), "--port", port]) == EXIT_OK
    assert "is passive" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("bus", BUSES)
def test_two_arms_of_seven_joints_share_a_bus(bus: str, tmp_path: Path) -> None:
    """14 servos at 50 Hz: every joint moves and is recorded, and a replay repeats it."""
    file = two_arms_file(tmp_path, bus)
    names = [joint.name for joint in file.joints]
    assert len(names) == 14
    robot = str(tmp_path / "robot.yaml")
    with deal_hw.emulate(robot, profile="sensor", seed=1) as emulated:
        port = emulated.port
        report = undisturbed(
            lambda: deal_hw.collect(robot, port=port, out=tmp_path / "run", motion="chirp", seconds=4.0)
        )
        again = undisturbed(lambda: deal_hw.replay(report.paths[0], port=port, out=tmp_path / "again"))
    assert report.outcome is again.outcome is Outcome.FINISHED
    assert report.episodes[0].passive_confirmed and report.episodes[0].states_recorded > 150
    found = read_trajectory(report.paths[0])
    assert list(found.joint_names) == names and np.ptp(found.position, axis=0).min() > 0.05
    difference = again.episodes[0].replay
    assert difference is not None and difference.position.max() < 0.05
