"""Common parts of all CAN adapters: the address of a bus, and the report of its errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl, urlencode

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import ConfigurationError, TransportLostError, TransportTimeoutError, UnknownNameError
from deal_hw.transport import Transport

BITRATE: Final = 500_000
_BITRATE: Final = "bitrate"
_MOST: Final = 1_000_000
NO_ACKNOWLEDGE: Final = (
    "no other node acknowledges: check the device's power, the bit rate, and the termination at both ends "
    "of the bus (60 ohm between CAN-H and CAN-L)"
)
BUS_OFF: Final = "the controller went bus-off after too many errors; check wiring, termination and bit rate."


@dataclass(frozen=True, slots=True, kw_only=True)
class CanAddress:
    """Where a CAN bus is, as in ``slcan:/dev/ttyACM0?bitrate=1000000``.

    Attributes:
        interface: Name of a python-can interface: "socketcan", "slcan", "virtual", "pcan", ...
        channel: The interface's name for the bus: "can0", a serial port.
        bitrate: Bits per second of the bus; socketcan's is set by ``ip link``.
    """

    interface: str
    channel: str
    bitrate: int = BITRATE

    @classmethod
    def parse(cls, port: str) -> CanAddress:
        """Return the address in a port. ``can0`` alone is socketcan, a path alone is slcan.

        Raises:
            ConfigurationError: The port is not valid.
            UnknownNameError: A setting after ``?`` does not exist.
        """
        place, values = take_settings(port, {_BITRATE: 1})
        interface, colon, channel = place.partition(":")
        if not colon:
            interface, channel = ("slcan" if "/" in place else "socketcan"), place
        if not interface or not channel:
            raise ConfigurationError(
                f"port {port!r}: a CAN port is INTERFACE:CHANNEL, such as socketcan:can0 or "
                "slcan:/dev/ttyACM0?bitrate=500000"
            )
        return cls(interface=interface, channel=channel, **values)


def take_settings(port: str, lowest: Mapping[str, int]) -> tuple[str, dict[str, int]]:
    """Take a driver's settings out of a port, such as ``node`` out of ``can0?bitrate=250000&node=3``.

    Args:
        port: As the user gave it.
        lowest: The settings by name, with the lowest value of each.

    Returns:
        The port without them, and the settings that were given.

    Raises:
        ConfigurationError: A value is no whole number of the allowed range.
        UnknownNameError: A setting is neither one of these nor one of the bus.
    """
    place, _, query = port.partition("?")
    allowed = tuple(dict.fromkeys((_BITRATE, *lowest)))
    taken: dict[str, int] = {}
    rest = []
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in allowed:
            raise UnknownNameError("setting of a CAN port", name, allowed)
        if name not in lowest:
            rest.append((name, value))
            continue
        if not value.isascii() or not value.isdigit() or not lowest[name] <= int(value[:9]) <= _MOST:
            raise ConfigurationError(f"port {port!r}: {name} is a whole number, {lowest[name]} to {_MOST}")
        taken[name] = int(value)
    return place + ("?" + urlencode(rest) if rest else ""), taken


class CanTransport(Transport):
    """A CAN bus: a message is one classic frame, its channel the 11-bit id as three hex digits.

    Extended, remote and FD frames are foreign here and are not returned.

    Attributes:
        port: As given by the user.
        address: Its parsed form.
        error_frames: Number of errors reported by adapter or controller.
        trouble: The last report, as text; "" for none.

    Args:
        port: See :meth:`CanAddress.parse`.
        clock: Gives the stamps.
        accept: Pairs of id and mask: frames with ``id & mask == wanted & mask`` are received; none: all.
    """

    def __init__(self, port: str, clock: Clock | None = None, accept: Sequence[tuple[int, int]] = ()) -> None:
        self.port = port
        self.address = CanAddress.parse(port)
        self.error_frames = 0
        self.trouble = ""
        self._accept = tuple(accept)
        self._clock = clock or MonotonicClock()
        self._off = False

    def _bus_off(self) -> None:
        self._off = True
        self.trouble = f"{BUS_OFF} {self._bus_off_remedy}"

    @property
    def _bus_off_remedy(self) -> str:
        """What brings this kind of adapter back, or what its bus-off says of the bit rate."""
        if self.address.interface == "socketcan":
            return f"It restarts by itself after `ip link set {self.address.channel} type can restart-ms 100`"
        return (
            f"The adapter runs at {self.address.bitrate} bit/s: another rate of the bus looks the same, and "
            f"is given as {self.address.interface}:{self.address.channel}?bitrate=RATE"
        )

    def _report(self, trouble: str) -> None:
        self.error_frames += 1
        self.trouble = trouble

    def _check_bus(self) -> None:
        if self._off:
            raise TransportLostError(f"{self.port}: {self.trouble}")

    def _timeout(self, timeout_s: float) -> TransportTimeoutError:
        why = f"; the adapter reports: {self.trouble}" if self.trouble else ""
        return TransportTimeoutError(f"{self.port}: nothing arrived within {timeout_s:g} s{why}")
