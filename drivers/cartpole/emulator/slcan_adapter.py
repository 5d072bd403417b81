"""An emulated serial CAN adapter (slcan), its bus and the devices on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from deal_hw.drivers.cartpole.chips.device import EmulatedDevice
from deal_hw.drivers.cartpole.emulator.faults import CanFaults
from deal_hw.drivers.cartpole.wire.can_link import FRAME, REMOTE
from deal_hw.drivers.transports.slcan_transport import (
    BITRATES,
    BUS_ERROR,
    END,
    PASSIVE,
    REFUSED,
    TX_FULL,
    WARNING,
    LineReader,
    decode_line,
    decode_remote_line,
    encode_line,
    is_extended_line,
)

_BUFFERED: Final = 3
"""Most frames waiting in the adapter while the first is not acknowledged."""


class SlcanAdapter:
    """The adapter, the bus and the devices on it, as one device; its bytes are the adapter's characters.

    Args:
        devices: Devices on the bus, whose bytes are frames in the layout of :data:`FRAME`; the first is the
            cart-pole itself.
        faults: Faults of the bus.
    """

    def __init__(self, devices: Sequence[EmulatedDevice], faults: CanFaults) -> None:
        self._devices = devices
        self._faults = faults
        self._reader = LineReader()
        self._answers = b""
        self._bitrate: bytes | None = None
        self._is_open = False
        self._armed_ns: int | None = None
        self._bus_off = False
        self._waiting = 0

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        return self._devices[0].device_ns

    @property
    def received_bytes(self) -> int:
        """Bytes of the frames from the host that reached a device; not the adapter's own commands."""
        return sum(device.received_bytes for device in self._devices)

    @property
    def armed(self) -> bool:
        """Whether the motor follows targets."""
        return self._devices[0].armed

    @property
    def mode(self) -> str:
        """State of the motor."""
        return self._devices[0].mode

    @property
    def watchdog(self) -> bool:
        """Whether the motor was stopped by missing commands."""
        return self._devices[0].watchdog

    @property
    def trouble(self) -> str:
        """Current fault of the bus."""
        if self._driven_off:
            return "bus-off"
        if self._full:
            return "transmit buffer full"
        return "node lost" if self._during(self._faults.lost_node_after_s, float("inf")) else ""

    def receive(self, data: bytes) -> None:
        """Take characters from the host; frames reach the devices in their next tick."""
        for line in self._reader.feed(data):
            self._answers += self._answer(line)

    def advance_to(self, device_ns: int) -> bytes:
        """Run every tick up to a device time [ns]; return the characters sent meanwhile."""
        answers, self._answers = self._answers, b""
        sent = [device.advance_to(device_ns) for device in self._devices]
        if self._armed_ns is None and self.armed:
            self._armed_ns = device_ns
        self._bus_off |= self._driven_off
        if not self._hears:
            return answers
        lines = [[_line(f) for f in FRAME.iter_unpack(frames)] for frames in sent]
        # Two devices with one number corrupt each other's messages.
        longest = max(map(len, lines))
        return answers + b"".join(own[k] for k in range(longest) for own in lines if k < len(own))

    def tick(self) -> bytes:
        """Run one tick; return the characters sent in it."""
        return self.advance_to(self.device_ns)

    def _answer(self, line: bytes) -> bytes:
        match line[:1]:
            case b"t" | b"r" | b"T" | b"R":
                return self._send(line)
            case b"S":
                self._bitrate = line
            case b"O" | b"L":
                self._is_open = True
            case b"C":
                self._is_open = False
                # Closing and opening helps only after the cause of the bus-off is over.
                self._bus_off = self._driven_off
                self._waiting = 0
            case b"F":
                return b"F%02X" % self._flags() + END
            case b"V":
                return b"V1013" + END
            case b"N":
                return b"NEMUL" + END
            case b"":
                pass
            case _:
                return REFUSED
        return END

    def _send(self, line: bytes) -> bytes:
        frame = _frame(line)
        if frame is None or not self._is_open or self._bus_off or self._full:
            return REFUSED
        sent = (b"z" if line[:1] in (b"t", b"r") else b"Z") + END
        if not self._acknowledged:
            self._waiting += 1
            return sent if self._waiting <= _BUFFERED else REFUSED
        for device in self._devices:
            device.receive(frame)
        return sent

    def _flags(self) -> int:
        if self._bus_off or not self._right_bitrate:
            return BUS_ERROR | PASSIVE
        if self._full:
            return TX_FULL
        return 0 if self._acknowledged else WARNING | BUS_ERROR

    @property
    def _hears(self) -> bool:
        return self._is_open and not self._bus_off and self._acknowledged

    @property
    def _acknowledged(self) -> bool:
        lost = self._during(self._faults.lost_node_after_s, float("inf"))
        return self._right_bitrate and not lost and not self._faults.no_acknowledge

    @property
    def _driven_off(self) -> bool:
        return self._during(self._faults.bus_off_after_s, self._faults.bus_off_s)

    @property
    def _full(self) -> bool:
        return self._during(self._faults.tx_full_after_s, self._faults.tx_full_s)

    @property
    def _right_bitrate(self) -> bool:
        return self._bitrate == BITRATES[self._faults.bitrate]

    def _during(self, after_s: float | None, length_s: float) -> bool:
        if after_s is None or self._armed_ns is None:
            return False
        return after_s < (self.device_ns - self._armed_ns) / 1e9 <= after_s + length_s


def _frame(line: bytes) -> bytes | None:
    """Return the frame of a line for the devices, empty for one with a 29-bit id: no device here has one."""
    if (data := decode_line(line)) is not None:
        return FRAME.pack(data[0], len(data[1]), data[1])
    if (remote := decode_remote_line(line)) is not None:
        return FRAME.pack(remote[0] | REMOTE, remote[1], b"")
    return b"" if is_extended_line(line) else None


def _line(frame: tuple[int, int, bytes]) -> bytes:
    return encode_line(f"{frame[0]:03X}", frame[2][: frame[1]])
