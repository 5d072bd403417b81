"""Other participants of a DDS domain, from Cyclone's own discovery, without our own messages."""

from __future__ import annotations

import base64
import contextlib
import ipaddress
import socket
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from deal_hw.drivers.transports.dds_types import COMPLETE, MINIMAL, UINT8, hash_text
from deal_hw.drivers.transports.interfaces import list_interfaces

OUR_NOTE: Final = b"deal-hw"
"""User data of deal-hw's participants."""

_VENDORS: Final = {
    b"\x01\x01": "RTI Connext",
    b"\x01\x02": "OpenSplice",
    b"\x01\x03": "OpenDDS",
    b"\x01\x0f": "Fast DDS",
    b"\x01\x10": "Cyclone DDS",
    b"\x01\x12": "RustDDS",
}
"""First two bytes of a GUID -> implementation (RTPS 2.5, section 9.3.1.5)."""
_BATCH: Final = 256


@dataclass(frozen=True, slots=True)
class DdsPeer:
    """A participant of the domain. Unknown fields are "" or 0.

    Attributes:
        key: Its GUID.
        vendor: DDS implementation.
        host: Name of its computer.
        process: Name of its program.
        pid: Number of its process.
        addresses: IPv4 addresses that it listens on.
        deal_hw: Whether it is a deal-hw of any computer.
    """

    key: uuid.UUID
    vendor: str
    host: str = ""
    process: str = ""
    pid: int = 0
    addresses: tuple[str, ...] = ()
    deal_hw: bool = False

    def __str__(self) -> str:
        parts = [f"process {self.process or 'unknown'}{f' (pid {self.pid})' if self.pid else ''}"]
        if self.host:
            parts.append(f"on host {self.host}")
        if self.addresses:
            parts.append(f"at {', '.join(self.addresses)}")
        name = "deal-hw" if self.deal_hw else self.vendor
        return f"{name} {self.key.hex[:24]}: {' '.join(parts)}"

    def is_ghost(self) -> bool:
        """Return whether its process has died on this very computer; discovery forgets it after 10 s."""
        if not self.pid or self.host != socket.gethostname() or Path(f"/proc/{self.pid}").exists():
            return False
        ours = {address for interface in list_interfaces() for address in interface.addresses}
        return bool(self.addresses) and ours.issuperset(self.addresses)


@dataclass(frozen=True, slots=True)
class DdsEndpoint:
    """A writer or reader of a topic.

    Attributes:
        key: Its GUID.
        topic: Topic.
        type_name: DDS name of the topic's type.
        type_hash: Complete XTypes hash of that type in hexadecimal; "" if it is not reported.
        writes: Whether it writes the topic.
        peer: The participant that it belongs to.
        ros_hash: ROS 2's hash of that type, from its user data; "" without (Humble and older, no ROS).
    """

    key: uuid.UUID
    topic: str
    type_name: str
    type_hash: str
    writes: bool
    peer: DdsPeer
    ros_hash: str = ""

    @property
    def shown_hash(self) -> str:
        """Text with the type's hash: the minimal one of the vendor's headers, if it is the robot's type."""
        if self.type_hash and self.type_hash == COMPLETE.get(self.type_name):
            return f"type hash {MINIMAL[self.type_name]}, the robot's"
        return f"complete type hash {self.type_hash}" if self.type_hash else "type hash not reported"

    def complaint(self, type_name: str) -> str | None:
        """Return text on why this endpoint and our type do not match; None if they match."""
        role = f"{'writer' if self.writes else 'reader'} of {self.topic} ({self.peer})"
        if self.type_name != type_name:
            return f"{role}: type {self.type_name}, not {type_name}; is it another robot or another domain?"
        if not self.type_hash or self.type_hash == COMPLETE.get(type_name):
            return None
        if self.type_hash == UINT8.get(type_name):
            return (
                f"{role}: declares octets as uint8, which crashes Cyclone DDS 0.10.2, the robot's version; "
                "stop it and declare them as types.byte"
            )
        known = COMPLETE.get(type_name)
        return f"{role}: complete type hash {self.type_hash}, not {known}; is its firmware newer?"


@dataclass(frozen=True, slots=True)
class DdsSurvey:
    """The participants of a domain and their endpoints.

    Attributes:
        peers: Other participants.
        endpoints: Their writers and readers.
        complaints: Texts on endpoints whose types do not match ours.
    """

    peers: tuple[DdsPeer, ...]
    endpoints: tuple[DdsEndpoint, ...]
    complaints: tuple[str, ...]


