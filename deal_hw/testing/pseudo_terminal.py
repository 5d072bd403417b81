"""A device in virtual time behind a pseudo-terminal in real time, with faults of its port."""

from __future__ import annotations

import contextlib
import os
import select
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import ConfigurationError
from deal_hw.testing.faults import FrameFaults

STALL_NS = 50_000_000
"""If the process is behind by more than this, device time stands still instead of catching up."""

_MOST_CHANGES = 2000


class SteppedDevice(Protocol):
    """A device in virtual device time: bytes in, bytes out. It also fits a ``VirtualTransport``."""

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        ...

    @property
    def armed(self) -> bool:
        """Whether the motor follows commands; times of faults count from its first moment."""
        ...

    @property
    def mode(self) -> str:
        """State of the motor, one word."""
        ...

    @property
    def watchdog(self) -> bool:
        """Whether the device stopped its motor because no commands came."""
        ...

    @property
    def trouble(self) -> str:
        """Current fault; "" for none."""
        ...

    @property
    def received_bytes(self) -> int:
        """Number of bytes from the host."""
        ...

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        ...

    def advance_to(self, device_ns: int) -> bytes:
        """Run every tick up to and including a time [ns]; return the bytes sent meanwhile."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PortFaults:
    """Faults of a pseudo-terminal and of the device's firmware. Times count from the first arming.

    Attributes:
        freeze_after_s: The firmware hangs: it sends and receives nothing any more [s]; None for never.
        cut_after_s: The wire is cut: nothing is sent or received, but the firmware runs on [s]; None for
            never.
        cut_s: Duration of the cut [s].
        vanish_after_s: The port disappears as if unplugged, but the firmware runs on [s]; None for never.
        return_after_s: Time after that until it returns, as a new port under the same link [s]; None: it does
            not return, and the emulator ends.
        faults: What happens to frames from the device.
    """

    freeze_after_s: float | None = None
    cut_after_s: float | None = None
    cut_s: float = 1.0
    vanish_after_s: float | None = None
    return_after_s: float | None = None
    faults: FrameFaults | None = None


class PseudoTerminal:
    """Runs a device core behind a pty; device time follows the clock.

    A host may close the port and open it again. Frames that nobody reads are dropped, as on a UART.

    Attributes:
        slips: How often this process stalled and device time stood still.
        dropped: Number of writes that the full buffer did not take.
        changes: Changes of the motor and the port, the first 2000: device ms, host ns, and a mode of the
            device, "frozen", "cut", "gone" or "back", or the fault of a bus.

    Args:
        device: The device.
        link: A symbolic link to make to the port; None for none.
        hazards: Faults to make.
        clock: Real time.
        port: Turns the path into the host's ``--port``.
    """

    def __init__(
        self,
        device: SteppedDevice,
        link: Path | None = None,
        hazards: PortFaults | None = None,
        clock: Clock | None = None,
        port: Callable[[str], str] = str,
    ) -> None:
        self.slips = 0
        self.dropped = 0
        self._device = device
        self._port = port
        self._link = link
        self._hazards = hazards or PortFaults()
        self._clock = clock or MonotonicClock()
        self._master = self._slave = -1
        self._origin_ns = 0
        self._unsent = b""
        self._armed_ns: int | None = None
        self._cut_after_s, self._vanish_after_s = self._hazards.cut_after_s, self._hazards.vanish_after_s
        self._freeze_after_s, self._frozen = self._hazards.freeze_after_s, False
        self._cut_end_ns, self._gone_ns = 0, -1
        self.changes: list[tuple[int, int, str]] = []
        self._mode, self._trouble = device.mode, ""

    def open(self) -> str:
        """Make the pty; return the host's ``--port``."""
        self._origin_ns = self._clock.now_ns() - self._device.device_ns
        return self._open_port()

    def _open_port(self) -> str:
        self._master, self._slave = os.openpty()
        # Our own copy of the slave keeps the pair alive while no host has it open.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        port = os.ttyname(self._slave)
        if self._link is not None:
            if self._link.is_symlink():
                self._link.unlink()
            elif self._link.exists():
                self.close()
                raise ConfigurationError(
                    f"{self._link} exists and is not a symbolic link; choose another --link"
                )
            self._link.symlink_to(port)
        return self._port(port if self._link is None else str(self._link))

    def close(self) -> None:
        """Remove the pty and the link."""
        for fd in (self._master, self._slave):
            if fd >= 0:
                with contextlib.suppress(OSError):
                    os.close(fd)
        self._master = self._slave = -1
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def step(self, wait_s: float = 0.002) -> bool:
        """Wait for bytes or for the next tick, at most ``wait_s``, then let the device catch up.

        Returns:
            Whether the port exists; False once it has vanished.
        """
        next_tick_ns = self._origin_ns + self._device.device_ns
        wait_s = min(wait_s, max(0, next_tick_ns - self._clock.now_ns()) / 1e9)
        data = self._read(wait_s)
        now_ns = self._clock.now_ns()
        late_ns = now_ns - self._origin_ns - self._device.device_ns
        if late_ns > STALL_NS:
            # If it caught up, the device's watchdog would see a silence that the host did not cause.
            self._origin_ns += late_ns
            self.slips += 1
        armed_s = 0.0 if self._armed_ns is None else (now_ns - self._armed_ns) / 1e9
        if not self._have_port(now_ns, armed_s):
            return False
        if _passed(self._cut_after_s, armed_s):
            self._cut_after_s = None
            self.cut()
        silent = self._gone_ns >= 0 or now_ns < self._cut_end_ns
        out = self._device.advance_to(now_ns - self._origin_ns)
        self._follow(now_ns)
        if _passed(self._freeze_after_s, armed_s):
            self._freeze_after_s, self._frozen = None, True
            self._note(now_ns, "frozen")
        if silent or self._frozen:
            return True
        self._device.receive(data)
        if self._armed_ns is None and self._device.armed:
            self._armed_ns = now_ns
        self._write(out)
        return True

    def cut(self) -> None:
        """Cut the wire now, for the hazards' ``cut_s``."""
        now_ns = self._clock.now_ns()
        self._cut_end_ns = now_ns + round(self._hazards.cut_s * 1e9)
        self._note(now_ns, "cut")

    def report(self) -> dict[str, Any]:
        """Return what happened, as plain JSON values."""
        device = self._device
        return {
            "device_ms": device.device_ns // 10**6,
            "changes": [list(change) for change in self.changes],
            "last_mode": device.mode,
            "watchdog": device.watchdog,
            "received_bytes": device.received_bytes,
            "slips": self.slips,
        }

    def _have_port(self, now_ns: int, armed_s: float) -> bool:
        """Remove the port and bring it back at the set times; return False if it is gone for good."""
        again_s = self._hazards.return_after_s
        if self._gone_ns < 0 and _passed(self._vanish_after_s, armed_s):
            self.close()
            self._vanish_after_s, self._gone_ns = None, now_ns
            self._note(now_ns, "gone")
            return again_s is not None
        if self._gone_ns >= 0 and _passed(again_s, (now_ns - self._gone_ns) / 1e9):
            self._open_port()
            self._unsent, self._gone_ns = b"", -1
            self._note(now_ns, "back")
        return True

    def _read(self, wait_s: float) -> bytes:
        if self._master < 0:
            self._clock.sleep_until_ns(self._clock.now_ns() + round(wait_s * 1e9))
        elif select.select([self._master], [], [], wait_s)[0]:
            with contextlib.suppress(BlockingIOError):
                return os.read(self._master, 4096)
        return b""

    def _follow(self, now_ns: int) -> None:
        if (mode := self._device.mode) != self._mode:
            self._mode = mode
            self._note(now_ns, mode)
        if (trouble := self._device.trouble) != self._trouble:
            self._trouble = trouble
            self._note(now_ns, trouble or "bus well")

    def _note(self, now_ns: int, what: str) -> None:
        if len(self.changes) < _MOST_CHANGES:
            self.changes.append((self._device.device_ns // 10**6, now_ns, what))

    def _write(self, out: bytes) -> None:
        if out and self._hazards.faults is not None:
            out = self._hazards.faults.apply(out)
        if self._unsent and out:
            # A frame that was written in part must be finished before the next one starts.
            self.dropped += 1
            out = b""
        data = self._unsent or out
        if not data:
            return
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        if written == 0 and not self._unsent:
            self.dropped += 1
            return
        self._unsent = data[written:]


def _passed(limit_s: float | None, time_s: float) -> bool:
    return limit_s is not None and time_s > limit_s
