"""What every transport for byte streams must do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from deal_hw.errors import TransportError, TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, Transport

_PATIENCE_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TransportPair:
    """A transport under test and its far end.

    Attributes:
        near: The transport, not opened.
        write: Makes the far end send bytes.
        read: Waits for that many bytes at the far end and returns them.
        unplug: Makes the far end vanish.
    """

    near: Transport
    write: Callable[[bytes], None]
    read: Callable[[int], bytes]
    unplug: Callable[[], None]


class TransportSuite:
    """Contract of a transport; inherit it and override ``pair``."""

    @pytest.fixture
    def pair(self) -> TransportPair:
        """Return the transport under test."""
        raise NotImplementedError("a TransportSuite overrides the fixture `pair`")

    def test_bytes_arrive_unchanged_in_both_directions(self, pair: TransportPair) -> None:
        """All 256 byte values pass, so no terminal setting and no escape character is in the way."""
        data = bytes(range(256))
        with pair.near as near:
            near.send(Message("", data, 0))
            assert pair.read(len(data)) == data
            pair.write(data)
            assert receive_bytes(near, len(data)) == data

    def test_messages_keep_their_order(self, pair: TransportPair) -> None:
        """What is sent first arrives first, also when nobody reads in between."""
        with pair.near as near:
            for i in range(20):
                pair.write(bytes([i] * 7))
            assert receive_bytes(near, 140) == b"".join(bytes([i] * 7) for i in range(20))

    def test_nothing_at_hand_is_a_timeout(self, pair: TransportPair) -> None:
        """Polling and waiting both end in TransportTimeoutError, which is a TimeoutError too."""
        with pair.near as near:
            with pytest.raises(TransportTimeoutError):
                near.receive(0.0)
            with pytest.raises(TimeoutError):
                near.receive(0.01)

    def test_stamps_do_not_go_back(self, pair: TransportPair) -> None:
        """Later messages have later or equal stamps, and every message has at least one byte."""
        stamps = []
        with pair.near as near:
            for i in range(5):
                pair.write(bytes([i]))
                message = near.receive(_PATIENCE_S)
                assert message.payload
                stamps.append(message.stamp_ns)
        assert stamps == sorted(stamps)

    def test_open_and_close_may_be_repeated(self, pair: TransportPair) -> None:
        """Opening an open transport and closing a closed one do nothing."""
        pair.near.close()
        pair.near.open()
        pair.near.open()
        pair.write(b"a")
        assert receive_bytes(pair.near, 1) == b"a"
        pair.near.close()
        pair.near.close()

    def test_a_closed_transport_refuses(self, pair: TransportPair) -> None:
        """Neither sending nor receiving works before opening or after closing."""
        for _ in range(2):
            with pytest.raises(TransportError):
                pair.near.send(Message("", b"a", 0))
            with pytest.raises(TransportError):
                pair.near.receive(0.0)
            pair.near.open()
            pair.near.close()

    def test_unplugging_in_flight_is_reported(self, pair: TransportPair) -> None:
        """Once the peer vanished, receiving fails with TransportLostError, and sending fails too."""
        with pair.near as near:
            pair.write(b"last words")
            pair.unplug()
            with pytest.raises(TransportLostError):
                for _ in range(20):
                    near.receive(_PATIENCE_S)
            with pytest.raises(TransportError):
                near.send(Message("", b"hello?", 0))


def receive_bytes(transport: Transport, count: int) -> bytes:
    """Receive until ``count`` bytes have come; they may come in pieces."""
    data = b""
    while len(data) < count:
        data += transport.receive(_PATIENCE_S).payload
    return data
