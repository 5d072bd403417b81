"""Makes a robot of ros2_control, and its transports, from its robot.yaml."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.ros2.robot import Ros2ControlRobot
from deal_hw.drivers.ros2.topics import topics_of
from deal_hw.drivers.transports.dds_discovery import OUR_NOTE
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.transport import TopicTransport, WireOptions

EMULATED_NOTE = b"emulated by deal-hw"
"""What an emulator's participant says of itself: it is no program that commands."""


def ros2_robot(
    section: Ros2Section,
    description: RobotDescription,
    wire: str,
    port: str,
    clock: Clock,
    fd: int | None = None,
    *,
    can_send: bool = True,
) -> Ros2ControlRobot:
    """Return the driver of a robot; nothing is opened yet.

    Args:
        section: Its controller and topics.
        description: The robot.
        wire: "dds" or "zenoh".
        port: A network interface, or the end point of the router.
        clock: Gives the stamps.
        fd: Unused: each process opens its own connection.
        can_send: False for a robot that is only listened to.

    Raises:
        ConfigurationError: A descriptor is given.
    """
    if fd is not None:
        raise ConfigurationError(
            "topics have no descriptor to inherit; each process opens its own connection"
        )
    link = make_link(section, wire, port, clock)
    return Ros2ControlRobot(
        link if can_send else cast(TopicTransport, listen_only(link)), clock, description, section
    )


def make_link(
    section: Ros2Section, wire: str, port: str, clock: Clock, *, emulated: bool = False
) -> TopicTransport:
    """Return the transport of a robot's topics; nothing is opened yet.

    Args:
        section: The topics, the domain and the files of TLS.
        wire: "dds" or "zenoh".
        port: A network interface, or an end point.
        clock: Gives the stamps.
        emulated: Whether the robot's side is made, which over Zenoh listens at the end point.
    """
    typed = topics_of(section).typed
    if wire == "dds":
        from deal_hw.drivers.transports.dds_transport import DdsTransport

        note = EMULATED_NOTE if emulated else OUR_NOTE
        return DdsTransport(port, clock, WireOptions(domain=section.domain), typed=typed, note=note)
    from deal_hw.drivers.ros2.rmw_zenoh import RmwZenohTransport

    options = WireOptions(
        insecure=section.insecure,
        listen=emulated,
        ca=_path(section.ca),
        certificate=_path(section.certificate),
        key=_path(section.key),
    )
    return RmwZenohTransport(port, clock, options, typed=typed, domain=section.domain, emulated=emulated)


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)
