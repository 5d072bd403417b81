"""Network interfaces of this machine, for options and messages that name one."""

from __future__ import annotations

import array
import contextlib
import fcntl
import socket
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from deal_hw.errors import PortNotFoundError

_SIOCGIFCONF: Final = 0x8912
_SIOCGIFFLAGS: Final = 0x8913
_IFF_UP, _IFF_LOOPBACK, _IFF_RUNNING, _IFF_MULTICAST = 0x1, 0x8, 0x40, 0x1000
_IFREQ_BYTES: Final = 40
"""Size of the kernel's ``struct ifreq`` where pointers have 64 bits."""


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
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        addresses = _addresses(probe)
        found = []
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):  # It vanished after it was listed.
                found.append(_interface(probe, name, addresses.get(name, ())))
    return tuple(found)


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


def _interface(probe: socket.socket, name: str, addresses: tuple[str, ...]) -> Interface:
    request = struct.pack("16s24x", name.encode())
    (flags,) = struct.unpack_from("H", fcntl.ioctl(probe, _SIOCGIFFLAGS, request), 16)
    carrier = bool(flags & _IFF_RUNNING)
    with contextlib.suppress(OSError):
        carrier = Path("/sys/class/net", name, "carrier").read_text().strip() == "1"
    return Interface(
        name=name,
        addresses=addresses,
        up=bool(flags & _IFF_UP),
        carrier=carrier,
        multicast=bool(flags & _IFF_MULTICAST),
        loopback=bool(flags & _IFF_LOOPBACK),
    )


def _addresses(probe: socket.socket) -> dict[str, tuple[str, ...]]:
    room = array.array("B", bytes(_IFREQ_BYTES * 256))
    place, length = room.buffer_info()
    answer = fcntl.ioctl(probe, _SIOCGIFCONF, struct.pack("iP", length, place))
    (used,) = struct.unpack_from("i", answer)
    found: dict[str, tuple[str, ...]] = {}
    for start in range(0, used, _IFREQ_BYTES):
        entry = room[start : start + _IFREQ_BYTES].tobytes()
        # A second address of eth0 may stand under a label such as eth0:1.
        name = entry[:16].split(b"\0")[0].decode().partition(":")[0]
        found[name] = (*found.get(name, ()), socket.inet_ntoa(entry[20:24]))
    return found
