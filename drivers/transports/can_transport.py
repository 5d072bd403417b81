"""CAN frames through the adapters that python-can drives, and the choice of an adapter by its port."""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

from deal_hw.clock import Clock
from deal_hw.drivers.transports.can_bus import BITRATE, NO_ACKNOWLEDGE, CanAddress, CanTransport
from deal_hw.drivers.transports.slcan_transport import SlcanTransport
from deal_hw.errors import (
    ConfigurationError,
    MissingExtraError,
    PortNotFoundError,
    TransportError,
    TransportLostError,
    TransportTimeoutError,
    UnknownNameError,
)
from deal_hw.transport import Message

if TYPE_CHECKING:
    import can

_NOT_SET_HERE: Final = ("socketcan", "virtual", "udp_multicast")
"""Interfaces whose bit rate the system sets (``ip link``), or that have none."""
_CAN_LINK: Final = "280"
"""Type of a CAN interface in /sys/class/net (ARPHRD_CAN)."""


def open_can(
    port: str, clock: Clock | None = None, accept: Sequence[tuple[int, int]] = (), fd: int | None = None
) -> CanTransport:
    """Return a transport for a port; it is not opened yet.

    Args:
        port: See :meth:`CanAddress.parse`.
        clock: Gives the stamps.
        accept: See :class:`CanTransport`.
        fd: Descriptor of a serial adapter that a parent process opened and set up.

    Raises:
        ConfigurationError: The port is not valid.
    """
    if CanAddress.parse(port).interface == "slcan":
        return SlcanTransport(port, clock, accept, fd=fd)
    return PythonCanTransport(port, clock, accept)


def adopt_can(fd: int, clock: Clock | None = None, port: str = "") -> CanTransport:
    """Return a transport over the descriptor of a serial adapter that a parent process opened."""
    return open_can(port, clock, fd=fd)


