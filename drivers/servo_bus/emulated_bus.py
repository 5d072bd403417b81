"""A bus of emulated servos: handles instruction packets, and answers at the time a real bus would."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from deal_hw.drivers.servo_bus.emulated_servo import (
    KEEP_ID,
    KEEP_ID_AND_BAUD,
    RESET_ALL,
    EmulatedServo,
)
from deal_hw.drivers.servo_bus.interface import BITS_PER_BYTE
from deal_hw.drivers.servo_bus.packets import (
    BROADCAST,
    Error,
    Instruction,
    Packet,
    PacketParser,
    fast_status,
    protocol_1_requests,
    protocol_1_status,
    status,
)
from deal_hw.drivers.servo_bus.registers import PRESENT_POSITION
from deal_hw.drivers.servo_bus.servos_side import ServosSide, at_once

_CLEAR_TURNS: Final = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))
"""Parameters of Clear: the position, and a safety code."""


class EmulatedBus(ServosSide[EmulatedServo]):
    """The servos' side of a bus.

    Packets are handled on arrival. An answer leaves after the time of request and answer on a wire of the
    servo's baud rate, plus its return delay. Two servos with one id answer at the same time. Assumed, as no
    source says it: those behind them in a group take what they receive for an answer, and go on.

    Attributes:
        fast_read: Whether they know Fast Sync and Bulk Read; older firmware does not.

    Args:
        servos: The servos.
        changed: Called after registers were written.
        loses: Called for each read of the present position; returns whether the answer is lost.
    """

    position = PRESENT_POSITION

    def __init__(
        self, servos: list[EmulatedServo], changed: Callable[[], None], loses: Callable[[], bool]
    ) -> None:
        super().__init__(servos, changed, loses)
        self.fast_read = True
        self._parser = PacketParser()

    @property
    def errors(self) -> int:
        """Corrupt packets received so far."""
        return self._parser.errors

    def receive(self, data: bytes) -> None:
        """Take bytes from the host and handle the packets that they complete."""
        for servo in self.servos:
            if servo.protocol == 1 and self._hears(servo):
                for request in protocol_1_requests(data):
                    self._answer_protocol_1(servo, *request)
        if not any(self._hears(servo) for servo in self.servos):
            return
        for packet in self._parser.feed(data):
            self.alive_ns = self.now_ns
            self._handle(packet)

    def receive_foreign(self, packet: bytes, shown: bool) -> None:
        """Take a whole packet of another master; it keeps the servos' watchdogs quiet, too."""
        if shown and self.servos:
            wire_ns = round(BITS_PER_BYTE * len(packet) / self.servos[0].baud_rate * 1e9)
            self._replies.append((self._free_ns + wire_ns, packet))
        self.alive_ns = self.now_ns
        for request in PacketParser().feed(packet):
            self._handle(request)

    def _listeners(self, servo: int) -> list[EmulatedServo]:
        return [s for s in self.servos if s.protocol == 2 and self._hears(s) and servo in (s.id, BROADCAST)]

    def _handle(self, packet: Packet) -> None:
        params = packet.params
        match packet.instruction:
            case Instruction.PING:
                for servo in sorted({s.id for s in self._listeners(packet.servo)}):
                    self._reply(packet, servo, lambda s: (Error.NONE, s.read(0, 2)[1] + s.read(6, 1)[1]))
            case Instruction.READ if len(params) == 4:
                address, size = _words(params)
                if not self._loses(address, size):
                    self._reply(packet, packet.servo, lambda s: s.read(address, size))
            case Instruction.WRITE | Instruction.REG_WRITE if len(params) > 2:
                self._write_one(packet)
            case Instruction.ACTION:
                # Not answered: the SDK does not wait for it, and would take it for its next answer.
                for s in self._listeners(packet.servo):
                    s.act()
                self._changed()
            case Instruction.REBOOT | Instruction.FACTORY_RESET | Instruction.CLEAR:
                self._restart(packet)
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ if len(params) > 4:
                address, size = _words(params)
                self._read_group(packet, [(servo, address, size) for servo in params[4:]])
            case Instruction.BULK_READ | Instruction.FAST_BULK_READ if len(params) % 5 == 0:
                groups = [params[k : k + 5] for k in range(0, len(params), 5)]
                self._read_group(packet, [(g[0], *_words(g[1:])) for g in groups])
            case Instruction.SYNC_WRITE if len(params) > 4:
                address, size = _words(params)
                step = size + 1
                for k in range(4, len(params) - size, step):
                    self._write(params[k], address, params[k + 1 : k + step])
            case Instruction.BULK_WRITE:
                self._write_bulk(params)
            case _:
                self._reply(packet, packet.servo, lambda s: (Error.INSTRUCTION, b""), read=False)

    def _restart(self, packet: Packet) -> None:
        """Answer, then restart, reset or clear the turns of the servos that are asked."""
        params, listeners = packet.params, self._listeners(packet.servo)
        resets = packet.instruction == Instruction.FACTORY_RESET
        clears = packet.instruction == Instruction.CLEAR
        unknown = (resets and params[:1] not in map(_byte, (KEEP_ID, KEEP_ID_AND_BAUD, RESET_ALL))) or (
            clears and params != _CLEAR_TURNS
        )
        error = Error.DATA_RANGE if unknown else Error.NONE
        self._reply(packet, packet.servo, lambda s: (error, b""), read=False)
        if unknown or (resets and params[0] == RESET_ALL and packet.servo == BROADCAST):
            # All servos of a bus with one id and one rate could not be distinguished any more.
            return
        for s in listeners:
            if clears:
                s.forget_turns()
            elif resets:
                s.factory_reset(params[0], self.now_ns)
            else:
                s.reboot(self.now_ns)
        self._changed()

    def _write_one(self, packet: Packet) -> None:
        address, data = int.from_bytes(packet.params[:2], "little"), packet.params[2:]
        # A servo answers by the id and the return level that it had when it was asked.
        asked = self._listeners(packet.servo)
        answering = [s for s in asked if s.answers(read=False)]
        errors = {}
        for s in asked:
            kept = packet.instruction == Instruction.REG_WRITE
            errors[s] = s.register_write(address, data) if kept else s.write(address, data)
        self._changed()
        self._answer(packet, packet.servo, [(s, errors[s], b"") for s in answering])

    def _write(self, servo: int, address: int, data: bytes) -> None:
        for s in self._listeners(servo):
            s.write(address, data)
        self._changed()

    def _write_bulk(self, params: bytes) -> None:
        at = 0
        while at + 5 < len(params):
            address, size = _words(params[at + 1 : at + 5])
            self._write(params[at], address, params[at + 5 : at + 5 + size])
            at += 5 + size

    def _read_group(self, packet: Packet, wanted: Sequence[tuple[int, int, int]]) -> None:
        fast = packet.instruction in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
        if not wanted or self._loses(*wanted[0][1:]) or (fast and not self.fast_read):
            return
        parts: list[tuple[int, int, bytes]] = []
        speaker = None
        for servo, address, size in wanted:
            listeners = self._listeners(servo) if servo != BROADCAST else []
            if not listeners:
                # Each waits for the answer of the servo before it, which never comes.
                break
            speaker = listeners[0]
            if not fast:
                self.sense(servo, self._free_ns)
            answers = [(s, *s.read(address, size)) for s in listeners]
            if any(error for _, error, _ in answers):
                return
            said = [(servo, error | s.alert, data) for s, error, data in answers]
            parts += said
            if not fast:
                self._send(packet, speaker, at_once(status(*part) for part in said))
        if fast and speaker is not None:
            self._send(packet, speaker, fast_status(parts, sum(size + 4 for _, _, size in wanted)))

    def _reply(
        self,
        packet: Packet,
        servo: int,
        answer: Callable[[EmulatedServo], tuple[int, bytes]],
        *,
        read: bool = True,
    ) -> None:
        """Send the answers of servos with an id; two with the same id answer at the same time."""
        pinged = packet.instruction == Instruction.PING
        asked = [s for s in self._listeners(servo) if pinged or s.answers(read=read)]
        self._answer(packet, servo, [(s, *answer(s)) for s in asked])

    def _answer(
        self, packet: Packet, servo: int, answers: Sequence[tuple[EmulatedServo, int, bytes]]
    ) -> None:
        """Send the errors and data of servos that were asked by one id."""
        if answers and servo != BROADCAST:
            sent = (status(servo, error | s.alert, data) for s, error, data in answers)
            self._send(packet, answers[0][0], at_once(sent))

    def _send(self, packet: Packet, servo: EmulatedServo, data: bytes) -> None:
        wire_s = BITS_PER_BYTE * (packet.size + len(data)) / servo.baud_rate
        self._replies.append((self._free_ns + round((wire_s + servo.return_delay_s) * 1e9), data))

    @property
    def _free_ns(self) -> int:
        """When the wire is free for the next answer [ns]."""
        return max(self.now_ns, self._replies[-1][0] if self._replies else 0)

    def _answer_protocol_1(self, servo: EmulatedServo, wanted: int, code: int, params: bytes) -> None:
        if wanted != servo.id or code not in (Instruction.PING, Instruction.READ):
            return
        data = servo.read(params[0], params[1])[1] if code == Instruction.READ and len(params) == 2 else b""
        self._replies.append((self.now_ns, protocol_1_status(servo.id, data)))


def _words(data: bytes) -> tuple[int, int]:
    """Return the two 16-bit numbers at the beginning."""
    return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")


def _byte(value: int) -> bytes:
    return bytes([value])
