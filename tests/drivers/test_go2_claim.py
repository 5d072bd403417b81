"""The claim on a Go2's wire: one commander, refused at once, over a bus in memory and over Zenoh."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Collection, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.transports.interfaces import list_interfaces
from deal_hw.drivers.transports.topics import CLAIM
from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
from deal_hw.drivers.unitree import claim as module
from deal_hw.drivers.unitree.claim import ASKING, HELD, RELEASED, WireClaim
from deal_hw.drivers.unitree.rpc import CLAIM_TEXTS, Request, encode_request, read_note
from deal_hw.errors import PortBusyError, TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport, WireOptions

pytestmark = pytest.mark.real_time

CLOCK = MonotonicClock()


class Bus:
    """Carries each message to every open end but the sender's.

    Attributes:
        sent_claims: All claims so far, in order: identity and state.
    """

    def __init__(self) -> None:
        self.ends: list[End] = []
        self.sent_claims: list[tuple[str, str]] = []

    def end(self) -> End:
        """Return a new end, not open."""
        return End(self)


class End(TopicTransport):
    """One participant of the bus.

    Attributes:
        cut: Whether nothing of it arrives any more.
        lost: Whether its link is gone, with an error.
        reopened: How often it was opened again.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._arrived: queue.Queue[Message] = queue.Queue()
        self.cut = self.lost = False
        self.reopened = 0

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """One topic is enough."""
        assert tuple(publish) == tuple(subscribe) == (CLAIM,)

    def writers(self, topic: str) -> tuple[str, ...]:
        """Not known."""
        return ()

    def open(self) -> None:
        """Join."""
        self._bus.ends.append(self)

    def close(self) -> None:
        """Leave."""
        if self in self._bus.ends:
            self._bus.ends.remove(self)

    def reopen(self) -> None:
        """The link comes back."""
        self.reopened += 1
        self.lost = False

    def send(self, message: Message) -> None:
        """Hand it to all others."""
        if self.lost:
            raise TransportLostError("gone")
        if self.cut:
            return
        if (claim := read_note(message.payload, CLAIM_TEXTS)) is not None:
            self._bus.sent_claims.append((claim["id"], claim["state"]))
        for end in list(self._bus.ends):
            if end is not self:
                end._arrived.put(message)

    def receive(self, timeout_s: float) -> Message:
        """Return what came."""
        try:
            return self._arrived.get(timeout=max(timeout_s, 1e-4))
        except queue.Empty:
            raise TransportTimeoutError("nothing") from None


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    """A bus on which everything is twenty times as fast."""
    for name, seconds in (("LISTEN_S", 0.1), ("REFRESH_S", 0.01), ("_ASK_S", 0.02)):
        monkeypatch.setattr(module, name, seconds)
    return Bus()


@pytest.fixture
def make(bus: Bus) -> Iterator[Callable[..., WireClaim]]:
    """Make claims that are released at the end."""
    made: list[WireClaim] = []

    def claim(identity: str, end: End | None = None) -> WireClaim:
        made.append(WireClaim(end or bus.end(), CLOCK, f"run {identity}", identity))
        return made[-1]

    yield claim
    for one in made:
        one.release()
    assert bus.ends == []


def test_a_claim_is_asked_for_then_held_then_released(bus: Bus, make: Callable[..., WireClaim]) -> None:
    """Its life cycle on the wire, in this order."""
    claim = make("a")
    claim.acquire()
    claim.release()
    claim.release()
    states = [state for _, state in bus.sent_claims]
    assert list(dict.fromkeys(states)) == [ASKING, HELD, RELEASED]
    assert states.count(RELEASED) == 1


def test_a_second_run_is_refused_at_once_and_told_by_whom(bus: Bus, make: Callable[..., WireClaim]) -> None:
    """By the first one's answer to its first question, whatever their numbers; the first goes on."""
    make("b").acquire()
    for other in ("a", "c"):
        with pytest.raises(PortBusyError, match="run b commands it, or is about to"):
            make(other).acquire()
        assert [i for i, _ in bus.sent_claims].count(other) == 1, "it did not ask twice"
    assert bus.sent_claims[-1] == ("b", HELD)


