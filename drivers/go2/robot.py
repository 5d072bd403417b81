"""The Go2 over topics: DDS or Zenoh carries the same bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.go2.descriptions import on_stand
from deal_hw.drivers.go2.descriptions.driver import DRIVER, SUPPLY
from deal_hw.drivers.go2.descriptions.leg_geometry import SUPPORT
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.refusals import Refusals, StateCheck
from deal_hw.drivers.go2.state_stream import StateStream
from deal_hw.drivers.go2.wording import WORDING
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.go_messages.body import body_state
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.go_messages.robot_kind import quadruped_complaint
from deal_hw.drivers.unitree.motor_command import MODE_SERVO
from deal_hw.drivers.unitree.remote import Remote
from deal_hw.drivers.unitree.robot import SUBSCRIBED, UnitreeRobot
from deal_hw.drivers.unitree.rpc import HEARD_TEXTS, STATUS_TEXTS, read_note
from deal_hw.drivers.unitree.supply import Supply
from deal_hw.drivers.unitree.support import Support, SupportConfig, SupportGuard
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import SafetyError, WrongDeviceError
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import BodyState, FloatArray

STOP_BUTTONS: Final = "L2+B"
BRIDGE_DELAY_NS: Final = 100_000_000
"""A bridge's status within this time after the arming may be from before it [ns]."""


@dataclass(frozen=True, slots=True)
class Go2Info:
    """What the robot reports about itself.

    Attributes:
        battery: State of charge, 0 to 1.
        voltage: Of the supply [V].
        serial: Serial number, two words.
        version: Version of its firmware, two words.
    """

    battery: float
    voltage: float
    serial: tuple[int, int]
    version: tuple[int, int]


class Go2Robot(UnitreeRobot[LowStateFrame]):
    """A Unitree Go2 at its motors' own level.

    Before it is released it lies down, and it must be on the floor, or on a stand, as in the description. A
    bridge between robot and network reports who controls the robot, and is listened to.

    Attributes:
        refusals: Counts refused states.
        supply: Its supply, which tells it from another robot with the same messages.
        servo_mode: Mode of a motor that follows commands.
        support: The limits between floor and stand.
        other_support: The robot of deal-hw with the other support.

    Args:
        transport: Topics of the robot, or of a bridge to it.
        clock: The clock of the transport's stamps.
        stop_buttons: Buttons of the remote that stop a run while held together; "" for none.
        state_check: What a state must pass: "strict", or "length" for firmware or a simulator that makes head
            or checksum by another rule. Corrupted states are then not detected.
        support_check: Whether ``home`` checks that the robot is on the floor, or on a stand, as in the
            description.
    """

    description: ClassVar[RobotDescription] = DRIVER
    stopped_by: ClassVar[str] = (
        "a bridge on the robot's side (deal-hw bridge), its own remote (damping) or its power switch"
    )
    wording: ClassVar[Wording] = WORDING
    refusals: ClassVar[type[Refusals]] = Refusals
    supply: ClassVar[Supply] = SUPPLY
    servo_mode: ClassVar[int] = MODE_SERVO
    support: ClassVar[SupportConfig] = SUPPORT
    other_support: ClassVar[str] = "go2_on_stand"
    subscribed: ClassVar[tuple[str, ...]] = (*SUBSCRIBED, topics.BRIDGE)
    info: Go2Info | None

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        *,
        stop_buttons: str = STOP_BUTTONS,
        state_check: StateCheck = "strict",
        support_check: bool = True,
    ) -> None:
        self._encoder = LowCommandEncoder(self.servo_mode)
        self._modes = np.full(len(self.description.actuated), self.servo_mode)
        super().__init__(transport, clock, stop_buttons, self._make_stream(state_check))
        self._support = SupportGuard(
            self.description.name,
            Support.HELD if self.description.floating_base is None else Support.FLOOR,
            self.other_support,
            clock,
            self._pump,
            self.support if support_check else None,
        )

    def _make_stream(self, check: StateCheck) -> StateStream:
        return StateStream(check, self.refusals)

    def _await_robot(self) -> None:
        super()._await_robot()
        if self._frame is None:
            return
        wrong = quadruped_complaint(self._frame.payload, self.supply.kind)
        if wrong := wrong or self.supply.complaint(self._frame.voltage):
            raise WrongDeviceError(f"{self.wording.name}: {wrong}. Nothing was sent")

    def _forget(self) -> None:
        super()._forget()
        self._bridged = False
        # Streams that the bridge has received, and when it reported so [ns].
        self._bridge_heard, self._bridge_heard_ns = "", 0

    def _encode(
        self,
        position: FloatArray,
        velocity: FloatArray,
        stiffness: FloatArray,
        damping: FloatArray,
        effort: FloatArray,
    ) -> bytes:
        return self._encoder.encode(LowCommand(position, velocity, stiffness, damping, effort, self._modes))

    def _read_info(self) -> Go2Info | None:
        if self._frame is None:
            return None
        values = self._frame.values()
        return Go2Info(values.battery_percent / 100, values.voltage, values.serial, values.version)

    def _body(self, frame: LowStateFrame, remote: Remote | None) -> BodyState:
        return body_state(frame, remote)

    def _before_release(self) -> None:
        self._support.before_release()

    def _after_release(self) -> None:
        self._support.require()

    def _notice_frame(self, frame: LowStateFrame) -> None:
        self._support.take(frame)

    def _take_other(self, message: Message) -> bool:
        if message.channel == topics.BRIDGE:
            self._take_bridge(message)
            return True
        # A command of another client has an attachment, and the bridge checks it. Commands from the robot's
        # side have none.
        return message.channel == topics.LOW_COMMAND and self._bridged and bool(message.attachment)

    def _take_bridge(self, message: Message) -> None:
        """Read a bridge's status on who controls the robot.

        Raises:
            SafetyError: Another controller has it, and this one has just begun to take it over.
        """
        status = read_note(message.payload, STATUS_TEXTS)
        if status is None:
            return
        self._bridged = True
        if (received := read_note(message.payload, HEARD_TEXTS)) is not None:
            self._bridge_heard, self._bridge_heard_ns = received["heard"], message.stamp_ns
        controlled = status["control"] == "controlled"
        ours = bool(self._sender.in_force or self._armed_ns)
        if controlled and self._in_charge and not ours:
            raise SafetyError(
                f"{self.wording.name}: another controller commands the robot through the bridge; end the "
                "other run first (Ctrl-C in its terminal)"
            )
        later = message.stamp_ns - self._armed_ns > BRIDGE_DELAY_NS
        if self._armed and later and not controlled and not self._fault:
            self._fault = f"{self.wording.name}: the bridge took the robot from this run: {status['reason']}"

    def _why_unreached(self, since_ns: int) -> str:
        """Return why requests since a time [ns] do not pass the bridge; "" if nothing is known.

        Zenoh drops a reader's messages and tells neither side. The bridge says whom it hears.
        """
        stream = self._transport.stream
        if stream is None or self._bridge_heard_ns <= since_ns or f"{stream:016x}" in self._bridge_heard:
            return ""
        return (
            "states arrive through the bridge, but it hears none of this run's messages: the certificate "
            "may only read (an observer's). Give a controller's by --certificate and --key, and its name to "
            "the bridge by --controllers (`deal-hw keys show DIR` lists names)"
        )


class Go2OnStandRobot(Go2Robot):
    """A Go2 with its base on a stand."""

    description: ClassVar[RobotDescription] = on_stand.DESCRIPTION
    other_support: ClassVar[str] = "go2"
