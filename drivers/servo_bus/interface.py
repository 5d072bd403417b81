"""A bus of servos: what Dynamixel and Feetech have in common.

A subclass knows the packets. Here are the port, the deadlines, and the requests that wait for their answers.
"""

from __future__ import annotations

import abc
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple, TypeAlias

from deal_hw.clock import Clock
from deal_hw.drivers.servo_bus.master_watch import MasterWatch
from deal_hw.drivers.servo_bus.registers import Register
from deal_hw.errors import DealHwError, FrameError, TransportTimeoutError
from deal_hw.transport import Message, Transport

BITS_PER_BYTE: Final = 10
"""On the wire: start bit, 8 data bits, stop bit."""
BROADCAST: Final = 0xFE
"""Id by which all servos are asked."""
_QUEUE: Final = 4096
_SILENCE_NS: Final = 20_000_000
"""Silence after a failed request, beyond which no late answer to it is expected [ns]."""
_ECHOES: Final = 64
"""Messages that are remembered, to tell their echo from another master's packets."""
_MOST_LATE: Final = 100
"""Messages that are discarded at most after a failed request."""

Writes: TypeAlias = Sequence[tuple[int, Mapping[int, bytes]]]
"""Sync writes: an address, and the bytes that each servo gets there."""


class Answer(NamedTuple):
    """A servo's answer to a ping."""

    model: int
    firmware: int


class WantedAnswer(NamedTuple):
    """A requested answer.

    Attributes:
        ids: The servos.
        address: The first register.
        size: Bytes of each servo.
        fast: Whether they come in one packet.
        until_ns: Deadline [ns].
        commands: Commands that were written before it, as the bus' watch counts them.
    """

    ids: tuple[int, ...]
    address: int
    size: int
    fast: bool
    until_ns: int
    commands: int


class SilentServosError(TransportTimeoutError):
    """Servos of a group did not answer, and no corrupt bytes came.

    Attributes:
        answered: The ids of those that did.

    Args:
        silent: The ids of those that did not.
        answered: The ids of those that did.
    """

    def __init__(self, silent: Sequence[int], answered: Sequence[int]) -> None:
        self.answered = tuple(answered)
        others = f"; servos {self.answered} did" if self.answered else ""
        super().__init__(f"servos {tuple(silent)} do not answer{others}")


class SpoiltAnswerError(FrameError):
    """The answers of a group are corrupt.

    Attributes:
        answered: The ids of those servos that answered soundly, once.

    Args:
        text: What is wrong.
        answered: Those ids.
    """

    def __init__(self, text: str, answered: Sequence[int] = ()) -> None:
        self.answered = tuple(answered)
        super().__init__(text)


