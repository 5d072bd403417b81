"""The TCP transport: deal-hw's contract of a transport, over a socket on this computer."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest
from deal_hw_bench_cartpole.tcp_transport import TcpTransport, is_local

from deal_hw.errors import ConfigurationError, PortNotFoundError
from deal_hw.testing.transport_suite import TransportPair, TransportSuite


class Server:
    """Accepts a connection when it is first needed, so that one may be closed and made again."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.settimeout(10.0)
        self.port = f"127.0.0.1:{self.listener.getsockname()[1]}"
        self._made: list[socket.socket] = []

    def newest(self) -> socket.socket:
        """Return the newest connection; earlier ones were closed by the other side."""
        self.listener.settimeout(0.0 if self._made else 10.0)
        try:
            while True:
                self._made.append(self.listener.accept()[0])
                self.listener.settimeout(0.0)
        except BlockingIOError:
            return self._made[-1]

    def write(self, data: bytes) -> None:
        self.newest().sendall(data)

    def read(self, count: int) -> bytes:
        link, data = self.newest(), b""
        link.settimeout(10.0)
        while len(data) < count:
            data += link.recv(count - len(data))
        return data

    def unplug(self) -> None:
        """Close everything; a reset makes also sending fail at once."""
        link = self.newest()
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")
        link.close()
        self.listener.close()

    def close(self) -> None:
        for link in (self.listener, *self._made):
            link.close()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


class TestTcpTransport(TransportSuite):
    @pytest.fixture
    def pair(self, server: Server) -> TransportPair:
        return TransportPair(
            near=TcpTransport(server.port), write=server.write, read=server.read, unplug=server.unplug
        )


def test_a_child_process_goes_on_with_the_connection(server: Server) -> None:
    """The descriptor of an open connection is enough."""
    with TcpTransport(server.port) as parent:
        with TcpTransport.from_fd(os.dup(parent.fileno())) as child:
            server.write(b"to the child")
            assert child.receive(5.0).payload == b"to the child"


@pytest.mark.parametrize("port", ["", "host", "host:", ":2000", "host:port", "host:99999"])
def test_a_port_names_host_and_number(port: str) -> None:
    """Anything else is refused with an example."""
    with pytest.raises(ConfigurationError, match="HOST:PORT"):
        TcpTransport(port).open()


def test_a_closed_port_is_not_found(server: Server) -> None:
    """Nobody listens there."""
    server.close()
    with pytest.raises(PortNotFoundError, match=server.port):
        TcpTransport(server.port).open()


def test_ports_of_this_computer() -> None:
    """So messages advise to look at a program instead of a cable."""
    assert is_local("127.0.0.1:2000") and is_local("[::1]:2000") and is_local("localhost:2000")
    assert not is_local("192.168.0.7:2000")
