"""Selects the joint states that are new and complete, in the order of the robot's joints."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.drivers.command_echo import ClockOffset
from deal_hw.drivers.ros2.messages import JointStates, decode_joint_states
from deal_hw.errors import FrameError, TransportLostError, WrongDeviceError, short
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.transport import Message
from deal_hw.types import FloatArray

RESTART_NS: Final = 1_000_000_000
"""If the stamps go back further than this, the robot's clock was set or restarted [ns]."""
JUMP_NS: Final = 500_000_000
"""If a stamp is this much further ahead than the time that passed here, the robot's clock jumped [ns]."""
_ONE_ROBOT: Final = 0.4
"""If a larger share of states is not new, two programs publish them."""


@dataclass(frozen=True, slots=True, eq=False)
class JointSample:
    """Joint states in the order of the robot's joints, (J,) each."""

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


class JointStateStream:
    """Checks joint states by their names and stamps, and keeps the robot's time.

    Messages of other joints on the same topic, such as a gripper's, are left out. A velocity that is empty or
    NaN is the difference of positions over one control period; an effort is then 0.

    Attributes:
        errors: Corrupt, incomplete, missing and stale states so far.
        accepted: New and complete states so far.
        stale: States so far whose stamp was not newer than the one before.
        sequence: Number of the newest state, counted in the robot's state periods.
        device_ns: Its stamp [ns].
        trouble: What is wrong with the states, for the operator; "" for nothing.
        differs: Quantities that the robot does not report.

    Args:
        description: The robot.
        section: The joints' names in ROS, and the topic.
    """

    def __init__(self, description: RobotDescription, section: Ros2Section) -> None:
        self._joints = description.joint_names
        self._names = tuple(section.ros_name(joint) for joint in self._joints)
        self._topic = "/" + section.state_topic
        self._rate_hz = description.state_rate_hz
        self._window_ns = round(1e9 / description.control_rate_hz)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.errors = self.accepted = self.stale = self.device_ns = 0
        self.sequence = -1
        self.trouble = ""
        self.differs: set[str] = set()
        self._offset = ClockOffset()
        self._receive_ns = 0
        self._order: dict[tuple[str, ...], tuple[int, ...]] = {}
        self._past: deque[tuple[int, FloatArray]] = deque()
        self._others: set[str] = set()
        self._refused = ""
        self._missing: tuple[str, ...] = ()

    def take(self, message: Message) -> JointSample | None:
        """Return the state in a message; None where it is corrupt, of other joints, incomplete or not new.

        Raises:
            TransportLostError: The robot's clock went back.
        """
        try:
            states = decode_joint_states(message.payload)
        except FrameError as error:
            self.errors += 1
            self._refused = self._refused or str(error)
            return None
        order = self._order_of(states.names)
        if not order:
            return None
        position = states.position[list(order)]
        if not np.isfinite(position).all():
            self.errors += 1
            joint = self._joints[int(np.flatnonzero(~np.isfinite(position))[0])]
            self.trouble = (
                f"{self._topic}: the position of joint {joint} is {position[self._joints.index(joint)]}: its "
                "hardware interface does not report it; look at the controller_manager's output"
            )
            return None
        if not self._is_new(states.stamp_ns, message.stamp_ns):
            return None
        self.accepted += 1
        self._offset.take(message.stamp_ns, self.device_ns)
        return JointSample(position, self._velocity(states, order, position), self._effort(states, order))

    @property
    def offset_ns(self) -> int:
        """This computer's clock minus the robot's, by the fastest recent message [ns]."""
        return self._offset.offset_ns

    @property
    def doubled(self) -> bool:
        """Whether so many states are not new that two programs must be publishing them."""
        return self.stale > _ONE_ROBOT * self.accepted

    def complaint(self) -> WrongDeviceError | None:
        """Return the error if messages arrive and none is a state of this robot; None otherwise."""
        if self.accepted:
            return None
        wrong = f"it is no state of this robot on {self._topic}"
        if self._missing:
            return WrongDeviceError(
                f"{self._topic} has no joint {', '.join(self._missing)}; write the names of ROS at `names` "
                "in robot.yaml, or let the joint_state_broadcaster publish all joints"
            )
        if self.trouble:
            return WrongDeviceError(self.trouble)
        if self._others:
            there = short(", ".join(sorted(self._others)), 200)
            return WrongDeviceError(
                f"{wrong}: its joints are {there}, not {', '.join(self._names)}. Is it another robot, "
                "namespace or domain? Names that differ belong at `names` in robot.yaml"
            )
        return WrongDeviceError(f"{wrong}: {self._refused}") if self._refused else None

    def _order_of(self, names: tuple[str, ...]) -> tuple[int, ...]:
        """Return the index of each joint in a message; () if it has not all of them."""
        known = self._order.get(names)
        if known is None:
            place = {name: i for i, name in enumerate(names)}
            missing = tuple(name for name in self._names if name not in place)
            if not missing:
                known = tuple(place[name] for name in self._names)
                # Corrupt names must not fill the memory.
                self._order = {names: known}
            elif len(missing) < len(self._names):
                self.errors += 1
                self._missing = missing
                self.trouble = self.trouble or (
                    f"{self._topic}: a message has no joint {', '.join(missing)}, but others of this robot"
                )
            else:
                self._others.update(names[: 64 - len(self._others)])
        return known or ()

    def _is_new(self, stamp_ns: int, receive_ns: int) -> bool:
        """Return whether a stamp is newer than the last; note the robot's time."""
        first = self.accepted == 0
        step_ns = 0 if first else stamp_ns - self.device_ns
        if not first and step_ns <= 0:
            self.errors += 1
            self.stale += 1
            if step_ns < -RESTART_NS:
                raise TransportLostError(
                    f"{self._topic}: the stamps went back by {-step_ns * 1e-9:.1f} s: the robot's clock was "
                    "set, its controller_manager or simulator restarted, or a second one publishes; start "
                    "the run again"
                )
            return False
        passed_ns = receive_ns - self._receive_ns
        if not first and step_ns - passed_ns > JUMP_NS:
            self.trouble = (
                f"{self._topic}: the stamps jumped by {step_ns * 1e-9:.2f} s while {passed_ns * 1e-9:.2f} s "
                "passed here: the robot's clock was set (NTP, chrony makestep); let it adjust slowly"
            )
        periods = 1 if first else max(round(step_ns * 1e-9 * self._rate_hz), 1)
        self.errors += periods - 1
        self.sequence += periods
        self.device_ns, self._receive_ns = stamp_ns, receive_ns
        return True

    def _velocity(self, states: JointStates, order: tuple[int, ...], position: FloatArray) -> FloatArray:
        self._past.append((self.device_ns, position))
        while len(self._past) > 2 and self.device_ns - self._past[1][0] >= self._window_ns:
            self._past.popleft()
        if len(states.velocity):
            velocity = states.velocity[list(order)]
            if np.isfinite(velocity).all():
                return velocity
        self.differs.add("velocity")
        then_ns, then = self._past[0]
        return (position - then) / max((self.device_ns - then_ns) * 1e-9, 1e-9)

    def _effort(self, states: JointStates, order: tuple[int, ...]) -> FloatArray:
        effort = states.effort[list(order)] if len(states.effort) else np.full(len(order), np.nan)
        if not np.isfinite(effort).all():
            self.differs.add("effort")
            effort = np.zeros(len(order))
        return effort
