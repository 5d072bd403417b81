"""`robot new --lerobot`: LeRobot's calibration as the servos' section of a robot.yaml."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from arm_rig import MJCF
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import deal_hw
from deal_hw.cli.main import EXIT_ERROR, EXIT_OK, main
from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.robots import driver_description, recorded_description
from deal_hw.sim.robots.hardware_section import RAD
from deal_hw.sim.robots.robot_file import RobotFile, read_robot_file
from deal_hw.workflows.own_robot.lerobot import read_calibration

SO101_MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
RANGES = ((746, 3411), (850, 3230), (890, 3100), (900, 3170), (0, 4095), (2030, 3500))


def motor(number: int, low: int, high: int, **more: int) -> dict[str, int]:
    """Return a motor as LeRobot writes it."""
    return {"id": number, "drive_mode": 0, "homing_offset": 100, "range_min": low, "range_max": high, **more}


TWO = {"shoulder": motor(1, 1000, 3000), "elbow": motor(2, 1100, 3000)}


def calibration(folder: Path, motors: Any, mjcf: str = MJCF) -> tuple[Path, Path]:
    """Write an MJCF and LeRobot's file; return both."""
    model, file = folder / "arm.xml", folder / "calibration.json"
    model.write_text(mjcf, encoding="utf-8")
    file.write_text(motors if isinstance(motors, str) else json.dumps(motors), encoding="utf-8")
    return model, file


def made(folder: Path, motors: Any, mjcf: str = MJCF, **options: Any) -> RobotFile:
    """Return the robot.yaml of a calibration."""
    model, file = calibration(folder, motors, mjcf)
    return read_robot_file(deal_hw.new_robot(model, lerobot=file, **options))


def test_an_so101(tmp_path: Path) -> None:
    """Each joint has its servo with LeRobot's gains; ranges only become narrower; it can be driven."""
    motors = {
        name: motor(i + 1, *ends) for i, (name, ends) in enumerate(zip(SO101_MOTORS, RANGES, strict=True))
    }
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(motors), encoding="utf-8")
    path = deal_hw.new_robot(
        recorded_description("so101").mjcf, lerobot=file, out=tmp_path / "robot.yaml", name="mine"
    )
    robot = read_robot_file(path)
    section = robot.servo_bus
    assert section is not None and (section.bus, section.baud_rate) == ("feetech", 1_000_000)
    assert [servo.joint for servo in section.servos] == list(SO101_MOTORS)
    assert {(s.model, s.p_gain, s.d_gain, s.i_gain, s.direction) for s in section.servos} == {
        ("sts3215", 16, 32, 0, 1)
    }
    # The middle of 746 and 3411 is 0, as the MJCF's range is symmetric; the gripper's is not.
    assert [servo.zero for servo in section.servos[:5]] == [2078, 2040, 1995, 2035, 2048]
    gripper, jaw = section.servos[5], robot.joints[5]
    assert gripper.zero == round(2765 - (2.1633 - 0.174533) / 2 / RAD)
    for joint, servo, (low, high) in zip(robot.joints, section.servos, RANGES, strict=True):
        assert joint.position_range is not None
        ends = [servo.ticks(angle) for angle in joint.position_range]
        assert low <= ends[0] < ends[1] <= high
        assert (joint.velocity_limit, joint.sensor_resolution) == (5.2, RAD)
    assert robot.joints[4].position_range == (-2.7438473, 2.7438473)
    assert jaw.position_range is not None and jaw.position_range[1] - jaw.position_range[0] < 1470 * RAD
    assert driver_description(str(path)).limits.stiffness[0] == 11
    assert deal_hw.check_robot(path).exit_code == 0


def test_zero_2048_is_the_pose_of_homing(tmp_path: Path) -> None:
    """The range moves with it, and stays inside the MJCF's."""
    middle = made(tmp_path, TWO)
    (tmp_path / "robot.yaml").unlink()
    homed = made(tmp_path, TWO, zero="2048")
    assert middle.servo_bus is not None and homed.servo_bus is not None
    assert [servo.zero for servo in middle.servo_bus.servos] == [2000, 2050]
    assert [servo.zero for servo in homed.servo_bus.servos] == [2048, 2048]
    assert homed.joints[0].position_range == pytest.approx((-1.5, 952 * RAD), abs=1e-4)


def test_an_inverted_motor_counts_the_other_way(tmp_path: Path) -> None:
    """drive_mode 1 is the direction -1."""
    robot = made(tmp_path, TWO | {"elbow": motor(2, 1100, 3000, drive_mode=1)})
    assert robot.servo_bus is not None
    assert [servo.direction for servo in robot.servo_bus.servos] == [1, -1]


def test_other_names_are_mapped(tmp_path: Path) -> None:
    """A motor that is not named keeps its name."""
    motors = {"base": TWO["shoulder"], "elbow": TWO["elbow"]}
    robot = made(tmp_path, motors, joint_names=("base=shoulder",))
    assert robot.servo_bus is not None
    assert [(servo.joint, servo.id) for servo in robot.servo_bus.servos] == [("shoulder", 1), ("elbow", 2)]


