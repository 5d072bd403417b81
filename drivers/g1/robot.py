"""The G1 over topics, hung on a crane: DDS or Zenoh carries the same bytes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.g1.description import DESCRIPTION, DESCRIPTION_23, WINDING_C
from deal_hw.drivers.g1.joints import MACHINES, ROBOT_OF
from deal_hw.drivers.g1.messages import (
    MODE_PR,
    G1Command,
    G1CommandEncoder,
    G1Frame,
    G1StateDecoder,
)
from deal_hw.drivers.g1.refusals import G1Refusals
from deal_hw.drivers.g1.wording import WORDING
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.claim import WireClaim
from deal_hw.drivers.unitree.crane import STOP_BUTTONS, HungRobot, hung, on_crane
from deal_hw.drivers.unitree.motor_command import MODE_SERVO
from deal_hw.drivers.unitree.remote import Remote, sticks_of
from deal_hw.drivers.unitree.tick_stream import TickStream
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import WrongDeviceError
from deal_hw.transport import TopicTransport
from deal_hw.types import BodyState, FloatArray


@dataclass(frozen=True, slots=True)
class G1Info:
    """What the robot reports about itself.

    Attributes:
        machine: mode_machine, the version of the G1.
        version: Version of its firmware, two words.
    """

    machine: int
    version: tuple[int, int]


def machine_fault(machine: int, robot: str) -> str:
    """Return why a G1 with this mode_machine is not this robot of deal-hw, and what to do; "" if it is."""
    fits = ROBOT_OF.get(machine)
    if fits == robot:
        return ""
    what = MACHINES.get(machine, "an unknown version")
    if fits is not None:
        return (
            f"{robot}: the robot says mode_machine {machine}, a G1 with {what}, which is robot `{fits}` "
            f"here: take `{fits}` in place of `{robot}`"
        )
    return (
        f"{robot}: the robot says mode_machine {machine} ({what}), and deal-hw describes only "
        f"{', '.join(f'{number} ({MACHINES[number]})' for number in ROBOT_OF)}. Nothing was sent; write a "
        "robot of your own for this version"
    )


class G1Claim(WireClaim):
    """A claim on a G1."""

    robot: ClassVar[str] = "g1"


class G1Robot(HungRobot[G1Frame]):
    """A Unitree G1 with 29 joints at its motors' own level, hung on a crane.

    The safety filter leads the joints from where they hang to the first targets within 3 s.

    Args:
        transport: Topics of the robot.
        clock: The clock of the transport's stamps.
        stop_buttons: Buttons of the remote that stop a run while held together; "" for none.
        hung_on_crane: Whether the operator confirmed that the robot hangs on a crane.
    """

    description: ClassVar[RobotDescription] = DESCRIPTION
    wording: ClassVar[Wording] = WORDING
    types: ClassVar[Mapping[str, str]] = topics.HUMANOID_TYPES
    condition: ClassVar[str] = hung("G1")
    notice: ClassVar[str] = on_crane("G1")
    info: G1Info | None

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        *,
        stop_buttons: str = STOP_BUTTONS,
        hung_on_crane: bool = False,
    ) -> None:
        joints = self.description.joint_names
        self._encoder, self._enabled = G1CommandEncoder(joints), np.full(len(joints), MODE_SERVO)
        self._lost = np.zeros(len(joints), dtype=np.int64)
        stream = TickStream("g1", G1StateDecoder(joints).decode, G1Refusals)
        super().__init__(transport, clock, stop_buttons, stream, hung_on_crane=hung_on_crane)

    def _await_robot(self) -> None:
        super()._await_robot()
        if self._frame is not None and (wrong := machine_fault(self._machine, self.description.name)):
            raise WrongDeviceError(wrong)

    @property
    def _machine(self) -> int:
        return 0 if self._frame is None else self._frame.mode_machine

    def _encode(
        self,
        position: FloatArray,
        velocity: FloatArray,
        stiffness: FloatArray,
        damping: FloatArray,
        effort: FloatArray,
    ) -> bytes:
        return self._encoder.encode(
            G1Command(
                position,
                velocity,
                stiffness,
                damping,
                effort,
                self._enabled,
                mode_machine=self._machine,
                mode_pr=MODE_PR,
            )
        )

    def _read_info(self) -> G1Info | None:
        if self._frame is None:
            return None
        return G1Info(self._frame.mode_machine, self._frame.version)

    def _frame_fault(self, frame: G1Frame) -> str:
        return self._motor_fault(frame) or machine_fault(frame.mode_machine, self.description.name)

    def _motor_fault(self, frame: G1Frame) -> str:
        """Return what a motor reports that must end the run; "" if nothing."""
        error = frame.error
        if error.any():
            joint = int(np.argmax(error != 0))
            return (
                f"g1: the motor of joint {self.description.joint_names[joint]!r} reports error "
                f"0x{error[joint]:X}; restart the robot, and do not continue while it persists"
            )
        winding = frame.winding
        hot = int(np.argmax(winding))
        if winding[hot] > WINDING_C:
            return (
                f"g1: the winding of the motor of joint {self.description.joint_names[hot]!r} is at "
                f"{winding[hot]} °C, at most {WINDING_C:g} °C are allowed; let it cool down"
            )
        return ""

    def _body(self, frame: G1Frame, remote: Remote | None) -> BodyState:
        return BodyState(
            orientation=frame.orientation,
            angular_velocity=frame.angular_velocity,
            acceleration=frame.specific_force,
            foot_force=np.zeros(0),
            temperature=frame.casing.astype(np.float64),
            lost=self._lost,
            battery=math.nan,
            voltage=float(np.median(frame.voltage)),
            current=math.nan,
            sticks=sticks_of(remote),
            buttons=-1 if remote is None else remote.buttons,
        )


class G1Dof23Robot(G1Robot):
    """A G1 with 23 joints."""

    description: ClassVar[RobotDescription] = DESCRIPTION_23
