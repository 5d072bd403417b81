"""Adapters that python-can drives, by frames and errors as SocketCAN gives them."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator

import can
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.transports import can_transport
from deal_hw.drivers.transports.can_transport import PythonCanTransport
from deal_hw.errors import PortNotFoundError, TransportLostError, TransportTimeoutError
from deal_hw.transport import Message

SECOND_NS = 10**9


class FakeBus(can.BusABC):
    """A bus that gives what the test put in, frames or errors."""

    def __init__(self, script: list[can.Message | Exception]) -> None:
        self.script = script
        self.sent: list[can.Message] = []
        self.refuse: Exception | None = None
        super().__init__(channel="fake")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Keep the frame, or raise what the test wants."""
        assert timeout == 0
        if self.refuse is not None:
            raise self.refuse
        self.sent.append(msg)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self.script:
            return None, True
        found = self.script.pop(0)
        if isinstance(found, Exception):
            raise found
        return found, True


@pytest.fixture
def fake(
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Callable[..., tuple[PythonCanTransport, FakeBus]]]:
    """Return a function that makes an open transport over a bus with a script."""
    opened: list[PythonCanTransport] = []

    def make(*script: can.Message | Exception, wall_ns: int = 0) -> tuple[PythonCanTransport, FakeBus]:
        bus = FakeBus(list(script))
        monkeypatch.setattr(can, "Bus", lambda **kwargs: bus)
        monkeypatch.setattr(can_transport, "check_link", lambda channel: None)
        clock = VirtualClock(5 * SECOND_NS)
        transport = PythonCanTransport("socketcan:can0", clock, wall_ns=lambda: wall_ns)
        transport.open()
        opened.append(transport)
        return transport, bus

    yield make
    for transport in opened:
        transport.close()


def frame(data: bytes = b"x", stamp_s: float = 0.0, **kinds: bool) -> can.Message:
    """Return a data frame with id 0x123."""
    return can.Message(
        arbitration_id=0x123,
        is_extended_id=kinds.pop("extended", False),
        data=data,
        timestamp=stamp_s,
        **kinds,
    )


def error_frame(kind: int, controller: int = 0) -> can.Message:
    """Return an error frame as SocketCAN gives it."""
    return can.Message(
        arbitration_id=kind,
        is_error_frame=True,
        is_extended_id=False,
        data=bytes([0, controller, 0, 0, 0, 0, 0, 0]),
    )


def test_adapter_stamps_become_ours_by_their_age(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]],
) -> None:
    """Wall 100 s, adapter 99.75 s: received 250 ms ago, so at 4.75 s of our clock, which stands at 5 s."""
    transport, _ = fake(frame(stamp_s=99.75), wall_ns=100 * SECOND_NS)
    assert transport.receive(0.0).stamp_ns == 4_750_000_000


@pytest.mark.parametrize("stamp_s", [98.9, 100.1, 0.0])
def test_stamps_that_cannot_be_are_replaced(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]], stamp_s: float
) -> None:
    """Too old, of the future, or counted from power-on: the time of reading."""
    transport, _ = fake(frame(stamp_s=stamp_s), wall_ns=100 * SECOND_NS)
    assert transport.receive(0.0).stamp_ns == 5 * SECOND_NS


def test_stamps_of_an_adapter_do_not_go_back(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]],
) -> None:
    """A wall clock that was set between two frames changes no order."""
    transport, _ = fake(frame(stamp_s=99.9), frame(stamp_s=99.5), wall_ns=100 * SECOND_NS)
    assert transport.receive(0.0).stamp_ns == transport.receive(0.0).stamp_ns == 4_900_000_000


def test_extended_remote_and_fd_frames_are_foreign(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]],
) -> None:
    """Only classic data frames with an 11-bit id come through."""
    remote = can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True)
    transport, _ = fake(frame(extended=True), remote, frame(is_fd=True), frame(b"mine"))
    assert transport.receive(0.0).payload == b"mine"


def test_bus_off_is_a_lost_bus_until_it_is_opened_again(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]],
) -> None:
    """Neither reading nor sending goes on; the message says how the kernel restarts a controller."""
    transport, bus = fake(error_frame(0x040))
    with pytest.raises(TransportLostError, match=r"bus-off.*restart-ms"):
        transport.receive(0.0)
    with pytest.raises(TransportLostError, match="bus-off"):
        transport.send(Message("123", b"x", 0))
    bus.script.append(frame(b"back"))
    transport.reopen()
    assert transport.receive(0.0).payload == b"back"
    assert transport.trouble == ""


