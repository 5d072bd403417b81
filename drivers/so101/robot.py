"""The driver of an SO-101: six Feetech STS3215 servos with the ids and the calibration of LeRobot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from deal_hw.clock import Clock
from deal_hw.drivers.servo_arm.calibrated import CalibratedArm
from deal_hw.drivers.servo_arm.connect import bus_link
from deal_hw.drivers.so101.description import DRIVEN, JOINTS, RANGE_RAD
from deal_hw.sim.robots.hardware_section import TICKS, HardwareSection, ServoEntry
from deal_hw.transport import Transport

P_GAIN, D_GAIN = 16, 32
"""What LeRobot writes to the servos, and what the description's stiffness was measured with."""
REST_RAD: Final = (0.0, -1.69, 1.57, 0.87, 0.0, 0.0)
"""Folded on its base, where the arm may go limp: LeIsaac's rest pose is 0, -100, 90, 50, 0, -10 degrees."""
RANGES: Final[Mapping[str, tuple[float, float]]] = dict(zip(JOINTS, RANGE_RAD, strict=True))
UNSWEPT: Final = ("wrist_roll",)
"""lerobot-calibrate writes a whole turn for it."""
HARDWARE: Final = HardwareSection(
    bus="feetech",
    passive="damping",
    servos=tuple(
        ServoEntry(
            joint=joint,
            id=number,
            model="sts3215",
            # Until the servo's own limits are known.
            zero=TICKS // 2,
            p_gain=P_GAIN,
            d_gain=D_GAIN,
            rest=rest,
        )
        for number, (joint, rest) in enumerate(zip(JOINTS, REST_RAD, strict=True), start=1)
    ),
)
"""The servos. LeRobot's signs are those of the model: isaac-sim2real/sage drives a real arm so."""


def so101_robot(port: str, clock: Clock, fd: int | None = None, *, can_send: bool = True) -> CalibratedArm:
    """Return the driver of an SO-101; nothing is opened yet.

    Args:
        port: Path of the serial port.
        clock: Gives the stamps.
        fd: Descriptor of the port that a parent process opened.
        can_send: False for an arm that is only listened to; ``connect`` then refuses.
    """
    return so101_arm(bus_link(HARDWARE, port, clock, fd, can_send=can_send), clock)


def so101_arm(link: Transport, clock: Clock) -> CalibratedArm:
    """Return the driver of an SO-101 over a byte stream."""
    return CalibratedArm(link, clock, DRIVEN, HARDWARE, RANGES, UNSWEPT)