class Discovery:
    """Follows the built-in topics; each call reads only what is new (some 10 us if nothing is).

    Args:
        participant: Our participant of cyclonedds; it and its endpoints are left out.

    Attributes:
        entities: DDS entities to delete at the end.
    """

    def __init__(self, participant: Any) -> None:
        from cyclonedds import builtin
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

        self._own = participant.guid
        self._peers: dict[uuid.UUID, DdsPeer] = {}
        self._endpoints: dict[uuid.UUID, tuple[uuid.UUID, bool, Any]] = {}
        mask = ViewState.Any | InstanceState.Any | SampleState.Any
        self.entities: list[Any] = []
        self._sources = []
        for topic in (
            builtin.BuiltinTopicDcpsParticipant,
            builtin.BuiltinTopicDcpsPublication,
            builtin.BuiltinTopicDcpsSubscription,
        ):
            reader = builtin.BuiltinDataReader(participant, topic)
            condition = ReadCondition(reader, mask)
            self.entities += [reader, condition]
            self._sources.append((reader, condition))

    def peers(self) -> tuple[DdsPeer, ...]:
        """Return the other participants."""
        self._update()
        return tuple(self._peers.values())

    def endpoints(self, topic: str = "") -> tuple[DdsEndpoint, ...]:
        """Return the writers and readers of other participants, of one topic or of all."""
        self._update()
        return tuple(
            DdsEndpoint(
                key=key,
                topic=sample.topic_name,
                type_name=sample.type_name,
                type_hash=hash_text(sample.type_id),
                writes=writes,
                peer=self._peers.get(owner, DdsPeer(owner, _vendor(owner))),
                ros_hash=_ros_hash(_user_data(sample.qos.asdict())),
            )
            for key, (owner, writes, sample) in self._endpoints.items()
            if topic in ("", sample.topic_name)
        )

    def survey(self, types: Mapping[str, str]) -> DdsSurvey:
        """Return the survey; ``types`` maps each topic to its expected type."""
        endpoints = self.endpoints()
        found = [end.complaint(types[end.topic]) for end in endpoints if end.topic in types]
        return DdsSurvey(self.peers(), endpoints, tuple(text for text in found if text))

    def _update(self) -> None:
        participants, publications, subscriptions = self._sources
        for sample in _news(*participants):
            if sample.sample_info.valid_data and sample.key != self._own:
                self._peers[sample.key] = _peer(sample)
            else:
                self._peers.pop(sample.key, None)
        for source, writes in ((publications, True), (subscriptions, False)):
            for sample in _news(*source):
                if not sample.sample_info.valid_data:
                    self._endpoints.pop(sample.key, None)
                elif sample.participant_key != self._own:
                    self._endpoints[sample.key] = (sample.participant_key, writes, sample)


def _news(reader: Any, condition: Any) -> Iterable[Any]:
    while samples := reader.take(_BATCH, condition=condition):
        yield from samples


def _peer(sample: Any) -> DdsPeer:
    settings = sample.qos.asdict()

    def word(key: str) -> str:
        return str(settings.get(f"Property<{key}>", {}).get("value", ""))

    note = _user_data(settings)
    pid = word("__Pid")
    return DdsPeer(
        key=sample.key,
        vendor=_vendor(sample.key),
        host=word("__Hostname"),
        process=word("__ProcessName"),
        pid=int(pid) if pid.isdecimal() else 0,
        addresses=_unicast(word("__NetworkAddresses")),
        deal_hw=note.startswith(OUR_NOTE),
    )


def ros_user_data(type_hash: str) -> bytes:
    """Return the user data by which ROS 2 announces a type's hash (rmw_cyclonedds, rmw_fastrtps)."""
    return f"typehash={type_hash};".encode()


def _ros_hash(user_data: bytes) -> str:
    """Return the hash in user data such as ``typehash=RIHS01_...;``; "" if there is none."""
    for entry in user_data.decode("ascii", "replace").split(";"):
        name, _, value = entry.partition("=")
        if name == "typehash":
            return value
    return ""


def _user_data(settings: Mapping[str, Any]) -> bytes:
    return base64.b64decode(settings.get("Userdata", {}).get("data", ""))


def _unicast(locators: str) -> tuple[str, ...]:
    """Return the addresses in text like ``udp/239.255.0.1:7401@1,udp/127.0.0.1:52537@1`` without groups."""
    found: dict[str, None] = {}
    for entry in locators.split(","):
        host = entry.rpartition("/")[2].partition(":")[0]
        with contextlib.suppress(ValueError):
            if not ipaddress.IPv4Address(host).is_multicast:
                found[host] = None
    return tuple(found)


def _vendor(key: uuid.UUID) -> str:
    return _VENDORS.get(key.bytes[:2], f"DDS vendor {key.bytes[:2].hex()}")
