"""robot.yaml: facts about a robot that its MJCF does not contain, and copies of those that it does.

A joint has the names, units and gains of the MJCF. The file may be stricter than the MJCF, never looser:
:mod:`deal_hw.sim.robots.user_robot` compares both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

import yaml

from deal_hw.description import EFFORT_UNITS
from deal_hw.errors import ConfigurationError
from deal_hw.physical import SENSOR, check_amount
from deal_hw.reading import NAMES, read_yaml, reading
from deal_hw.schema import FINITE, Tagged, from_values, refusal
from deal_hw.sim.robots.hardware_section import (
    HEAD,
    HardwareJoint,
    HardwareSection,
    hardware_problems,
    section_lines,
)
from deal_hw.sim.robots.ros2_section import ROS2_HEAD, Ros2Section, ros2_lines, ros2_problems

FILE_NAME: Final = "robot.yaml"
ADVICE: Final = "`deal-hw robot new robot.xml` writes one"
_LONGEST_NAME: Final = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class ActuatorEntry:
    """The actuator of a joint.

    Attributes:
        stiffness: kp of a position servo [N·m/rad or N/m]; 0 for a motor. Without `hardware`, a joint with 0
            takes efforts, also beside servos.
        damping: kd of a position servo [N·m·s/rad or N·s/m]; 0 for a motor.
        effort_limit: Largest effort [N·m or N]; None for no limit. For a motor, the effort at command 1.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    stiffness: float = 0.0
    damping: float = 0.0
    effort_limit: float | None = None

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            if getattr(self, name) < 0:
                raise refusal(name, getattr(self, name), "0 or more")
        if self.effort_limit is not None and self.effort_limit <= 0:
            raise refusal("effort_limit", self.effort_limit, "a number above 0, or null for no limit")

    def check_amounts(self, unit: str) -> None:
        """Check its numbers for a joint whose position has this unit; errors name the field."""
        effort = EFFORT_UNITS[unit]
        check_amount("field actuator.stiffness", self.stiffness, f"{effort}/{unit}")
        check_amount("field actuator.damping", self.damping, f"{effort}·s/{unit}")
        if self.effort_limit is not None:
            check_amount("field actuator.effort_limit", self.effort_limit, effort)


