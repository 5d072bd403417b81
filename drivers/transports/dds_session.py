"""The objects of an open DDS transport."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Hashable, Mapping, Sequence
from itertools import accumulate, chain
from typing import Any, Final

from deal_hw.clock import Clock
from deal_hw.drivers.transports.dds_discovery import OUR_NOTE, Discovery
from deal_hw.drivers.transports.dds_domain import delete_entities
from deal_hw.errors import TransportError
from deal_hw.transport import Message

READER_DEPTH: Final = 64
"""Messages kept per topic for a reader that is late: 128 ms of states at 500 Hz."""
MAX_BLOCKING_NS: Final = 1_000_000
"""Longest wait of a send for a peer that confirms nothing [ns]."""
_SLICE_NS: Final = 100_000_000
"""A wait inside the library ignores signals; after this time [ns] Ctrl-C is handled."""


class ArrivalClock:
    """Estimates when messages arrived, which may be much earlier than they are read.

    Cyclone reports when a message was written, by the writer's clock. If a message ends a wait, it arrived
    now: this gives the offset of the two clocks, transit included. Any other message arrived now or earlier,
    which bounds the offset. The estimate follows a clock that jumps. Stamps of a topic never go back.
    """

    def __init__(self) -> None:
        self._offsets_ns: dict[Hashable, int] = {}

    def stamps_ns(
        self, topics: Sequence[Sequence[tuple[Hashable, int]]], now_ns: int, fresh: bool
    ) -> list[list[int]]:
        """Return when each message arrived [ns]: never later than now, and never falling within a topic.

        Args:
            topics: For each topic its messages in order: whose clock, and its time of writing [ns].
            now_ns: Our clock [ns].
            fresh: Whether the readers were empty until just now.
        """
        bounds: dict[Hashable, int] = {}
        for owner, written_ns in chain.from_iterable(topics):
            bound = now_ns - written_ns
            bounds[owner] = min(bounds.get(owner, bound), bound)
        for owner, bound in bounds.items():
            known = self._offsets_ns.get(owner)
            self._offsets_ns[owner] = bound if fresh or known is None else min(known, bound)
        return [
            list(accumulate((written_ns + self._offsets_ns[owner] for owner, written_ns in topic), max))
            for topic in topics
        ]


class DdsSession:
    """Participant, writers and readers.

    Args:
        domain: Number of the domain, which is open.
        topics: Topic -> whether it is written, whether it is read.
        types: Topic -> class of cyclonedds.
        clock: Gives the stamps.
        announced: Topic -> user data of its writer and reader.
        note: User data of the participant.

    Attributes:
        writers: Topic -> handle for ``write``.
        write: Writes a payload to a handle and returns the C library's code at once.
        discovery: Other participants of the domain.
    """

    def __init__(
        self,
        domain: int,
        topics: Mapping[str, tuple[bool, bool]],
        types: Mapping[str, Any],
        clock: Clock,
        announced: Mapping[str, bytes] | None = None,
        note: bytes = OUR_NOTE,
    ) -> None:
        # These two are private to cyclonedds. Its public calls build a Python object of each message, at ten
        # times the cost. The extra `dds` pins the version, and a test tells when they change.
        from cyclonedds._clayer import ddspy_take, ddspy_write
        from cyclonedds.core import DDSException, InstanceState, SampleState, ViewState

        self._failure = DDSException
        self.write = ddspy_write
        self.writers: dict[str, int] = {}
        self._take = ddspy_take
        self._mask = SampleState.Any | ViewState.Any | InstanceState.Any
        self._clock = clock
        self._entities: list[Any] = []
        self._readers: list[tuple[str, Any]] = []
        self._owners: dict[int, Hashable] = {}
        self._queue: deque[Message] = deque()
        self._last_ns: int | None = None
        self._arrivals = ArrivalClock()
        self._announced, self._note = announced or {}, note
        try:
            self._build(domain, topics, types)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Delete everything, the participant last."""
        delete_entities(self._entities)
        self._entities.clear()

    def next_message(self, timeout_ns: int) -> Message | None:
        """Return the message that arrived first; None if none arrives before the timeout [ns]."""
        if not self._queue:
            self._gather(fresh=False)
        deadline_ns = time.monotonic_ns() + timeout_ns
        while not self._queue and (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            if self._wait(min(left_ns, _SLICE_NS)):
                self._gather(fresh=True)
        return self._queue.popleft() if self._queue else None

    def _wait(self, timeout_ns: int) -> int:
        try:
            return int(self._waitset.wait(timeout_ns))
        except self._failure as error:
            raise TransportError(f"waiting for DDS messages failed: {error}") from error

    def _gather(self, fresh: bool) -> None:
        """Take all messages of the readers; ``fresh``: the readers were empty until just now."""
        now_ns = self._clock.now_ns()
        taken = [(topic, self._take_all(topic, reader)) for topic, reader in self._readers]
        if not any(samples for _, samples in taken):
            return
        written = [
            [(self._owner(info.publication_handle), info.source_timestamp) for _, info in samples]
            for _, samples in taken
        ]
        found: list[tuple[int, str, bytes]] = []
        stamps = self._arrivals.stamps_ns(written, now_ns, fresh)
        for (topic, samples), arrived in zip(taken, stamps, strict=True):
            found += [(stamp, topic, data) for stamp, (data, _) in zip(arrived, samples, strict=True)]
        found.sort(key=lambda entry: entry[0])
        for stamp_ns, topic, data in found:
            self._last_ns = stamp_ns if self._last_ns is None else max(self._last_ns, stamp_ns)
            self._queue.append(Message(topic, data, self._last_ns))

    def _take_all(self, topic: str, reader: Any) -> list[tuple[bytes, Any]]:
        taken = self._take(reader._ref, self._mask, READER_DEPTH)
        if isinstance(taken, int):
            raise TransportError(f"{topic}: DDS gives no messages (code {taken})")
        return [(data, info) for data, info in taken if info.valid_data]

    def _owner(self, writer: int) -> Hashable:
        """Return whose clock a writer uses: all writers of a participant share one."""
        owner = self._owners.get(writer)
        if owner is None:
            found = (reader.get_matched_publication_data(writer) for _, reader in self._readers)
            owner = next((end.participant_key for end in found if end is not None), writer)
            self._owners[writer] = owner
        return owner

    def _keep(self, entity: Any) -> Any:
        self._entities.append(entity)
        return entity

    def _build(self, domain: int, topics: Mapping[str, tuple[bool, bool]], types: Mapping[str, Any]) -> None:
        from cyclonedds.core import Policy, Qos, ReadCondition, WaitSet
        from cyclonedds.domain import DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        participant = self._keep(DomainParticipant(domain, qos=Qos(Policy.Userdata(self._note))))
        self.discovery = Discovery(participant)
        self._entities += self.discovery.entities
        writing = (Policy.Reliability.Reliable(MAX_BLOCKING_NS), Policy.History.KeepLast(1))
        reading = (
            Policy.Reliability.BestEffort,
            Policy.History.KeepLast(READER_DEPTH),
            Policy.IgnoreLocal.Participant,
        )
        conditions = []
        for name, (writes, reads) in topics.items():
            topic = self._keep(Topic(participant, name, types[name]))
            more = (Policy.Userdata(self._announced[name]),) if name in self._announced else ()
            if writes:
                self.writers[name] = self._keep(DataWriter(participant, topic, qos=Qos(*writing, *more)))._ref
            if reads:
                reader = self._keep(DataReader(participant, topic, qos=Qos(*reading, *more)))
                conditions.append(self._keep(ReadCondition(reader, self._mask)))
                self._readers.append((name, reader))
        # Made last, so deleted first: it detaches its conditions.
        self._waitset = self._keep(WaitSet(participant))
        for condition in conditions:
            self._waitset.attach(condition)