@pytest.mark.parametrize(
    ("kind", "controller", "words"),
    [
        (0x020, 0, "acknowledges"),
        (0x004, 0x01, "receive buffer"),
        (0x004, 0x02, "transmit buffer"),
        (0x004, 0x20, "error-passive"),
        (0x008, 0, "bit rate"),
    ],
)
def test_error_frames_are_counted_and_said(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]], kind: int, controller: int, words: str
) -> None:
    """They end no episode; what they say is in the next timeout's message."""
    transport, _ = fake(error_frame(kind, controller))
    with pytest.raises(TransportTimeoutError, match=words):
        transport.receive(0.0)
    assert transport.error_frames == 1


@pytest.mark.parametrize(
    "refusal",
    [
        can.CanOperationError("Failed to transmit", errno.ENOBUFS),
        can.CanOperationError("Transmit buffer full"),
    ],
)
def test_a_full_transmit_buffer_is_a_timeout(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]], refusal: Exception
) -> None:
    """It names the usual reason: nobody acknowledges."""
    transport, bus = fake()
    bus.refuse = refusal
    with pytest.raises(TransportTimeoutError, match="acknowledges"):
        transport.send(Message("123", b"x", 0))


@pytest.mark.parametrize(
    "failure", [can.CanOperationError("Failed to receive", errno.ENETDOWN), OSError(errno.ENODEV, "gone")]
)
def test_an_adapter_that_vanishes_is_lost(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]], failure: Exception
) -> None:
    """Whatever python-can raises becomes an error of ours."""
    transport, bus = fake(failure)
    bus.refuse = failure
    with pytest.raises(TransportLostError):
        transport.receive(0.0)
    with pytest.raises(TransportLostError):
        transport.send(Message("123", b"x", 0))


@pytest.mark.parametrize("sending", [False, True])
def test_an_adapter_that_is_back_is_opened_again(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]], monkeypatch: pytest.MonkeyPatch, sending: bool
) -> None:
    """A pulled adapter's socket stays dead, and an adapter that allows one opening must be closed before."""
    gone = can.CanOperationError("Failed to transmit", errno.ENODEV)
    transport, dead = fake(gone)
    dead.refuse = gone
    with pytest.raises(TransportLostError):
        if sending:
            transport.send(Message("123", b"x", 0))
        else:
            transport.receive(0.0)
    fresh = FakeBus([frame(b"back")])

    def unplugged(**kwargs: object) -> can.BusABC:
        raise can.CanInitializationError("no such device")

    def only_once(**kwargs: object) -> can.BusABC:
        if not dead._is_shutdown:
            raise can.CanInitializationError("the channel is in use")
        return fresh

    monkeypatch.setattr(can, "Bus", unplugged)
    with pytest.raises(PortNotFoundError):
        transport.reopen()
    monkeypatch.setattr(can, "Bus", only_once)
    transport.reopen()
    assert transport.receive(0.0).payload == b"back"
    transport.send(Message("123", b"x", 0))
    assert len(fresh.sent) == 1


def test_a_bus_that_works_stays_open(fake: Callable[..., tuple[PythonCanTransport, FakeBus]]) -> None:
    """Opening it again would lose received frames."""
    transport, bus = fake(frame(b"kept"))
    transport.reopen()
    assert not bus._is_shutdown
    assert transport.receive(0.0).payload == b"kept"


@pytest.mark.parametrize(("kind", "controller"), [(0x004, 0x40), (0x204, 0x40), (0x100, 0)])
def test_a_controller_without_errors_again_is_no_trouble(
    fake: Callable[..., tuple[PythonCanTransport, FakeBus]], kind: int, controller: int
) -> None:
    """SocketCAN reports error-active (and restarted) after error-passive: the trouble is over."""
    transport, _ = fake(error_frame(0x004, 0x20), error_frame(kind, controller))
    with pytest.raises(TransportTimeoutError, match=r"within 0 s$"):
        transport.receive(0.0)
    assert transport.error_frames == 1