class Port:
    """Sends and receives the bytes of a bus.

    Attributes:
        baud_rate: Bits per second.
        answer_s: Additional time for an answer [s].
        wire: Messages sent and received; the newest few thousand.
        buffer: Received bytes that nobody has read.
        observer: Called with all bytes as they are received, also those that are discarded later.
        received_bytes: Received bytes so far, valid or not.
        stamp_ns: Time of the newest bytes [ns].

    Args:
        transport: A byte stream, open.
        clock: The clock of its stamps.
        baud_rate: Baud rate of the bus, for the time of bytes.
        answer_s: Additional time for an answer [s].
    """

    def __init__(self, transport: Transport, clock: Clock, baud_rate: int, answer_s: float) -> None:
        self.baud_rate, self.answer_s = baud_rate, answer_s
        self.wire: deque[Message] = deque(maxlen=_QUEUE)
        self.buffer = bytearray()
        self.written = bytearray()
        self.received_bytes = self.stamp_ns = 0
        self.observer: Callable[[bytes], None] = lambda data: None
        self._sent: deque[bytes] = deque(maxlen=_ECHOES)
        self._transport, self._clock = transport, clock

    def answer_ns(self, length: int) -> int:
        """Return how long an answer of that many bytes may take [ns]."""
        return round((length * BITS_PER_BYTE / self.baud_rate + self.answer_s) * 1e9)

    def write(self, packet: bytes) -> None:
        """Keep a packet until :meth:`flush`."""
        self.written += packet

    def flush(self) -> None:
        """Send the written packets as one message."""
        if self.written:
            data, self.written = bytes(self.written), bytearray()
            message = Message("tx", data, self._clock.now_ns())
            self._sent.append(data)
            self._transport.send(Message("", data, message.stamp_ns))
            self.wire.append(message)

    def sent(self, packet: bytes) -> bool:
        """Return whether a packet is one of those that were sent last."""
        return any(packet in data for data in self._sent)

    def receive(self, deadline_ns: int) -> bool:
        """Wait for bytes; return whether any arrived."""
        try:
            message = self._transport.receive(max(0, deadline_ns - self._clock.now_ns()) / 1e9)
        except TransportTimeoutError:
            return False
        self.buffer += message.payload
        self.received_bytes += len(message.payload)
        self.stamp_ns = message.stamp_ns
        self.wire.append(Message("rx", message.payload, message.stamp_ns))
        self.observer(message.payload)
        return True

    def drop(self) -> None:
        """Discard bytes that arrived too late for the previous answer."""
        while self.receive(0):
            pass
        self.buffer.clear()


