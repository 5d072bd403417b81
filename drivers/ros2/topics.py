"""The topics of a robot of ros2_control, as on the wire, and their types for DDS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from deal_hw.drivers.ros2.messages import ACTIVITY_TYPE, COMMAND_TYPES, HASHES, STATE_TYPE
from deal_hw.drivers.transports.topics import TypedTopics
from deal_hw.sim.robots.ros2_section import Ros2Section

PREFIX: Final = "rt/"
"""Before the names of topics of ROS 2 in DDS (rmw_cyclonedds: namespace_prefix.hpp)."""
_TIME: Final = "builtin_interfaces::msg::dds_::Time_"
_DURATION: Final = "builtin_interfaces::msg::dds_::Duration_"
_HEADER: Final = "std_msgs::msg::dds_::Header_"
_DIMENSION: Final = "std_msgs::msg::dds_::MultiArrayDimension_"
_LAYOUT: Final = "std_msgs::msg::dds_::MultiArrayLayout_"
_POINT: Final = "trajectory_msgs::msg::dds_::JointTrajectoryPoint_"
_LIFECYCLE: Final = "lifecycle_msgs::msg::dds_::State_"
_NAMED: Final = "controller_manager_msgs::msg::dds_::NamedLifecycleState_"
_FLOATS: Final = "sequence<float64>"
STRUCTS: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType(
    {
        _TIME: {"sec": "int32", "nanosec": "uint32"},
        _DURATION: {"sec": "int32", "nanosec": "uint32"},
        _HEADER: {"stamp": _TIME, "frame_id": "string"},
        STATE_TYPE: {
            "header": _HEADER,
            "name": "sequence<string>",
            **dict.fromkeys(("position", "velocity", "effort"), _FLOATS),
        },
        _DIMENSION: {"label": "string", "size": "uint32", "stride": "uint32"},
        _LAYOUT: {"dim": f"sequence<{_DIMENSION}>", "data_offset": "uint32"},
        COMMAND_TYPES["position"]: {"layout": _LAYOUT, "data": _FLOATS},
        _POINT: {
            **dict.fromkeys(("positions", "velocities", "accelerations", "effort"), _FLOATS),
            "time_from_start": _DURATION,
        },
        COMMAND_TYPES["trajectory"]: {
            "header": _HEADER,
            "joint_names": "sequence<string>",
            "points": f"sequence<{_POINT}>",
        },
        _LIFECYCLE: {"id": "octet", "label": "string"},
        _NAMED: {"name": "string", "state": _LIFECYCLE},
        ACTIVITY_TYPE: {
            "header": _HEADER,
            "controllers": f"sequence<{_NAMED}>",
            "hardware_components": f"sequence<{_NAMED}>",
        },
    }
)
"""Struct -> field -> type, named as in IDL; a struct comes after those that it contains."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotTopics:
    """The topics of a robot, as on the wire of DDS.

    Attributes:
        states: Of its joint states.
        commands: Of its controller's commands.
        command_type: DDS name of the commands' type.
        activity: Of the controller_manager's word on its controllers, since ROS 2 Jazzy.
    """

    states: str
    commands: str
    command_type: str
    activity: str

    @property
    def typed(self) -> TypedTopics:
        """The same for a transport."""
        types = {
            self.states: STATE_TYPE,
            self.commands: self.command_type,
            self.activity: ACTIVITY_TYPE,
        }
        return TypedTopics(types=types, structs=STRUCTS, hashes=HASHES)


def topics_of(section: Ros2Section) -> RobotTopics:
    """Return the topics that a robot.yaml names."""
    return RobotTopics(
        states=PREFIX + section.state_topic,
        commands=PREFIX + section.command_topic,
        command_type=COMMAND_TYPES[section.command],
        activity=PREFIX + section.topic("controller_manager/activity"),
    )


def ros_topic(topic: str) -> str:
    """Return a topic's name as ROS 2 shows it."""
    return "/" + topic.removeprefix(PREFIX)
