"""A robot of ros2_control that its robot.yaml describes: emulated in its own process, driven by each verb."""

from __future__ import annotations

import importlib.util
import random
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from ros2_rig import ros2_file

import deal_hw
from deal_hw.cli.main import EXIT_OK, main
from deal_hw.control.process.channel import Outcome
from deal_hw.errors import ConfigurationError, SafetyError
from deal_hw.findings import Severity
from deal_hw.workflows.robot import carries_robot
from deal_hw.workflows.running.settings import LinkOptions

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="pip install 'deal-hw[dds]'"),
]

WIRES = {"dds": "position", "zenoh": "trajectory"}
"""Wire -> kind of controller: each kind is driven on one of the two."""


@pytest.fixture(params=["dds", pytest.param("zenoh", marks=pytest.mark.slow)], scope="module")
def wire(request: pytest.FixtureRequest) -> str:
    """The wire."""
    return str(request.param)


@pytest.fixture(scope="module")
def robot(wire: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The robot.yaml, in a domain of its own."""
    folder = tmp_path_factory.mktemp(wire)
    ros2_file(folder, WIRES[wire], domain=random.SystemRandom().randrange(10, 100), namespace="left")
    return folder / "robot.yaml"


@pytest.fixture(scope="module")
def port(robot: Path, wire: str) -> Iterator[str]:
    """The port of the emulated robot."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number = probe.getsockname()[1]
    where = "127.0.0.1" if wire == "dds" else f"tcp/127.0.0.1:{number}"
    with deal_hw.emulate(str(robot), transport=wire, port=where, profile="sensor", seed=1) as emulated:
        yield emulated.port
    assert emulated.truth["commands_accepted"] > 100 and emulated.truth["commands_refused"] == 0
    assert set(emulated.truth["parameters"]) >= {"shoulder.frictionloss", "elbow.servo_stiffness"}


def test_doctor_shows_who_is_on_the_topics(robot: Path, wire: str, port: str) -> None:
    """No failure; the robot's publisher and its controller, and nobody else."""
    report = deal_hw.doctor(str(robot), port=port, transport=wire, seconds=1.0)
    assert not [finding for finding in report.findings if finding.severity is Severity.FAIL]
    seen = [finding.seen for finding in report.findings if finding.code == "topics"]
    assert any("publishes /left/joint_states" in text for text in seen)
    assert any("subscribes to /left/forward_position_controller/" in text for text in seen)
    assert any("nobody else publishes" in text for text in seen)


def test_collect_and_replay(robot: Path, wire: str, port: str, tmp_path: Path) -> None:
    """The dataset holds the robot; the replay needs only the recording."""
    link = LinkOptions(transport=wire)
    run = tmp_path / "run"
    report = deal_hw.collect(str(robot), port=port, link=link, out=run, motion="chirp", seconds=2.0)
    assert report.outcome is Outcome.FINISHED
    assert report.episodes[0].passive_confirmed and report.episodes[0].states_recorded > 100
    assert carries_robot(run / "dataset")
    kept = (run / "dataset" / "robot" / "robot.yaml").read_text(encoding="utf-8")
    assert "bus: ros2_control" in kept
    again = deal_hw.replay(report.paths[0], port=port, link=link, out=tmp_path / "again")
    assert again.outcome is Outcome.FINISHED
    difference = again.episodes[0].replay
    assert difference is not None and difference.position.max() < 0.05


def test_stop_makes_it_passive(robot: Path, wire: str, port: str, capsys: pytest.CaptureFixture[str]) -> None:
    """From any terminal, by the file's name: it holds the pose that it has."""
    assert main(["stop", str(robot), "--transport", wire, "--port", port]) == EXIT_OK
    assert "is passive" in capsys.readouterr().out


def test_a_controller_that_is_not_there_is_refused(robot: Path, wire: str, port: str, tmp_path: Path) -> None:
    """The file names another controller than the robot has."""
    ros2_file(tmp_path)
    text = robot.read_text(encoding="utf-8").replace("forward_position_controller", "arm_controller")
    other = tmp_path / "robot.yaml"
    other.write_text(text, encoding="utf-8")
    with pytest.raises(SafetyError, match="nobody subscribes to /left/arm_controller/"):
        deal_hw.collect(
            str(other),
            port=port,
            link=LinkOptions(transport=wire),
            out=tmp_path / "run",
            motion="hold",
            seconds=1.0,
        )


def test_no_other_wire(tmp_path: Path) -> None:
    """A robot on topics has no serial port, and check compares no servos."""
    ros2_file(tmp_path)
    path = tmp_path / "robot.yaml"
    with pytest.raises(ConfigurationError, match="choose --transport dds or zenoh"):
        deal_hw.collect(
            str(path), port="/dev/null", link=LinkOptions(transport="serial"), out=tmp_path / "run"
        )
    assert main(["robot", "check", str(path)]) == EXIT_OK