class ServoBus(abc.ABC):
    """Reads and writes servos' registers.

    All deadlines are of the given clock. One corrupt answer is one missed sample: the bus counts it, raises
    its error, and the next request begins with an empty buffer.

    Attributes:
        errors: Corrupt or missing answers so far.
        watch: Recognises another master by what is written and read here.
        echoes: Whether the adapter returns this computer's own packets.
        doubled: Servos that answered the newest request to a group twice.

    Args:
        port: The port.
        clock: The clock of its stamps.
        watch: Made for the servos' register of the goal.
    """

    def __init__(self, port: Port, clock: Clock, watch: MasterWatch) -> None:
        self.errors = 0
        self.watch, self.echoes = watch, False
        self.doubled: frozenset[int] = frozenset()
        self._clock = clock
        self._port = port
        port.observer = self._find_requests
        self._wanted: deque[WantedAnswer] = deque()

    @abc.abstractmethod
    def _find_requests(self, data: bytes) -> None:
        """Look for packets that ask servos in received bytes: echoes of our own, and another master's."""

    def _note_request(self, instruction: str, servo: int) -> None:
        """Take another master's packet: the name of its instruction, and whom it asks."""
        whom = "all servos" if servo == BROADCAST else f"servo {servo}"
        self.watch.request(
            f"a packet ({instruction.lower().replace('_', ' ')}) to {whom}", self._clock.now_ns()
        )

    @property
    def received_bytes(self) -> int:
        """Received bytes so far, valid or not."""
        return self._port.received_bytes

    @property
    def stamp_ns(self) -> int:
        """Time of the newest bytes [ns]."""
        return self._port.stamp_ns

    @property
    def wire(self) -> deque[Message]:
        """Messages sent and received; the newest few thousand."""
        return self._port.wire

    @abc.abstractmethod
    def ping(self, servo: int) -> Answer:
        """Return model and firmware of a servo.

        Raises:
            TransportTimeoutError: It is silent.
            FrameError: Its answer is corrupt.
        """

    @abc.abstractmethod
    def broadcast_ping(self, seconds: float) -> dict[int, Answer]:
        """Return all servos that answer a broadcast ping within a time [s]."""

    @abc.abstractmethod
    def read(self, servo: int, register: Register) -> int:
        """Return a register, without sign; raises as :meth:`ping`."""

    @abc.abstractmethod
    def write(self, servo: int, register: Register, value: int) -> None:
        """Write a register and wait for the servo's confirmation; raises as :meth:`ping`.

        Raises:
            ProtocolError: The servo refuses the value.
        """

    @staticmethod
    @abc.abstractmethod
    def answer_bytes(servos: int, size: int, fast: bool) -> int:
        """Return the number of bytes of a group's answer."""

    def post(self, writes: Writes) -> int:
        """Write registers in one message without waiting; return the send time [ns].

        Args:
            writes: Sync writes, in order: an address, and the bytes of each servo.
        """
        self._write_all(writes)
        now_ns = self._clock.now_ns()
        self._port.flush()
        return now_ns

    def ask(
        self,
        servos: Sequence[int],
        address: int,
        size: int,
        *,
        fast: bool = False,
        writes: Writes = (),
        behind: bool = False,
    ) -> int:
        """Request the same registers of servos in one message; return the send time [ns].

        Args:
            servos: Their ids.
            address: The first register.
            size: Number of bytes of each.
            fast: Whether they answer in one packet, where the protocol has that, or each in its own.
            writes: Sync writes before it in the same message, as in :meth:`post`.
            behind: Wait for this answer after the one before it; otherwise that one is forgotten.
        """
        if not behind:
            self._forget()
        self._write_all(writes)
        self._put_group_read(servos, address, size, fast)
        within_ns = self._port.answer_ns(self._wire_bytes(len(servos), size, fast))
        now_ns = self._clock.now_ns()
        self._port.flush()
        commands = self.watch.commands
        self._wanted.append(WantedAnswer(tuple(servos), address, size, fast, now_ns + within_ns, commands))
        return now_ns

    def take(self, deadline_ns: int) -> dict[int, bytes] | None:
        """Return the registers of the oldest question by id, waiting for them until a deadline at most.

        Returns:
            None if no complete answer arrived until the deadline, but may still arrive.

        Raises:
            SilentServosError: Some or all servos are silent.
            FrameError: The answer is corrupt.
        """
        wanted = self._wanted[0]
        try:
            while (found := self._collect(wanted)) is None:
                if self._clock.now_ns() >= wanted.until_ns:
                    raise self._incomplete(wanted)
                if not self._port.receive(min(deadline_ns, wanted.until_ns)) and (
                    self._clock.now_ns() >= deadline_ns
                ):
                    return None
        except (FrameError, TransportTimeoutError):
            self.errors += 1
            self._wanted.popleft()
            raise
        self._wanted.popleft()
        self.watch.read(wanted.address, found, wanted.commands, self._clock.now_ns())
        return found

    def settle(self) -> None:
        """Discard what arrives until the line is silent; for after a failed request, before it is repeated.

        An answer to a request that was given up may still come. It would be taken for that to the next
        request, or as a corrupt one; and the next answer for that to the one after it, without an end.
        """
        for _ in range(_MOST_LATE):
            if not self._port.receive(self._clock.now_ns() + _SILENCE_NS):
                break
        self._forget()

    def _forget(self) -> None:
        """Discard received bytes and the answers that were still wanted."""
        self._port.drop()
        self._wanted.clear()

    def _write_all(self, writes: Writes) -> None:
        self._put_writes(writes)
        for address, values in writes:
            self.watch.wrote(address, values)

    @abc.abstractmethod
    def _put_writes(self, writes: Writes) -> None:
        """Write sync writes to the port."""

    @abc.abstractmethod
    def _put_group_read(self, servos: Sequence[int], address: int, size: int, fast: bool) -> None:
        """Write the request for the same registers of servos to the port."""

    @abc.abstractmethod
    def _wire_bytes(self, servos: int, size: int, fast: bool) -> int:
        """Return the bytes that a group's answer waits for, before its request is sent."""

    @abc.abstractmethod
    def _collect(self, wanted: WantedAnswer) -> dict[int, bytes] | None:
        """Return an answer from the received bytes; None while it may still become complete.

        Raises:
            FrameError: It is corrupt.
            SilentServosError: It will not become complete.
        """

    @abc.abstractmethod
    def _incomplete(self, wanted: WantedAnswer) -> DealHwError:
        """Return the error for an answer that is not complete at its deadline."""
