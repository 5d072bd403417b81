"""What CAN adapters of every kind have in common: the address of a bus, and how trouble on it is told."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import ConfigurationError, TransportLostError, TransportTimeoutError, UnknownNameError
from deal_hw.transport import Transport

BITRATE: Final = 500_000
_SETTINGS: Final = (
    "bitrate", "node", "encoder", "mm_per_turn", "kv", "enable_watchdog", "watchdog_timeout",
)  # fmt: skip
NO_ACKNOWLEDGE: Final = (
    "no other node acknowledges: is the device powered, does it use this bit rate, are both ends of the bus "
    "terminated (60 ohm between CAN-H and CAN-L)?"
)
BUS_OFF: Final = (
    "the controller went bus-off after too many errors; check wiring, termination and bit rate. SocketCAN "
    "recovers by itself after `ip link set {channel} type can restart-ms 100`"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CanAddress:
    """Where a CAN device is, as in ``slcan:/dev/ttyACM0?bitrate=1000000&node=3``.

    Attributes:
        interface: Name of a python-can interface: "socketcan", "slcan", "virtual", "pcan", ...
        channel: The interface's name for the bus: "can0", a serial port.
        bitrate: Bits per second of the bus; socketcan's is set by ``ip link``.
        node: Number of the device on the bus; None: the driver's usual one.
        encoder: Number of a second device, the pole's encoder; None: the driver's usual one.
        mm_per_turn: Travel of the cart a turn of the motor [mm], for a motor drive.
        kv: Of the motor [rev/min/V], for a motor drive.
        enable_watchdog: Number of a motor drive's setting, as its firmware numbers them.
        watchdog_timeout: The same.
    """

    interface: str
    channel: str
    bitrate: int = BITRATE
    node: int | None = None
    encoder: int | None = None
    mm_per_turn: int | None = None
    kv: int | None = None
    enable_watchdog: int | None = None
    watchdog_timeout: int | None = None

    @classmethod
    def parse(cls, port: str) -> CanAddress:
        """Return what a port means. ``can0`` alone is socketcan, a path alone is slcan.

        Raises:
            ConfigurationError: It means nothing.
            UnknownNameError: A setting after ``?`` does not exist.
        """
        place, _, query = port.partition("?")
        interface, colon, channel = place.partition(":")
        if not colon:
            interface, channel = ("slcan" if "/" in place else "socketcan"), place
        if not interface or not channel:
            raise ConfigurationError(
                f"port {port!r}: a CAN port is INTERFACE:CHANNEL, such as socketcan:can0 or "
                "slcan:/dev/ttyACM0?bitrate=500000"
            )
        values: dict[str, int] = {}
        for name, value in parse_qsl(query, keep_blank_values=True):
            if name not in _SETTINGS:
                raise UnknownNameError("setting of a CAN port", name, _SETTINGS)
            least = 0 if name == "node" else 1
            if not value.isascii() or not value.isdigit() or not least <= int(value[:9]) <= 1_000_000:
                raise ConfigurationError(f"port {port!r}: {name} is a whole number, {least} to 1000000")
            values[name] = int(value)
        return cls(interface=interface, channel=channel, **values)


class CanTransport(Transport):
    """A CAN bus: a message is one classic frame, its channel the 11-bit id as three hex digits.

    Extended, remote and FD frames are foreign here and are not returned.

    Attributes:
        port: As it was given.
        address: What that means.
        error_frames: How often adapter or controller reported an error.
        trouble: What it last reported, in words; "" for nothing.

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

    @abc.abstractmethod
    def fileno(self) -> int:
        """Return a descriptor that a child process can inherit; -1: each process opens its own path."""

    def _bus_off(self) -> None:
        self._off = True
        self.trouble = BUS_OFF.format(channel=self.address.channel)

    def _report(self, trouble: str) -> None:
        self.error_frames += 1
        self.trouble = trouble

    def _check_bus(self) -> None:
        if self._off:
            raise TransportLostError(f"{self.port}: {self.trouble}")

    def _timeout(self, timeout_s: float) -> TransportTimeoutError:
        why = f"; the adapter reports: {self.trouble}" if self.trouble else ""
        return TransportTimeoutError(f"{self.port}: nothing arrived within {timeout_s:g} s{why}")
