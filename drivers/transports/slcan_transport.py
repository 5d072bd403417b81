"""CAN frames over a serial adapter that speaks slcan (Lawicel): CANable, CANtact, USBtin, Arduino bridges.

python-can has an slcan bus, too, but a process with deadlines cannot use it. It reads byte by byte, hides the
adapter's refusals, and stops reading after one byte above 0x7F. It may wait in a write. It neither locks the
port nor uses one that a parent process opened. So this module reads the ASCII lines itself, over our serial
port.
"""

from __future__ import annotations

import contextlib
import re
from collections import deque
from collections.abc import Sequence
from typing import Final

from serial.tools import list_ports

from deal_hw.clock import Clock
from deal_hw.drivers.transports.can_bus import NO_ACKNOWLEDGE, CanTransport
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import ConfigurationError, TransportTimeoutError
from deal_hw.transport import Message, Transport

BITRATES: Final = {
    10_000: b"S0",
    20_000: b"S1",
    50_000: b"S2",
    100_000: b"S3",
    125_000: b"S4",
    250_000: b"S5",
    500_000: b"S6",
    800_000: b"S7",
    1_000_000: b"S8",
}
TTY_BAUD_RATE: Final = 1_000_000
"""Baud rate of adapters behind a real UART; over USB it has no effect."""
END: Final = b"\r"
REFUSED: Final = b"\a"
LONGEST_LINE: Final = 40
"""An extended frame of 8 bytes with a time stamp has 31 characters; longer lines are invalid."""
USB_ADAPTERS: Final = {
    (0xAD50, 0x60C4): "CANable or CANtact (slcan)",
    (0x16D0, 0x117E): "CANable 2 (slcan)",
    (0x04D8, 0x000A): "USBtin (slcan)",
}
"""USB vendor and product of adapters that speak slcan."""
TX_FULL, WARNING, PASSIVE, BUS_ERROR = 0x02, 0x04, 0x20, 0x80
"""Used bits of the adapter's answer to F."""
_SILENCE_NS = 100_000_000
"""After this silence another process may have left half a line in the adapter, so it is ended first [ns]."""
_LINE = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")
_REMOTE_LINE = re.compile(rb"r([0-7][0-9A-Fa-f]{2})([0-8])")
_EXTENDED_LINE = re.compile(rb"[TR]([01][0-9A-Fa-f]{7})([0-8])((?:[0-9A-Fa-f]{2})*)")
_FLAGS = re.compile(rb"F([0-9A-Fa-f]{2})")


def serial_adapters() -> list[tuple[str, str]]:
    """Return this computer's serial CAN adapters: port and kind."""
    found = ((port.device, USB_ADAPTERS.get((port.vid, port.pid))) for port in list_ports.comports())
    return [(device, kind) for device, kind in found if kind is not None]


def encode_line(channel: str, payload: bytes) -> bytes:
    """Return a data frame as a line for the adapter.

    Args:
        channel: The id as hex digits.
        payload: 0 to 8 bytes.
    """
    return b"t%03X%d" % (int(channel, 16), len(payload)) + payload.hex().upper().encode() + END


def decode_line(line: bytes) -> tuple[int, bytes] | None:
    """Return id and data of a line without its end; None if it is no whole data frame with an 11-bit id.

    Two bytes beyond the length are the adapter's time stamp. It is not used: it counts whole milliseconds,
    and the time of reading is as good.
    """
    if (match := _LINE.fullmatch(line)) is None:
        return None
    data, length = bytes.fromhex(match[3].decode()), int(match[2])
    return (int(match[1], 16), data[:length]) if len(data) in (length, length + 2) else None


def decode_remote_line(line: bytes) -> tuple[int, int] | None:
    """Return id and length of a line without its end; None if it is no remote frame with an 11-bit id."""
    match = _REMOTE_LINE.fullmatch(line)
    return None if match is None else (int(match[1], 16), int(match[2]))


def is_extended_line(line: bytes) -> bool:
    """Whether a line without its end is a whole frame with a 29-bit id."""
    match = _EXTENDED_LINE.fullmatch(line)
    return match is not None and len(match[3]) == (2 * int(match[2]) if line[:1] == b"T" else 0)


