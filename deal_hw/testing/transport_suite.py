"""Contract of every transport: of byte streams, and of messages with topics."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest

from deal_hw.errors import ConfigurationError, TransportError, TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport, Transport

_PATIENCE_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TransportPair:
    """A transport under test and its far end.

    Attributes:
        near: The transport, not opened.
        write: Makes the far end send bytes, in as many messages as they need.
        read: Waits for that many bytes at the far end and returns them.
        unplug: Makes the far end vanish.
        channel: Channel of messages to the far end.
        largest: Most bytes of a message; 0: any number.
    """

    near: Transport
    write: Callable[[bytes], None]
    read: Callable[[int], bytes]
    unplug: Callable[[], None]
    channel: str = ""
    largest: int = 0

    def send(self, data: bytes) -> None:
        """Send bytes from the near end, in as many messages as they need."""
        size = self.largest or len(data)
        for begin in range(0, len(data), size):
            self.near.send(Message(self.channel, data[begin : begin + size], 0))


class TransportSuite:
    """Contract of a transport; inherit it and override ``pair``."""

    @pytest.fixture
    def pair(self) -> TransportPair:
        """Return the transport under test."""
        raise NotImplementedError("a TransportSuite overrides the fixture `pair`")

    def test_bytes_arrive_unchanged_in_both_directions(self, pair: TransportPair) -> None:
        """All 256 byte values pass, so no terminal setting or escape character changes them."""
        data = bytes(range(256))
        with pair.near as near:
            pair.send(data)
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
                pair.send(b"a")
            with pytest.raises(TransportError):
                pair.near.receive(0.0)
            pair.near.open()
            pair.near.close()

    def test_reopening_a_path_that_works_loses_nothing(self, pair: TransportPair) -> None:
        """An open transport may be opened again: bytes pass in both directions afterwards."""
        with pair.near as near:
            near.reopen()
            pair.send(b"x")
            assert pair.read(1) == b"x"
            pair.write(b"y")
            assert receive_bytes(near, 1) == b"y"

    def test_unplugging_in_flight_is_reported(self, pair: TransportPair) -> None:
        """Once the peer vanished, receiving fails with TransportLostError, and sending fails too."""
        with pair.near as near:
            pair.write(b"last words")
            pair.unplug()
            with pytest.raises(TransportLostError):
                for _ in range(20):
                    near.receive(_PATIENCE_S)
            with pytest.raises(TransportError):
                pair.send(b"hello?")


def receive_bytes(transport: Transport, count: int) -> bytes:
    """Receive until ``count`` bytes have come; they may come in pieces."""
    data = b""
    while len(data) < count:
        data += transport.receive(_PATIENCE_S).payload
    return data


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicPair:
    """Two transports of topics that reach each other; neither is open, and nothing is declared.

    Attributes:
        near: The transport under test.
        far: Its peer, in this process or in a child of it.
        down: Topic that the near end sends on.
        up: Topic that the far end sends on.
        payload: Returns a valid message of a topic; other numbers (0 to 255), other bytes.
    """

    near: TopicTransport
    far: TopicTransport
    down: str
    up: str
    payload: Callable[[str, int], bytes]


class TopicTransportSuite:
    """Contract of a transport of topics; inherit it and override ``pair``.

    Number 0 is the hello that :func:`meet` sends until the ends have found each other. A hello may
    still be on its way when ``meet`` returns, so the tests skip hellos: see :func:`next_message`.
    """

    @pytest.fixture
    def pair(self) -> TopicPair:
        """Return the transport under test and its peer."""
        raise NotImplementedError("a TopicTransportSuite overrides the fixture `pair`")

    def test_bytes_arrive_unchanged_in_both_directions(self, pair: TopicPair) -> None:
        """Each message arrives once, whole, unchanged and under its topic."""
        with _met(pair):
            for number in (1, 127, 128, 255):
                pair.near.send(Message(pair.down, pair.payload(pair.down, number), 0))
                arrived = next_message(pair, pair.far)
                assert (arrived.channel, arrived.payload) == (pair.down, pair.payload(pair.down, number))
                pair.far.send(Message(pair.up, pair.payload(pair.up, number), 0))
                arrived = next_message(pair, pair.near)
                assert (arrived.channel, arrived.payload) == (pair.up, pair.payload(pair.up, number))

    def test_messages_keep_their_order(self, pair: TopicPair) -> None:
        """A burst that nobody reads may lose messages, but never reorders or repeats them."""
        with _met(pair):
            for number in range(1, 21):
                pair.far.send(Message(pair.up, pair.payload(pair.up, number), 0))
            arrived = [message.payload for message in _all_at_hand(pair, pair.near)]
        known = [pair.payload(pair.up, number) for number in range(21)]
        numbers = [known.index(payload) for payload in arrived]
        assert numbers
        assert numbers == sorted(set(numbers))

    def test_nothing_at_hand_is_a_timeout(self, pair: TopicPair) -> None:
        """Polling and waiting both end in TransportTimeoutError, with no peer in sight too."""
        pair.near.declare(publish=[pair.down], subscribe=[pair.up])
        with pair.near as near:
            with pytest.raises(TransportTimeoutError):
                near.receive(0.0)
            with pytest.raises(TimeoutError):
                near.receive(0.01)

    def test_stamps_do_not_go_back(self, pair: TopicPair) -> None:
        """Later messages have later or equal stamps."""
        stamps = []
        with _met(pair):
            for number in range(1, 6):
                pair.far.send(Message(pair.up, pair.payload(pair.up, number), 0))
                stamps.append(next_message(pair, pair.near).stamp_ns)
        assert stamps == sorted(stamps)

    def test_open_and_close_may_be_repeated(self, pair: TopicPair) -> None:
        """Opening an open transport and closing a closed one do nothing; opened again, it works as before."""
        for _ in range(2):
            pair.near.close()
            with _met(pair):
                pair.near.open()
                pair.far.send(Message(pair.up, pair.payload(pair.up, 7), 0))
                assert next_message(pair, pair.near).payload == pair.payload(pair.up, 7)
            pair.near.close()

    def test_a_closed_transport_refuses(self, pair: TopicPair) -> None:
        """Neither sending nor receiving works before opening or after closing."""
        pair.near.declare(publish=[pair.down], subscribe=[pair.up])
        for _ in range(2):
            with pytest.raises(TransportError):
                pair.near.send(Message(pair.down, pair.payload(pair.down, 1), 0))
            with pytest.raises(TransportError):
                pair.near.receive(0.0)
            pair.near.open()
            pair.near.close()

    def test_own_messages_do_not_come_back(self, pair: TopicPair) -> None:
        """A writer does not receive its own messages."""
        for end in (pair.near, pair.far):
            end.declare(publish=[pair.down], subscribe=[pair.down])
        with _met(pair):
            pair.near.send(Message(pair.down, pair.payload(pair.down, 1), 0))
            assert next_message(pair, pair.far).payload == pair.payload(pair.down, 1)
            assert _greet(pair, pair.far, pair.down, pair.near).payload == pair.payload(pair.down, 0)

    def test_an_undeclared_topic_is_refused(self, pair: TopicPair) -> None:
        """Sending on a topic that was only subscribed is a ConfigurationError that names it."""
        pair.near.declare(publish=[pair.down], subscribe=[pair.up])
        with pair.near as near, pytest.raises(ConfigurationError, match=pair.up):
            near.send(Message(pair.up, pair.payload(pair.up, 1), 0))

    def test_declarations_add_up(self, pair: TopicPair) -> None:
        """Two users of one transport declare their topics one after the other."""
        pair.near.declare(publish=[pair.up])
        with _met(pair):
            pair.near.send(Message(pair.up, pair.payload(pair.up, 1), 0))
            pair.near.send(Message(pair.down, pair.payload(pair.down, 2), 0))
            assert next_message(pair, pair.far).channel == pair.down

    def test_nobody_listening_is_no_error(self, pair: TopicPair) -> None:
        """Commands to an absent robot are dropped, without a wait and without an error."""
        pair.near.declare(publish=[pair.down], subscribe=[pair.up])
        with pair.near as near:
            for number in range(50):
                near.send(Message(pair.down, pair.payload(pair.down, number), 0))

    def test_a_peer_that_leaves_is_silence_and_heard_again_when_back(self, pair: TopicPair) -> None:
        """The near end stays open: a robot that restarts is found again automatically."""
        with _met(pair):
            pair.far.close()
            _all_at_hand(pair, pair.near)
            with pytest.raises(TransportTimeoutError):
                pair.near.receive(0.0)
            pair.far.open()
            meet(pair)

    def test_reopening_a_path_that_works_loses_nothing(self, pair: TopicPair) -> None:
        """An open transport may be opened again: messages pass in both directions afterwards."""
        with _met(pair):
            pair.near.reopen()
            meet(pair)

    def test_oneself_is_not_among_the_writers(self, pair: TopicPair) -> None:
        """The only writer of a topic sees no other writer."""
        pair.near.declare(publish=[pair.down], subscribe=[pair.down])
        with pair.near as near:
            assert near.writers(pair.down) == ()


@contextlib.contextmanager
def _met(pair: TopicPair) -> Iterator[None]:
    pair.near.declare(publish=[pair.down], subscribe=[pair.up])
    pair.far.declare(publish=[pair.up], subscribe=[pair.down])
    with pair.near, pair.far:
        meet(pair)
        yield


def meet(pair: TopicPair) -> None:
    """Wait until messages pass in both directions: both ends are open and greet each other."""
    _greet(pair, pair.near, pair.down, pair.far)
    _greet(pair, pair.far, pair.up, pair.near)


def _greet(pair: TopicPair, sender: TopicTransport, topic: str, receiver: TopicTransport) -> Message:
    for _ in range(round(_PATIENCE_S / 0.02)):
        sender.send(Message(topic, pair.payload(topic, 0), 0))
        with contextlib.suppress(TransportTimeoutError):
            return receiver.receive(0.02)
    raise TransportTimeoutError(f"nothing passed on {topic!r} within {_PATIENCE_S:g} s")


def next_message(pair: TopicPair, receiver: TopicTransport) -> Message:
    """Receive a message that is not a hello."""
    while True:
        message = receiver.receive(_PATIENCE_S)
        if message.payload != pair.payload(message.channel, 0):
            return message


def _all_at_hand(pair: TopicPair, receiver: TopicTransport) -> list[Message]:
    found = []
    with contextlib.suppress(TransportTimeoutError):
        while True:
            found.append(receiver.receive(0.2))
    return [message for message in found if message.payload != pair.payload(message.channel, 0)]
