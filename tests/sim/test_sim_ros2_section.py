"""The section `hardware` with `bus: ros2_control`: read as written; what cannot be driven is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from ros2_rig import ros2_file

from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.robot_file import read_robot_file
from deal_hw.sim.robots.ros2_section import Ros2Section


def section(**fields: Any) -> Ros2Section:
    """Return a section with these fields."""
    return Ros2Section(**{"bus": "ros2_control", "controller": "arm", "joints": ("a",), **fields})


def test_it_is_read_as_written(tmp_path: Path) -> None:
    """All fields, with and without those of TLS."""
    more: dict[str, Any] = {"namespace": "/left", "domain": 7, "ca": "ca.pem", "insecure": True}
    for fields in ({}, more):
        written = ros2_file(tmp_path, **fields)
        assert read_robot_file(tmp_path / "robot.yaml") == written
        assert written.servo_bus is None and written.ros2 is not None


@pytest.mark.parametrize(
    ("fields", "states", "commands"),
    [
        ({}, "joint_states", "arm/commands"),
        ({"namespace": "/left/"[:-1]}, "left/joint_states", "left/arm/commands"),
        ({"namespace": "left", "joint_states": "/all/joint_states"}, "all/joint_states", "left/arm/commands"),
        ({"command": "trajectory", "joints": ()}, "joint_states", "arm/joint_trajectory"),
        ({"controller": "/other/arm", "namespace": "left"}, "left/joint_states", "other/arm/commands"),
    ],
)
def test_topics(fields: dict[str, Any], states: str, commands: str) -> None:
    """Names belong to the namespace unless they begin with a slash."""
    made = section(**fields)
    assert (made.state_topic, made.command_topic) == (states, commands)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"command": "effort"}, "applies the last command for ever"),
        ({"command": "velocity"}, "applies the last command for ever"),
        ({"joints": ()}, "ros2 param get /arm joints"),
        ({"joints": ("a", "a")}, "each joint once"),
        ({"names": {"a": "x", "b": "x"}}, "each joint once"),
        ({"domain": 233}, "0 to 232"),
        ({"controller": "my arm"}, "a name of ROS 2"),
        ({"controller": ""}, "a name of ROS 2"),
        ({"namespace": "/"}, "a name of ROS 2"),
        ({"joint_states": "1st"}, "a name of ROS 2"),
        ({"certificate": "me.pem"}, "certificate and key together"),
    ],
)
def test_what_cannot_be_is_refused(fields: dict[str, Any], told: str) -> None:
    """Each with what to write instead."""
    with pytest.raises(ConfigurationError, match=told):
        section(**fields)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"joints": ["shoulder"]}, "joints shoulder are not those with an actuator, shoulder, elbow"),
        ({"joints": ["shoulder", "wrist"]}, "wrist: no such joint; joints are shoulder, elbow"),
        ({"names": {"wrist": "w"}}, "wrist: no such joint"),
        ({"names": {"elbow": "shoulder"}}, "two joints have the ROS name shoulder"),
        ({"bus": "ethercat"}, "does not match any of the expected tags"),
        ({"id": 3}, "Unexpected"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    """By the robot's joints, and by the kinds of buses."""
    ros2_file(tmp_path)
    path = tmp_path / "robot.yaml"
    values = yaml.safe_load(path.read_text(encoding="utf-8"))
    values["hardware"] |= change
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=told):
        read_robot_file(path)


def test_a_robot_that_cannot_be_driven_so(tmp_path: Path) -> None:
    """Motors, a floating base, and a joint without a range or a velocity limit."""
    file = ros2_file(tmp_path)
    with pytest.raises(ConfigurationError, match="actuation is motor"):
        dataclasses.replace(file, actuation="motor")
    with pytest.raises(ConfigurationError, match="the base floats"):
        dataclasses.replace(file, floating_base="root")
    joints = tuple(dataclasses.replace(joint, velocity_limit=None) for joint in file.joints)
    with pytest.raises(ConfigurationError, match="shoulder needs position_range and velocity_limit"):
        dataclasses.replace(file, joints=joints)