REFUSED: list[tuple[Any, dict[str, Any], str]] = [
    ({"shoulder": TWO["shoulder"]}, {}, "joints elbow have no motor.*--joint-names.*another arm"),
    (TWO | {"gripper": motor(3, 10, 20)}, {}, "motors 'gripper' are no joints of the MJCF"),
    (TWO, {"joint_names": ("arm=elbow",)}, "unknown motor of .*'arm'; known: shoulder, elbow"),
    (TWO, {"joint_names": ("elbow",)}, "--joint-names 'elbow': write MOTOR=JOINT"),
    (TWO | {"elbow": motor(1, 1100, 3000)}, {}, "motors 'shoulder', 'elbow' have the id 1.*lerobot-setup"),
    (TWO | {"elbow": motor(300, 1100, 3000)}, {}, "elbow: field id is 300; allowed: 0 to 252"),
    (TWO | {"elbow": motor(2, 1100, 5000)}, {}, "range_max 5000 are no range within one turn.*again"),
    (TWO | {"elbow": motor(2, 3000, 1100)}, {}, "no range within one turn"),
    (TWO | {"elbow": motor(2, 1100, 3000, drive_mode=2)}, {}, "drive_mode is 2; allowed: 0 or 1"),
    (TWO | {"elbow": motor(2, 1100, 3000, homing_offset=-2648)}, {}, "-2648.*--bus dynamixel --port"),
    (TWO | {"elbow": motor(2, 1900, 2100)}, {}, r"elbow: servo 2 travels.*have 10 % in common, and 70 %"),
    (TWO | {"elbow": motor(2, 100, 4000)}, {}, r"elbow.*have 50 % in common.*calibrate it again"),
    (TWO | {"elbow": motor(2, 100, 2000)}, {"zero": "2048"}, r"elbow.*try --zero middle"),
    (TWO, {"zero": "3000"}, "unknown zero '3000'; known: middle, 2048"),
    ("[1, 2]", {}, "cannot be read as LeRobot's calibration.*lerobot-calibrate"),
    ({}, {}, "has 0 motors"),
    (TWO | {"elbow": {"id": 2}}, {}, "elbow.drive_mode is missing"),
    (TWO | {"elbow": motor(2, 1100, 3000) | {"id": "2"}}, {}, "elbow.id is '2'"),
]


@pytest.mark.parametrize(("motors", "options", "words"), REFUSED, ids=[row[2][:36] for row in REFUSED])
def test_a_calibration_of_another_arm_is_refused(
    tmp_path: Path, motors: Any, options: dict[str, Any], words: str
) -> None:
    """With what to do; nothing is written."""
    with pytest.raises(ConfigurationError, match=words):
        made(tmp_path, motors, **options)
    assert not (tmp_path / "robot.yaml").exists()


def test_an_mjcf_without_ranges_is_refused(tmp_path: Path) -> None:
    """The safety filter needs them."""
    mjcf = MJCF.replace('range="-1.5 1.5" ', "").replace(' ctrlrange="-1.5 1.5"', "")
    with pytest.raises(ConfigurationError, match="joint shoulder has no range in the MJCF; give it one"):
        made(tmp_path, TWO, mjcf)


def test_the_command_line_says_what_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The servos' offsets are part of the calibration; an option without its file is explained."""
    model, file = calibration(tmp_path, TWO)
    assert main(["robot", "new", str(model), "--lerobot", str(file), "--zero", "2048"]) == EXIT_OK
    printed = capsys.readouterr().out
    assert "homing offsets" in printed
    assert main(["robot", "new", str(model), "--zero", "2048", "--out", "none.yaml"]) == EXIT_ERROR
    assert "`robot new --lerobot` has it" in capsys.readouterr().err


values = st.integers(-(2**17), 2**17) | st.sampled_from((0, 1, 2047, 2048, 4095, 4096))
motors = st.fixed_dictionaries(
    {name: values for name in ("id", "drive_mode", "homing_offset", "range_min", "range_max")}
)
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
@given(content=st.dictionaries(st.text(max_size=12), motors | anything, max_size=4) | anything)
def test_any_content_is_read_or_refused(tmp_path: Path, content: Any) -> None:
    """What is read is a motor of one turn with an id of its own; nothing else escapes than our errors."""
    file = tmp_path / "any.json"
    file.write_text(json.dumps(content), encoding="utf-8")
    try:
        found = read_calibration(file)
    except DealHwError as error:
        assert str(file) in str(error)
        return
    assert len({one.id for one in found.values()}) == len(found) > 0
    for name, one in found.items():
        assert content[name] == {key: getattr(one, key) for key in content[name]}
        assert 0 <= one.range_min < one.range_max <= 4095 and abs(one.homing_offset) <= 2047
