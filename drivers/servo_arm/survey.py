"""Asks a bus which servos it has, and what they say about themselves; only :meth:`release` writes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar

from deal_hw.clock import Clock
from deal_hw.drivers.servo_arm.families import OFF, Family, LoopGains, ServoSample
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.servo_bus.interface import Answer, ServoBus
from deal_hw.drivers.servo_bus.registers import Register
from deal_hw.errors import FrameError, TransportTimeoutError

T = TypeVar("T")

_TRIES: Final = 5
"""Attempts of a request; with 5 % corrupt answers all fail once in 10**6."""
_LISTEN_S: Final = 0.3
_SEARCHES: Final = 2
_VOLT: Final = 0.1
"""Unit of voltages, of both kinds of servos."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoFacts:
    """What a servo says about itself.

    Attributes:
        id: Its id.
        model: Its model, such as sts3215, or its number.
        offset: Its homing offset [ticks].
        least: Its own lowest goal [ticks].
        most: Its own highest goal [ticks].
        gains: Of its position loop.
        volts: Supply voltage [V].
        volt_range: Allowed voltage [V].
        celsius: Temperature.
        most_celsius: Allowed temperature.
        velocity_limit: Largest velocity that it allows [rad/s]; None if it has no such register.
    """

    id: int
    model: str
    offset: int
    least: int
    most: int
    gains: LoopGains
    volts: float
    volt_range: tuple[float, float]
    celsius: int
    most_celsius: int
    velocity_limit: float | None


@dataclass(frozen=True, slots=True)
class _Table:
    """The registers that :class:`ServoFacts` are read from."""

    offset: Register
    least: Register
    most: Register
    gains: tuple[Register, Register, Register]
    volts: Register
    least_volts: Register
    most_volts: Register
    celsius: Register
    most_celsius: Register
    velocity_limit: Register | None


_TABLES: Final[Mapping[str, _Table]] = {
    "feetech": _Table(
        f.HOMING_OFFSET,
        f.MIN_POSITION,
        f.MAX_POSITION,
        (f.P_GAIN, f.I_GAIN, f.D_GAIN),
        f.PRESENT_VOLTAGE,
        f.MIN_VOLTAGE,
        f.MAX_VOLTAGE,
        f.PRESENT_TEMPERATURE,
        f.MAX_TEMPERATURE,
        None,
    ),
    "dynamixel": _Table(
        r.HOMING_OFFSET,
        r.MIN_POSITION_LIMIT,
        r.MAX_POSITION_LIMIT,
        (r.POSITION_P_GAIN, r.POSITION_I_GAIN, r.POSITION_D_GAIN),
        r.PRESENT_INPUT_VOLTAGE,
        r.MIN_VOLTAGE_LIMIT,
        r.MAX_VOLTAGE_LIMIT,
        r.PRESENT_TEMPERATURE,
        r.TEMPERATURE_LIMIT,
        r.VELOCITY_LIMIT,
    ),
}


class Survey:
    """Questions to a bus of servos.

    Args:
        bus: The bus, open.
        family: The servos' kind.
        clock: The clock of the bus.
        where: The port, for messages.
    """

    def __init__(self, bus: ServoBus, family: Family, clock: Clock, where: str) -> None:
        self.bus, self.family, self.clock, self.where = bus, family, clock, where

    def find(self) -> dict[int, Answer]:
        """Return the servos that answer, by id."""
        found: dict[int, Answer] = {}
        for _ in range(_SEARCHES):
            found |= self.bus.broadcast_ping(_LISTEN_S)
        return dict(sorted(found.items()))

    def facts(self, servo: int, answer: Answer) -> ServoFacts:
        """Return what a servo says about itself.

        Raises:
            TransportTimeoutError: It does not answer soundly.
        """
        table = _TABLES[self.family.name]

        def read(register: Register) -> int:
            return self._surely(servo, partial(self.bus.read, servo, register))

        volts, least_volts, most_volts = (
            _VOLT * read(one) for one in (table.volts, table.least_volts, table.most_volts)
        )
        speed = table.velocity_limit
        return ServoFacts(
            id=servo,
            model=self.family.model_name(answer.model),
            offset=self._offset(read(table.offset)),
            least=read(table.least),
            most=read(table.most),
            gains=LoopGains(*(read(one) for one in table.gains)),
            volts=volts,
            volt_range=(least_volts, most_volts),
            celsius=read(table.celsius),
            most_celsius=read(table.most_celsius),
            velocity_limit=None if speed is None else read(speed) * r.RAD_S_PER_COUNT,
        )

    def _offset(self, value: int) -> int:
        if self.family.name == "feetech":
            return f.signed(value, f.SIGN_BITS[f.HOMING_OFFSET])
        return value - (1 << 32) if value >> 31 else value

    def samples(self, servos: Sequence[int]) -> dict[int, ServoSample]:
        """Return a sample of each servo, all asked together.

        Raises:
            TransportTimeoutError: They do not answer soundly.
        """
        return self._surely(servos[0], partial(self._sample, tuple(servos)), servos)

    def _sample(self, servos: tuple[int, ...]) -> dict[int, ServoSample]:
        address, size = self.family.block
        self.bus.ask(servos, address, size)
        while (found := self.bus.take(self.clock.now_ns() + 100_000_000)) is None:
            pass
        return {servo: self.family.sample(servo, data) for servo, data in found.items()}

    def release(self, servos: Sequence[int]) -> None:
        """Switch the motors off; the arm falls.

        Raises:
            TransportTimeoutError: A motor keeps its torque.
        """
        for _ in range(_TRIES):
            self.bus.post([*self.family.alive(servos, False), *self.family.torque(servos, OFF)])
            if all(sample.torque == OFF for sample in self.samples(servos).values()):
                return
        raise TransportTimeoutError(
            f"{self.where}: the servos keep their torque; switch their supply off and on"
        )

    def round_trips_s(self, servos: Sequence[int], count: int) -> list[float]:
        """Return the times from a request to all servos to its answer, the shortest first [s].

        Lost answers are left out.
        """
        found = []
        for _ in range(count):
            start_ns = self.clock.now_ns()
            try:
                self._sample(tuple(servos))
            except (FrameError, TransportTimeoutError):
                self.bus.settle()
                continue
            found.append((self.clock.now_ns() - start_ns) / 1e9)
        return sorted(found)

    def _surely(self, servo: int, request: Callable[[], T], together: Sequence[int] = ()) -> T:
        for _ in range(_TRIES):
            try:
                return request()
            except (TransportTimeoutError, FrameError) as error:
                last: Exception = error
                self.bus.settle()
        named = ", ".join(map(str, together)) or str(servo)
        raise TransportTimeoutError(
            f"{self.where}: servo {named} answers no question soundly ({last}). Two servos with one id "
            "answer at the same time: connect them one by one, and give each an id of its own; otherwise the "
            "line is noisy, or another program uses the port"
        ) from last
