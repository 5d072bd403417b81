"""Dynamixel packets over a byte stream: ROBOTIS' SDK encodes and decodes them, our transport carries them.

The SDK's own port waits in a busy loop on the wall clock, and 34 ms for an absent servo. Here its packet
handler gets our port: the transport waits, on a monotonic clock, and an answer may take its time on the wire
plus an allowance. A group's answer is read without blocking: bytes are collected as they arrive, and the SDK
gets them when the last packet is complete.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

from deal_hw.clock import Clock
from deal_hw.drivers.servo_bus import packets
from deal_hw.drivers.servo_bus.interface import (
    BROADCAST,
    Answer,
    Port,
    ServoBus,
    SilentServosError,
    SpoiltAnswerError,
    WantedAnswer,
    Writes,
)
from deal_hw.drivers.servo_bus.master_watch import MasterWatch
from deal_hw.drivers.servo_bus.registers import GOAL_POSITION, Register
from deal_hw.drivers.servo_bus.sdk import COMM_SUCCESS, PacketHandler, Protocol2PacketHandler
from deal_hw.errors import DealHwError, FrameError, ProtocolError, TransportTimeoutError
from deal_hw.transport import Transport

HEADER: Final = b"\xff\xff\xfd\x00"
_SYNC_READ, _FAST_SYNC_READ, _STATUS = 0x82, 0x8A, 0x55
_STATUS_BYTES = 11
"""A status packet without data: header 4, id, length 2, instruction, error, CRC 2."""
_PING_BYTES = _STATUS_BYTES + 3
_ALERT = 0x80
_INSTRUCTIONS: Final = frozenset(packets.Instruction)
_STUFFING_BYTES = 16
"""Additional bytes that a group's answer has time for."""


