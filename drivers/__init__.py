"""Robots and the transports that reach them.

Explicit tables, name -> "module:class", imported on use: naming a robot loads its driver and nothing else.
"""

from __future__ import annotations

import importlib
from typing import Any, Final

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.errors import UnknownNameError
from deal_hw.robot import Robot

ROBOTS: Final = {
    "cartpole": "deal_hw.drivers.cartpole.robot:CartpoleRobot",
}
TRANSPORTS: Final = {
    "serial": "deal_hw.drivers.transports.serial_transport:SerialTransport",
}

__all__ = ["ROBOTS", "TRANSPORTS", "adopt_robot", "make_robot", "robot_description"]


def make_robot(name: str, transport_name: str, port: str, clock: Clock) -> Robot:
    """Return a robot that will be reached over a port; nothing is opened yet.

    Raises:
        UnknownNameError: There is no such robot or transport.
    """
    robot, transport = _find("robot", ROBOTS, name), _find("transport", TRANSPORTS, transport_name)
    made: Robot = robot(transport(port, clock=clock), clock)
    return made


def adopt_robot(name: str, transport_name: str, fd: int, clock: Clock) -> Robot:
    """Return a robot over a descriptor that a parent process opened and this process inherited.

    Raises:
        UnknownNameError: There is no such robot or transport.
    """
    robot, transport = _find("robot", ROBOTS, name), _find("transport", TRANSPORTS, transport_name)
    made: Robot = robot(transport.from_fd(fd, clock=clock), clock)
    return made


def robot_description(name: str) -> RobotDescription:
    """Return the facts about a robot.

    Raises:
        UnknownNameError: There is no such robot.
    """
    found: RobotDescription = _find("robot", ROBOTS, name).description
    return found


def _find(what: str, table: dict[str, str], name: str) -> Any:
    if name not in table:
        raise UnknownNameError(what, name, table)
    module, _, attribute = table[name].partition(":")
    return getattr(importlib.import_module(module), attribute)
