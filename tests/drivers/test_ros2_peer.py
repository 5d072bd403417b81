"""Programs on Cyclone DDS 0.10.2 and Fast DDS 2.9 meet an emulated robot of ros2_control and our driver."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ros2_rig import ros2_file

import deal_hw
from deal_hw.errors import SafetyError
from deal_hw.workflows.running.settings import LinkOptions

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="pip install 'deal-hw[dds]'"),
]

STATES, COMMANDS = "rt/left/joint_states", "rt/left/forward_position_controller/commands"
LO = "127.0.0.1"


@pytest.fixture
def robot(tmp_path: Path, dds_domain: int) -> Path:
    """The robot.yaml, in a domain of its own."""
    ros2_file(tmp_path, domain=dds_domain, namespace="left")
    return tmp_path / "robot.yaml"


@contextmanager
def commanding(peer: Path, domain: int, messages: int, *targets: float) -> Iterator[subprocess.Popen[str]]:
    """Run the peer during a block that begins at its first command; end it by SIGTERM if it runs then."""
    words = [domain, STATES, COMMANDS, messages, *targets]
    with subprocess.Popen(
        [peer, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            assert process.stdout.readline() == "commanding\n", process.stderr.read()
            yield process
        finally:
            process.send_signal(signal.SIGTERM)


def test_a_program_reads_and_moves_the_robot(ros2_peer: Path, dds_domain: int, robot: Path) -> None:
    """Its targets, in the controller's order, are where the joints are in the states that it reads."""
    with deal_hw.emulate(str(robot), transport="dds", port=LO, profile="ideal", nominal=True) as emulated:
        with commanding(ros2_peer, dds_domain, 100, 0.4, -0.2) as peer:
            printed, warnings = peer.communicate(timeout=60)
    report = json.loads(printed)
    assert (peer.returncode, warnings) == (0, "")
    assert report["version"].startswith("2." if "fastdds" in str(ros2_peer) else "0.10.")
    assert report["received"] > 50
    # The position loop has no integrator: weight keeps a joint some hundredths of a radian from its target.
    assert report["position"] == pytest.approx({"elbow_joint": 0.4, "shoulder": -0.2}, abs=0.15)
    assert emulated.truth["commands_accepted"] > 50 and emulated.truth["commands_refused"] == 0


@pytest.mark.slow
def test_a_program_as_second_publisher_is_refused(
    ros2_peer: Path, dds_domain: int, robot: Path, tmp_path: Path
) -> None:
    """While it publishes commands, no run begins; the message names its middleware."""
    middleware = "Fast DDS" if "fastdds" in str(ros2_peer) else "Cyclone DDS"
    with (
        deal_hw.emulate(str(robot), transport="dds", port=LO, profile="ideal", nominal=True),
        commanding(ros2_peer, dds_domain, 100_000, 0.3, 0.2) as peer,
    ):
        with pytest.raises(
            SafetyError, match=f"another program publishes on /left/forward.*commands.*{middleware}"
        ):
            deal_hw.collect(
                str(robot),
                port=LO,
                link=LinkOptions(transport="dds"),
                out=tmp_path / "run",
                motion="hold",
                seconds=1.0,
            )
        assert peer.poll() is None
