"""The section ``hardware`` of a robot that ros2_control drives: topics of ROS 2, and the controller."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Literal

from deal_hw.errors import ConfigurationError
from deal_hw.schema import FINITE, refusal
from deal_hw.sim.robots.hardware_section import HardwareJoint

MOST_DOMAIN: Final = 232
"""Largest number of a DDS domain: the ports of the next one are beyond 65535."""
_NAME: Final = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
"""A topic or namespace of ROS 2; a name begins with no digit."""
_NO_DEADMAN: Final = (
    "a forward_command_controller applies the last command for ever, so after a crash of this program an "
    "effort or a velocity would act on and on. Let the controller claim the position interface, or use a "
    "joint_trajectory_controller (command: trajectory)"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2Section:
    """The section ``hardware`` with ``bus: ros2_control``.

    Attributes:
        bus: "ros2_control".
        controller: Name of the controller that takes the commands.
        command: "position" (``std_msgs/Float64MultiArray``, as of a forward_command_controller or
            position_controllers) or "trajectory" (``trajectory_msgs/JointTrajectory`` of one point, as of a
            joint_trajectory_controller).
        joints: Joints in the order of the controller's parameter ``joints``, by their names here; a
            Float64MultiArray carries no names. Empty only for "trajectory", whose messages have names.
        names: ROS names of joints that have another name here.
        domain: ROS_DOMAIN_ID.
        namespace: Namespace of the controller_manager and its topics; "" for none.
        joint_states: Topic of the states, in the namespace unless it begins with a slash.
        insecure: Zenoh: allow plain TCP to another machine.
        ca: Zenoh over TLS: authority that signed the router's certificate (PEM).
        certificate: Zenoh over TLS: this side's certificate (PEM).
        key: Zenoh over TLS: its private key (PEM).
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    bus: Literal["ros2_control"]
    controller: str
    command: Literal["position", "trajectory", "velocity", "effort"] = "position"
    joints: tuple[str, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    domain: int = 0
    namespace: str = ""
    joint_states: str = "joint_states"
    insecure: bool = False
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None

    def __post_init__(self) -> None:
        if self.command in ("velocity", "effort"):
            raise ConfigurationError(f"field command is {self.command!r}; {_NO_DEADMAN}")
        if not 0 <= self.domain <= MOST_DOMAIN:
            raise refusal("domain", self.domain, f"0 to {MOST_DOMAIN} (ROS_DOMAIN_ID)")
        for name in ("controller", "joint_states", "namespace"):
            value = getattr(self, name)
            if not _NAME.fullmatch(value) and not (name == "namespace" and value == ""):
                raise refusal(name, value, "a name of ROS 2, such as arm_controller or /arm/joint_states")
        for name, given in (("joints", self.joints), ("names", tuple(self.names.values()))):
            if len(set(given)) != len(given) or "" in given:
                raise refusal(name, list(given), "each joint once, none empty")
        if self.command == "position" and not self.joints:
            raise ConfigurationError(
                "field joints is missing: a Float64MultiArray carries no names, so write the joints in the "
                f"order that the controller has them (`ros2 param get /{self.controller.strip('/')} joints`)"
            )
        if (self.certificate is None) != (self.key is None):
            raise refusal("certificate", self.certificate, "certificate and key together, or neither")

    def topic(self, name: str) -> str:
        """Return the full name of a topic of ROS 2, without its leading slash."""
        if name.startswith("/") or not self.namespace:
            return name.strip("/")
        return f"{self.namespace.strip('/')}/{name}"

    @property
    def command_topic(self) -> str:
        """The controller's topic, without its leading slash."""
        name = {"position": "commands", "trajectory": "joint_trajectory"}[self.command]
        return f"{self.topic(self.controller)}/{name}"

    @property
    def state_topic(self) -> str:
        """The topic of the states, without its leading slash."""
        return self.topic(self.joint_states)

    def ros_name(self, joint: str) -> str:
        """Return the name of a joint in ROS."""
        return self.names.get(joint, joint)


def ros2_problems(
    section: Ros2Section, joints: Sequence[HardwareJoint], *, actuation: str, floating: bool
) -> Iterator[str]:
    """Yield what keeps a robot from being driven by a section, each with what to write instead."""
    if actuation != "position":
        yield "actuation is motor; the controller takes positions: use position actuators in the MJCF"
    if floating:
        yield "the base floats; joint_states says nothing of it: only a robot with a fixed base can be driven"
    names = [joint.name for joint in joints]
    driven = [joint.name for joint in joints if joint.driven]
    if unknown := [name for name in (*section.joints, *section.names) if name not in names]:
        yield f"{', '.join(dict.fromkeys(unknown))}: no such joint; joints are {', '.join(names)}"
        return
    if section.joints and sorted(section.joints) != sorted(driven):
        yield (
            f"joints {', '.join(section.joints)} are not those with an actuator, {', '.join(driven)}; the "
            "controller must command all of them and no other"
        )
    ros = [section.ros_name(name) for name in names]
    if doubled := sorted({name for name in ros if ros.count(name) > 1}):
        yield f"two joints have the ROS name {', '.join(doubled)}; give each its own in `names`"
    for joint in joints:
        if joint.driven and (joint.position_range is None or joint.velocity_limit is None):
            yield (
                f"joint {joint.name} needs position_range and velocity_limit: the safety filter keeps to them"
            )


ROS2_HEAD: Final = """\
# The topics and the controller of ros2_control. joints: in the order of the controller's parameter `joints`,
# by their names here.
"""


def ros2_lines(section: Ros2Section) -> Iterator[tuple[int, str, Any, str]]:
    """Yield the section's lines for a robot.yaml: indent, name, value, comment."""
    yield 2, "bus", section.bus, "topics of ROS 2, over DDS or rmw_zenoh"
    yield 2, "controller", section.controller, "the controller that takes the commands"
    yield 2, "command", section.command, "position: Float64MultiArray; trajectory: JointTrajectory"
    yield 2, "joints", list(section.joints), "in the controller's order"
    yield 2, "names", dict(section.names), "joint here: joint in ROS, where they differ"
    yield 2, "domain", section.domain, "ROS_DOMAIN_ID"
    yield 2, "namespace", section.namespace, 'of the controller_manager; "": none'
    yield 2, "joint_states", section.joint_states, "topic of the states"
    yield 2, "insecure", section.insecure, "Zenoh: plain TCP to another machine"
    for name in ("ca", "certificate", "key"):
        if getattr(section, name) is not None:
            yield 2, name, getattr(section, name), "Zenoh over TLS (PEM)"
