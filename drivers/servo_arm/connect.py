"""Makes an arm of servos from its robot.yaml."""

from __future__ import annotations

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.hardware_section import HardwareSection
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.transport import Transport


def servo_arm(
    file: RobotFile,
    description: RobotDescription,
    port: str,
    clock: Clock,
    fd: int | None = None,
    *,
    can_send: bool = True,
) -> ServoArm:
    """Return the driver of an arm; nothing is opened yet.

    Args:
        file: The robot, with its section ``hardware``.
        description: Its description.
        port: Path of the serial port.
        clock: Gives the stamps.
        fd: Descriptor of the port that a parent process opened.
        can_send: False for a robot that is only listened to; ``connect`` then refuses.

    Raises:
        ConfigurationError: The file names no bus.
    """
    hardware = section_of(file)
    link = bus_link(hardware, port, clock, fd, can_send=can_send)
    return ServoArm(link, clock, description, hardware, FAMILIES[hardware.bus]())


def bus_link(
    hardware: HardwareSection, port: str, clock: Clock, fd: int | None, *, can_send: bool
) -> Transport:
    """Return the byte stream of a bus, not opened; arguments as :func:`servo_arm`."""
    link: Transport
    if fd is None:
        link = SerialTransport(port, hardware.baud_rate, clock)
    else:
        link = SerialTransport.from_fd(fd, clock, port, hardware.baud_rate)
    return link if can_send else listen_only(link)


def section_of(file: RobotFile) -> HardwareSection:
    """Return the section ``hardware`` of a robot.

    Raises:
        ConfigurationError: It has none.
    """
    if file.servo_bus is None:
        raise ConfigurationError(f"robot {file.name!r} has no bus of servos in its robot.yaml")
    return file.servo_bus
