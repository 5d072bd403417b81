"""A cart-pole on a pseudo-terminal in real time: the device core behind ``deal-hw emulate cartpole``."""

from __future__ import annotations

import contextlib
import os
import select
import tty
from dataclasses import dataclass
from pathlib import Path

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.drivers.cartpole.device import CartpoleDevice
from deal_hw.errors import ConfigurationError
from deal_hw.testing.faults import FrameFaults

STALL_NS = 50_000_000
"""Behind by more than this, the device's time stands still instead of catching up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hazards:
    """What goes wrong on purpose, counted from the moment the motor is first armed.

    Attributes:
        freeze_after_s: The firmware hangs: nothing is sent or heard any more [s]; None for never.
        vanish_after_s: The port disappears as if unplugged [s]; None for never.
        faults: What happens to frames from the device.
    """

    freeze_after_s: float | None = None
    vanish_after_s: float | None = None
    faults: FrameFaults | None = None


class CartpoleEmulator:
    """Runs a device core behind a pty; device time follows the clock.

    A host may close the port and open it again. Nobody reading means frames are dropped, as on a UART.

    Attributes:
        slips: Times that this process was stalled and device time stood still.
        dropped: Writes that found no room.

    Args:
        device: The device.
        link: A symbolic link to make to the port; None for none.
        hazards: What goes wrong on purpose.
        clock: Real time.
    """

    def __init__(
        self,
        device: CartpoleDevice,
        link: Path | None = None,
        hazards: Hazards | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.slips = 0
        self.dropped = 0
        self._device = device
        self._link = link
        self._hazards = hazards or Hazards()
        self._clock = clock or MonotonicClock()
        self._master = self._slave = -1
        self._origin_ns = 0
        self._unsent = b""
        self._armed_ns: int | None = None

    def open(self) -> str:
        """Make the pty; return the path of the port."""
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
        self._origin_ns = self._clock.now_ns() - self._device.device_ns
        return port if self._link is None else str(self._link)

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
            Whether there is still a port; False once it has vanished.
        """
        next_tick_ns = self._origin_ns + self._device.device_ns
        wait_s = min(wait_s, max(0, next_tick_ns - self._clock.now_ns()) / 1e9)
        readable, _, _ = select.select([self._master], [], [], wait_s)
        data = b""
        if readable:
            with contextlib.suppress(BlockingIOError):
                data = os.read(self._master, 4096)
        now_ns = self._clock.now_ns()
        late_ns = now_ns - self._origin_ns - self._device.device_ns
        if late_ns > STALL_NS:
            # Catching up would make the device's watchdog see a silence that the host is not guilty of.
            self._origin_ns += late_ns
            self.slips += 1
        armed_s = 0.0 if self._armed_ns is None else (now_ns - self._armed_ns) / 1e9
        if _passed(self._hazards.vanish_after_s, armed_s):
            self.close()
            return False
        out = self._device.advance_to(now_ns - self._origin_ns)
        if _passed(self._hazards.freeze_after_s, armed_s):
            return True
        self._device.receive(data)
        if self._armed_ns is None and self._device.armed:
            self._armed_ns = now_ns
        self._write(out)
        return True

    def _write(self, out: bytes) -> None:
        if out and self._hazards.faults is not None:
            out = self._hazards.faults.apply(out)
        if self._unsent and out:
            # A frame that was cut short must be finished before another may start.
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
