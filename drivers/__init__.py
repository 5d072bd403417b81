"""Robots and their transports.

Explicit tables, name -> "module:class", imported on use: naming a robot loads its driver and nothing else.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.robot import Robot
from deal_hw.transport import TopicTransport, Transport, WireOptions
from deal_hw.types import Trajectory

if TYPE_CHECKING:
    from deal_hw.drivers.go2.claim import WireClaim
    from deal_hw.motions.scores.balance import BalanceResult
    from deal_hw.motions.scores.velocity_error import Track

ROBOTS: Final = {
    "cartpole": "deal_hw.drivers.cartpole.robots.robot:CartpoleRobot",
    "go2": "deal_hw.drivers.go2.robot:Go2Robot",
    "go2_on_stand": "deal_hw.drivers.go2.robot:Go2OnStandRobot",
}
DESCRIPTIONS: Final = {
    "allegro": "deal_hw.drivers.allegro.description:DESCRIPTION",
    "ant": "deal_hw.drivers.ant.description:DESCRIPTION",
    "go2": "deal_hw.drivers.go2.descriptions.floor:DESCRIPTION",
    "go2_suspended": "deal_hw.drivers.go2.descriptions.on_stand_recording:DESCRIPTION",
    "humanoid": "deal_hw.drivers.humanoid.description:DESCRIPTION",
    "so101": "deal_hw.drivers.so101.description:DESCRIPTION",
}
"""Descriptions for simulation and calibration, of robots whose driver has another one."""
SPACES: Final = {
    "allegro": "deal_hw.drivers.allegro.description:SPACES",
    "ant": "deal_hw.drivers.ant.description:SPACES",
    "cartpole": "deal_hw.drivers.cartpole.description:SPACES",
    "go2": "deal_hw.drivers.go2.descriptions.floor:SPACES",
    "go2_on_stand": "deal_hw.drivers.go2.descriptions.on_stand:SPACES",
    "go2_suspended": "deal_hw.drivers.go2.descriptions.on_stand_recording:SPACES",
    "humanoid": "deal_hw.drivers.humanoid.description:SPACES",
    "so101": "deal_hw.drivers.so101.description:SPACES",
}
"""Tables of parameter sets, name -> function; the first of each is the default."""
ODOMETRY: Final = {"go2": "deal_hw.drivers.go2.odometry:walked"}
"""Robots with odometry -> function that returns the walked track of a recording."""
BALANCE: Final = {"cartpole": "deal_hw.motions.scores.balance:recorded_balance"}
"""Robots whose policies balance a pole -> function that judges a recording."""
TRANSPORTS: Final = {
    "serial": "deal_hw.drivers.transports.serial_transport:SerialTransport",
    "dds": "deal_hw.drivers.transports.dds_transport:DdsTransport",
    "zenoh": "deal_hw.drivers.transports.zenoh_transport:ZenohTransport",
}
TOPIC_TRANSPORTS: Final = ("dds", "zenoh")
"""Transports whose connection a child process cannot inherit: each process opens its own."""
WIRE_OPTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "dds": ("domain",),
    "zenoh": ("listen", "mode", "insecure", "ca", "certificate", "key"),
}
"""The fields of :class:`~deal_hw.transport.WireOptions` that each transport takes."""
MAKERS: Final[Mapping[tuple[str, str], str]] = {
    ("cartpole", "can"): "deal_hw.drivers.cartpole.robots.can_robot:can_robot",
    ("cartpole", "odrive"): "deal_hw.drivers.cartpole.robots.odrive_robot:odrive_robot",
    ("cartpole", "dynamixel"): "deal_hw.drivers.cartpole.dynamixel.connect:dynamixel_robot",
}
"""Robots with another driver on one wire than in :data:`ROBOTS`, (robot, wire) -> "module:function".

