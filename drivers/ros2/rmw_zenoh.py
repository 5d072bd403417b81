"""Topics over rmw_zenoh, ROS 2's middleware on Zenoh: its keys, attachments and liveliness tokens."""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import socket
import time
from typing import TYPE_CHECKING, Any, Final

from deal_hw.clock import Clock
from deal_hw.drivers.ros2.graph import NO_HASH
from deal_hw.drivers.ros2.topics import PREFIX
from deal_hw.drivers.ros2.zenoh_keys import (
    GID_BYTES,
    PUBLISHER,
    SUBSCRIBER,
    TOKENS,
    Attachment,
    Token,
    data_key,
    node_key,
    read_attachment,
    read_token,
)
from deal_hw.drivers.transports.topics import TypedTopics
from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
from deal_hw.errors import FrameError, UnknownNameError
from deal_hw.transport import TopicEnd, WireOptions

if TYPE_CHECKING:
    import zenoh

_ROBOT: Final = "emulated_ros2_control"


class RmwZenohTransport(ZenohTransport):
    """A session of rmw_zenoh with two topics of one robot.

    rmw_zenoh needs a router (``rmw_zenohd``), to which this is a client. Each publisher and subscriber has a
    liveliness token, so that ROS 2 and other programs see them; those of others are followed from the opening
    on. Since ROS 2 Iron a key ends in a hash of the type; Humble has a word in its place. States are read
    under any of both, and commands are sent under the one that the controller's token shows.

    Args:
        port: End point of the router.
        clock: Gives the stamps.
        options: Whether to listen there in place of a router, and who may connect.
        typed: The topics and their types.
        domain: ROS_DOMAIN_ID.
        emulated: Whether this is an emulated robot, and no program that commands one.
    """

    _encoding = "application/cdr"

    def __init__(
        self,
        port: str,
        clock: Clock,
        options: WireOptions,
        *,
        typed: TypedTopics,
        domain: int,
        emulated: bool = False,
    ) -> None:
        super().__init__(port, clock, options)
        self._typed, self._domain = typed, domain
        # A node's name has no hyphen or dot, as a computer's may have.
        self._here = "deal_hw_" + hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]
        self._node = _ROBOT if emulated else self._here
        self._gid = secrets.token_bytes(GID_BYTES)
        self._counts: dict[str, int] = {}
        self._keyed = False
        self._ends: dict[str, Token] = {}
        self._tokens: list[Any] = []

    def declare(self, *, publish: Any = (), subscribe: Any = ()) -> None:
        """Declare the topics to use, from the next ``open`` on.

        Raises:
            UnknownNameError: A topic has no type.
        """
        for topic in (*publish, *subscribe):
            if topic not in self._typed.types:
                raise UnknownNameError("topic", topic, self._typed.types)
        super().declare(publish=publish, subscribe=subscribe)

    def close(self) -> None:
        """Close the session, and with it the tokens."""
        self._tokens.clear()
        super().close()

    def ends(self, topic: str) -> tuple[TopicEnd, ...]:
        """Return the publishers and subscribers of a topic in other sessions."""
        name = topic.removeprefix(PREFIX)
        return tuple(
            TopicEnd(
                who=f"node {token.node_name} (Zenoh session {token.session[:8]})",
                writes=token.kind == PUBLISHER,
                type_name=token.type_name,
                type_hash=token.type_hash,
                ours=token.node == self._here,
            )
            for token in tuple(self._ends.values())
            if token.topic == name
        )

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return the other publishers of a topic."""
        return tuple(end.who for end in self.ends(topic) if end.writes)

    def _published_key(self, topic: str) -> str:
        return self._key(topic, self._typed.hashes[self._typed.types[topic]])

    def _subscribed_key(self, topic: str) -> str:
        return self._key(topic, "*")

    def _key(self, topic: str, type_hash: str) -> str:
        return data_key(self._domain, topic.removeprefix(PREFIX), self._typed.types[topic], type_hash)

    def _next_attachment(self, topic: str) -> bytes:
        # The wall clock: subscribers compare the stamp with their own. Nothing here depends on it.
        sequence = self._counts[topic] = self._counts.get(topic, 0) + 1
        return Attachment(sequence, time.time_ns(), self._gid, self._keyed).encode()

    def _heed(self, attachment: bytes) -> None:
        """Send attachments in the form that the peer sends; by default the newest."""
        with contextlib.suppress(FrameError):
            self._keyed = read_attachment(attachment).keyed

    def _declare_more(self, session: zenoh.Session) -> None:
        from zenoh.handlers import FifoChannel

        zid = str(session.info.zid())
        liveliness = session.liveliness()
        self._ends.clear()
        self._tokens = [liveliness.declare_token(node_key(self._domain, zid, self._node))]
        ends = [(topic, PUBLISHER) for topic in sorted(self._publish)]
        ends += [(topic, SUBSCRIBER) for topic in sorted(self._subscribe)]
        for number, (topic, kind) in enumerate(ends, 1):
            type_name = self._typed.types[topic]
            token = Token(
                session=zid,
                node_id=0,
                entity_id=number,
                kind=kind,
                namespace="",
                node=self._node,
                topic=topic.removeprefix(PREFIX),
                type_name=type_name,
                type_hash=self._typed.hashes[type_name],
            )
            self._tokens.append(liveliness.declare_token(token.key(self._domain)))
        others = liveliness.declare_subscriber(f"{TOKENS}/{self._domain}/**", FifoChannel(4096), history=True)
        self._start(self._follow_tokens, "zenoh tokens", session, zid, others)

    def _follow_tokens(self, session: zenoh.Session, own: str, events: Any) -> None:
        import zenoh

        with contextlib.suppress(Exception):
            while True:
                event = events.recv()
                key = str(event.key_expr)
                token = read_token(key)
                if token is None or token.session == own:
                    continue
                if event.kind == zenoh.SampleKind.PUT:
                    self._ends[key] = token
                    self._meet(session, token)
                else:
                    self._ends.pop(key, None)

    def _meet(self, session: zenoh.Session, token: Token) -> None:
        """Publish under the key of a subscriber of ROS 2 Humble, which has no hash."""
        topic = PREFIX + token.topic
        if token.kind == SUBSCRIBER and token.type_hash == NO_HASH and topic in self._publish:
            publisher = self._publisher(session, self._key(topic, NO_HASH))
            with self._sending:
                self._publishers[topic] = publisher
