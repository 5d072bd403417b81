"""A transport: the bytes of a serial port through TCP, as a serial server such as ser2net offers them."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import select
import socket

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import (
    ConfigurationError,
    PortNotFoundError,
    TransportLostError,
    TransportTimeoutError,
)
from deal_hw.transport import Message, Transport

CONNECT_S = 3.0
_READ_SIZE = 4096


class TcpTransport(Transport):
    """A TCP connection; the channel of its messages is "".

    Args:
        port: ``HOST:PORT``.
        clock: Gives the stamps.
    """

    def __init__(self, port: str, clock: Clock | None = None) -> None:
        self.port = port
        self._clock = clock or MonotonicClock()
        self._adopted: int | None = None
        self._socket: socket.socket | None = None

    @classmethod
    def from_fd(cls, fd: int, clock: Clock | None = None, port: str = "") -> TcpTransport:
        """Return a transport over a connection that a parent process opened."""
        transport = cls(port, clock)
        transport._adopted = fd
        return transport

    def open(self) -> None:
        """Connect; Nagle's delay is switched off, since a command must leave at once."""
        if self._socket is not None:
            return
        if self._adopted is not None:
            fresh, self._adopted = socket.socket(fileno=self._adopted), None
        else:
            fresh = self._connect()
        fresh.setblocking(False)
        self._socket = fresh

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def reopen(self) -> None:
        """Connect again if the connection was lost; one that works is kept."""
        if self._socket is not None and not self._lost():
            return
        fresh = self._connect()
        self.close()
        fresh.setblocking(False)
        self._socket = fresh

    def send(self, message: Message) -> None:
        """Write without waiting; bytes that the connection does not take are an error."""
        link = self._open_socket()
        try:
            sent = link.send(message.payload)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise TransportLostError(f"{self.port}: {error}") from error
        if sent < len(message.payload):
            raise TransportTimeoutError(f"{self.port} takes no more bytes")

    def receive(self, timeout_s: float) -> Message:
        """Return all waiting bytes, waiting for the first."""
        link = self._open_socket()
        if not select.select([link], [], [], timeout_s)[0]:
            raise TransportTimeoutError(f"{self.port}: nothing within {timeout_s:g} s")
        try:
            data = link.recv(_READ_SIZE)
        except OSError as error:
            raise TransportLostError(f"{self.port}: {error}") from error
        if not data:
            raise TransportLostError(f"{self.port}: the other side closed the connection")
        return Message("", data, self._clock.now_ns())

    def fileno(self) -> int:
        """Return the connection's descriptor."""
        return self._open_socket().fileno()

    def _connect(self) -> socket.socket:
        host, number = _parsed(self.port)
        try:
            fresh = socket.create_connection((host, number), CONNECT_S)
        except OSError as error:
            raise PortNotFoundError(f"{self.port}: {error}") from error
        fresh.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return fresh

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise TransportLostError(f"{self.port} is not open")
        return self._socket

    def _lost(self) -> bool:
        """Return whether the other side has closed the connection."""
        with contextlib.suppress(BlockingIOError):
            try:
                return not self._open_socket().recv(1, socket.MSG_PEEK)
            except OSError as error:
                if error.errno in (errno.EAGAIN, errno.EWOULDBLOCK):
                    raise BlockingIOError from error
                return True
        return False


def is_local(port: str) -> bool:
    """Return whether a port is on this computer."""
    host, _ = _parsed(port)
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def _parsed(port: str) -> tuple[str, int]:
    host, colon, number = port.rpartition(":")
    if not (host and colon and number.isdecimal() and 0 < int(number) < 65536):
        raise ConfigurationError(f"port {port!r}: give HOST:PORT, such as 192.168.0.7:2000")
    return host.strip("[]"), int(number)
