"""Topics over DDS (Cyclone DDS), as Unitree's robots use it."""

from __future__ import annotations

import socket
from collections.abc import Collection, Mapping

from deal_hw.clock import Clock
from deal_hw.drivers.transports.dds_discovery import OUR_NOTE, DdsSurvey, ros_user_data
from deal_hw.drivers.transports.dds_domain import acquire_domain, dds_errors, release_domain
from deal_hw.drivers.transports.dds_session import DdsSession
from deal_hw.drivers.transports.dds_types import build_types, load_types
from deal_hw.drivers.transports.interfaces import find_interface
from deal_hw.drivers.transports.topics import TYPES, TypedTopics
from deal_hw.errors import (
    ConfigurationError,
    FrameError,
    TransportError,
    TransportLostError,
    TransportTimeoutError,
    UnknownNameError,
)
from deal_hw.transport import Message, TopicEnd, TopicTransport, WireOptions

_OK, _BAD_PARAMETER, _TIMEOUT = 0, -3, -10
"""Return codes of the C library."""


class DdsTransport(TopicTransport):
    """A participant of a DDS domain.

    The quality of service is that of Unitree's SDKs (Cyclone's defaults: writers Reliable, readers
    BestEffort). It matches every setting of the robot. Two things differ: readers keep more than one message,
    and writers never wait.

    This class starts no thread. Cyclone's own threads receive, and :meth:`receive` waits without the GIL.
    Those threads inherit the scheduling of the thread that opens the transport, so set the real-time
    priority before. DDS does not survive a fork; a child process opens a transport of its own.

    Args:
        port: Network interface, by name or IPv4 address; "lo" for this machine only.
        clock: Gives the stamps.
        options: Only the domain is used.
        typed: Topics of ROS 2; None: those of Unitree's robots.
        note: What the participant says of itself; deal-hw's programs that command robots say so.
    """

    def __init__(
        self,
        port: str,
        clock: Clock,
        options: WireOptions | None = None,
        *,
        typed: TypedTopics | None = None,
        note: bytes = OUR_NOTE,
    ) -> None:
        self.port = port
        self._typed, self._note = typed, note
        self._types: Mapping[str, str] = TYPES if typed is None else typed.types
        self._clock = clock
        self._domain = (options or WireOptions()).domain
        self._topics: dict[str, tuple[bool, bool]] = {}
        self._live: DdsSession | None = None

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Declare the topics to use, from the next ``open`` on; calls add up."""
        for topic in (*publish, *subscribe):
            if topic not in self._types:
                raise UnknownNameError("DDS topic", topic, self._types)
            writes, reads = self._topics.get(topic, (False, False))
            self._topics[topic] = (writes or topic in publish, reads or topic in subscribe)

    def name_types(self, types: Mapping[str, str]) -> None:
        """Name the types of topics whose type is not the Go2's, from the next ``open`` on."""
        self._types = {**self._types, **types}

    def open(self) -> None:
        """Join the domain.

        Raises:
            PortNotFoundError: There is no such interface; the text lists the existing ones.
            MissingExtraError: cyclonedds is not installed.
            VersionMismatchError: Our types are not the robot's; joining could crash its DDS process.
            ConfigurationError: This process has the domain open on another interface.
        """
        if self._live is None:
            known = load_types() if self._typed is None else build_types(self._typed.structs)
            types = {topic: known[self._types[topic]] for topic in self._topics}
            acquire_domain(self._domain, find_interface(self.port))
            try:
                with dds_errors(f"DDS on {self.port}, domain {self._domain}"):
                    self._live = DdsSession(
                        self._domain, self._topics, types, self._clock, self._announced(), self._note
                    )
            except BaseException:
                release_domain(self._domain)
                raise

    def close(self) -> None:
        """Leave the domain; peers are informed at once."""
        live, self._live = self._live, None
        if live is not None:
            live.close()
            release_domain(self._domain)

    def send(self, message: Message) -> None:
        """Write at once.

        Raises:
            ConfigurationError: The topic is not declared.
            FrameError: The payload is no message of the topic's type.
            TransportTimeoutError: A peer confirms nothing and the queue is full; after 1 ms.
        """
        live = self._opened()
        writer = live.writers.get(message.channel)
        if writer is None:
            declared = ", ".join(live.writers) or "none"
            raise ConfigurationError(
                f"topic {message.channel!r} is not declared for publishing; declared: {declared}"
            )
        code = live.write(writer, message.payload)
        if code != _OK:
            raise _send_error(message, code, self._types[message.channel])

    def receive(self, timeout_s: float) -> Message:
        """Return the next message of all subscribed topics."""
        live = self._opened()
        message = live.next_message(max(0, round(timeout_s * 1e9)))
        if message is None:
            raise TransportTimeoutError(f"{self.port}: nothing arrived within {timeout_s:g} s")
        return message

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return the other participants that write a topic, each once.

        Left out are processes that died on this computer, which discovery remembers for 10 s.
        """
        ends = self._opened().discovery.endpoints()
        peers = {end.peer for end in ends if end.writes and end.topic == topic}
        return tuple(sorted(str(peer) for peer in peers if not peer.is_ghost()))

    def ends(self, topic: str) -> tuple[TopicEnd, ...]:
        """Return the writers and readers of a topic in other programs, without those that died here."""
        here = socket.gethostname()
        return tuple(
            TopicEnd(
                who=str(end.peer),
                writes=end.writes,
                type_name=end.type_name,
                type_hash=end.ros_hash,
                ours=end.peer.deal_hw and end.peer.host == here,
            )
            for end in self._opened().discovery.endpoints(topic)
            if not end.peer.is_ghost()
        )

    def survey(self) -> DdsSurvey:
        """Return the other participants of the domain, their types, and which of these do not match."""
        return self._opened().discovery.survey(self._types)

    def _announced(self) -> dict[str, bytes]:
        """Return what writers and readers of a topic announce: ROS 2's hash of its type."""
        if self._typed is None:
            return {}
        hashes = self._typed.hashes
        return {
            topic: ros_user_data(hashes[name]) for topic, name in self._typed.types.items() if name in hashes
        }

    def _opened(self) -> DdsSession:
        if self._live is None:
            raise TransportLostError(f"DDS on {self.port}: the transport is not open")
        return self._live


def _send_error(message: Message, code: int, type_name: str) -> TransportError | FrameError:
    if code == _TIMEOUT:
        return TransportTimeoutError(f"{message.channel}: a peer confirms nothing and the queue is full")
    if code == _BAD_PARAMETER:
        return FrameError(
            f"{message.channel}: {len(message.payload)} bytes starting {message.payload[:4].hex(' ')!r} are "
            f"no {type_name} in CDR with its 4-byte header"
        )
    return TransportError(f"{message.channel}: DDS did not take the message (code {code})")
