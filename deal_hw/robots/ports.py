"""Ports: one name for all spellings of a port, and whether a program on this computer is behind it."""

from __future__ import annotations

import os

from deal_hw.transport import WireOptions


def path_claim(port: str, options: WireOptions) -> str:
    """Return a serial port's own path; settings after the path do not make it another port."""
    return _resolved(port.partition("?")[0])


def can_claim(port: str, options: WireOptions) -> str:
    """Return a CAN bus. Two devices on one bus are one claim: a bus has one commander."""
    from deal_hw.drivers.transports.can_bus import CanAddress

    address = CanAddress.parse(port.partition("?")[0])
    return f"{address.interface}:{_resolved(address.channel)}"


def dds_claim(port: str, options: WireOptions) -> str:
    """Return a network interface and a domain."""
    from deal_hw.drivers.transports.interfaces import find_interface

    return f"{find_interface(port).name}, domain {options.domain}"


def zenoh_claim(port: str, options: WireOptions) -> str:
    """Return end points; those of this computer by their number alone."""
    from deal_hw.drivers.transports.zenoh_session import parse_endpoints

    ends = parse_endpoints(port)
    return ", ".join(sorted("loopback:" + str(end.port) if end.loopback else str(end) for end in ends))


def path_is_local(port: str) -> bool:
    """Return whether a serial port is a pseudo-terminal, or an emulator's link to one."""
    # A link in the working folder has no slash.
    return os.path.realpath(port.partition("?")[0]).startswith("/dev/pts/")


def can_is_local(port: str) -> bool:
    """Return whether a CAN bus is virtual, or its serial adapter emulated."""
    from deal_hw.drivers.transports.can_bus import CanAddress

    address = CanAddress.parse(port.partition("?")[0])
    if address.interface == "virtual" or address.channel.startswith("vcan"):
        return True
    return path_is_local(address.channel)


def dds_is_local(port: str) -> bool:
    """Return whether a network interface is the loopback."""
    from deal_hw.drivers.transports.interfaces import list_interfaces

    return any(one.loopback and port in (one.name, *one.addresses) for one in list_interfaces())


def zenoh_is_local(port: str) -> bool:
    """Return whether all end points are on this computer."""
    from deal_hw.drivers.transports.zenoh_session import parse_endpoints

    return all(end.loopback for end in parse_endpoints(port))


def _resolved(path: str) -> str:
    return os.path.realpath(path) if "/" in path else path
