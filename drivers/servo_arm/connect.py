"""Makes an arm of servos from its robot.yaml."""

from __future__ import annotations

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import ConfigurationError
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
    hardware = file.hardware
    if hardware is None:
        raise ConfigurationError(f"robot {file.name!r} has no section `hardware` in its robot.yaml")
    link: Transport
    if fd is None:
        link = SerialTransport(port, hardware.baud_rate, clock)
    else:
        link = SerialTransport.from_fd(fd, clock, port, hardware.baud_rate)
    family = FAMILIES[hardware.bus]()
    return ServoArm(link if can_send else listen_only(link), clock, description, hardware, family)
