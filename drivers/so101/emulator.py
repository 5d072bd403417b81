"""An emulated SO-101: the bytes of six STS3215 servos that lerobot-calibrate has calibrated."""

from __future__ import annotations

import dataclasses
from typing import Final

from deal_hw.drivers.servo_arm.calibrated import WHOLE_TURN
from deal_hw.drivers.servo_arm.device import ArmDevice
from deal_hw.drivers.servo_arm.emulator import arm_device
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.so101.description import DRIVEN, emulated_space
from deal_hw.drivers.so101.robot import HARDWARE, RANGES, UNSWEPT
from deal_hw.sim.robots.hardware_section import RAD, HardwareSection, ServoEntry
from deal_hw.sim.robots.simulated import SimulatedTruth
from deal_hw.testing.joint_faults import JointFaults

HOMED: Final = 2047
"""What LeRobot's homing makes of the middle of a joint's travel [ticks]."""


def so101_device(
    truth: SimulatedTruth,
    *,
    faults: ArmFaults | None = None,
    noisy: bool = True,
    joint_faults: JointFaults | None = None,
) -> ArmDevice:
    """Return an emulated arm, whose servos keep the ends of their travels as LeRobot writes them.

    A joint's encoder bias is that its middle was not found exactly: the servo's limits are off by it.

    Args:
        truth: Values of the parameters of :func:`~deal_hw.drivers.so101.description.emulated_space`.
        faults: Faults of one servo.
        noisy: Whether positions have the noise of the description.
        joint_faults: Faults of the joints.
    """
    hardware = homed()
    device = arm_device(
        hardware, DRIVEN, emulated_space(), truth, faults=faults, noisy=noisy, joint_faults=joint_faults
    )
    for servo, emulated in zip(hardware.servos, device.bus.servos, strict=True):
        low, high = limits_of(servo)
        emulated.keep(f.MIN_POSITION, low)
        emulated.keep(f.MAX_POSITION, high)
    return device


def limits_of(servo: ServoEntry) -> tuple[int, int]:
    """Return the limits that lerobot-calibrate writes into a homed servo [ticks]."""
    if servo.joint in UNSWEPT:
        return WHOLE_TURN
    low, high = (servo.ticks(end) for end in RANGES[servo.joint])
    return low, high


def homed() -> HardwareSection:
    """Return the servos with the zeros that they have after LeRobot's homing."""
    middles = {joint: sum(ends) / 2 for joint, ends in RANGES.items()}
    servos = tuple(
        dataclasses.replace(servo, zero=HOMED - servo.direction * round(middles[servo.joint] / RAD))
        for servo in HARDWARE.servos
    )
    return dataclasses.replace(HARDWARE, servos=servos)
