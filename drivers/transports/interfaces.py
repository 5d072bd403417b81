"""Network interfaces of this machine, for options and messages that name one."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil

from deal_hw.errors import PortNotFoundError

_INTERFACES: Final = Path("/sys/class/net")
_FLAG_BITS: Final = {"up": 0x1, "loopback": 0x8, "multicast": 0x1000}
"""Bits of an interface's file ``flags`` (IFF_UP, IFF_LOOPBACK and IFF_MULTICAST in Linux's if.h)."""


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
    return tuple(_interface(name, flags, addresses.get(name, ())) for name, flags in _flags().items())


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
        carrier = (_INTERFACES / name / "carrier").read_text().strip() == "1"
    return Interface(
        name=name,
        addresses=addresses,
        up="up" in flags,
        carrier=carrier,
        multicast="multicast" in flags,
        loopback="loopback" in flags,
    )


def _flags() -> dict[str, set[str]]:
    """Return the flags of each interface, by psutil's names."""
    try:
        return {name: set(state.flags.split(",")) for name, state in psutil.net_if_stats().items()}
    except OSError:
        # psutil also asks for the speed, and QEMU's user-mode emulation of ARM has no answer to that.
        folders = sorted(_INTERFACES.iterdir())
        bits = {folder.name: int((folder / "flags").read_text(), 16) for folder in folders}
        return {name: {flag for flag, bit in _FLAG_BITS.items() if bit & own} for name, own in bits.items()}


def _addresses() -> dict[str, tuple[str, ...]]:
    """Return the IPv4 addresses of each interface."""
    found: dict[str, tuple[str, ...]] = {}
    for label, addresses in psutil.net_if_addrs().items():
        # A second address of eth0 may stand under a label such as eth0:1.
        name = label.partition(":")[0]
        mine = (entry.address for entry in addresses if entry.family is socket.AF_INET)
        found[name] = (*found.get(name, ()), *mine)
    return found
