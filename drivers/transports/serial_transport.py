"""Bytes over a serial port (USB, UART or a pty)."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import stat
import termios
import threading

import serial
from serial.tools import list_ports

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.drivers.transports.arrivals import Arrivals
from deal_hw.errors import (
    ConfigurationError,
    PortBusyError,
    PortNotFoundError,
    TransportError,
    TransportLostError,
    TransportTimeoutError,
)
from deal_hw.transport import Message, Transport

_READ_SIZE = 4096


class SerialTransport(Transport):
    """A serial port, opened exclusively; the channel of its messages is "".

    pyserial opens and sets up the port. Reading and writing use the file descriptor directly. This is
    faster, and a child process can use a descriptor that it inherited (:meth:`from_fd`). The lock
    belongs to the open file, so it holds until the last process closes it.

    Args:
        port: Path of the port, such as ``/dev/ttyACM0``.
        baud_rate: Bits per second.
        clock: Gives the stamps.
    """

    def __init__(self, port: str, baud_rate: int = 1_000_000, clock: Clock | None = None) -> None:
        self.port = port
        self._baud_rate = baud_rate
        self._clock = clock or MonotonicClock()
        self._adopted: int | None = None
        self._serial: serial.Serial | None = None
        self._ahead: ReadAhead | None = None
        self._fd = -1

    @classmethod
    def from_fd(
        cls, fd: int, clock: Clock | None = None, port: str = "", baud_rate: int = 1_000_000
    ) -> SerialTransport:
        """Return a transport over a port that a parent process opened; it closes ``fd`` when closed.

        It is for the process with deadlines, so it reads ahead in a thread.

        Args:
            fd: The descriptor.
            clock: Gives the stamps.
            port: Path of the port, for :meth:`reopen`; "": it cannot be opened again.
            baud_rate: For :meth:`reopen`; the descriptor keeps its own.
        """
        transport = cls(port or f"inherited descriptor {fd}", baud_rate, clock)
        transport._adopted = fd
        return transport

    def open(self) -> None:
        """Open the port and discard bytes received before."""
        if self._fd >= 0:
            return
        if self._adopted is None:
            self._serial = self._open_port()
            self._fd = self._serial.fileno()
        else:
            self._fd = self._adopt(self._adopted)
            self._ahead = ReadAhead(self._fd, self._clock)

    def close(self) -> None:
        """Close the port."""
        fd, self._fd = self._fd, -1
        ahead, self._ahead = self._ahead, None
        if ahead is not None:
            ahead.stop()
        if self._serial is not None:
            with contextlib.suppress(OSError):
                self._serial.close()
            self._serial = None
        elif fd >= 0:
            with contextlib.suppress(OSError):
                os.close(fd)

    def reopen(self) -> None:
        """Open the port again by its path if the device vanished, as when a cable was pulled and put back.

        The new port is opened before the dead one is closed, so a failed try loses nothing. A port that still
        works is kept, because its lock is this program's own.
        """
        if self._fd >= 0 and not _hung_up(self._fd):
            return
        fresh = self._open_port()
        self.close()
        self._fd, self._serial = fresh.fileno(), fresh
        if self._adopted is not None:
            self._ahead = ReadAhead(self._fd, self._clock)

    def send(self, message: Message) -> None:
        """Write without waiting; bytes that the port does not take are an error."""
        fd = self.fileno()
        try:
            written = os.write(fd, message.payload)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise self._lost(error) from error
        if written < len(message.payload):
            raise TransportTimeoutError(
                f"{self.port}: took {written} of {len(message.payload)} bytes; "
                "the device does not read its input, or another program writes to the port"
            )

    def receive(self, timeout_s: float) -> Message:
        """Return all received bytes, waiting up to ``timeout_s`` for the first."""
        fd = self.fileno()
        if self._ahead is not None:
            return self._receive_ahead(self._ahead, timeout_s)
        # select, not poll: poll rounds its timeout up to whole milliseconds, so every cycle would start late.
        if not select.select([fd], [], [], max(0.0, timeout_s))[0]:
            raise TransportTimeoutError(f"{self.port}: nothing arrived within {timeout_s:g} s")
        try:
            data = os.read(fd, _READ_SIZE)
        except BlockingIOError as error:
            raise TransportTimeoutError(f"{self.port}: nothing arrived within {timeout_s:g} s") from error
        except OSError as error:
            raise self._lost(error) from error
        if not data:
            raise self._lost(None)
        return Message("", data, self._clock.now_ns())

    def _receive_ahead(self, ahead: ReadAhead, timeout_s: float) -> Message:
        arrived = ahead.take(timeout_s)
        if arrived is None:
            raise TransportTimeoutError(f"{self.port}: nothing arrived within {timeout_s:g} s")
        stamp_ns, data = arrived
        if isinstance(data, OSError):
            raise self._lost(data) from data
        if not data:
            raise self._lost(None)
        return Message("", data, stamp_ns)

    def fileno(self) -> int:
        """Return the descriptor of the open port, for ``select`` and for child processes."""
        if self._fd < 0:
            raise TransportLostError(f"{self.port}: the port is not open")
        return self._fd

    def _open_port(self) -> serial.Serial:
        try:
            port = serial.Serial(self.port, self._baud_rate, timeout=0, write_timeout=0, exclusive=True)
        except (serial.SerialException, OSError) as error:
            raise self._open_error(error) from error
        except ValueError as error:
            raise ConfigurationError(f"{self.port}: {error}") from error
        # FTDI adapters hold bytes back for up to 16 ms without this; ptys and many drivers lack this call.
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            port.set_low_latency_mode(True)
        _read_nothing_means_gone(port.fileno())
        return port

    def _adopt(self, fd: int) -> int:
        try:
            if not stat.S_ISCHR(os.fstat(fd).st_mode):
                raise ConfigurationError(f"descriptor {fd} is not a serial port")
            os.set_blocking(fd, False)
            termios.tcflush(fd, termios.TCIFLUSH)
            _read_nothing_means_gone(fd)
        except (OSError, termios.error) as error:
            raise TransportLostError(f"descriptor {fd} cannot be used as a serial port: {error}") from error
        return fd

    def _open_error(self, error: Exception) -> TransportError:
        code = getattr(error, "errno", None)
        text = str(error)
        if code in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in text:
            return PortBusyError(
                f"{self.port} is used by another process; close that program (`fuser {self.port}` shows it)"
            )
        if code == errno.EACCES:
            return PortNotFoundError(
                f"this user may not open {self.port}; add the user to the group that owns it (often "
                "`dialout`)"
            )
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO):
            return PortNotFoundError(f"there is no serial port {self.port!r}; ports at hand: {_ports()}")
        if "configure port" in text or code == errno.ENOTTY:
            # The kernel's text, "inappropriate ioctl for device", does not say that it is no port.
            return PortNotFoundError(
                f"{self.port} cannot be opened as a serial port: it is a file or another device; ports at "
                f"hand: {_ports()}"
            )
        return PortNotFoundError(f"{self.port} cannot be opened as a serial port: {text}")

    def _lost(self, error: OSError | None) -> TransportLostError:
        reason = f" ({error.strerror})" if error is not None else ""
        return TransportLostError(f"{self.port}: the device vanished{reason}; check the cable and the power")


def _hung_up(fd: int) -> bool:
    poll = select.poll()
    poll.register(fd, 0)
    return bool(poll.poll(0))


def _read_nothing_means_gone(fd: int) -> None:
    # pyserial sets VMIN to 0, where an empty read means both "nothing yet" and "hung up".
    settings = termios.tcgetattr(fd)
    settings[6][termios.VMIN] = 1
    settings[6][termios.VTIME] = 0
    termios.tcsetattr(fd, termios.TCSANOW, settings)


def _ports() -> str:
    return ", ".join(sorted(entry.device for entry in list_ports.comports())) or "none"


_READ_SIZE = 4096


class ReadAhead:
    """Reads a descriptor in a thread of its own and keeps the bytes with their stamps.

    Linux hands received bytes to a tty through a kernel worker of ordinary priority, and ``select`` and
    ``read`` on a tty wait for that worker. On a busy machine this takes tens of milliseconds, at any priority
    of the reading process. Here only this thread waits for it. A thread that waits for the queue wakes up at
    its own deadline.

    Args:
        fd: The descriptor; stays open.
        clock: Gives the stamps.
    """

    def __init__(self, fd: int, clock: Clock) -> None:
        self._fd, self._clock = fd, clock
        self._arrived: Arrivals[tuple[int, bytes | OSError]] = Arrivals()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name="tty read-ahead", daemon=True)
        self._thread.start()

    def take(self, timeout_s: float) -> tuple[int, bytes | OSError] | None:
        """Return the next stamp [ns] and bytes (empty: hung up), or the error; None after the timeout."""
        try:
            arrived = self._arrived.take(timeout_s)
        except TimeoutError:
            return None
        if _is_last(arrived[1]):
            # The thread has ended: the next call must return the same error.
            self._arrived.put(arrived)
        return arrived

    def stop(self) -> None:
        """End the thread; bytes that were not taken are lost."""
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"x")
        self._thread.join()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _run(self) -> None:
        while True:
            try:
                ready, _, _ = select.select([self._fd, self._wake_read], [], [])
                if self._wake_read in ready:
                    return
                data: bytes | OSError = os.read(self._fd, _READ_SIZE)
            except BlockingIOError:
                continue
            except OSError as error:
                data = error
            self._arrived.put((self._clock.now_ns(), data))
            if _is_last(data):
                return


def _is_last(data: bytes | OSError) -> bool:
    return not isinstance(data, bytes) or not data