class PythonCanTransport(CanTransport):
    """An adapter that python-can drives: socketcan, virtual, pcan, kvaser and others.

    The adapter stamps frames by the wall clock. The age of a stamp, by the wall clock, is subtracted from our
    clock. A stamp that is older than ``oldest_stamp_s`` or in the future is replaced by the time of reading:
    the wall clock was set, or the adapter counts from its power-on. Stamps never go back.

    Args:
        port: See :meth:`CanAddress.parse`.
        clock: Gives the stamps.
        accept: See :class:`CanTransport`; the kernel or the adapter filters where it can.
        wall_ns: The clock of the adapter's stamps [ns].
        oldest_stamp_s: Largest age of a stamp that is used [s]: longer than a frame waits in a buffer.
    """

    def __init__(
        self,
        port: str,
        clock: Clock | None = None,
        accept: Sequence[tuple[int, int]] = (),
        wall_ns: Callable[[], int] = time.time_ns,
        oldest_stamp_s: float = 1.0,
    ) -> None:
        super().__init__(port, clock, accept)
        self._wall_ns, self._oldest_ns = wall_ns, round(oldest_stamp_s * 1e9)
        self._bus: can.BusABC | None = None
        self._lost = False
        self._last_ns = 0

    def open(self) -> None:
        """Open the bus.

        Raises:
            MissingExtraError: python-can is not installed.
            PortNotFoundError: The adapter is missing, or its interface is down.
            UnknownNameError: python-can has no such interface.
        """
        if self._bus is None:
            self._bus = self._open_bus()
            self._off, self._lost, self.trouble = False, False, ""

    def close(self) -> None:
        """Close the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(_python_can().CanError, OSError):
                bus.shutdown()

    def reopen(self) -> None:
        """Open the bus again if it was lost or went bus-off; do nothing if it works.

        A socket of an adapter that was pulled out stays dead when the adapter is back. The old bus is closed
        first, because many adapters can be opened only once.
        """
        if self._off or self._lost:
            self.close()
        self.open()

    def fileno(self) -> int:
        """Return -1: python-can cannot use an inherited descriptor."""
        return -1

    def send(self, message: Message) -> None:
        """Give a frame to the adapter; never waits: a full transmit buffer is an error."""
        self._check_bus()
        python_can = _python_can()
        frame: can.Message = python_can.Message(
            arbitration_id=int(message.channel, 16), is_extended_id=False, data=message.payload, check=True
        )
        try:
            self._open_or_raise().send(frame, timeout=0)
        except (python_can.CanError, OSError) as error:
            raise self._failed(error) from error

    def receive(self, timeout_s: float) -> Message:
        """Return the next data frame."""
        bus = self._open_or_raise()
        errors = (_python_can().CanError, OSError)
        deadline_ns = self._clock.now_ns() + round(max(0.0, timeout_s) * 1e9)
        while True:
            self._check_bus()
            left_s = max(0, deadline_ns - self._clock.now_ns()) / 1e9
            try:
                frame = bus.recv(left_s)
            except errors as error:
                raise self._failed(error) from error
            if frame is None:
                raise self._timeout(timeout_s)
            if frame.is_error_frame:
                self._take_error(frame)
            elif not frame.is_rx and self.address.interface != "socketcan":
                continue  # An adapter's echo of our own frame; with socketcan, another program here.
            elif not (frame.is_extended_id or frame.is_remote_frame or frame.is_fd):
                return Message(f"{frame.arbitration_id:03X}", bytes(frame.data), self._stamp(frame.timestamp))

    def _stamp(self, adapter_s: float) -> int:
        now_ns = self._clock.now_ns()
        age_ns = self._wall_ns() - round(adapter_s * 1e9)
        stamp_ns = now_ns - age_ns if 0 <= age_ns <= self._oldest_ns else now_ns
        self._last_ns = max(self._last_ns, stamp_ns)
        return self._last_ns

    def _take_error(self, frame: can.Message) -> None:
        """Read an error frame as linux/can/error.h lays it out."""
        kind, controller = frame.arbitration_id, (bytes(frame.data) + bytes(2))[1]
        if kind & 0x040:
            self._report("")
            self._bus_off()
        elif kind & 0x020:
            self._report(NO_ACKNOWLEDGE)
        elif kind & 0x004 and controller & 0x03:
            side = "receive" if controller & 0x01 else "transmit"
            self._report(f"the adapter's {side} buffer overflowed: frames are lost")
        elif kind & 0x004 and controller & 0x30:
            self._report("the controller is error-passive: many frames fail; check wiring and termination")
        elif kind & 0x100 or (kind & 0x004 and controller & 0x40):
            # The controller was restarted, or works without errors again.
            self.trouble = ""
        else:
            self._report(f"bus error (class 0x{kind:03x}); check wiring, termination and bit rate")

    def _open_or_raise(self) -> can.BusABC:
        if self._bus is None:
            raise TransportLostError(f"{self.port}: the bus is not open")
        return self._bus

    def _open_bus(self) -> can.BusABC:
        python_can = _python_can()
        name, channel = self.address.interface, self.address.channel
        if name not in python_can.VALID_INTERFACES:
            raise UnknownNameError("CAN interface", name, sorted(python_can.VALID_INTERFACES))
        if name == "socketcan":
            check_link(channel)
        settings: dict[str, Any] = {} if name in _NOT_SET_HERE else {"bitrate": self.address.bitrate}
        filters: list[Any] = [{"can_id": i, "can_mask": m, "extended": False} for i, m in self._accept]
        try:
            bus: can.BusABC = python_can.Bus(
                interface=name, channel=channel, can_filters=filters or None, ignore_config=True, **settings
            )
        except ValueError as error:
            raise ConfigurationError(f"{self.port}: {error}") from error
        except (python_can.CanError, OSError, ImportError) as error:
            if getattr(error, "errno", None) == errno.EAFNOSUPPORT:
                raise PortNotFoundError(
                    f"{self.port}: this kernel has no CAN (containers often have none); load the modules "
                    "can, can_raw and the adapter's, or use a serial adapter: slcan:/dev/ttyACM0"
                ) from error
            raise PortNotFoundError(
                f"{self.port} cannot be opened: {error}; check that the adapter is plugged in, and its "
                "driver installed"
            ) from error
        return bus

    def _failed(self, error: Exception) -> TransportError:
        code = getattr(error, "error_code", None) or getattr(error, "errno", None)
        if code == errno.ENOBUFS or "buffer full" in str(error):
            why = f" (the adapter reports: {self.trouble})" if self.trouble else f"; {NO_ACKNOWLEDGE}"
            return TransportTimeoutError(f"{self.port}: the transmit buffer is full{why}")
        self._lost = True
        return TransportLostError(
            f"{self.port}: the bus is lost ({error}); check that the adapter is plugged in, and that `ip "
            "link` shows it up"
        )


def _python_can() -> ModuleType:
    """Return python-can, which an adapter on a serial port (slcan) does not need."""
    try:
        import can
    except ImportError as error:
        raise MissingExtraError("python-can", "can") from error
    return can


def can_links(root: Path = Path("/sys/class/net")) -> list[str]:
    """Return the names of this computer's CAN network interfaces."""
    found = []
    for link in sorted(root.iterdir()) if root.is_dir() else ():
        with contextlib.suppress(OSError):
            if (link / "type").read_text().strip() == _CAN_LINK:
                found.append(link.name)
    return found


def check_link(name: str, root: Path = Path("/sys/class/net")) -> None:
    """Refuse a CAN network interface that is not there or not up.

    Raises:
        PortNotFoundError: It is missing or down; the text has the command that sets it up.
    """
    if name not in can_links(root):
        at_hand = ", ".join(can_links(root)) or "none"
        raise PortNotFoundError(
            f"there is no CAN interface {name!r}; at hand: {at_hand}. A serial adapter is given as "
            "slcan:/dev/ttyACM0"
        )
    if not int((root / name / "flags").read_text(), 16) & 1:
        raise PortNotFoundError(
            f"the CAN interface {name!r} is down; set it up: ip link set {name} up type can bitrate "
            f"{BITRATE} restart-ms 100"
        )
