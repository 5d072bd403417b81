"""Makes an emulated arm of servos."""

from __future__ import annotations

from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.device import ArmDevice
from deal_hw.drivers.servo_arm.emulated_families import EMULATED
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.robots.hardware_section import HardwareSection
from deal_hw.sim.robots.simulated import SimulatedTruth
from deal_hw.testing.joint_faults import JointFaults


def arm_device(
    hardware: HardwareSection,
    description: RobotDescription,
    space: ParameterSpace,
    truth: SimulatedTruth,
    *,
    faults: ArmFaults | None = None,
    noisy: bool = True,
    joint_faults: JointFaults | None = None,
) -> ArmDevice:
    """Return an emulated arm.

    Args:
        hardware: Its servos.
        description: The robot.
        space: The parameters of the truth.
        truth: Their hidden values.
        faults: Faults of one servo.
        noisy: Whether positions have the noise of the description.
        joint_faults: Faults of the joints.
    """
    by_joint = {servo.joint: servo for servo in hardware.servos}
    servos = [by_joint[name] for name in description.joint_names]
    joints, bus = EMULATED[hardware.bus](servos, hardware.baud_rate)
    robot = load_model(description)
    return ArmDevice(
        hardware,
        robot,
        space,
        truth,
        joints,
        bus,
        faults=faults,
        noisy=noisy,
        joint_faults=joint_faults,
    )
