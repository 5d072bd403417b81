"""The section `hardware` of a robot.yaml: it is read as written; what cannot be driven is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from arm_rig import BUSES, arm_file
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.errors import ConfigurationError
from deal_hw.robots import driver_description, robot_entry
from deal_hw.sim.robots.hardware_section import TICKS, ServoEntry
from deal_hw.sim.robots.robot_file import read_robot_file, write_robot_file
from deal_hw.sim.robots.user_robot import read_robot


@pytest.mark.parametrize("bus", BUSES)
def test_what_is_written_is_read_again(tmp_path: Path, bus: str) -> None:
    """With its comments; and the same robot comes out."""
    file = arm_file(tmp_path, bus)
    assert read_robot_file(tmp_path / "robot.yaml") == file
    assert write_robot_file(read_robot_file(tmp_path / "robot.yaml")) == write_robot_file(file)


@given(
    zero=st.integers(0, TICKS - 1),
    direction=st.sampled_from((1, -1)),
    ticks=st.integers(-2 * TICKS, 2 * TICKS),
)
def test_ticks_of_an_angle(zero: int, direction: Any, ticks: int) -> None:
    """A whole number of ticks from zero comes out as such, on the side that the direction says."""
    servo = ServoEntry(joint="j", id=1, zero=zero, direction=direction, p_gain=1)
    assert servo.ticks(direction * ticks * 2 * 3.141592653589793 / TICKS) == zero + ticks


def test_the_description_without_mujoco_is_that_with_it(tmp_path: Path) -> None:
    """But for what only a driven robot has: easing in, slower targets, and limits of the gains."""
    file = arm_file(tmp_path, "feetech")
    driven = driver_description(str(tmp_path / "robot.yaml"))
    (tmp_path / "robot.yaml").write_text(
        write_robot_file(dataclasses.replace(file, hardware=None)), encoding="utf-8"
    )
    derived = read_robot(tmp_path / "robot.yaml").description()
    same = {"stiffness", "damping", "ease_in_s", "target_step"}
    for name in derived.to_json().keys() | driven.to_json().keys():
        one, two = getattr(driven, name), getattr(derived, name)
        if name == "limits":
            one, two = (
                {k: v for k, v in dataclasses.asdict(limits).items() if k not in same}
                for limits in (one, two)
            )
        if name != "sources":
            assert one == two, name
    assert driven.limits.stiffness == (17.8, 17.8) and driven.limits.ease_in_s == 1.0
    # 0.7 of 6 rad/s, in a fiftieth of a second.
    assert driven.limits.target_step == pytest.approx((0.084, 0.084))


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"bus": "canbus"}, "bus"),
    ({"baud_rate": 38400}, "baud_rate is 38400; allowed: 128000, 250000, 500000, 1000000"),
    ({"passive": "limp"}, "passive"),
    ({"answer_ms": 500}, "answer_ms is 500.0; allowed: 0 to 100 ms"),
    ({"servos": []}, "servos: id"),
    ({"servos.0.id": 2}, "each id once"),
    ({"servos.0.id": 254}, "id is 254; allowed: 0 to 252"),
    ({"servos.0.zero": 4096}, "zero is 4096; allowed: 0 to 4095 ticks"),
    ({"servos.0.direction": 2}, "direction"),
    ({"servos.0.p_gain": 0}, "p_gain of shoulder is 0; allowed: 1 to 254"),
    ({"servos.0.i_gain": 300}, "i_gain of shoulder is 300; allowed: 0 to 254"),
    ({"servos.0.joint": "wrist"}, "servos of wrist: no such joint; joints are shoulder, elbow"),
    ({"servos.1.zero": 200}, r"elbow: its position_range is -778 to 1178 ticks.*homing offset"),
    ({"servos.0.rest": 0.5}, "rest is missing for elbow; allowed: one for each servo, or none"),
    ({"servos.0.rest": 0.5, "servos.1.rest": 1.6}, r"joint elbow: rest 1\.6 is outside its position_range"),
    ({"nosuch": 1}, "nosuch"),
]


@pytest.mark.parametrize(("change", "words"), REFUSED, ids=[words[:30] for _, words in REFUSED])
def test_what_cannot_be_driven_is_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    """Each with what is allowed or what to do."""
    arm_file(tmp_path, "feetech")
    path = tmp_path / "robot.yaml"
    values = yaml.safe_load(path.read_text(encoding="utf-8"))
    for place, value in change.items():
        *parts, last = place.split(".")
        at: Any = values["hardware"]
        for part in parts:
            at = at[int(part) if part.isdigit() else part]
        at[last] = value
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=words):
        read_robot_file(path)


@pytest.mark.parametrize(
    ("joint", "words"),
    [
        ({"velocity_limit": None}, "needs position_range and velocity_limit"),
        ({"position_range": None}, "needs position_range and velocity_limit"),
        ({"unit": "m"}, "is a slide; a servo turns a hinge"),
        ({"actuator": None}, "has a servo but no actuator"),
    ],
)
def test_joints_that_no_servo_can_drive(tmp_path: Path, joint: dict[str, Any], words: str) -> None:
    """The safety filter needs limits; a servo needs a hinge with an actuator."""
    arm_file(tmp_path, "dynamixel")
    path = tmp_path / "robot.yaml"
    values = yaml.safe_load(path.read_text(encoding="utf-8"))
    values["joints"][0] |= joint
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=words):
        read_robot_file(path)


def test_brakes_are_feetechs(tmp_path: Path) -> None:
    """A Dynamixel servo without a goal is free."""
    with pytest.raises(ConfigurationError, match="passive is 'damping'; allowed: off; only Feetech"):
        arm_file(tmp_path, "dynamixel", passive="damping")


def test_off_needs_no_quotes(tmp_path: Path) -> None:
    """YAML reads the bare word, as a user writes it by the page, as false."""
    file = arm_file(tmp_path, "dynamixel")
    path = tmp_path / "robot.yaml"
    text = path.read_text(encoding="utf-8")
    assert text.count("passive: 'off'") == 1
    path.write_text(text.replace("passive: 'off'", "passive: off"), encoding="utf-8")
    assert read_robot_file(path) == file
    path.write_text(text.replace("passive: 'off'", "passive: on"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="passive is True"):
        read_robot_file(path)


def test_a_timestep_that_is_not_the_mjcfs_is_a_contradiction(tmp_path: Path) -> None:
    """The driver would describe another physics than the calibration."""
    file = dataclasses.replace(arm_file(tmp_path, "feetech"), physics_step=0.001)
    (tmp_path / "robot.yaml").write_text(write_robot_file(file), encoding="utf-8")
    with pytest.raises(
        ConfigurationError, match=r"physics_step is 0\.001, the MJCF's timestep 0\.002; write 0\.002"
    ):
        read_robot(tmp_path / "robot.yaml")
    none = dataclasses.replace(file, physics_step=None)
    (tmp_path / "robot.yaml").write_text(write_robot_file(none), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"physics_step is missing; write 0\.002"):
        read_robot(tmp_path / "robot.yaml")
    with pytest.raises(ConfigurationError, match="write the timestep of its MJCF at `physics_step`"):
        driver_description(str(tmp_path / "robot.yaml"))


def test_an_entry_is_made_of_the_file(tmp_path: Path) -> None:
    """With a driver and an emulator on its wire; without the section the message says what to write."""
    file = arm_file(tmp_path, "feetech")
    path = tmp_path / "robot.yaml"
    entry = robot_entry(str(path))
    assert (entry.driven, entry.emulated_on) == (True, ("serial",))
    path.write_text(write_robot_file(dataclasses.replace(file, hardware=None)), encoding="utf-8")
    assert not robot_entry(str(path)).driven
    with pytest.raises(ConfigurationError, match="write the section `hardware` into"):
        driver_description(str(path))