class _Packets(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's codec, with one error corrected."""

    def removeStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """Return an answer without the stuffing bytes; the SDK then checks its CRC.

        SDK 4.1 does it in place, and after the first such byte compares with bytes that it has already
        overwritten: FF FF FD FD FF FD FD lost its last byte, and all registers behind it were shifted.
        """
        whole = bytes(packet)
        body = whole[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        return [*whole[:5], *(len(body) + 2).to_bytes(2, "little"), *body, *whole[-2:]]


class _Port(Port):
    """The port interface of the SDK's packet handler."""

    is_using = property(lambda self: False, lambda self, value: None)
    """The SDK's lock stays taken after a read that raises; this bus has one user."""

    def __init__(self, transport: Transport, clock: Clock, baud_rate: int, answer_s: float) -> None:
        super().__init__(transport, clock, baud_rate, answer_s)
        self._deadline_ns = 0

    # The names below are the SDK's.

    def clearPort(self) -> None:  # noqa: N802
        """Keep the received bytes; :meth:`drop` discards them before a new request."""

    def getBaudRate(self) -> int:  # noqa: N802
        """Return the bits per second."""
        return self.baud_rate

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802
        """Keep a packet until :meth:`flush`."""
        self.write(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return up to that many bytes, waiting for the first until the deadline."""
        self.flush()
        if not self.buffer and length > 0:
            self.receive(self._deadline_ns)
        # A corrupt length field makes the SDK request a negative number.
        length = max(length, 0)
        taken = bytes(self.buffer[:length])
        del self.buffer[:length]
        return taken

    def setPacketTimeout(self, length: int) -> None:  # noqa: N802
        """Begin to wait for an answer of that many bytes."""
        self._deadline_ns = self._clock.now_ns() + self.answer_ns(length)

    def setPacketTimeoutMillis(self, milliseconds: float) -> None:  # noqa: N802
        """Begin to wait for this time [ms]."""
        self._deadline_ns = self._clock.now_ns() + round(milliseconds * 1e6)

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Return whether the time is over and all received bytes are read."""
        return not self.buffer and self._clock.now_ns() >= self._deadline_ns

    def expire(self) -> None:
        """Stop waiting; the SDK then reads the buffer."""
        self._deadline_ns = 0


@contextlib.contextmanager
def _short_is_corrupt(servo: int) -> Iterator[None]:
    """Raise FrameError if the SDK reads beyond the end of an answer with a valid CRC."""
    try:
        yield
    except IndexError as error:
        raise FrameError(f"servo {servo}: a short answer") from error


class Bus(ServoBus):
    """Reads and writes the registers of Dynamixel servos.

    Args:
        transport: A byte stream, open.
        clock: The clock of its stamps.
        baud_rate: Baud rate of the bus, for the time of bytes.
        answer_s: Additional time for an answer [s].
    """

    _port: _Port

    def __init__(self, transport: Transport, clock: Clock, baud_rate: int, answer_s: float) -> None:
        super().__init__(
            _Port(transport, clock, baud_rate, answer_s), clock, MasterWatch(GOAL_POSITION, _signed)
        )
        self._sdk: Any = _Packets()
        self._line = packets.PacketParser()
        self._chained = False

    def ping(self, servo: int) -> Answer:
        """Return model and firmware of a servo.

        Raises:
            TransportTimeoutError: It is silent.
            FrameError: Its answer is corrupt.
        """
        self._port.drop()
        packet = [0, 0, 0, 0, servo, 3, 0, 1, 0, 0]
        with _short_is_corrupt(servo):
            answer, result, _ = self._sdk.txRxPacket(self._port, packet)
        # Error, model (2), firmware, CRC (2).
        self._check(servo, result, result != COMM_SUCCESS or len(answer) >= _PING_BYTES)
        return Answer(answer[9] | answer[10] << 8, answer[11])

    def ping_protocol_1(self, servo: int) -> bool:
        """Return whether a servo answers in the older protocol 1.0."""
        self._port.drop()
        try:
            _, result, _ = PacketHandler(1.0).ping(self._port, servo)
        except IndexError:
            return False
        return bool(result == COMM_SUCCESS)

    def broadcast_ping(self, seconds: float) -> dict[int, Answer]:
        """Return all servos that answer a broadcast ping within a time [s]."""
        self._port.drop()
        self._sdk.txPacket(self._port, [0, 0, 0, 0, BROADCAST, 3, 0, 1, 0, 0])
        self._port.flush()
        self._port.setPacketTimeoutMillis(1e3 * seconds)
        found: dict[int, Answer] = {}
        while not self._port.isPacketTimeout():
            # Packet by packet, since the SDK's own function waits for all 252 servos, 1.3 s.
            try:
                packet, result = self._sdk.rxPacket(self._port, False)
            except IndexError:
                self.errors += 1
                continue
            if result == COMM_SUCCESS and len(packet) >= _PING_BYTES:
                found[packet[4]] = Answer(packet[9] | packet[10] << 8, packet[11])
            elif result != COMM_SUCCESS and packet:
                self.errors += 1
        return found

    def read(self, servo: int, register: Register) -> int:
        """Return a register, without sign; raises as :meth:`ping`."""
        self._port.drop()
        with _short_is_corrupt(servo):
            data, result, _ = self._sdk.readTxRx(self._port, servo, register.address, register.size)
        self._check(servo, result, len(data) == register.size)
        return int.from_bytes(bytes(data), "little")

    def write(self, servo: int, register: Register, value: int) -> None:
        """Write a register and wait for the servo's confirmation; raises as :meth:`ping`.

        Raises:
            ProtocolError: The servo refuses the value.
        """
        self._port.drop()
        data = list((value % (1 << 8 * register.size)).to_bytes(register.size, "little"))
        with _short_is_corrupt(servo):
            result, error = self._sdk.writeTxRx(self._port, servo, register.address, register.size, data)
        self._check(servo, result)
        if error & ~_ALERT:
            text = self._sdk.getRxPacketError(error & ~_ALERT).removeprefix("[RxPacketError] ")
            raise ProtocolError(
                f"servo {servo} refuses {value} in its register {register.name} ({register.address}): {text}"
            )

    def _find_requests(self, data: bytes) -> None:
        for packet in self._line.feed(data):
            whole = packets.instruction(packet.servo, packet.instruction, packet.params)
            # A group's answer is counted by its packets.
            if (at := self._port.buffer.find(whole)) >= 0:
                del self._port.buffer[at : at + len(whole)]
            if self._port.sent(whole):
                self.echoes = True
            elif packet.instruction in _INSTRUCTIONS:
                self._note_request(packets.Instruction(packet.instruction).name, packet.servo)

    def _put_writes(self, writes: Writes) -> None:
        for address, values in writes:
            size = len(next(iter(values.values())))
            params = [byte for servo, data in values.items() for byte in (servo, *data)]
            self._sdk.syncWriteTxOnly(self._port, address, size, params, len(params))

    def _put_group_read(self, servos: Sequence[int], address: int, size: int, fast: bool) -> None:
        self._sdk.syncReadTx(self._port, address, size, list(servos), len(servos), fast)

    @staticmethod
    def answer_bytes(servos: int, size: int, fast: bool) -> int:
        """Return the number of bytes of a group's answer; ``fast`` is a Fast Sync Read."""
        return 8 + servos * (size + 4) if fast else servos * (size + _STATUS_BYTES)

    def _wire_bytes(self, servos: int, size: int, fast: bool) -> int:
        return self.answer_bytes(servos, size, fast) + _STUFFING_BYTES

    def _collect(self, wanted: WantedAnswer) -> dict[int, bytes] | None:
        if not self._whole(wanted):
            return None
        found, sound = self._fast_answer(wanted) if wanted.fast else self._answers(wanted)
        if not sound or len(found) < len(wanted.ids):
            raise self._spoilt(wanted, found)
        return {servo: found[servo] for servo in wanted.ids}

    def _incomplete(self, wanted: WantedAnswer) -> DealHwError:
        if wanted.fast and self._port.buffer:
            return self._spoilt(wanted)
        found, sound = self._answers(wanted)
        silent = [servo for servo in wanted.ids if servo not in found]
        if not sound or not silent:
            return self._spoilt(wanted, found)
        return SilentServosError(silent, list(found))

    def _spoilt(self, wanted: WantedAnswer, found: Iterable[int] = ()) -> SpoiltAnswerError:
        text = f"the answer of servos {wanted.ids} is corrupt or incomplete"
        return SpoiltAnswerError(text, [servo for servo in found if servo not in self.doubled])

    def _whole(self, answer: WantedAnswer) -> bool:
        """Return whether the buffer contains all requested packets; the SDK checks their content."""
        at, wanted = 0, 1 if answer.fast else len(answer.ids)
        while wanted:
            at = self._port.buffer.find(HEADER, at)
            if at < 0 or len(self._port.buffer) < at + 7:
                return False
            at += 7 + int.from_bytes(self._port.buffer[at + 5 : at + 7], "little")
            if len(self._port.buffer) < at:
                return False
            wanted -= 1
        return True

    def _fast_answer(self, wanted: WantedAnswer) -> tuple[dict[int, bytes], bool]:
        """Return the sound parts of the one packet in the buffer, and whether the packet itself is sound."""
        self._port.expire()
        try:
            packet, result = self._sdk.rxPacket(self._port, True)
        except IndexError:
            return {}, False
        if result != COMM_SUCCESS or packet[4] != BROADCAST or packet[7] != _STATUS:
            return {}, False
        stuffed = len(packet) > self.answer_bytes(len(wanted.ids), wanted.size, True)
        if stuffed:
            # The SDK expects such answers without stuffing; the length shows whether a servo stuffs them.
            packet = self._sdk.removeStuffing(packet)
        whole, found, wrong = bytes(packet), dict[int, bytes](), set[int]()
        for k, servo in enumerate(wanted.ids):
            at = 8 + k * (wanted.size + 4)
            end = at + 2 + wanted.size
            if len(whole) < end + 2 or whole[at + 1] != servo:
                return found, False
            if not stuffed and packets.crc(whole[:end]) != int.from_bytes(whole[end : end + 2], "little"):
                wrong.add(servo)
            found[servo] = whole[at + 2 : end]
        # The SDK checks the last CRC, which its servo makes of all bytes before as they came. So those of the
        # other servos count, too, where they were once seen to be made so.
        self._chained = self._chained or not (wrong or stuffed)
        if self._chained:
            found = {servo: data for servo, data in found.items() if servo not in wrong}
        return found, True

    def _answers(self, wanted: WantedAnswer) -> tuple[dict[int, bytes], bool]:
        """Return the sound answers in the buffer by id, and whether all of it was sound.

        A packet with a wrong CRC is skipped by its length, so the next one is found.
        """
        found, twice, all_sound = dict[int, bytes](), set[int](), True
        self._port.expire()
        while self._port.buffer and len(found) < len(wanted.ids):
            try:
                packet, result = self._sdk.rxPacket(self._port, False)
            except IndexError:
                packet, result = [], -1
            data = bytes(packet[9 : 9 + wanted.size])
            if result != COMM_SUCCESS or packet[4] not in wanted.ids or len(data) != wanted.size:
                all_sound = False
                continue
            if packet[4] in found:
                twice.add(packet[4])
            found[packet[4]] = data
        self.doubled = frozenset(twice)
        return found, all_sound

    def _check(self, servo: int, result: int, whole: bool = True) -> None:
        if result == COMM_SUCCESS and whole:
            return
        self.errors += 1
        text = self._sdk.getTxRxResult(result).removeprefix("[TxRxResult] ")
        if "no status packet" in text:
            raise TransportTimeoutError(f"servo {servo} does not answer")
        raise FrameError(f"servo {servo}: {text or 'a short answer'}")


def _signed(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)
