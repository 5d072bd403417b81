"""Messages with topics over Zenoh, as zenoh-bridge-dds maps DDS: topic as key, CDR as payload."""

from __future__ import annotations

import atexit
import contextlib
import json
import re
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.drivers.transports import zenoh_session
from deal_hw.drivers.transports.arrivals import Arrivals
from deal_hw.drivers.transports.zenoh_stamps import Echoes
from deal_hw.errors import (
    ConfigurationError,
    MissingExtraError,
    PortBusyError,
    PortNotFoundError,
    TransportLostError,
    TransportTimeoutError,
)
from deal_hw.transport import Message, TopicTransport, WireOptions

if TYPE_CHECKING:
    import zenoh
    from zenoh.handlers import Handler, RingChannel

T = TypeVar("T")

_TOPIC: Final = re.compile(r"[^/*$?#\s]+(/[^/*$?#\s]+)*")
_AT_HAND: Final = 256
"""Most messages kept for a reader: half a second of states. The oldest are dropped."""
_JOIN_S: Final = 1.0
_REOPEN_PROBE_S: Final = 0.2
_SILENT_NS: Final = 2_000_000_000
"""After this silence :meth:`reopen` makes a new session [ns]: as long as a peer's lease."""


class ZenohTransport(TopicTransport):
    """A Zenoh session with named end points and no discovery. No call waits for a peer.

    Sending never waits: messages that a stalled peer cannot take are dropped. A thread for each subscribed
    topic stamps messages as they arrive. It has the scheduling of the thread that calls :meth:`open`; so do
    Zenoh's own threads, from the first session of a process on. A process with deadlines therefore calls
    ``open`` after it has become a real-time process.

    The side that listens has no fixed peer, so it notices a lost link only by silence. Zenoh
    reports it to the side that connected to an end point. Then ``send`` and ``receive`` raise
    :class:`~deal_hw.errors.TransportLostError`; ``receive`` first returns the messages already received.
    Zenoh keeps trying to connect, and afterwards both work again. That side also numbers its messages, and
    returns the newest stamp of the other side with each (:mod:`zenoh_stamps`). A message with an attachment
    of its own keeps that.

    Args:
        port: End points, comma separated: "tcp/127.0.0.1:7447". A peer connects to all of them, a client to
            the first that answers.
        clock: Gives the stamps.
        options: Whether to listen there, the mode, and who may connect.
        settings: Further settings of the session, by their paths in Zenoh's configuration.
    """

    def __init__(
        self,
        port: str,
        clock: Clock | None = None,
        options: WireOptions | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self.port = port
        self._clock = clock or MonotonicClock()
        self._options = options or WireOptions()
        self._settings = settings or {}
        self._echoes: Echoes | None = None
        self._publish: set[str] = set()
        self._subscribe: set[str] = set()
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._threads: list[threading.Thread] = []
        self._arrived: Arrivals[Message | None] = Arrivals(_AT_HAND)
        self._lost = False
        self._heard_ns = 0
        # A daemon thread that is inside Zenoh when the interpreter ends makes the process abort, so close()
        # waits for it. Re-entrant, because a signal handler may close what the code that it interrupted uses.
        self._sending = threading.RLock()

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Declare the topics to use, from the next ``open`` on.

        Raises:
            ConfigurationError: A name is no topic, such as one with a wildcard.
        """
        for topic in (*publish, *subscribe):
            if not _TOPIC.fullmatch(topic):
                raise ConfigurationError(
                    f"topic {topic!r}: write it as on the wire of DDS, such as rt/lowstate, without a "
                    "leading slash and without * $ ? #"
                )
        self._publish |= set(publish)
        self._subscribe |= set(subscribe)

    def open(self) -> None:
        """Listen at the end points, or connect to them and wait for the session.

        Raises:
            ConfigurationError: The end points cannot be used as they are.
            MissingExtraError: Zenoh is not installed.
            PortNotFoundError: Nothing listens there, or it is no Zenoh, or there is no such address here.
            PortBusyError: Another process listens there.
            TransportTimeoutError: The host does not answer.
        """
        if self._session is not None:
            return
        self._arrived, self._lost = Arrivals(_AT_HAND), False
        self._echoes = None if self._options.listen else Echoes()
        self._heard_ns = self._clock.now_ns()
        self._session = self._open_session()
        # A process that ends by an exception must not stay alive for its peers.
        atexit.register(self.close)
        try:
            self._declare_all(self._session)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the session; messages that were not received are lost."""
        session, self._session = self._session, None
        with self._sending:
            self._publishers = {}
        if session is None:
            return
        atexit.unregister(self.close)
        with contextlib.suppress(Exception):
            session.close()  # type: ignore[no-untyped-call]
        # Their channels are closed now, so they end; one that hangs is a daemon and blocks no exit.
        threads, self._threads = self._threads, []
        for thread in threads:
            thread.join(_JOIN_S)

    def reopen(self) -> None:
        """Make a new session if the link is gone or silent, and the end point answers.

        Zenoh tries by itself, too. But after a cable was out for some seconds, it neither reported a lost TLS
        link nor made a new one (measured: 24 s, with an interface of a namespace).

        Raises:
            TransportError: The end points do not answer, or there is no session with them.
        """
        silent = self._clock.now_ns() - self._heard_ns > _SILENT_NS
        if self._session is not None and (self._options.listen or not (self._lost or silent)):
            return
        # A short check only: a caller that repeats a command must not wait for a host that is gone.
        zenoh_session.answering(zenoh_session.parse_endpoints(self.port), self._options, _REOPEN_PROBE_S)
        self.close()
        self.open()

    def send(self, message: Message) -> None:
        """Put a message on the wire, or drop it if a peer takes no more.

        Raises:
            ConfigurationError: The topic was not declared for publishing.
            TransportLostError: The link to the end points is gone, or the transport is not open.
        """
        with self._sending:
            publisher = self._publishers.get(message.channel)
            if publisher is None:
                self._opened()
                raise ConfigurationError(
                    f"{self.port}: topic {message.channel!r} is not declared for publishing; declared: "
                    f"{', '.join(sorted(self._publish)) or '(none)'}"
                )
            if self._lost:
                raise self._gone()
            attachment = message.attachment or self._next_attachment(message.channel)
            try:
                publisher.put(message.payload, attachment=attachment)
            except Exception as error:  # Zenoh raises an error of its own, which is not imported here.
                raise TransportLostError(f"{self.port}: sending failed: {error}") from error

    def receive(self, timeout_s: float) -> Message:
        """Return the next message of the subscribed topics."""
        self._opened()
        try:
            message = self._arrived.take(timeout_s)
        except TimeoutError:
            if self._lost:
                raise self._gone() from None
            raise TransportTimeoutError(f"{self.port}: nothing arrived within {timeout_s:g} s") from None
        if message is not None:
            return message
        if self._lost:
            raise self._gone()
        return self.receive(timeout_s)

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return nothing: Zenoh does not report writers."""
        return ()

    @property
    def stream(self) -> int | None:
        """Number of the stream of our messages, by which a bridge identifies us; None if there is none."""
        return None if self._echoes is None else self._echoes.stream

    def _open_session(self) -> zenoh.Session:
        endpoints = zenoh_session.parse_endpoints(self.port)
        zenoh_session.check_security(endpoints, self._options)
        try:
            import zenoh
        except ImportError as error:
            raise MissingExtraError("eclipse-zenoh", "zenoh") from error
        if not self._options.listen:
            endpoints = zenoh_session.answering(endpoints, self._options)

        try:
            config = zenoh.Config()
            chosen = zenoh_session.settings(endpoints, self._options) | dict(self._settings)
            for key, value in chosen.items():
                config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigurationError(f"{self.port}: Zenoh refuses a setting: {error}") from error
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            raise self._open_error(endpoints, str(error)) from error

    def _open_error(
        self, endpoints: tuple[zenoh_session.Endpoint, ...], text: str
    ) -> PortNotFoundError | PortBusyError:
        if "Address already in use" in text:
            return PortBusyError(f"{self.port}: another process listens there; name another port")
        if self._options.listen:
            return PortNotFoundError(
                f"{self.port}: cannot listen there ({text[:200]}); name an address of this machine"
            )
        reason = zenoh_session.why_no_session(endpoints, self._options)
        return PortNotFoundError(f"{self.port}: no Zenoh session: {reason}")

    def _declare_all(self, session: zenoh.Session) -> None:
        import zenoh

        if not self._options.listen:
            events = session.info.declare_transport_events_listener(_ring(), history=True)
            # The link may be gone again already, and then it has no history.
            self._lost = not session.info.transports()
            self._start(self._follow_links, "zenoh links", events, self._arrived)
        for topic in sorted(self._subscribe):
            # Handlers, never callbacks: a callback's thread prevents the interpreter's end.
            subscriber = session.declare_subscriber(
                self._subscribed_key(topic), _ring(), allowed_origin=zenoh.Locality.REMOTE
            )
            self._start(self._read, f"zenoh {topic}", topic, subscriber, self._arrived)
        for topic in sorted(self._publish):
            self._publishers[topic] = self._publisher(session, self._published_key(topic))
        self._declare_more(session)

    def _publisher(self, session: zenoh.Session, key: str) -> zenoh.Publisher:
        import zenoh

        return session.declare_publisher(
            key,
            encoding=self._encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            allowed_destination=zenoh.Locality.REMOTE,
        )

    # What another use of Zenoh does in its own way.

    _encoding: ClassVar[str | None] = None
    """Encoding of the messages; None: none is said."""

    def _published_key(self, topic: str) -> str:
        """Return the key under which a topic is published."""
        return topic

    def _subscribed_key(self, topic: str) -> str:
        """Return the keys, with wildcards, that are a topic's."""
        return topic

    def _next_attachment(self, topic: str) -> bytes | None:
        """Return the attachment of the next message on a topic; None for none."""
        return self._echoes.next() if self._echoes else None

    def _heed(self, attachment: bytes) -> None:
        """Take the attachment of a received message."""
        if self._echoes is not None:
            self._echoes.hear(attachment)

    def _declare_more(self, session: zenoh.Session) -> None:
        """Declare what else belongs to the session, such as liveliness tokens."""

    def _start(self, run: Callable[..., None], name: str, *arguments: object) -> None:
        thread = threading.Thread(target=run, name=name, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _read(
        self,
        topic: str,
        subscriber: zenoh.Subscriber[Handler[zenoh.Sample]],
        arrived: Arrivals[Message | None],
    ) -> None:
        for sample in _until_closed(subscriber.recv):
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            if attachment:
                self._heed(attachment)
            self._heard_ns = now_ns = self._clock.now_ns()
            arrived.put(Message(topic, sample.payload.to_bytes(), now_ns, attachment))

    def _follow_links(
        self,
        events: zenoh.TransportEventsListener[Handler[zenoh.TransportEvent]],
        arrived: Arrivals[Message | None],
    ) -> None:
        import zenoh

        links: set[str] = set()
        for event in _until_closed(events.recv):
            if event.kind == zenoh.SampleKind.PUT:
                links.add(str(event.transport.zid))
            else:
                links.discard(str(event.transport.zid))
            self._lost = not links
            if self._lost:
                # Wake a waiting reader.
                arrived.put(None)

    def _opened(self) -> None:
        if self._session is None:
            raise TransportLostError(f"{self.port}: the transport is not open")

    def _gone(self) -> TransportLostError:
        return TransportLostError(
            f"{self.port}: no connection: the bridge or emulator stopped, or the network is down; "
            "Zenoh keeps trying to connect"
        )


def _ring() -> RingChannel[Any]:
    from zenoh.handlers import RingChannel

    return RingChannel(_AT_HAND)


def _until_closed(receive: Callable[[], T]) -> Iterator[T]:
    """Yield messages until the session is closed."""
    with contextlib.suppress(Exception):
        while True:
            yield receive()
