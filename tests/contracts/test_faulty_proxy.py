"""The proxy that freezes, resets and refuses connections, over real sockets."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from fakes.faulty_proxy import FaultyProxy

pytestmark = pytest.mark.real_time

SHORT_S = 0.2
LONG_S = 10.0


@pytest.fixture
def server() -> Iterator[socket.socket]:
    """What the proxy forwards to."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(LONG_S)
        yield listening


@pytest.fixture
def proxy(server: socket.socket) -> Iterator[FaultyProxy]:
    """A proxy before the server."""
    with FaultyProxy(server.getsockname()) as made:
        yield made


def connect(proxy: FaultyProxy, server: socket.socket) -> tuple[socket.socket, socket.socket]:
    """Return both ends of a connection through the proxy."""
    near = socket.create_connection(("127.0.0.1", proxy.port), LONG_S)
    far, _ = server.accept()
    far.settimeout(LONG_S)
    return near, far


def read(end: socket.socket, size: int) -> bytes:
    """Return so many bytes."""
    data = b""
    while len(data) < size:
        part = end.recv(size - len(data))
        assert part, "the connection ended"
        data += part
    return data


def test_everything_passes_both_ways_in_order(proxy: FaultyProxy, server: socket.socket) -> None:
    """More than the kernel's buffers hold, while the other side reads; then the end passes, too."""
    near, far = connect(proxy, server)
    data = bytes(range(256)) * 40_000
    with near, far:
        far.sendall(b"hello")
        assert read(near, 5) == b"hello"
        near.setblocking(False)
        sent, got = 0, b""
        while len(got) < len(data):
            if sent < len(data):
                try:
                    sent += near.send(data[sent : sent + 65536])
                except BlockingIOError:
                    pass
            got += far.recv(65536)
        assert got == data
        near.close()
        assert far.recv(1) == b""


def test_frozen_nothing_passes_and_nothing_is_lost(proxy: FaultyProxy, server: socket.socket) -> None:
    """What was sent meanwhile comes afterwards, in order, over the same connection."""
    near, far = connect(proxy, server)
    with near, far:
        proxy.set("frozen")
        near.sendall(b"one")
        near.sendall(b"two")
        far.settimeout(SHORT_S)
        with pytest.raises(TimeoutError):
            far.recv(1)
        far.settimeout(LONG_S)
        proxy.set("open")
        assert read(far, 6) == b"onetwo"


def test_refused_resets_and_refuses_until_it_opens(proxy: FaultyProxy, server: socket.socket) -> None:
    """Both ends see a reset, a new connection is refused, and later the same port works again."""
    near, far = connect(proxy, server)
    with near, far:
        proxy.set("refused")
        for end in (near, far):
            with pytest.raises(ConnectionResetError):
                end.recv(1)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", proxy.port), LONG_S)
    proxy.set("open")
    near, far = connect(proxy, server)
    with near, far:
        near.sendall(b"again")
        assert read(far, 5) == b"again"


def test_where_nobody_listens_the_connection_ends() -> None:
    """The proxy lives on."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        target = listening.getsockname()
    with FaultyProxy(target) as proxy:
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", proxy.port), LONG_S) as near:
                assert near.recv(1) == b""
