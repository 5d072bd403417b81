"""Robots and the transports that reach them.

Explicit tables, name -> "module:class", imported on use: naming a robot loads its driver and nothing else.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any, Final

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.robot import Robot

ROBOTS: Final = {
    "cartpole": "deal_hw.drivers.cartpole.robot:CartpoleRobot",
}
DESCRIPTIONS: Final = {
    "ant": "deal_hw.drivers.ant.description:DESCRIPTION",
    "go2": "deal_hw.drivers.go2.description:DESCRIPTION",
    "go2_suspended": "deal_hw.drivers.go2.suspended:DESCRIPTION",
    "so101": "deal_hw.drivers.so101.description:DESCRIPTION",
}
"""Robots that can be simulated and calibrated from recordings, but have no driver."""
SPACES: Final = {
    "ant": "deal_hw.drivers.ant.description:SPACES",
    "cartpole": "deal_hw.drivers.cartpole.description:SPACES",
    "go2": "deal_hw.drivers.go2.description:SPACES",
    "go2_suspended": "deal_hw.drivers.go2.suspended:SPACES",
    "so101": "deal_hw.drivers.so101.description:SPACES",
}
"""Tables of parameter sets, name -> function; the first of each is the default."""
TRANSPORTS: Final = {
    "serial": "deal_hw.drivers.transports.serial_transport:SerialTransport",
}

__all__ = [
    "DESCRIPTIONS",
    "ROBOTS",
    "SPACES",
    "TRANSPORTS",
    "adopt_robot",
    "make_robot",
    "parameter_spaces",
    "robot_description",
]


def make_robot(name: str, transport_name: str, port: str, clock: Clock) -> Robot:
    """Return a robot that will be reached over a port; nothing is opened yet.

    Raises:
        UnknownNameError: There is no such robot or transport.
        ConfigurationError: The robot has a description, but no driver.
    """
    robot, transport = _driver(name), _find("transport", TRANSPORTS, transport_name)
    made: Robot = robot(transport(port, clock=clock), clock)
    return made


def adopt_robot(name: str, transport_name: str, fd: int, clock: Clock) -> Robot:
    """Return a robot over a descriptor that a parent process opened and this process inherited.

    Raises:
        UnknownNameError: There is no such robot or transport.
        ConfigurationError: The robot has a description, but no driver.
    """
    robot, transport = _driver(name), _find("transport", TRANSPORTS, transport_name)
    made: Robot = robot(transport.from_fd(fd, clock=clock), clock)
    return made


def robot_description(name: str) -> RobotDescription:
    """Return the facts about a robot, whether it has a driver or not.

    Raises:
        UnknownNameError: There is no such robot.
        MissingExtraError: The package that carries the robot's model is not installed.
    """
    found: RobotDescription
    if name in DESCRIPTIONS:
        found = _find("robot", DESCRIPTIONS, name)
    elif name in ROBOTS:
        found = _find("robot", ROBOTS, name).description
    else:
        raise UnknownNameError("robot", name, (*ROBOTS, *DESCRIPTIONS))
    return found


def parameter_spaces(name: str) -> Mapping[str, Callable[[], ParameterSpace]]:
    """Return a robot's parameter sets by name; the first is the default.

    Raises:
        UnknownNameError: There is no such robot.
    """
    found: Mapping[str, Callable[[], ParameterSpace]] = _find("robot", SPACES, name)
    return found


def _driver(name: str) -> Any:
    if name in DESCRIPTIONS:
        raise ConfigurationError(
            f"robot {name!r} can be simulated and calibrated from recordings, but has no driver yet; "
            f"robots that can be driven: {', '.join(ROBOTS)}"
        )
    return _find("robot", ROBOTS, name)


def _find(what: str, table: dict[str, str], name: str) -> Any:
    if name not in table:
        raise UnknownNameError(what, name, table)
    module, _, attribute = table[name].partition(":")
    return getattr(importlib.import_module(module), attribute)