The function is called as ``function(port, clock, fd=None, can_send=True)``. It returns the Robot and does no
I/O. ``fd`` is the file descriptor of the port, if a parent process opened it."""
SIMULATED: Final[Mapping[tuple[str, str], str]] = {
    ("go2", "unitree_mujoco"): "deal_hw.drivers.go2.unitree_mujoco:UnitreeMujocoRobot",
    ("go2_on_stand", "unitree_mujoco"): "deal_hw.drivers.go2.unitree_mujoco:UnitreeMujocoOnStandRobot",
}
"""Drivers for a third-party simulator in place of a robot, (robot, simulator) -> "module:class"."""
CAN_BUSES: Final[Mapping[str, str]] = {
    "can": "deal_hw.drivers.cartpole.robots.can_robot:can_bus",
    "odrive": "deal_hw.drivers.cartpole.robots.odrive_robot:odrive_bus",
}
"""Transports over a CAN bus -> function that returns a port's bus and nodes."""
REACHED_BY: Final[Mapping[str, tuple[str, ...]]] = {
    "cartpole": ("serial", "can", "odrive", "dynamixel"),
    "go2": TOPIC_TRANSPORTS,
    "go2_on_stand": TOPIC_TRANSPORTS,
}
"""Transports that reach each robot; the first is the default."""


def make_robot(
    name: str,
    transport_name: str,
    port: str,
    clock: Clock,
    options: WireOptions | None = None,
    settings: Mapping[str, Any] | None = None,
    *,
    can_send: bool = True,
) -> Robot:
    """Return a robot that will be reached over a port; nothing is opened yet.

    Args:
        name: The robot.
        transport_name: How it is reached.
        port: Where: a serial port, a network interface, an endpoint.
        clock: Gives the stamps.
        options: More about a transport of topics.
        settings: The driver's own keyword arguments, such as ``stop_buttons`` of the Go2. ``simulator`` names
            a simulator in place of the robot, and thereby the driver.
        can_send: False for listening only, as in a dry run.

    Raises:
        UnknownNameError: There is no such robot or transport.
        ConfigurationError: The robot has a description but no driver, is not reached that way, or its driver
            has no such setting.
    """
    robot = _driver(name)
    _check_reach(name, transport_name)
    if settings and "simulator" in settings:
        settings = dict(settings)
        robot = _simulated(name, settings.pop("simulator"))
    try:
        if (name, transport_name) in MAKERS:
            _refuse_options(transport_name, options)
            return _make(name, transport_name, port, clock, can_send=can_send, **(settings or {}))
        link = make_transport(transport_name, port, clock, options)
        made: Robot = robot(link if can_send else listen_only(link), clock, **(settings or {}))
    except TypeError as error:
        raise ConfigurationError(
            f"{_options(settings or ())} would have no effect: robot {name!r} has no such setting"
        ) from error
    return made


def claim_name(transport_name: str, port: str, options: WireOptions) -> str:
    """Return the name under which a robot is claimed on this computer: its transport and port."""
    if transport_name == "zenoh":
        from deal_hw.drivers.transports.zenoh_session import parse_endpoints

        port = ", ".join(
            sorted("loopback:" + str(e.port) if e.loopback else str(e) for e in parse_endpoints(port))
        )
    elif transport_name == "dds":
        from deal_hw.drivers.transports.interfaces import find_interface

        port = f"{find_interface(port).name}, domain {options.domain}"
    elif transport_name in CAN_BUSES:
        from deal_hw.drivers.transports.can_bus import CanAddress

        # Two devices on one bus are one claim: a bus has one commander.
        address = CanAddress.parse(port.partition("?")[0])
        port = f"{address.interface}:{_resolved(address.channel)}"
    else:
        # Settings after the path of a port do not make it another port.
        port = _resolved(port.partition("?")[0])
    return f"{transport_name} on {port}"


def on_this_computer(transport_name: str, port: str) -> bool:
    """Return whether a port leads to a program on this computer, such as an emulator: there is no cable."""
    if transport_name == "zenoh":
        from deal_hw.drivers.transports.zenoh_session import parse_endpoints

        return all(end.loopback for end in parse_endpoints(port))
    if transport_name == "dds":
        from deal_hw.drivers.transports.interfaces import list_interfaces

        return any(one.loopback and port in (one.name, *one.addresses) for one in list_interfaces())
    path = port.partition("?")[0]
    if transport_name in CAN_BUSES:
        from deal_hw.drivers.transports.can_bus import CanAddress

        address = CanAddress.parse(path)
        if address.interface == "virtual" or address.channel.startswith("vcan"):
            return True
        path = address.channel
    # A pseudo-terminal, or an emulator's link to one.
    return _resolved(path).startswith("/dev/pts/")


