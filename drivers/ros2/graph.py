"""Who else is on the robot's topics: its controller, other programs that command it, types that differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from deal_hw.drivers.ros2.messages import HASHES, STATE_NAMES, STATE_TYPE
from deal_hw.drivers.ros2.topics import RobotTopics, ros_topic
from deal_hw.errors import ProtocolError, VersionMismatchError, WrongDeviceError
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.transport import TopicEnd, TopicTransport

NO_HASH: Final = "TypeHashNotSupported"
"""In place of a hash in rmw_zenoh of ROS 2 Humble."""


class Graph:
    """Judges what the transport's discovery shows. A transport without discovery gives no complaint.

    Args:
        transport: Topics of the robot.
        topics: Its topics.
        section: Its controller.
    """

    def __init__(self, transport: TopicTransport, topics: RobotTopics, section: Ros2Section) -> None:
        self._transport, self._topics, self._section = transport, topics, section

    def mismatch(self) -> ProtocolError | None:
        """Return the error if an end of a topic has another type, or another version of it."""
        expected = {self._topics.states: STATE_TYPE, self._topics.commands: self._topics.command_type}
        for topic, type_name in expected.items():
            for end in self._transport.ends(topic) or ():
                found = _type_error(topic, type_name, end)
                if found is not None:
                    return found
        return None

    def foreign(self) -> tuple[str, ...]:
        """Return the other programs that publish commands; not deal-hw's own processes of this computer."""
        return tuple(end.who for end in self._others() if end.writes)

    @property
    def controlled(self) -> bool | None:
        """Whether a controller subscribes to the commands; None: unknown."""
        if self._transport.ends(self._topics.commands) is None:
            return None
        return any(not end.writes for end in self._others())

    def foreign_complaint(self, who: Sequence[str]) -> str:
        """Return the message about other programs that publish commands."""
        named = f": {'; '.join(who)}" if who else ""
        return (
            f"another program publishes on {ros_topic(self._topics.commands)}{named}. Two programs that "
            "command one robot make it jump between both: end the other one"
        )

    def no_controller(self) -> str:
        """Return the message about commands that nobody reads."""
        name = self.controller
        manager = f" -c /{self._section.topic('controller_manager')}" if self._section.namespace else ""
        return (
            f"nobody subscribes to {ros_topic(self._topics.commands)}: controller {name} is not loaded, or "
            "has another name or namespace. `ros2 control list_controllers"
            f"{manager}` lists them; `ros2 control load_controller {name}{manager} --set-state active` "
            "starts it"
        )

    @property
    def controller(self) -> str:
        """The controller's name, as the controller_manager says it."""
        return self._section.controller.strip("/").rpartition("/")[2]

    def not_active(self, state: int) -> str:
        """Return the message about a controller that the controller_manager reports in another state."""
        name = STATE_NAMES.get(state, f"in state {state}")
        return (
            f"the controller_manager says that {self.controller} is {name}: it takes no commands. Find out "
            "why (emergency stop, a fault of the hardware, another program), then "
            f"`ros2 control switch_controllers --activate {self.controller}`"
        )

    def inactive(self) -> str:
        """Return the remedy if the robot does not follow commands that its controller gets."""
        return (
            f"Is the controller active (`ros2 control switch_controllers --activate {self.controller}`), the "
            "emergency stop released, the drive enabled?"
        )

    def state_publishers(self) -> Iterator[str]:
        """Yield the programs that publish the states."""
        for end in self._transport.ends(self._topics.states) or ():
            if end.writes:
                yield end.who

    def _others(self) -> Iterator[TopicEnd]:
        return (end for end in self._transport.ends(self._topics.commands) or () if not end.ours)


def _type_error(topic: str, type_name: str, end: TopicEnd) -> ProtocolError | None:
    role = "publishes" if end.writes else "subscribes to"
    if end.type_name and end.type_name != type_name:
        return WrongDeviceError(
            f"{end.who} {role} {ros_topic(topic)} as {_ros_type(end.type_name)}, not "
            f"{_ros_type(type_name)}: name another topic or controller in robot.yaml, or end that program"
        )
    known = HASHES[type_name]
    if end.type_hash and end.type_hash not in (known, NO_HASH):
        return VersionMismatchError(
            f"{end.who} {role} {ros_topic(topic)} with another version of {_ros_type(type_name)} (hash "
            f"{end.type_hash}, not {known}): update deal-hw, or install the message package of a release of "
            "ROS 2 there"
        )
    return None


def _ros_type(dds_name: str) -> str:
    """Return ``sensor_msgs::msg::dds_::JointState_`` as ROS 2 writes it."""
    return dds_name.replace("::dds_::", "/").replace("::", "/").rstrip("_")
