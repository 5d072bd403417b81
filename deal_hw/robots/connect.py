"""Connecting to robots by name: drivers, transports, and claims of a port."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from deal_hw.clock import Clock
from deal_hw.control.process.claim import LocalClaim
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.findings import Finding
from deal_hw.robots.entry import RobotEntry, TransportEntry, WireEntry
from deal_hw.robots.registry import (
    driven_entry,
    transport_entry,
    transport_of,
    transports,
    wires,
)
from deal_hw.transport import WireOptions

if TYPE_CHECKING:
    from deal_hw.robot import Robot
    from deal_hw.transport import TopicTransport, Transport


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
    entry, wire = reached_over(name, transport_name)
    given = dict(settings or {})
    driver = _simulator(entry, given.pop("simulator")) if "simulator" in given else entry.driver_of(wire)
    if wire.opens_port:
        _refuse_options(transport_entry(wire.transport), options, wire.name)
        arguments: tuple[Any, ...] = (port, clock)
        given["can_send"] = can_send
    else:
        link = make_transport(wire.transport, port, clock, options)
        arguments = (link if can_send else _listening(link), clock)
    try:
        made: Robot = driver(*arguments, **given)
    except TypeError as error:
        if not settings:
            raise
        raise ConfigurationError(
            f"{_options(settings)} would have no effect: robot {name!r} has no such setting"
        ) from error
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
    entry, wire = reached_over(name, transport_name)
    driver = entry.driver_of(wire)
    if wire.opens_port:
        robot: Robot = driver(port, clock, fd=fd, can_send=can_send)
        return robot
    transport = transport_entry(wire.transport)
    if not transport.adopt:
        raise ConfigurationError(
            f"transport {transport_name!r} has no descriptor to inherit; each process opens its own "
            "connection by make_robot()"
        )
    link: Transport = transport.load(transport.adopt)(fd, clock=clock, port=port)
    made: Robot = driver(link if can_send else _listening(link), clock)
    return made


def _listening(link: Transport) -> Transport:
    from deal_hw.drivers.transports.listen_only import listen_only

    return listen_only(link)


def make_transport(
    transport_name: str, port: str, clock: Clock, options: WireOptions | None = None
) -> Transport:
    """Return a transport; nothing is opened yet. Arguments and errors as :func:`make_robot`."""
    entry = transport_entry(transport_name)
    if entry.topics:
        return make_topic_transport(transport_name, port, clock, options)
    _refuse_options(entry, options)
    made: Transport = entry.load(entry.transport)(port, clock=clock)
    return made


def make_topic_transport(
    transport_name: str, port: str, clock: Clock, options: WireOptions | None = None
) -> TopicTransport:
    """Return a transport of topics; nothing is opened yet.

    Raises:
        UnknownNameError: There is no such transport, or it carries no topics.
        ConfigurationError: An option would be ignored.
    """
    entry = transports().find(transport_name)
    if entry is None or not entry.topics:
        raise UnknownNameError(
            "transport of topics", transport_name, [one.name for one in transports().entries() if one.topics]
        )
    _refuse_options(entry, options)
    made: TopicTransport = entry.load(entry.transport)(port, clock, options)
    return made


def claim_name(transport_name: str, port: str, options: WireOptions) -> str:
    """Return the name under which a robot is claimed on this computer: its transport and port."""
    entry = transport_of(transport_name)
    where = entry.load(entry.claim)(port, options) if entry.claim else port
    return f"{transport_name} on {where}"


def on_this_computer(transport_name: str, port: str) -> bool:
    """Return whether a port leads to a program on this computer, such as an emulator: there is no cable."""
    entry = transport_of(transport_name)
    return bool(entry.local and entry.load(entry.local)(port))


def spoilt_on_purpose(transport_name: str, port: str, options: WireOptions | None = None) -> LocalClaim:
    """Return the name that an emulator holds while it spoils frames on purpose.

    Programs that receive its frames ask whether it is held. Then corrupt or lost states have this cause.

    Args:
        transport_name: How the robot is reached.
        port: Where.
        options: More about a transport of topics.
    """
    return LocalClaim(f"spoilt frames: {claim_name(transport_name, port, options or WireOptions())}")


def carries_topics(transport_name: str) -> bool:
    """Return whether a wire carries messages with topics."""
    return transport_of(transport_name).topics


def wire_claim(
    name: str, transport_name: str, port: str, clock: Clock, holder: str, options: WireOptions
) -> Any | None:
    """Return the claim on a robot that other programs on its wire see; None if the port itself is exclusive.

    Args:
        name: The robot.
        transport_name: How it is reached.
        port: Where.
        clock: For the waiting.
        holder: Text that names the claiming program, for messages of other programs.
        options: More about a transport of topics.
    """
    entry, wire = reached_over(name, transport_name)
    if not wire.claim:
        return None
    link = make_topic_transport(wire.transport, port, clock, options)
    return entry.load(wire.claim)(link, clock, holder)


def reached_over(name: str, transport_name: str) -> tuple[RobotEntry, WireEntry]:
    """Return a robot's entry and its wire of that name.

    Raises:
        UnknownNameError: There is no such robot or wire.
        ConfigurationError: The robot has no driver, or is not reached that way.
    """
    entry = driven_entry(name)
    own = [wire.name for wire in entry.wires]
    if transport_name in own:
        return entry, entry.wire(transport_name)
    known = dict.fromkeys((*(wire.name for wire in wires()), *transports().names()))
    if transport_name not in known:
        raise UnknownNameError("transport", transport_name, known)
    raise ConfigurationError(
        f"robot {name!r} is not reached by transport {transport_name!r}; "
        f"choose --transport {' or '.join(own)}"
    )


def other_wires(name: str, port: str, transport_name: str, clock: Clock) -> Iterator[Finding]:
    """Yield findings on what else a port carries, after a robot did not answer there."""
    entry = driven_entry(name)
    if entry.other_wires:
        yield from entry.load(entry.other_wires)(port, transport_name, clock)


def _simulator(entry: RobotEntry, simulator: str) -> Any:
    if not entry.simulators:
        raise ConfigurationError(
            f"--simulator would have no effect: there is no simulator for robot {entry.name!r}; leave it out"
        )
    if simulator not in entry.simulators:
        raise UnknownNameError(f"simulator of robot {entry.name!r}", simulator, entry.simulators)
    return entry.load(entry.simulators[simulator])


def _options(names: Iterable[str]) -> str:
    """Return settings as they are typed."""
    return ", ".join("--" + name.replace("_", "-") for name in names)


def _refuse_options(entry: TransportEntry, options: WireOptions | None, wire: str = "") -> None:
    """Refuse settings that a transport would ignore, by its name or that of the robot's wire."""
    default = WireOptions().to_json()
    given = [name for name, value in (options or WireOptions()).to_json().items() if value != default[name]]
    foreign = [name for name in given if name not in entry.options]
    if not foreign:
        return
    takes = f"takes {_options(entry.options)}" if entry.options else "is no network; leave it out"
    raise ConfigurationError(
        f"{_options(foreign)} would have no effect: transport {wire or entry.name!r} {takes}"
    )
