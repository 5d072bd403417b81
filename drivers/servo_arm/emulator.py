"""Makes an emulated arm from its robot.yaml."""

from __future__ import annotations

from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.device import ArmDevice
from deal_hw.drivers.servo_arm.emulated_families import EMULATED
from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space


def arm_device(
    file: RobotFile, description: RobotDescription, truth: SimulatedTruth, *, noisy: bool = True
) -> ArmDevice:
    """Return an emulated arm.

    Args:
        file: The robot, with its section ``hardware``.
        description: Its description.
        truth: Hidden parameters.
        noisy: Whether positions have the noise of the description.

    Raises:
        ConfigurationError: The file names no bus.
    """
    hardware = file.hardware
    if hardware is None:
        raise ConfigurationError(f"robot {file.name!r} has no section `hardware` in its robot.yaml")
    by_joint = {servo.joint: servo for servo in hardware.servos}
    joints, bus = EMULATED[hardware.bus](
        [by_joint[name] for name in description.joint_names], hardware.baud_rate
    )
    robot, space = load_model(description), default_space(description)
    return ArmDevice(hardware, robot, space, truth, joints, bus, noisy=noisy)