@dataclass(frozen=True, slots=True, kw_only=True)
class JointEntry:
    """One joint.

    Attributes:
        name: As in the MJCF.
        unit: Of its position: "rad" (hinge) or "m" (slide).
        default_position: Start pose, and the middle of excitations [rad or m].
        position_range: Lowest and highest position target [rad or m]; None for no limit.
        velocity_limit: Speed that trips, and largest change of targets in a second [rad/s or m/s]; None for
            no limit.
        sensor_noise: Standard deviation of a reported position [rad or m].
        sensor_resolution: Step of a reported position [rad or m]; 0 for none.
        may_be_blocked: Whether it may push at its limit without moving, as a gripper does that holds an
            object. Any other joint that does trips a run.
        actuator: None for a joint without an actuator.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    name: str
    unit: Literal["rad", "m"]
    default_position: float = 0.0
    position_range: tuple[float, float] | None = None
    velocity_limit: float | None = None
    sensor_noise: float = 0.0
    sensor_resolution: float = 0.0
    may_be_blocked: bool = False
    actuator: ActuatorEntry | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise refusal("name", self.name, "the name of a joint of the MJCF")
        for name in ("sensor_noise", "sensor_resolution"):
            if not SENSOR[self.unit].holds(getattr(self, name)):
                raise refusal(name, getattr(self, name), str(SENSOR[self.unit]))
        if self.velocity_limit is not None and self.velocity_limit <= 0:
            raise refusal("velocity_limit", self.velocity_limit, "a number above 0, or null for no limit")
        low, high = self.position_range or (-math.inf, math.inf)
        if not low < high:
            raise refusal("position_range", [low, high], "two numbers, the lower one first, or null")
        if not low <= self.default_position <= high:
            raise refusal("default_position", self.default_position, f"{low:g} to {high:g} (position_range)")
        check_amount("field default_position", self.default_position, self.unit)
        for end in self.position_range or ():
            check_amount("field position_range", end, self.unit)
        if self.velocity_limit is not None:
            check_amount("field velocity_limit", self.velocity_limit, f"{self.unit}/s")
        if self.actuator is not None:
            self.actuator.check_amounts(self.unit)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotFile:
    """A robot.yaml.

    Attributes:
        version: Version of this format.
        name: The robot's name; datasets, excitations and results carry it.
        mjcf: Its MuJoCo model, relative to this file.
        actuation: "position": commands are set-points [rad, m]; "motor": commands are efforts.
        floating_base: Name of the free joint that carries the robot; None for a fixed base.
        feet: Sphere geoms of the feet of a robot whose base floats.
        control_rate_hz: Commands per second.
        state_rate_hz: State samples per second; a whole multiple of ``control_rate_hz``.
        joints: The joints, in the order that every array follows.
        physics_step: The MJCF's timestep [s], so that the robot is driven without MuJoCo; None: not noted.
        hardware: The bus and the servos, or the controller of ros2_control, by which it is driven; None: it
            is not.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    version: Literal[1]
    name: str
    mjcf: str
    actuation: Literal["position", "motor"]
    control_rate_hz: float
    state_rate_hz: float
    joints: tuple[JointEntry, ...]
    floating_base: str | None = None
    feet: tuple[str, ...] = ()
    physics_step: float | None = None
    hardware: Annotated[HardwareSection | Ros2Section, Tagged("bus")] | None = None

    def __post_init__(self) -> None:
        if not 0 < len(self.name) <= _LONGEST_NAME or not self.name.isprintable() or "/" in self.name:
            raise refusal("name", self.name, f"1 to {_LONGEST_NAME} printable characters without /")
        if not self.mjcf:
            raise refusal("mjcf", self.mjcf, "the path of the MJCF, relative to this file")
        for name in ("control_rate_hz", "state_rate_hz"):
            if not 1e-3 <= getattr(self, name):
                raise refusal(name, getattr(self, name), "0.001 Hz or more")
            check_amount(f"field {name}", getattr(self, name), "Hz")
        ratio = self.state_rate_hz / self.control_rate_hz
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise refusal(
                "state_rate_hz",
                self.state_rate_hz,
                f"whole multiples of control_rate_hz {self.control_rate_hz:g}",
            )
        names = [joint.name for joint in self.joints]
        if not 0 < len(names) <= NAMES or len(set(names)) != len(names):
            raise refusal("joints", names, "each joint once, at least one")
        if self.physics_step is not None and not 1e-6 <= self.physics_step <= 1:
            raise refusal("physics_step", self.physics_step, "the MJCF's timestep, 1e-6 to 1 s, or null")
        self._check_hardware()

    @property
    def servo_bus(self) -> HardwareSection | None:
        """The bus of its servos; None if it has none."""
        return self.hardware if isinstance(self.hardware, HardwareSection) else None

    @property
    def ros2(self) -> Ros2Section | None:
        """Its controller of ros2_control; None if it has none."""
        return self.hardware if isinstance(self.hardware, Ros2Section) else None

    def _check_hardware(self) -> None:
        if self.hardware is None:
            return
        joints = [
            HardwareJoint(j.name, j.actuator is not None, j.unit, j.position_range, j.velocity_limit)
            for j in self.joints
        ]
        floating = self.floating_base is not None
        problems: Iterator[str]
        if isinstance(self.hardware, Ros2Section):
            problems = ros2_problems(self.hardware, joints, actuation=self.actuation, floating=floating)
        else:
            problems = hardware_problems(self.hardware, joints, actuation=self.actuation, floating=floating)
        if found := list(problems):
            raise ConfigurationError(f"hardware: {'; '.join(found)}")


def read_robot_file(path: Path) -> RobotFile:
    """Read a robot.yaml.

    Raises:
        ConfigurationError: It cannot be read, or a field is wrong; the message names the fields.
    """
    if path.suffix.lower() == ".xml":
        raise ConfigurationError(
            f"{path} is an MJCF, not a robot.yaml: make one with `deal-hw robot new {path}`, and name that"
        )
    with reading(path, "a robot (YAML)", ADVICE, error=ConfigurationError):
        return from_values(RobotFile, _with_off(read_yaml(path)))


def _with_off(values: Any) -> Any:
    """Return a file's values with the word ``off`` of ``hardware.passive``, which YAML 1.1 reads as false."""
    section = values.get("hardware") if isinstance(values, dict) else None
    if not isinstance(section, dict) or section.get("passive") is not False:
        return values
    return {**values, "hardware": {**section, "passive": "off"}}


