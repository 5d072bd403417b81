"""Poses that a policy is to reach: the option, the script, and what a policy observes of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deal_hw.drivers.so101.description import DRIVEN, JOINTS
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.motions.joint_targets import make_targets
from deal_hw.policies.reach_env import reach_spec
from deal_hw.policy import Observation, ObservationBuilder
from deal_hw.types import FloatArray, RobotState, Status

HEAD = "time_s," + ",".join(JOINTS)


def _script(folder: Path, *lines: str) -> str:
    path = folder / "poses.csv"
    path.write_text("\n".join((HEAD, *lines)) + "\n", encoding="utf-8")
    return str(path)


def test_without_a_target_it_is_the_start_pose() -> None:
    """The default pose, at all times."""
    assert make_targets("", DRIVEN).at(7.0).tolist() == [0.0] * 6


def test_one_pose_holds_all_the_time() -> None:
    """Positions in the order of the joints."""
    found = make_targets("0.1,-0.2,0.3,0,0,1.5", DRIVEN)
    assert found.at(0.0).tolist() == found.at(9.0).tolist() == [0.1, -0.2, 0.3, 0.0, 0.0, 1.5]


def test_a_script_changes_the_pose_at_its_times(tmp_path: Path) -> None:
    """Each pose is valid until the next one's time; before the first one's time it is the first."""
    found = make_targets(_script(tmp_path, "0.5,0,0,0,0,0,0", "2,0.4,0,0,0,0,1"), DRIVEN)
    assert found.at(0.0).tolist() == found.at(1.999).tolist() == [0.0] * 6
    # A control period is not exact in binary.
    assert found.at(100 * 0.02 - 1e-12).tolist() == found.at(60.0).tolist() == [0.4, 0, 0, 0, 0, 1.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2,3", "give the positions of shoulder_pan,"),
        ("a,b,c,d,e,f", "give the positions of shoulder_pan,"),
        ("0,2,0,0,0,0", r"shoulder_lift is 2\.0, allowed: -1\.695 to 1\.695"),
        ("0,nan,0,0,0,0", "shoulder_lift is nan"),
        ("absent.csv", "no such file"),
    ],
)
def test_a_wrong_target_is_refused(text: str, words: str) -> None:
    """Too few numbers, no numbers, out of a joint's range, no file: each with what is allowed."""
    with pytest.raises(ConfigurationError, match=words):
        make_targets(text, DRIVEN)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "contains no line after its header"),
        (["0,0,0,0,0,0,0", "0,1,0,0,0,0,0"], "line 3 .* increasing times"),
        (["0,0,0,0,0,0"], "line 2 .* 7 numbers"),
        (["0,0,0,0,0,0,9"], r"line 2: gripper is 9\.0, allowed"),
        (["0,inf,0,0,0,0,0"], "line 2: shoulder_pan is inf"),
    ],
)
def test_a_wrong_script_names_its_line(tmp_path: Path, lines: list[str], words: str) -> None:
    """Nothing is moved by a script with one wrong line."""
    with pytest.raises(ConfigurationError, match=words):
        make_targets(_script(tmp_path, *lines), DRIVEN)


def test_another_robots_script_is_refused(tmp_path: Path) -> None:
    """The header has the joints of this robot, in its order."""
    path = tmp_path / "poses.csv"
    path.write_text("time_s,hip,knee\n0,0,0\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"first line is .time_s,hip,knee., expected time_s,sh"):
        make_targets(str(path), DRIVEN)


def test_a_target_is_observed_relative_to_the_default_pose() -> None:
    """Each entry is the target less the default position, times its scale; the same at all delays."""
    moved = dataclasses.replace(DRIVEN, default_position=(0.1, 0.2, 0.0, 0.0, 0.0, 0.5))
    spec = reach_spec(moved)
    builder = ObservationBuilder(spec)
    rows = [k for k, term in enumerate(spec.observation) if term.quantity == "joint_target"]
    position = np.array(moved.default_position)
    assert builder.build(position, np.zeros(6))[rows].tolist() == [0.0] * 6
    builder.joint_target = position + np.arange(6) / 8
    assert builder.build(position, np.zeros(6))[rows].tolist() == (np.arange(6) / 8).tolist()


def test_a_policy_gets_the_pose_of_its_time() -> None:
    """The behaviour hands the pose of the run's time to the observation."""
    spec = reach_spec(DRIVEN)
    rows = [k for k, term in enumerate(spec.observation) if term.quantity == "joint_target"]
    seen: list[FloatArray] = []

    class Watching:
        spec = reach_spec(DRIVEN)

        def reset(self) -> None:
            pass

        def act(self, observation: Observation) -> FloatArray:
            seen.append(np.array(observation[rows]))
            return np.zeros(6)

    behaviour = PolicyBehaviour(Watching(), DRIVEN, targets=lambda time_s: np.full(6, time_s))
    assert behaviour.follows_targets
    zeros = np.zeros(6)
    state = RobotState(
        position=zeros,
        velocity=zeros,
        effort=zeros,
        receive_ns=0,
        device_ns=0,
        sequence=0,
        command_sequence=-1,
        command_age_ns=-1,
        status=Status.ARMED,
    )
    behaviour.command(state, 0.25)
    behaviour.command(state, 0.5)
    assert [one[0] for one in seen] == [0.25, 0.5]
