"""Network interfaces of this machine, for options and messages that name one."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path

import psutil

from deal_hw.errors import PortNotFoundError


@dataclass(frozen=True, slots=True)
class Interface:
    """A network interface.

    Attributes:
        name: Such as ``eth0``.
        addresses: IPv4 addresses.
        up: Whether it is switched on.
        carrier: Whether the cable is plugged in and the other side is on.
        multicast: Whether it reports multicast; ``lo`` usually does not, although it can.
        loopback: Whether it reaches this machine only.
    """

    name: str
    addresses: tuple[str, ...]
    up: bool
    carrier: bool
    multicast: bool
    loopback: bool

    def __str__(self) -> str:
        state = "" if self.carrier else (" (no carrier)" if self.up else " (down)")
        return f"{self.name} {', '.join(self.addresses) or 'without an IPv4 address'}{state}"


def list_interfaces() -> tuple[Interface, ...]:
    """Return the interfaces of this machine."""
    addresses = _addresses()
    return tuple(
        _interface(name, set(state.flags.split(",")), addresses.get(name, ()))
        for name, state in psutil.net_if_stats().items()
    )


def find_interface(port: str) -> Interface:
    """Return the interface with a name or an IPv4 address.

    Raises:
        PortNotFoundError: There is none, it is switched off, or it has no IPv4 address.
    """
    interfaces = list_interfaces()
    for interface in interfaces:
        if port == interface.name or port in interface.addresses:
            break
    else:
        known = "; ".join(map(str, interfaces))
        raise PortNotFoundError(f"there is no network interface {port!r}; known interfaces: {known}")
    if not interface.up:
        raise PortNotFoundError(
            f"network interface {port!r} is switched off; ip link set {interface.name} up"
        )
    if not interface.addresses:
        raise PortNotFoundError(
            f"network interface {interface.name!r} has no IPv4 address; for the Go2's cable: "
            f"ip address add 192.168.123.99/24 dev {interface.name}"
        )
    return interface


def _interface(name: str, flags: Set[str], addresses: tuple[str, ...]) -> Interface:
    carrier = "running" in flags
    with contextlib.suppress(OSError):
        carrier = Path("/sys/class/net", name, "carrier").read_text().strip() == "1"
    return Interface(
        name=name,
        addresses=addresses,
        up="up" in flags,
        carrier=carrier,
        multicast="multicast" in flags,
        loopback="loopback" in flags,
    )


def _addresses() -> dict[str, tuple[str, ...]]:
    """Return the IPv4 addresses of each interface."""
    found: dict[str, tuple[str, ...]] = {}
    for label, addresses in psutil.net_if_addrs().items():
        # A second address of eth0 may stand under a label such as eth0:1.
        name = label.partition(":")[0]
        mine = (entry.address for entry in addresses if entry.family is socket.AF_INET)
        found[name] = (*found.get(name, ()), *mine)
    return found
