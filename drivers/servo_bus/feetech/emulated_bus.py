"""A bus of emulated STS servos: handles requests, and answers at the time a real bus would.

Assumed, as no source says it: in a sync read each servo waits for the time that the answers before its own
take, and not for the answers themselves, and reads its registers then. So the others still answer if one is
missing. A broadcast ping is
answered in the order of the ids. An incomplete request is forgotten after 10 ms without bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from deal_hw.drivers.servo_bus.feetech.emulated_servo import StsServo
from deal_hw.drivers.servo_bus.feetech.packets import (
    BROADCAST,
    FRAME_BYTES,
    Instruction,
    RequestFrame,
    RequestParser,
    status,
)
from deal_hw.drivers.servo_bus.feetech.registers import BAUD_RATES, PRESENT_POSITION
from deal_hw.drivers.servo_bus.interface import BITS_PER_BYTE
from deal_hw.drivers.servo_bus.servos_side import ServosSide, at_once

_GAP_NS: Final = 10_000_000


class StsBus(ServosSide[StsServo]):
    """The servos' side of a bus.

    Requests are handled on arrival. An answer leaves after the time of request and answer on the wire, plus
    the servo's return delay. Two servos with one id answer at the same time: a bit is 1 if both send 1.

    Attributes:
        echo: Whether the adapter returns the host's own bytes.

    Args:
        servos: The servos.
        changed: Called after registers were written.
        loses: Called for each read of the present position; returns whether the answer is lost.
        echo: Whether the adapter returns the host's own bytes.
    """

    position = PRESENT_POSITION

    def __init__(
        self,
        servos: list[StsServo],
        changed: Callable[[], None],
        loses: Callable[[], bool],
        *,
        echo: bool = False,
    ) -> None:
        super().__init__(servos, changed, loses)
        self.echo = echo
        self._byte_ns = self._free_ns = 0
        self._parser = RequestParser()

    @property
    def errors(self) -> int:
        """Corrupt requests received so far."""
        return self._parser.errors

    def receive(self, data: bytes) -> None:
        """Take bytes from the host and handle the requests that they complete."""
        hearing = [servo for servo in self.servos if self._hears(servo)]
        rate = self.host_baud_rate or (hearing[0].baud_rate if hearing else BAUD_RATES[0])
        self._occupy(len(data), rate)
        if self.echo:
            self._replies.append((self._free_ns, data))
        if not hearing:
            return
        if self._now_ns - self._byte_ns > _GAP_NS:
            self._parser.reset()
        self._byte_ns = self._now_ns
        for request in self._parser.feed(data):
            self.alive_ns = self._now_ns
            self._handle(request)

    def receive_foreign(self, packet: bytes, shown: bool) -> None:
        """Take a whole packet of another master; it takes its time on the wire."""
        self._occupy(len(packet), self.host_baud_rate or BAUD_RATES[0])
        if shown:
            self._replies.append((self._free_ns, packet))
        for request in RequestParser().feed(packet):
            self._handle(request)

    def _advance(self) -> None:
        # The servos' protections follow the time.
        for servo in self.servos:
            servo.tick(self._now_ns)

    def _listeners(self, servo: int) -> list[StsServo]:
        return [s for s in self.servos if self._hears(s) and servo in (s.id, BROADCAST)]

    def _handle(self, request: RequestFrame) -> None:
        params = request.params
        match request.instruction:
            case Instruction.PING:
                for servo in sorted({s.id for s in self._listeners(request.servo)}):
                    self._answer([(s, servo, s.error, b"") for s in self._listeners(servo)])
            case Instruction.READ if len(params) == 2 and request.servo != BROADCAST:
                address, size = params
                if not self._loses(address, size):
                    self._answer(self._data(request.servo, address, size))
            case Instruction.SYNC_READ if len(params) > 2:
                self._read_group(params[0], params[1], params[2:])
            case Instruction.SYNC_WRITE if len(params) > 2:
                address, step = params[0], params[1] + 1
                for k in range(2, len(params) - step + 1, step):
                    for s in self._listeners(params[k]):
                        s.write(address, params[k + 1 : k + step])
                self._changed()
            case _:
                self._change(request)

    def _change(self, request: RequestFrame) -> None:
        """Do what changes the servos asked; an unknown instruction and wrong parameters change nothing."""
        asked = self._listeners(request.servo)
        # A servo answers by the id and the response level that it had when it was asked.
        answering = [(s, s.id) for s in asked if s.answers(read=False)]
        params = request.params
        if request.instruction == Instruction.REBOOT:
            answering = []
        for s in asked:
            match request.instruction:
                case Instruction.WRITE if len(params) > 1:
                    s.write(params[0], params[1:])
                case Instruction.REG_WRITE if len(params) > 1:
                    s.register_write(params[0], params[1:])
                case Instruction.ACTION:
                    s.act()
                case Instruction.REBOOT:
                    s.reboot(self._now_ns)
                case Instruction.FACTORY_RESET:
                    s.factory_reset()
                case Instruction.BACKUP:
                    s.back_up()
                case Instruction.RESET:
                    s.reset_status()
                case Instruction.CALIBRATE if not params:
                    s.calibrate()
                case Instruction.CALIBRATE if len(params) == 2:
                    s.calibrate(int.from_bytes(params, "little"))
        self._changed()
        if request.servo != BROADCAST:
            self._answer([(s, servo, s.error, b"") for s, servo in answering])

    def _data(self, servo: int, address: int, size: int) -> list[tuple[StsServo, int, int, bytes]]:
        """Return the answers of the servos with an id to a read."""
        found = [(s, s.read(address, size)) for s in self._listeners(servo)]
        return [(s, servo, s.error, data) for s, data in found if data is not None]

    def _read_group(self, address: int, size: int, servos: Sequence[int]) -> None:
        if self._loses(address, size):
            return
        rate = self.host_baud_rate or BAUD_RATES[0]
        for servo in servos:
            self.sense(servo, max(self._free_ns, self._now_ns))
            answers = self._data(servo, address, size) if servo != BROADCAST else []
            if answers:
                rate = answers[0][0].baud_rate
                self._answer(answers)
            else:
                self._occupy(FRAME_BYTES + size, rate)

    def _answer(self, answers: Sequence[tuple[StsServo, int, int, bytes]]) -> None:
        """Send the answers (servo, id, error, data) of servos with one id, at the same time."""
        if not answers:
            return
        data = at_once(status(servo, error, data) for _, servo, error, data in answers)
        speaker = answers[0][0]
        self._free_ns = max(self._free_ns, self._now_ns) + round(speaker.return_delay_s * 1e9)
        self._occupy(len(data), speaker.baud_rate)
        self._replies.append((self._free_ns, data))

    def _occupy(self, size: int, baud_rate: int) -> None:
        """Let some bytes take their time on the wire."""
        wire_ns = round(size * BITS_PER_BYTE / baud_rate * 1e9)
        self._free_ns = max(self._free_ns, self._now_ns) + wire_ns
