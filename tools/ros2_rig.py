"""Emulated robots of ros2_control for tests: the two joints of :mod:`arm_rig`, in virtual time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from arm_rig import MJCF, write_driven

from deal_hw.clock import VirtualClock
from deal_hw.drivers.ros2.device import Ros2Device
from deal_hw.drivers.ros2.emulator import ros2_device
from deal_hw.drivers.ros2.messages import (
    HASHES,
    STATE_TYPE,
    JointStates,
    decode_joint_states,
    encode_joint_states,
)
from deal_hw.drivers.ros2.robot import Ros2ControlRobot
from deal_hw.drivers.ros2.topics import topics_of
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.sim.robots.file_description import file_description
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space
from deal_hw.sim.robots.user_robot import derive_robot
from deal_hw.testing.faults import FaultyTransport
from deal_hw.testing.robot_suite import arm, default_command, read_until, run_cycles
from deal_hw.transport import Message, TopicEnd, TopicTransport
from deal_hw.types import FloatArray, RobotState

COMMANDS = ("position", "trajectory")
STATE_RATE_HZ = 100.0


def ros2_file(folder: Path, command: str = "position", **section: Any) -> RobotFile:
    """Write a robot's MJCF and robot.yaml into a folder, and return the latter's content.

    The controller has the joints in another order, and one has another name in ROS.
    """
    mjcf = folder / "arm.xml"
    mjcf.write_text(MJCF, encoding="utf-8")
    own = derive_robot(mjcf, name="two joints", control_rate_hz=50.0).file
    values = {
        "bus": "ros2_control",
        "controller": "forward_position_controller",
        "command": command,
        "joints": ("elbow", "shoulder"),
        "names": {"elbow": "elbow_joint"},
        **section,
    }
    return write_driven(folder, own, Ros2Section(**values), state_rate_hz=STATE_RATE_HZ)


class Ros2Rig:
    """An emulated robot, its driver, and the topics between them.

    Args:
        folder: Where the robot's files are written.
        command: Kind of the controller.
        wrap: Wraps the driver's transport.
        device_section: What differs in the section of the emulated robot.
        section: Fields of the section ``hardware``.
    """

    def __init__(
        self,
        folder: Path,
        command: str = "position",
        wrap: Callable[[TopicTransport], Any] = lambda transport: transport,
        device_section: dict[str, Any] | None = None,
        **section: Any,
    ) -> None:
        self.file = ros2_file(folder, command, **section)
        self.description = file_description(self.file, folder / "arm.xml")
        assert self.file.ros2 is not None
        self.section = self.file.ros2
        self.topics = topics_of(self.section)
        self.clock = VirtualClock()
        space = default_space(self.description)
        values = {**space.known, **{p.name: p.nominal for p in space.parameters}}
        truth = SimulatedTruth(parameters=values, latency_s=0.0, seed=0)
        emulated = dataclasses.replace(self.section, **(device_section or {}))
        self.device: Ros2Device = ros2_device(emulated, self.description, truth, noisy=False)
        self.virtual = VirtualTopics(self.device, self.clock)
        self.know()
        link = cast(TopicTransport, wrap(self.virtual))
        self.robot = Ros2ControlRobot(link, self.clock, self.description, self.section)

    def know(
        self,
        *more: TopicEnd,
        controller: bool = True,
        state_type: str = STATE_TYPE,
        state_hash: str = HASHES[STATE_TYPE],
        commands: tuple[TopicEnd, ...] = (),
    ) -> None:
        """Say what discovery shows: the robot's own ends, those of ``more`` on the states, and commanders."""
        states = TopicEnd(who="the robot", writes=True, type_name=state_type, type_hash=state_hash)
        there = (TopicEnd(who="the robot", writes=False),) if controller else ()
        self.virtual.discovered = {
            self.topics.states: (states, *more),
            self.topics.commands: (*there, *commands),
        }

    def armed(self) -> Ros2ControlRobot:
        """Return the driver, connected, homed and armed, after its first command."""
        arm(self.robot)
        return self.robot

    def run(self, cycles: int, target: float = 0.0) -> list[RobotState]:
        """Command and read as the control loop does; return the states."""
        return run_cycles(self.robot, self.clock, cycles, default_command(self.robot, target))

    def listen(self, deadline_ns: int) -> list[RobotState]:
        """Read until a time [ns]; return the states."""
        return read_until(self.robot, self.clock, deadline_ns)

    def pass_time(self, seconds: float) -> list[RobotState]:
        """Read for a time [s]; return the states."""
        return self.listen(self.clock.now_ns() + round(seconds * 1e9))

    def true_position(self) -> FloatArray:
        """True positions of the joints [rad]."""
        return self.device.true_position


class Topics(FaultyTransport, TopicTransport):
    """Topics with faults on the way; ``change`` also rewrites states."""

    change: Callable[[JointStates], JointStates | None] | None = None

    def declare(self, **topics: Any) -> None:
        """Declare the topics to use."""
        self._topics.declare(**topics)

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return the other writers of a topic."""
        return self._topics.writers(topic)

    def ends(self, topic: str) -> tuple[TopicEnd, ...] | None:
        """Return the other ends of a topic."""
        return self._topics.ends(topic)

    def receive(self, timeout_s: float) -> Message:
        """Receive a message after its faults and its change; a lost one never arrives."""
        while True:
            message = self._inner.receive(timeout_s)
            payload = message.payload if self._received is None else self._received.apply(message.payload)
            if self.change is not None and message.channel.endswith("joint_states"):
                states = self.change(decode_joint_states(payload))
                if states is None:
                    continue
                payload = encode_joint_states(states)
            return Message(message.channel, payload, message.stamp_ns)

    @property
    def _topics(self) -> TopicTransport:
        assert isinstance(self._inner, TopicTransport)
        return self._inner


def changed(folder: Path, change: Callable[[JointStates], JointStates | None], **options: Any) -> Ros2Rig:
    """Return a rig whose joint states are rewritten on their way."""
    made: list[Topics] = []

    def wrap(inner: TopicTransport) -> Topics:
        made.append(Topics(inner))
        made[0].change = change
        return made[0]

    return Ros2Rig(folder, wrap=wrap, **options)


def with_(states: JointStates, **fields: Any) -> JointStates:
    """Return states with other fields."""
    names = ("stamp_ns", "names", "position", "velocity", "effort")
    return JointStates(**{name: getattr(states, name) for name in names} | fields)
