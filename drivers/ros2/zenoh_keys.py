"""Keys, liveliness tokens and attachments of rmw_zenoh: text and bytes alone.

Sources: rmw_zenoh @ bfc065f (liveliness_utils.cpp, attachment_helpers.cpp of 038b5a4), and the clients of
others that talk to it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from deal_hw.errors import FrameError

TOKENS: Final = "@ros2_lv"
PUBLISHER, SUBSCRIBER, NODE = "MP", "MS", "NN"
QOS: Final = "::,1:,:,:,,"
"""Reliable, volatile, the newest message is kept: what controllers have (SystemDefaultsQoS)."""
_TOKEN_PARTS: Final = 13
_HEAD: Final = struct.Struct("<qqB")
_NUMBER: Final = struct.Struct("<q")
_KEYED: Final = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")
"""Names before the values, in the form of 2024 and 2025, each with its length."""
GID_BYTES: Final = 16


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Return the key of a topic's messages.

    Args:
        domain: ROS_DOMAIN_ID.
        topic: Full name of the topic.
        type_name: DDS name of its type.
        type_hash: Hash of the type; ``*`` for any.
    """
    return f"{domain}/{topic.strip('/')}/{type_name}/{type_hash}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """A liveliness token of a publisher or a subscriber.

    Attributes:
        session: Zenoh's id of its session.
        node_id: Number of its node in the session.
        entity_id: Its number in the session.
        kind: :data:`PUBLISHER` or :data:`SUBSCRIBER`; services and clients are others.
        namespace: Of its node; "" for none.
        node: Name of its node.
        topic: Full name of the topic, without its leading slash.
        type_name: DDS name of its type.
        type_hash: Hash of the type.
    """

    session: str
    node_id: int
    entity_id: int
    kind: str
    namespace: str
    node: str
    topic: str
    type_name: str
    type_hash: str

    def key(self, domain: int) -> str:
        """Return the token's key."""
        return "/".join(
            (
                TOKENS,
                str(domain),
                self.session,
                str(self.node_id),
                str(self.entity_id),
                self.kind,
                "%",
                _mangled(self.namespace),
                self.node,
                _mangled(self.topic),
                self.type_name,
                self.type_hash,
                QOS,
            )
        )

    @property
    def node_name(self) -> str:
        """The node's full name."""
        return f"{f'/{self.namespace}' if self.namespace else ''}/{self.node}"


def node_key(domain: int, session: str, node: str) -> str:
    """Return the token's key of a node without a namespace, number 0 in its session."""
    return f"{TOKENS}/{domain}/{session}/0/0/{NODE}/%/%/{node}"


def read_token(key: str) -> Token | None:
    """Return the token of an end of a topic in a key; None for a node's, or something else."""
    parts = key.split("/")
    if len(parts) != _TOKEN_PARTS or parts[0] != TOKENS:
        return None
    _, _, session, node_id, entity_id, kind, _, namespace, node, topic, type_name, type_hash, _ = parts
    if kind not in (PUBLISHER, SUBSCRIBER) or not (node_id.isdecimal() and entity_id.isdecimal()):
        return None
    return Token(
        session=session,
        node_id=int(node_id),
        entity_id=int(entity_id),
        kind=kind,
        namespace=_plain(namespace),
        node=node,
        topic=_plain(topic),
        type_name=type_name,
        type_hash=type_hash,
    )


@dataclass(frozen=True, slots=True)
class Attachment:
    """What accompanies a message.

    Attributes:
        sequence: Number of the message, of its publisher.
        stamp_ns: When it was published, by that computer's clock since 1970 [ns].
        gid: Id of the publisher, 16 bytes.
        keyed: Whether names stand before the values.
    """

    sequence: int
    stamp_ns: int
    gid: bytes
    keyed: bool = False

    def encode(self) -> bytes:
        """Return the bytes: 33, or 77 with names."""
        gid = bytes([len(self.gid)]) + self.gid
        if not self.keyed:
            return _HEAD.pack(self.sequence, self.stamp_ns, len(self.gid)) + self.gid
        names = _KEYED
        return (
            names[0] + _NUMBER.pack(self.sequence) + names[1] + _NUMBER.pack(self.stamp_ns) + names[2] + gid
        )


def read_attachment(data: bytes) -> Attachment:
    """Return the attachment in bytes of either form.

    Raises:
        FrameError: It has another form, such as that of the middle of 2024.
    """
    keyed = data.startswith(_KEYED[0])
    values = data
    if keyed:
        at, found = 0, []
        for name, size in zip(_KEYED, (8, 8, 1 + GID_BYTES), strict=True):
            if data[at : at + len(name)] != name:
                raise _refused(data)
            at += len(name)
            found.append(data[at : at + size])
            at += size
        values = b"".join(found)
        if at != len(data):
            raise _refused(data)
    if len(values) != _HEAD.size + GID_BYTES or values[_HEAD.size - 1] != GID_BYTES:
        raise _refused(data)
    sequence, stamp_ns, _ = _HEAD.unpack_from(values)
    return Attachment(sequence, stamp_ns, values[_HEAD.size :], keyed)


def _refused(data: bytes) -> FrameError:
    return FrameError(
        f"an attachment of {len(data)} bytes that begins {data[:8].hex(' ')!r} is not rmw_zenoh's"
    )


def _mangled(name: str) -> str:
    """Return a name as one part of a key: ``%`` for each slash, and before the first."""
    return "%" + name.strip("/").replace("/", "%")


def _plain(text: str) -> str:
    return text.strip("%").replace("%", "/")
