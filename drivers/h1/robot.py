"""The H1 over topics, hung on a crane: DDS or Zenoh carries the same bytes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.go2.messages.refusals import StateCheck, is_strict
from deal_hw.drivers.h1.description import DESCRIPTION
from deal_hw.drivers.h1.joints import MODES, ORDER, SERVO_MODE
from deal_hw.drivers.h1.messages import H1Refusals, H1StateDecoder, pelvis_of
from deal_hw.drivers.unitree.claim import WireClaim
from deal_hw.drivers.unitree.crane import STOP_BUTTONS, HungRobot, hung, on_crane, wording
from deal_hw.drivers.unitree.go_messages.body import body_state
from deal_hw.drivers.unitree.go_messages.low_command import GoCommand, GoCommandEncoder
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.go_messages.robot_kind import humanoid_complaint
from deal_hw.drivers.unitree.remote import Remote
from deal_hw.drivers.unitree.tick_stream import TickStream
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import WrongDeviceError
from deal_hw.transport import TopicTransport
from deal_hw.types import BodyState, FloatArray

WORDING: Final = wording("h1")


@dataclass(frozen=True, slots=True)
class H1Info:
    """What the robot reports about itself.

    Attributes:
        serial: Serial number, two words.
        version: Version of its firmware, two words.
    """

    serial: tuple[int, int]
    version: tuple[int, int]


class H1Claim(WireClaim):
    """A claim on an H1."""

    robot: ClassVar[str] = "h1"


class H1Robot(HungRobot[LowStateFrame]):
    """A Unitree H1 with 19 joints at its motors' own level, hung on a crane.

    The safety filter leads the joints from where they hang to the first targets within 3 s. The robot's
    inertial sensor is in the torso; states have the pelvis's orientation and motion.

    Args:
        transport: Topics of the robot.
        clock: The clock of the transport's stamps.
        stop_buttons: Buttons of the remote that stop a run while held together; "" for none.
        state_check: What a state must pass: "strict", or "length" for firmware that makes head or checksum by
            another rule. Corrupted states are then not detected.
        hung_on_crane: Whether the operator confirmed that the robot hangs on a crane.

    Raises:
        UnknownNameError: There is no such check.
    """

    description: ClassVar[RobotDescription] = DESCRIPTION
    wording: ClassVar[Wording] = WORDING
    condition: ClassVar[str] = hung("H1")
    notice: ClassVar[str] = on_crane("H1")
    info: H1Info | None

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        *,
        stop_buttons: str = STOP_BUTTONS,
        state_check: StateCheck = "strict",
        hung_on_crane: bool = False,
    ) -> None:
        strict, decoder = is_strict(state_check, "H1"), H1StateDecoder()
        self._encoder = GoCommandEncoder(ORDER.motors, MODES)
        stream = TickStream("h1", lambda payload: decoder.decode(payload, strict), H1Refusals)
        super().__init__(transport, clock, stop_buttons, stream, hung_on_crane=hung_on_crane)

    def _await_robot(self) -> None:
        super()._await_robot()
        if self._frame is not None and (wrong := humanoid_complaint(self._frame.payload)):
            raise WrongDeviceError(f"h1: {wrong}. Nothing was sent")

    def _encode(
        self,
        position: FloatArray,
        velocity: FloatArray,
        stiffness: FloatArray,
        damping: FloatArray,
        effort: FloatArray,
    ) -> bytes:
        return self._encoder.encode(GoCommand(position, velocity, stiffness, damping, effort, SERVO_MODE))

    def _read_info(self) -> H1Info | None:
        if self._frame is None:
            return None
        values = self._frame.values()
        return H1Info(values.serial, values.version)

    def _frame_fault(self, frame: LowStateFrame) -> str:
        return f"h1: {wrong}" if (wrong := humanoid_complaint(frame.payload)) else ""

    def _body(self, frame: LowStateFrame, remote: Remote | None) -> BodyState:
        orientation, angular_velocity, specific_force = pelvis_of(frame)
        return dataclasses.replace(
            body_state(frame, remote),
            orientation=orientation,
            angular_velocity=angular_velocity,
            acceleration=specific_force,
            foot_force=np.zeros(0),
        )
