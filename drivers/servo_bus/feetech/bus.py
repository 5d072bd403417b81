"""A bus of Feetech STS and SMS servos over a byte stream, with monotonic deadlines.

On one wire there may be an adapter that returns our own requests. Such an echo is found frame by frame: a
frame with all bytes of the present request is discarded, and so is a frame of the broadcast id, which no
servo has. An answer never looks like a request, except when two bytes are read: with a sensor fault (the
error byte 2 equals the instruction Read) and just the request's two parameters as data. That answer is lost.

The checksum has 8 bits. One of some hundred corrupt answers passes for a sound one, so a user has to expect
an impossible value now and then.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

from deal_hw.clock import Clock
from deal_hw.drivers.servo_bus.feetech.packets import (
    BROADCAST,
    FRAME_BYTES,
    MAX_FRAME_BYTES,
    AnswerFrame,
    AnswerParser,
    RequestFrame,
    RequestParser,
    StsInstruction,
    encode,
)
from deal_hw.drivers.servo_bus.feetech.registers import (
    FIRMWARE_MAJOR,
    FIRST_RAM,
    GOAL_POSITION,
    ID,
    LOCK,
    MODEL_NUMBER,
    decode,
)
from deal_hw.drivers.servo_bus.interface import (
    Answer,
    Port,
    ServoBus,
    SilentServosError,
    SpoiltAnswerError,
    WantedAnswer,
    Writes,
)
from deal_hw.drivers.servo_bus.master_watch import MasterWatch
from deal_hw.drivers.servo_bus.registers import Register
from deal_hw.errors import DealHwError, FrameError, ProtocolError, TransportTimeoutError
from deal_hw.transport import Transport

_IDENTITY = Register(
    FIRMWARE_MAJOR.address,
    MODEL_NUMBER.address + MODEL_NUMBER.size - FIRMWARE_MAJOR.address,
    "Firmware Version to Model Number",
)
_INSTRUCTIONS: Final = frozenset(StsInstruction)
_SEARCH_TRIES: Final = 3
"""Requests for the model of a servo that answered a broadcast ping."""


class FeetechBus(ServoBus):
    """Reads and writes the registers of Feetech's STS and SMS servos.

    Attributes:
        alerts: The newest error byte of each servo that has answered; its bits are
            :class:`~deal_hw.drivers.servo_bus.feetech.packets.Fault`.

    Args:
        transport: A byte stream, open.
        clock: The clock of its stamps.
        baud_rate: Baud rate of the bus, for the time of bytes.
        answer_s: Additional time for an answer [s]. All servos of a group share it, so it includes their
            return delays.
    """

    def __init__(self, transport: Transport, clock: Clock, baud_rate: int, answer_s: float) -> None:
        watch = MasterWatch(GOAL_POSITION, partial(decode, GOAL_POSITION))
        super().__init__(Port(transport, clock, baud_rate, answer_s), clock, watch)
        self.alerts: dict[int, int] = {}
        self._parser = AnswerParser(FRAME_BYTES)
        self._line = RequestParser()
        self._frames: deque[AnswerFrame] = deque()
        self._found: dict[int, bytes] = {}
        self._twice: set[int] = set()
        self._skipped = 0

    def ping(self, servo: int) -> Answer:
        """Return model and firmware of a servo, from its registers; firmware 3.10 is 310.

        The instruction Ping is not used: its answer with a voltage fault has the same bytes as its request.

        Raises:
            TransportTimeoutError: It is silent.
            FrameError: Its answer is corrupt.
        """
        data = self._read(servo, _IDENTITY)
        model = data[MODEL_NUMBER.address - FIRMWARE_MAJOR.address :]
        return Answer(int.from_bytes(model, "little"), 100 * data[0] + data[1])

    def broadcast_ping(self, seconds: float) -> dict[int, Answer]:
        """Return all servos that answer a broadcast ping within a time [s]; LeRobot waits 0.8 s.

        Then each is asked for its model and firmware. A servo whose answers stay corrupt, as those of two
        servos with one id, is left out; :attr:`errors` counts its answers.
        """
        self._forget()
        self._send(encode(BROADCAST, StsInstruction.PING))
        until_ns = self._clock.now_ns() + round(1e9 * seconds)
        broken = self._parser.errors
        answers = [f for f in self._arriving(until_ns) if f.servo != BROADCAST and not f.data]
        self.errors += self._parser.errors - broken
        found = {}
        for servo in sorted({f.servo for f in answers}):
            for _ in range(_SEARCH_TRIES):
                try:
                    found[servo] = self.ping(servo)
                    break
                except (FrameError, TransportTimeoutError):
                    continue
        return found

    def read(self, servo: int, register: Register) -> int:
        """Return a register, without sign; raises as :meth:`ping`."""
        return int.from_bytes(self._read(servo, register), "little")

    def write(self, servo: int, register: Register, value: int) -> None:
        """Write a register and wait for the servo's confirmation; raises as :meth:`ping`.

        A confirmation says that the request has arrived, not that the value is allowed: the protocol has no
        refusal. A servo with response level 0 confirms nothing; then the register is read back.

        Args:
            servo: Its id.
            register: The register.
            value: Its value, without sign: a negative number as
                :func:`~deal_hw.drivers.servo_bus.feetech.registers.encode` gives it.

        Raises:
            ProtocolError: The register has another value.
            ValueError: The value does not fit in the register.
        """
        if not 0 <= value < 1 << 8 * register.size:
            raise ValueError(f"{register.name} ({register.address}): {value} is no value of the register")
        params = bytes([register.address]) + value.to_bytes(register.size, "little")
        try:
            self._exchange(servo, StsInstruction.WRITE, params, 0)
            return
        except TransportTimeoutError:
            pass
        except FrameError:
            self.errors += 1
            raise
        shown = self.read(value if register == ID else servo, register)
        if shown != value:
            raise ProtocolError(
                f"servo {servo} does not confirm {value} in its register {register.name} "
                f"({register.address}), which is {shown}"
            )

    @staticmethod
    def answer_bytes(servos: int, size: int, fast: bool) -> int:
        """Return the number of bytes of a group's answer; each servo has its own frame in any case."""
        return servos * (size + FRAME_BYTES)

    def _read(self, servo: int, register: Register) -> bytes:
        params = bytes([register.address, register.size])
        try:
            return self._exchange(servo, StsInstruction.READ, params, register.size)
        except (FrameError, TransportTimeoutError):
            self.errors += 1
            raise

    def _exchange(self, servo: int, instruction: int, params: bytes, size: int) -> bytes:
        """Return the data of a servo's answer to a request, which has ``size`` bytes."""
        self._forget()
        request = encode(servo, instruction, params)
        self._send(request, FRAME_BYTES + size)
        until_ns = self._clock.now_ns() + self._port.answer_ns(len(request) + FRAME_BYTES + size)
        skipped = self._parser.skipped
        for frame in self._arriving(until_ns):
            echo = frame == (servo, instruction, params)
            if frame.servo == servo and len(frame.data) == size and not echo:
                self.alerts[servo] = frame.error
                return frame.data
        if self._parser.skipped > skipped:
            raise FrameError(f"servo {servo}: its answer is corrupt")
        raise TransportTimeoutError(f"servo {servo} does not answer")

    def _send(self, request: bytes, answer_bytes: int = FRAME_BYTES) -> None:
        self._put(request)
        self._parser.longest = max(self._parser.longest, answer_bytes)
        self._port.flush()

    def _put(self, request: bytes) -> None:
        # An echo that is longer than the parser allows would count as corrupt.
        self._parser.longest = max(self._parser.longest, len(request))
        self._port.write(request)

    def _arriving(self, until_ns: int) -> Iterator[AnswerFrame]:
        """Yield the frames that arrive until a time [ns]."""
        while True:
            yield from self._parse()
            if self._clock.now_ns() >= until_ns:
                break
            self._port.receive(until_ns)
        yield from self._parser.finish()

    def _parse(self) -> Iterator[AnswerFrame]:
        """Yield the frames in the received bytes."""
        data = bytes(self._port.buffer)
        self._port.buffer.clear()
        yield from self._parser.feed(data)

    # Other masters.

    def _find_requests(self, data: bytes) -> None:
        for request in self._line.feed(data):
            if request.instruction not in _INSTRUCTIONS:
                continue
            if self._port.sent(encode(*request)):
                self.echoes = True
            elif _asks(request):
                self._note_request(StsInstruction(request.instruction).name, request.servo)

    # Groups.

    def _forget(self) -> None:
        super()._forget()
        self._parser.reset()
        self._frames.clear()
        self._begin_group()

    def _begin_group(self) -> None:
        self._found, self._twice = {}, set()
        self._skipped = self._parser.skipped

    def _put_writes(self, writes: Writes) -> None:
        for address, values in writes:
            size = len(next(iter(values.values())))
            parts = [bytes([servo]) + data for servo, data in values.items()]
            at_once = (MAX_FRAME_BYTES - FRAME_BYTES - 2) // (size + 1)
            for k in range(0, len(parts), at_once):
                params = bytes([address, size]) + b"".join(parts[k : k + at_once])
                self._put(encode(BROADCAST, StsInstruction.SYNC_WRITE, params))

    def _put_group_read(self, servos: Sequence[int], address: int, size: int, fast: bool) -> None:
        self._put(encode(BROADCAST, StsInstruction.SYNC_READ, bytes([address, size, *servos])))
        self._parser.longest = max(self._parser.longest, FRAME_BYTES + size)

    def _wire_bytes(self, servos: int, size: int, fast: bool) -> int:
        # On one wire the request is before the answer.
        return len(self._port.written) + self.answer_bytes(servos, size, fast)

    def _collect(self, wanted: WantedAnswer) -> dict[int, bytes] | None:
        """Return the answers of a group.

        The servos answer in the order of their ids in the request. So the group is over after the last of
        them, and with a frame that only the next group can have.
        """
        self._frames += self._parse()
        over = self._clock.now_ns() >= wanted.until_ns
        if over:
            self._frames += self._parser.finish()
        while self._frames:
            frame = self._frames[0]
            fits = frame.servo in wanted.ids and len(frame.data) == wanted.size
            if (not fits or frame.servo in self._found) and self._is_next(frame):
                over = True
                break
            self._frames.popleft()
            if not fits:
                continue
            self.alerts[frame.servo] = frame.error
            # A second answer of a servo is newer: the first was an answer to an earlier request. If this
            # happens again and again, two servos have the id.
            if frame.servo in self._found:
                self._twice.add(frame.servo)
            self._found[frame.servo] = frame.data
            if len(self._found) == len(wanted.ids):
                found = {servo: self._found[servo] for servo in wanted.ids}
                self.doubled = frozenset(self._twice)
                self._begin_group()
                return found
            if frame.servo == wanted.ids[-1]:
                over = True
                break
        if over:
            raise self._incomplete(wanted)
        return None

    def _is_next(self, frame: AnswerFrame) -> bool:
        """Return whether the second oldest question asks for such a frame."""
        following = self._wanted[1] if len(self._wanted) > 1 else None
        return following is not None and frame.servo in following.ids and len(frame.data) == following.size

    def _incomplete(self, wanted: WantedAnswer) -> DealHwError:
        missing = tuple(servo for servo in wanted.ids if servo not in self._found)
        others = tuple(servo for servo in wanted.ids if servo in self._found)
        corrupt = self._parser.skipped > self._skipped
        self.doubled = frozenset(self._twice)
        self._begin_group()
        if corrupt:
            beside = f"; servos {others} did" if others else ""
            text = f"servos {missing} did not answer soundly, there were corrupt bytes{beside}"
            return SpoiltAnswerError(text, others)
        return SilentServosError(missing, others)


def _asks(frame: RequestFrame) -> bool:
    """Return whether a frame with the number of an instruction is a request; it may be a servo's faults.

    No servo has the broadcast id. Of other frames only a write to the registers of torque and goals is
    certain: an answer to a request of ours begins with another number there.
    """
    if frame.servo == BROADCAST:
        return True
    writes = frame.instruction == StsInstruction.WRITE and len(frame.params) > 1
    return writes and FIRST_RAM <= frame.params[0] < LOCK.address