def test_of_two_that_ask_at_the_same_time_one_wins(bus: Bus, make: Callable[..., WireClaim]) -> None:
    """The smaller number, each time."""
    outcome: dict[str, bool] = {}

    def ask(identity: str) -> None:
        try:
            make(identity).acquire()
            outcome[identity] = True
        except PortBusyError:
            outcome[identity] = False

    threads = [threading.Thread(target=ask, args=(name,)) for name in ("b", "a", "c")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert outcome == {"a": True, "b": False, "c": False}


def test_a_released_claim_is_free(bus: Bus, make: Callable[..., WireClaim]) -> None:
    """The next run gets it."""
    first = make("a")
    first.acquire()
    first.release()
    make("b").acquire()


def test_a_claim_that_is_not_refreshed_expires(bus: Bus, make: Callable[..., WireClaim]) -> None:
    """Its holder's computer is gone from the wire: nobody answers, so the next run gets it."""
    end = bus.end()
    make("a", end).acquire()
    end.cut = True
    make("b").acquire()


def test_a_holder_whose_link_comes_back_goes_on_holding(bus: Bus, make: Callable[..., WireClaim]) -> None:
    """The link is opened again, and the next that asks is refused."""
    end = bus.end()
    make("a", end).acquire()
    end.lost = True
    while not end.reopened:
        threading.Event().wait(0.001)
    with pytest.raises(PortBusyError):
        make("b").acquire()


def test_what_is_no_claim_is_ignored(bus: Bus, make: Callable[..., WireClaim]) -> None:
    """Garbage on the topic, other shapes, one's own echo, other topics."""
    noise = bus.end()
    noise.open()
    claim = make("b")
    own = encode_request(Request(0, 0, json.dumps({"id": "b", "who": "me", "state": HELD})))
    other = encode_request(Request(0, 0, json.dumps({"id": "a", "who": "x", "state": HELD})))
    for payload in (b"", b"garbage", encode_request(Request(0, 0, "[1]")), own):
        claim._transport._arrived.put(Message(CLAIM, payload, 0))  # type: ignore[attr-defined]
    claim._transport._arrived.put(Message("rt/other", other, 0))  # type: ignore[attr-defined]
    claim.acquire()
    noise.close()


def test_a_wire_that_cannot_be_opened_leaves_nothing_open(bus: Bus) -> None:
    """The error comes out, and no thread stays behind."""
    before = threading.active_count()
    claim = WireClaim(bus.end(), CLOCK, "x", "x")
    claim._transport.lost = True  # type: ignore[attr-defined]
    with pytest.raises(TransportLostError):
        claim.acquire()
    assert bus.ends == []
    assert threading.active_count() == before
    claim.release()


@given(st.binary(max_size=400))
def test_any_bytes_are_a_claim_or_none(payload: bytes) -> None:
    """Nothing that is received raises."""
    assert read_note(payload, CLAIM_TEXTS) is None or isinstance(read_note(payload, CLAIM_TEXTS), dict)


KEYS = st.sampled_from(["id", "who", "state", "x"])
LEAVES = st.none() | st.booleans() | st.floats() | st.text()


@given(st.recursive(LEAVES, lambda inner: st.lists(inner) | st.dictionaries(KEYS, inner), max_leaves=8))
def test_any_json_is_a_claim_or_none(values: object) -> None:
    """Text in the three fields, and no more than 200 characters of a name."""
    claim = read_note(encode_request(Request(0, 0, json.dumps(values))), CLAIM_TEXTS)
    sound = isinstance(values, dict) and all(isinstance(values.get(k), str) for k in ("id", "who", "state"))
    assert (claim is not None) == sound
    assert claim is None or len(claim["who"]) <= 200


def test_a_text_nested_too_deep_is_no_claim() -> None:
    """Python's parser gives up with an error of its own kind."""
    assert read_note(encode_request(Request(0, 0, "[" * 100_000)), CLAIM_TEXTS) is None


# Real wires.


def test_over_zenoh_the_second_run_is_refused() -> None:
    """Two clients of one end point, as two runs against one bridge; free again after the release."""
    from deal_hw.workflows.emulation.topics import free_port

    port = free_port("tcp/127.0.0.1:0")
    with ZenohTransport(port, CLOCK, WireOptions(listen=True)):
        first = WireClaim(ZenohTransport(port, CLOCK), CLOCK, "the first run")
        first.acquire()
        try:
            with pytest.raises(PortBusyError, match="the first run commands it"):
                WireClaim(ZenohTransport(port, CLOCK), CLOCK, "the second").acquire()
        finally:
            first.release()
        second = WireClaim(ZenohTransport(port, CLOCK), CLOCK, "the second")
        second.acquire()
        second.release()


def test_over_dds_the_second_run_is_refused() -> None:
    """Two participants of one domain, which discovery brings together inside the time of asking."""
    pytest.importorskip("cyclonedds")
    from deal_hw.drivers.transports.dds_transport import DdsTransport

    loopback = next(i.name for i in list_interfaces() if i.loopback)
    options = WireOptions(domain=73)
    first = WireClaim(DdsTransport(loopback, CLOCK, options), CLOCK, "the first run")
    first.acquire()
    try:
        with pytest.raises(PortBusyError, match="the first run commands it"):
            WireClaim(DdsTransport(loopback, CLOCK, options), CLOCK, "the second").acquire()
    finally:
        first.release()