class LineReader:
    """Cuts the adapter's characters into lines, and skips invalid characters.

    Attributes:
        errors: Overlong lines so far.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._rest = b""
        self._overrun = False

    def feed(self, data: bytes) -> list[bytes]:
        """Take characters; return completed lines, without their ends. A refusal is a line, too."""
        *lines, rest = (self._rest + data).replace(REFUSED, REFUSED + END).split(END)
        if lines and self._overrun:
            self._overrun = False
            self.errors += 1
            del lines[0]
        if len(rest) > LONGEST_LINE:
            self._overrun, rest = True, b""
        self._rest = rest
        return lines


class SlcanTransport(CanTransport):
    """A serial CAN adapter.

    The adapter filters nothing, so this class drops foreign frames by their id, before it reads their data.
    Frames are stamped when they are read. After a refusal the adapter's error flags are requested.

    Attributes:
        refused: Number of frames that the adapter refused to send.
        garbled: Number of lines that were no whole frame, from the first whole line on.

    Args:
        port: Such as ``slcan:/dev/ttyACM0``.
        clock: Gives the stamps.
        accept: See :class:`CanTransport`.
        fd: Descriptor of an adapter that a parent process opened and set up; it is closed by ``close``, and
            the adapter's bus stays open.
        serial: The serial port; made from ``port`` by default.

    Raises:
        ConfigurationError: slcan has no such bit rate.
    """

    def __init__(
        self,
        port: str,
        clock: Clock | None = None,
        accept: Sequence[tuple[int, int]] = (),
        fd: int | None = None,
        serial: Transport | None = None,
    ) -> None:
        super().__init__(port, clock, accept)
        if self.address.bitrate not in BITRATES:
            raise ConfigurationError(
                f"{port}: slcan has no bit rate {self.address.bitrate}; choose one of "
                f"{', '.join(map(str, BITRATES))}"
            )
        path = self.address.channel
        self._serial: Transport
        if serial is not None:
            self._serial = serial
        elif fd is None:
            self._serial = SerialTransport(path, TTY_BAUD_RATE, self._clock)
        else:
            self._serial = SerialTransport.from_fd(fd, self._clock, path)
        self._owned = fd is None
        self.refused = self.garbled = 0
        self._is_open = self._in_step = self._full = False
        self._forget()

    def open(self) -> None:
        """Open the port, set the bit rate and open the adapter's bus; an inherited one is open already."""
        if self._is_open:
            return
        self._serial.open()
        self._forget()
        self._is_open = True
        if self._owned:
            self._set_up()

    def close(self) -> None:
        """Close the port; the adapter's bus, too, where this process opened it."""
        if self._is_open and self._owned:
            with contextlib.suppress(ConnectionError):
                self._serial.send(Message("", b"\rC\r", 0))
        self._is_open = False
        self._serial.close()

    def reopen(self) -> None:
        """Open the port again if the adapter vanished; if it is bus-off, close and open its bus."""
        before = self._serial.fileno() if self._is_open else -1
        self._serial.reopen()
        if self._off or self._serial.fileno() != before:
            self._forget()
            self._is_open = True
            self._set_up()

    def send(self, message: Message) -> None:
        """Write one line at once."""
        self._check_bus()
        if self._full:
            self._full = False
            raise TransportTimeoutError(f"{self.port}: the transmit buffer is full; {NO_ACKNOWLEDGE}")
        self._write(encode_line(message.channel, message.payload))

    def receive(self, timeout_s: float) -> Message:
        """Return the next accepted frame."""
        deadline_ns = self._clock.now_ns() + round(max(0.0, timeout_s) * 1e9)
        while not self._frames:
            self._check_bus()
            left_s = max(0, deadline_ns - self._clock.now_ns()) / 1e9
            try:
                self._take(self._serial.receive(left_s))
            except TransportTimeoutError:
                raise self._timeout(timeout_s) from None
        return self._frames.popleft()

    def fileno(self) -> int:
        """Return the descriptor of the serial port."""
        return self._serial.fileno()

    def _forget(self) -> None:
        self._reader = LineReader()
        self._frames: deque[Message] = deque()
        self._is_open = self._in_step = self._off = self._full = False
        self._torn = True
        self._written_ns = self._asked_ns = -_SILENCE_NS
        self.trouble = ""

    def _set_up(self) -> None:
        self._write(b"C\r" + BITRATES[self.address.bitrate] + b"\rO\r")

    def _write(self, data: bytes) -> None:
        now_ns = self._clock.now_ns()
        begin = END if self._torn or now_ns - self._written_ns > _SILENCE_NS else b""
        self._torn = True
        self._serial.send(Message("", begin + data, now_ns))
        self._torn, self._written_ns = False, now_ns

    def _take(self, message: Message) -> None:
        for line in self._reader.feed(message.payload):
            if line[:1] == b"t":
                self._in_step = True
                self._take_frame(line, message.stamp_ns)
            elif line == REFUSED:
                self._take_refusal(message.stamp_ns)
            elif (flags := _FLAGS.fullmatch(line)) is not None:
                self._take_flags(int(flags[1], 16))
            elif line[:1] not in (b"", b"z", b"Z", b"T", b"r", b"R", b"V", b"v", b"N") and self._in_step:
                self.garbled += 1
        self.garbled += self._reader.errors
        self._reader.errors = 0

    def _take_frame(self, line: bytes, stamp_ns: int) -> None:
        frame = decode_line(line)
        if frame is None:
            self.garbled += 1
        elif not self._accept or any((frame[0] ^ wanted) & mask == 0 for wanted, mask in self._accept):
            self._frames.append(Message(f"{frame[0]:03X}", frame[1], stamp_ns))

    def _take_refusal(self, now_ns: int) -> None:
        self.refused += 1
        self._report("it refuses to send a frame")
        if now_ns - self._asked_ns > _SILENCE_NS:
            self._asked_ns = now_ns
            with contextlib.suppress(ConnectionError):
                self._write(b"F\r")

    def _take_flags(self, flags: int) -> None:
        if flags & BUS_ERROR and flags & PASSIVE:
            self._bus_off()
        elif flags & TX_FULL:
            self._full = True
            self.trouble = "its transmit buffer is full"
        elif flags & (BUS_ERROR | PASSIVE | WARNING):
            self._report(NO_ACKNOWLEDGE)
