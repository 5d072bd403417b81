"""Robots of users that ros2_control drives: their driver, their emulator, and doctor's look at the topics."""

from __future__ import annotations

from collections.abc import Iterator

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.ros2.connect import ros2_robot
from deal_hw.drivers.ros2.robot import Ros2ControlRobot
from deal_hw.errors import ConfigurationError
from deal_hw.findings import Finding
from deal_hw.robots.emulation import Emulation, EmulatorRequest
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.sim.robots.ros2_section import Ros2Section


def ros2_driver(
    file: RobotFile,
    description: RobotDescription,
    wire: str,
    port: str,
    clock: Clock,
    fd: int | None = None,
    *,
    can_send: bool = True,
) -> Ros2ControlRobot:
    """Return the driver; arguments as :func:`~deal_hw.drivers.ros2.connect.ros2_robot`."""
    return ros2_robot(_section(file), description, wire, port, clock, fd, can_send=can_send)


def emulate_ros2(file: RobotFile, description: RobotDescription, request: EmulatorRequest) -> Emulation:
    """Return the emulated robot on its network.

    Args:
        file: The robot, with its section ``hardware``.
        description: Its description.
        request: What was asked for.
    """
    from deal_hw.drivers.ros2.emulator import emulation, ros2_device
    from deal_hw.robots.file_emulator import truth_of
    from deal_hw.sim.robots.simulated import default_space

    section, truth = _section(file), truth_of(default_space(description), request)
    noisy = request.profile != "ideal"
    device = ros2_device(
        section,
        description,
        truth,
        noisy=noisy,
        rates=request.rates,
        joint_faults=request.joints,
        faults=request.controller,
    )
    return emulation(
        section,
        device,
        request.wire,
        request.port,
        cut_after_s=request.cut_after_s,
        cut_s=request.cut_s,
        freeze_after_s=request.freeze_after_s,
    )


def examine_ros2(
    file: RobotFile, description: RobotDescription, wire: str, port: str, clock: Clock
) -> Iterator[Finding]:
    """Yield findings on who is on the robot's topics; nothing is sent.

    Args:
        file: The robot.
        description: Its description.
        wire: "dds" or "zenoh".
        port: A network interface, or the end point of the router.
        clock: For the waiting.
    """
    from deal_hw.drivers.ros2.doctor import examine_topics

    return examine_topics(_section(file), wire, port, clock)


def _section(file: RobotFile) -> Ros2Section:
    section = file.ros2
    if section is None:
        raise ConfigurationError(f"robot {file.name!r} has no section `hardware` of ros2_control")
    return section
