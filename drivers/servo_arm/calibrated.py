"""An arm whose servos keep its calibration: their limits are the ends of its travel, as LeRobot has it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import ClassVar, Final

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.examination import ArmInfo
from deal_hw.drivers.servo_arm.families import Feetech
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.servo_bus.registers import Register
from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.hardware_section import TICKS, HardwareSection, ServoEntry
from deal_hw.sim.robots.travel import Travel
from deal_hw.transport import Transport

WHOLE_TURN: Final = (0, TICKS - 1)
"""Limits of a servo as it leaves the factory, and of a joint that LeRobot does not sweep."""
_LIMITS: Final = Register(
    f.MIN_POSITION.address, f.MIN_POSITION.size + f.MAX_POSITION.size, "Min and Max Position Limit"
)
"""Both in one read: an answer that comes late can then not be taken for the other one."""
_AGAIN: Final = "calibrate the arm with lerobot-calibrate"


class CalibratedArm(ServoArm):
    """An arm of Feetech servos whose zeros are in the servos, and not in a file.

    ``lerobot-calibrate`` writes the ends of each joint's travel into its servo, as lowest and highest
    position. ``connect`` reads them. A joint's zero is where the middles of this travel and of the joint's
    range agree. Goals stay within the servo's limits, also where these are narrower than the description's.

    Args:
        transport: A byte stream at the bus' baud rate.
        clock: The clock of the transport's stamps.
        description: The robot.
        hardware: Its servos; ``connect`` sets their zeros.
        ranges: Lowest and highest position of each joint in the model [rad].
        unswept: Joints whose travel LeRobot does not measure: a whole turn.
    """

    source: ClassVar[str] = "the SO-101 of LeRobot"

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        description: RobotDescription,
        hardware: HardwareSection,
        ranges: Mapping[str, tuple[float, float]],
        unswept: tuple[str, ...] = (),
    ) -> None:
        super().__init__(transport, clock, description, hardware, Feetech())
        self._ranges, self._unswept = dict(ranges), unswept

    def _examine(self) -> ArmInfo:
        """Find the servos, read their calibration, and check their settings; nothing is changed."""
        examination = self._examination()
        found = examination.presence()
        servos: list[ServoEntry] = []
        limits: dict[int, tuple[int, int]] = {}
        problems: list[str] = []
        for servo in self._hardware.servos:
            both = examination.surely(servo, partial(self._bus.read, servo.id, _LIMITS))
            low, high = both & 0xFFFF, both >> 16
            limits[servo.id] = low, high
            try:
                servos.append(self._calibrated(servo, low, high))
            except ConfigurationError as error:
                problems.append(str(error))
        if problems:
            raise ConfigurationError(f"{self._where}: {'; '.join(problems)}")
        self._take_hardware(dataclasses.replace(self._hardware, servos=tuple(servos)), limits)
        return self._examination().settings(found, limits)

    def _calibrated(self, servo: ServoEntry, low: int, high: int) -> ServoEntry:
        """Return a servo with the zero of its travel.

        Raises:
            ConfigurationError: It has no calibration, or that of another joint.
        """
        swept = (low, high) != WHOLE_TURN
        if not low < high or not (swept or servo.joint in self._unswept):
            raise ConfigurationError(
                f"joint {servo.joint}: servo {servo.id} allows {low} to {high} ticks, which is no travel of "
                f"this joint: it was never calibrated. {_AGAIN.capitalize()}"
            )
        travel = Travel(
            joint=servo.joint, id=servo.id, direction=servo.direction, low=low, high=high, measured=swept
        )
        zero, _ = travel.fitted(self._ranges[servo.joint], None, _AGAIN)
        return dataclasses.replace(servo, zero=zero)