_HEAD: Final = """\
# A robot for deal-hw, beside its MJCF; `deal-hw robot check` compares both. null: no limit, or none.
# Names, units, gains and effort limits are the MJCF's: change them there, then here.
# Rates, velocity limits and sensors are not in an MJCF: write those of your robot.
"""
_JOINT_HEAD: Final = """\
# In the order that every array follows.
# default_position: start pose, middle of excitations.  position_range: where targets may be.
# velocity_limit: trips above it, and limits the targets' change per second.  sensor_noise: standard
# deviation.
"""


def write_robot_file(robot: RobotFile) -> str:
    """Return the YAML text of a robot, with a comment and the unit at each field."""
    lines = [
        _HEAD,
        _line("version", robot.version, "of this format"),
        _line("name", robot.name, "datasets and results carry it"),
        _line("mjcf", robot.mjcf, "the MuJoCo model, relative to this file"),
        _line(
            "actuation",
            robot.actuation,
            "position: commands are set-points [rad, m]; motor: efforts [N·m, N]",
        ),
        _line(
            "floating_base", robot.floating_base, "the free joint that carries the robot; null: a fixed base"
        ),
        _line("feet", list(robot.feet), "sphere geoms of the feet of a robot whose base floats"),
        _line("control_rate_hz", robot.control_rate_hz, "commands a second [Hz]"),
        _line("state_rate_hz", robot.state_rate_hz, "states a second, a multiple of control_rate_hz [Hz]"),
        _line(
            "physics_step",
            robot.physics_step,
            "the MJCF's timestep [s]; with it no MuJoCo is needed to drive",
        ),
        _JOINT_HEAD,
        "joints:\n",
    ]
    for joint in robot.joints:
        lines += _joint_lines(joint)
    if isinstance(robot.hardware, Ros2Section):
        lines += [ROS2_HEAD, "hardware:\n"]
        lines += [
            _line(name, value, comment, indent) for indent, name, value, comment in ros2_lines(robot.hardware)
        ]
    elif robot.hardware is not None:
        lines += [HEAD, "hardware:\n"]
        for indent, name, value, comment in section_lines(robot.hardware):
            lines.append("  servos:\n" if name == "servos" else _line(name, value, comment, indent))
    return "".join(lines)


def _joint_lines(joint: JointEntry) -> list[str]:
    unit, effort = joint.unit, EFFORT_UNITS[joint.unit]
    fields = [
        ("unit", unit, "rad: hinge; m: slide"),
        ("default_position", joint.default_position, f"[{unit}]"),
        ("position_range", None if joint.position_range is None else list(joint.position_range), f"[{unit}]"),
        ("velocity_limit", joint.velocity_limit, f"[{unit}/s]"),
        ("sensor_noise", joint.sensor_noise, f"[{unit}]"),
        ("sensor_resolution", joint.sensor_resolution, f"[{unit}]"),
    ]
    if joint.may_be_blocked:
        fields.append(("may_be_blocked", True, "such as a gripper that holds an object"))
    lines = [_line("- name", joint.name, "as in the MJCF", indent=2)]
    lines += [_line(name, value, comment, indent=4) for name, value, comment in fields]
    if joint.actuator is None:
        return [*lines, _line("actuator", None, "nothing drives it", indent=4)]
    gains = [
        ("stiffness", joint.actuator.stiffness, f"kp [{effort}/{unit}]"),
        ("damping", joint.actuator.damping, f"kd [{effort}·s/{unit}]"),
        ("effort_limit", joint.actuator.effort_limit, f"[{effort}]"),
    ]
    return [*lines, "    actuator:\n", *(_line(name, value, text, indent=6) for name, value, text in gains)]


def _line(name: str, value: Any, comment: str, indent: int = 0) -> str:
    return f"{' ' * indent}{name}: {_dumped(value)}  # {comment}\n"


def _dumped(value: Any) -> str:
    # The dumper quotes ambiguous text, and writes 1.0e-05, which stays a number.
    def dump(style: str | None) -> str:
        # ASCII only: with allow_unicode PyYAML writes a next-line character as it is and reads it as a space.
        return yaml.safe_dump([value], default_style=style, default_flow_style=True, width=math.inf)

    text = dump(None)
    # Only double quotes keep text with line breaks on one line.
    return (dump('"') if text.count("\n") > 1 else text).strip()[1:-1]