def walked(name: str, trajectory: Trajectory) -> Track | None:
    """Return a robot's path by its own sensors; None if it does not walk or has no odometry."""
    if name not in ODOMETRY:
        return None
    found: Track | None = _find("odometry", ODOMETRY, name)(trajectory)
    return found


def balanced(name: str, trajectory: Trajectory) -> BalanceResult | None:
    """Return how well a robot's pole was held up; None without a pole, or without a duration."""
    if name not in BALANCE:
        return None
    found: BalanceResult | None = _find("balance", BALANCE, name)(trajectory)
    return found


def wire_claim(
    name: str, transport_name: str, port: str, clock: Clock, holder: str, options: WireOptions
) -> WireClaim | None:
    """Return the claim on a robot that other programs on its wire see; None if the port itself is exclusive.

    Args:
        name: The robot.
        transport_name: How it is reached.
        port: Where.
        clock: For the waiting.
        holder: Text that names the claiming program, for messages of other programs.
        options: More about a transport of topics.
    """
    if name not in ROBOTS or transport_name not in TOPIC_TRANSPORTS:
        return None
    from deal_hw.drivers.go2.claim import WireClaim

    return WireClaim(make_topic_transport(transport_name, port, clock, options), clock, holder)


def make_transport(
    transport_name: str, port: str, clock: Clock, options: WireOptions | None = None
) -> Transport:
    """Return a transport; nothing is opened yet. Arguments and errors as :func:`make_robot`."""
    if transport_name in TOPIC_TRANSPORTS:
        return make_topic_transport(transport_name, port, clock, options)
    transport = _find("transport", TRANSPORTS, transport_name)
    _refuse_options(transport_name, options)
    made: Transport = transport(port, clock=clock)
    return made


def make_topic_transport(
    transport_name: str, port: str, clock: Clock, options: WireOptions | None = None
) -> TopicTransport:
    """Return a transport of topics; nothing is opened yet.

    Raises:
        UnknownNameError: There is no such transport, or it carries no topics.
        ConfigurationError: An option would be ignored.
    """
    if transport_name not in TOPIC_TRANSPORTS:
        raise UnknownNameError("transport of topics", transport_name, TOPIC_TRANSPORTS)
    foreign = [name for name in _given(options) if name not in WIRE_OPTIONS[transport_name]]
    if foreign:
        raise ConfigurationError(
            f"{_options(foreign)} would have no effect: transport {transport_name!r} takes "
            f"{_options(WIRE_OPTIONS[transport_name])}"
        )
    made: TopicTransport = _find("transport", TRANSPORTS, transport_name)(port, clock, options)
    return made


def adopt_robot(
    name: str, transport_name: str, fd: int, clock: Clock, *, port: str = "", can_send: bool = True
) -> Robot:
    """Return a robot over a descriptor that a parent process opened and this process inherited.

    Args:
        name: The robot.
        transport_name: How it is reached.
        fd: The descriptor.
        clock: Gives the stamps.
        port: What the parent opened, to open it again where the device vanishes and comes back.
        can_send: False for a robot that is only listened to, as in a dry run.

    Raises:
        UnknownNameError: There is no such robot or transport.
        ConfigurationError: The robot has a description, but no driver, or the transport has no descriptor.
    """
    robot = _driver(name)
    _check_reach(name, transport_name)
    if (name, transport_name) in MAKERS:
        return _make(name, transport_name, port, clock, fd=fd, can_send=can_send)
    transport = _find("transport", TRANSPORTS, transport_name)
    if transport_name in TOPIC_TRANSPORTS:
        raise ConfigurationError(
            f"transport {transport_name!r} has no descriptor to inherit; each process opens its own "
            "connection by make_robot()"
        )
    link: Transport = transport.from_fd(fd, clock=clock, port=port)
    made: Robot = robot(link if can_send else listen_only(link), clock)
    return made


def driver_description(name: str) -> RobotDescription:
    """Return the facts about a robot in its driver, with the rates of its real wire.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver.
    """
    found: RobotDescription = _driver(name).description
    return found


def recorded_description(name: str) -> RobotDescription:
    """Return the facts under which a robot's recordings were made: its driver's, where it has one.

    Raises:
        UnknownNameError: There is no such robot.
    """
    return driver_description(name) if name in ROBOTS else robot_description(name)


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
        raise UnknownNameError("robot", name, dict.fromkeys((*ROBOTS, *DESCRIPTIONS)))
    return found


def parameter_spaces(name: str) -> Mapping[str, Callable[[], ParameterSpace]]:
    """Return a robot's parameter sets by name; the first is the default.

    Raises:
        UnknownNameError: There is no such robot.
    """
    found: Mapping[str, Callable[[], ParameterSpace]] = _find("robot", SPACES, name)
    return found


def can_bus(transport_name: str, port: str) -> tuple[str, tuple[int, ...]]:
    """Return the bus of a port on CAN, and the numbers of the devices that are expected there.

    Raises:
        UnknownNameError: The transport does not use CAN.
        ConfigurationError: The port is not valid.
    """
    found: tuple[str, tuple[int, ...]] = _find("CAN transport", CAN_BUSES, transport_name)(port)
    return found


def default_transport(name: str) -> str:
    """Return the transport that usually reaches a robot.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver.
    """
    _driver(name)
    return REACHED_BY[name][0]


def _resolved(path: str) -> str:
    return os.path.realpath(path) if "/" in path else path


def _simulated(name: str, simulator: str) -> Any:
    known = [has for robot, has in SIMULATED if robot == name]
    if not known:
        raise ConfigurationError(
            f"--simulator would have no effect: there is no simulator for robot {name!r}; leave it out"
        )
    if simulator not in known:
        raise UnknownNameError(f"simulator of robot {name!r}", simulator, known)
    return _find("simulator", {simulator: SIMULATED[name, simulator]}, simulator)


def _options(names: Iterable[str]) -> str:
    """Return settings as they are typed."""
    return ", ".join("--" + name.replace("_", "-") for name in names)


def _make(name: str, transport_name: str, port: str, clock: Clock, **settings: Any) -> Robot:
    made: Robot = _find("driver", {transport_name: MAKERS[name, transport_name]}, transport_name)(
        port, clock, **settings
    )
    return made


def _refuse_options(transport_name: str, options: WireOptions | None) -> None:
    """Refuse settings of a network on a wire that is none."""
    if given := _given(options):
        raise ConfigurationError(
            f"{_options(given)} would have no effect: transport {transport_name!r} is no network; leave it "
            "out"
        )


def _given(options: WireOptions | None) -> list[str]:
    """Return the names of the options that differ from their defaults."""
    default = WireOptions().to_json()
    return [name for name, value in (options or WireOptions()).to_json().items() if value != default[name]]


def _check_reach(name: str, transport_name: str) -> None:
    if transport_name not in TRANSPORTS and all(transport_name not in found for found in REACHED_BY.values()):
        raise UnknownNameError("transport", transport_name, dict.fromkeys(sum(REACHED_BY.values(), ())))
    if transport_name not in REACHED_BY[name]:
        raise ConfigurationError(
            f"robot {name!r} is not reached by transport {transport_name!r}; "
            f"choose --transport {' or '.join(REACHED_BY[name])}"
        )


def _driver(name: str) -> Any:
    if name in DESCRIPTIONS and name not in ROBOTS:
        raise ConfigurationError(
            f"robot {name!r} can be simulated and calibrated from recordings, but has no driver yet; "
            f"robots that can be driven: {', '.join(ROBOTS)}"
        )
    return _find("robot", ROBOTS, name)


def _find(what: str, table: Mapping[str, str], name: str) -> Any:
    if name not in table:
        raise UnknownNameError(what, name, table)
    module, _, attribute = table[name].partition(":")
    return getattr(importlib.import_module(module), attribute)
