"""What the two kinds of servos have in common for an arm, and what each writes and reads."""

from __future__ import annotations

import abc
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from deal_hw.clock import Clock
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.servo_bus.feetech.bus import FeetechBus
from deal_hw.drivers.servo_bus.feetech.packets import explain_fault
from deal_hw.drivers.servo_bus.interface import BITS_PER_BYTE, Answer, ServoBus, Writes
from deal_hw.errors import ConfigurationError
from deal_hw.transport import Transport

OFF, ON, DAMPING = 0, 1, 2
"""How a servo's motor is: without torque, following its goal, braking."""


@dataclass(frozen=True, slots=True)
class LoopGains:
    """Registers of a servo's position loop."""

    p: int
    i: int
    d: int


@dataclass(frozen=True, slots=True)
class ServoSample:
    """One servo's registers at one time.

    Attributes:
        ticks: Its position.
        ticks_s: Its velocity [ticks/s].
        duty: Voltage on its motor, as a share of the supply's, -1 to 1.
        goal: Its goal [ticks].
        torque: :data:`OFF`, :data:`ON` or :data:`DAMPING`.
        fault: What it reports, with the remedy; "" for nothing.
        tripped: Whether its own watchdog has stopped it.
    """

    ticks: int
    ticks_s: float
    duty: float
    goal: int
    torque: int
    fault: str
    tripped: bool = False


class Family(abc.ABC):
    """One kind of servo.

    Attributes:
        name: As in robot.yaml.
        block: Address and number of bytes of what is read with each sample.
        models: Names of models by their number.
        watchdog_s: After this time without a packet a servo stops by itself [s]; 0: it has no watchdog.
        tool: The vendor's program that sets registers, for messages.
        request_bytes: Bytes of a request to read from several servos, beside one for each.
    """

    name: ClassVar[str]
    block: ClassVar[tuple[int, int]]
    models: ClassVar[Mapping[int, str]]
    watchdog_s: ClassVar[float] = 0.0
    tool: ClassVar[str]
    request_bytes: ClassVar[int]

    def model_name(self, number: int) -> str:
        """Return a model's name, or its number in words."""
        return self.models.get(number, f"model {number}")

    def unknown_model(self, number: int) -> str:
        """Return what to say of a model that is not one of these; "" if it is."""
        if number in self.models:
            return ""
        known = ", ".join(sorted(set(self.models.values())))
        return f"is of model number {number}, which deal-hw does not know as {self.name}; known: {known}"

    def cycle_s(self, bus: ServoBus, servos: int, baud_rate: int) -> float:
        """Return the time of one sample and one command of so many servos on the wire [s]."""
        answers = bus.answer_bytes(servos, self.block[1], False)
        return BITS_PER_BYTE * (answers + 2 * self.request_bytes + 6 * servos) / baud_rate

    @abc.abstractmethod
    def bus(self, transport: Transport, clock: Clock, baud_rate: int, answer_s: float) -> ServoBus:
        """Return a bus over an open byte stream."""

    @abc.abstractmethod
    def sample(self, servo: int, data: bytes) -> ServoSample:
        """Return what the bytes of a servo's :attr:`block` say."""

    @abc.abstractmethod
    def check(self, bus: ServoBus, servo: int, low: int, high: int) -> None:
        """Check that a servo can be used, without changing anything.

        Args:
            bus: Its bus.
            servo: Its id.
            low: Lowest goal that it will get [ticks].
            high: Highest one [ticks].

        Raises:
            ConfigurationError: A register must be set first; the message names it.
        """

    @abc.abstractmethod
    def version_problem(self, bus: ServoBus, servo: int, answer: Answer | None) -> str:
        """Return why a servo's protocol or firmware cannot be used, and what to do; "" if it can.

        Args:
            bus: Its bus.
            servo: Its id.
            answer: Its answer to a ping; None if there was none.
        """

    @abc.abstractmethod
    def prepare(self, servos: Sequence[int]) -> Writes:
        """Return what is written before the torque comes on, beside gains and goals."""

    @abc.abstractmethod
    def gains(self, gains: Mapping[int, LoopGains]) -> Writes:
        """Return the writes of gains."""

    @abc.abstractmethod
    def efforts(self, shares: Mapping[int, float]) -> Writes:
        """Return the writes of effort limits, as shares of the most."""

    @abc.abstractmethod
    def goals(self, ticks: Mapping[int, int]) -> Writes:
        """Return the writes of goals."""

    @abc.abstractmethod
    def torque(self, servos: Sequence[int], state: int) -> Writes:
        """Return the writes that make the motors :data:`OFF`, :data:`ON` or :data:`DAMPING`."""

    def alive(self, servos: Sequence[int], on: bool) -> Writes:
        """Return the writes that start or stop the servos' own watchdog."""
        return []


class Dynamixel(Family):
    """X-series servos in position control mode (protocol 2.0)."""

    name = "dynamixel"
    models: ClassVar[Mapping[int, str]] = {
        1060: "xl430-w250",
        1070: "xc430-w150",
        1080: "xc430-w240",
        1020: "xm430-w350",
        1030: "xm430-w210",
        1120: "xm540-w270",
        1130: "xm540-w150",
        1110: "xh540-w270",
        1190: "xl330-m077",
        1200: "xl330-m288",
        1210: "xc330-t181",
        1220: "xc330-t288",
    }
    block = (r.BLOCK_ADDRESS, r.BLOCK_BYTES)
    watchdog_s = 0.2
    tool = "Dynamixel Wizard 2.0"
    request_bytes = 14
    _MOST_PWM: Final = 885

    def bus(self, transport: Transport, clock: Clock, baud_rate: int, answer_s: float) -> ServoBus:
        """Return a bus over an open byte stream."""
        # ROBOTIS' SDK is an extra; robots without these servos do not need it.
        from deal_hw.drivers.servo_bus.bus import Bus

        return Bus(transport, clock, baud_rate, answer_s)

    def sample(self, servo: int, data: bytes) -> ServoSample:
        """Return what the bytes of a servo's :attr:`block` say."""
        block = r.Block.unpack(data)
        at = r.PRESENT_PWM.address - r.BLOCK_ADDRESS
        (pwm,) = struct.unpack_from("<h", data, at)
        fault = r.explain_hardware_error(block.hardware_error) if block.hardware_error else ""
        if fault and not block.torque_enable:
            fault += f"; {r.UNTIL_RESTARTED}"
        return ServoSample(
            ticks=block.present_position,
            ticks_s=block.present_velocity * r.RAD_S_PER_COUNT * r.PULSES / (2 * math.pi),
            duty=pwm / self._MOST_PWM,
            goal=block.goal_position,
            torque=ON if block.torque_enable else OFF,
            fault=fault,
            tripped=block.bus_watchdog == r.WATCHDOG_TRIPPED,
        )

    def check(self, bus: ServoBus, servo: int, low: int, high: int) -> None:
        """Check the operating mode, the drive mode and the answers to writes."""
        level = bus.read(servo, r.STATUS_RETURN_LEVEL)
        if level != 2:
            raise ConfigurationError(_wrong(servo, r.STATUS_RETURN_LEVEL.name, level, "2", self.tool))
        mode = bus.read(servo, r.OPERATING_MODE)
        if mode not in (r.OperatingMode.POSITION, r.OperatingMode.EXTENDED_POSITION):
            raise ConfigurationError(_wrong(servo, r.OPERATING_MODE.name, mode, "3 (position)", self.tool))
        drive = bus.read(servo, r.DRIVE_MODE)
        if drive & r.TIME_BASED_PROFILE:
            wanted = f"{drive & ~r.TIME_BASED_PROFILE} (velocity-based profile)"
            raise ConfigurationError(_wrong(servo, r.DRIVE_MODE.name, drive, wanted, self.tool))
        if mode == r.OperatingMode.POSITION:
            least, most = bus.read(servo, r.MIN_POSITION_LIMIT), bus.read(servo, r.MAX_POSITION_LIMIT)
            if not least <= low <= high <= most:
                raise ConfigurationError(_limited(servo, low, high, least, most, self.tool))

    def version_problem(self, bus: ServoBus, servo: int, answer: Answer | None) -> str:
        """Return whether a silent servo speaks protocol 1.0."""
        from deal_hw.drivers.servo_bus.bus import Bus

        if answer is not None or not isinstance(bus, Bus) or not bus.ping_protocol_1(servo):
            return ""
        return (
            "speaks Dynamixel protocol 1.0, deal-hw speaks 2.0; set its register Protocol Type (13) to 2 "
            f"with {self.tool}, or update its firmware"
        )

    def prepare(self, servos: Sequence[int]) -> Writes:
        """Return what clears the feed-forward and the profile: goals are followed as they come."""
        nothing = dict.fromkeys(servos, bytes(8))
        return [
            (r.FEEDFORWARD_2ND.address, dict.fromkeys(servos, bytes(4))),
            (r.PROFILE_ACCELERATION.address, nothing),
        ]

    def gains(self, gains: Mapping[int, LoopGains]) -> Writes:
        """Return the writes of gains."""
        packed = {servo: struct.pack("<3H", one.d, one.i, one.p) for servo, one in gains.items()}
        return [(r.POSITION_D_GAIN.address, packed)]

    def efforts(self, shares: Mapping[int, float]) -> Writes:
        """Return the writes of effort limits: of the motor's voltage."""
        packed = {servo: struct.pack("<H", round(self._MOST_PWM * share)) for servo, share in shares.items()}
        return [(r.GOAL_PWM.address, packed)]

    def goals(self, ticks: Mapping[int, int]) -> Writes:
        """Return the writes of goals."""
        packed = {servo: struct.pack("<i", goal) for servo, goal in ticks.items()}
        return [(r.GOAL_POSITION.address, packed)]

    def torque(self, servos: Sequence[int], state: int) -> Writes:
        """Return the writes that switch the motors; these servos do not brake without a goal."""
        return [(r.TORQUE_ENABLE.address, dict.fromkeys(servos, bytes([state == ON])))]

    def alive(self, servos: Sequence[int], on: bool) -> Writes:
        """Return the writes that start or stop Bus Watchdog; it is cleared first where it has tripped."""
        counts = round(self.watchdog_s / r.WATCHDOG_UNIT_S) if on else 0
        register = r.BUS_WATCHDOG.address
        cleared = (register, dict.fromkeys(servos, b"\0"))
        return [cleared, (register, dict.fromkeys(servos, bytes([counts])))] if on else [cleared]


class Feetech(Family):
    """STS and SMS servos in position mode.

    They have no watchdog: without a host they hold their last goal.
    """

    name = "feetech"
    models: ClassVar[Mapping[int, str]] = {number: name.lower() for number, name in f.MODELS.items()}
    block = (f.BLOCK_ADDRESS, f.BLOCK_BYTES)
    tool = "Feetech's FD program"
    request_bytes = 8
    _SPEED_IN_TICKS: Final = 0x04
    _ZERO_IS_FASTEST: Final = 0x08
    _LEAST_FIRMWARE: Final = 309
    """3.9: LeRobot's users report corrupt answers from bus lines with older ones (its issue 1010)."""
    _COARSE_TICKS_S: Final = 50.0
    """Unit of speeds where Phase has no bit 2: 0.732 rev/min."""

    def __init__(self) -> None:
        self._ticks_s: dict[int, float] = {}
        self._most_torque: dict[int, int] = {}

    def bus(self, transport: Transport, clock: Clock, baud_rate: int, answer_s: float) -> ServoBus:
        """Return a bus over an open byte stream."""
        return FeetechBus(transport, clock, baud_rate, answer_s)

    def sample(self, servo: int, data: bytes) -> ServoSample:
        """Return what the bytes of a servo's :attr:`block` say."""
        block = f.StsBlock.unpack(data)
        return ServoSample(
            ticks=block.position,
            ticks_s=block.speed * self._ticks_s.get(servo, 1.0),
            duty=block.load * f.LOAD_UNIT,
            goal=block.goal_position,
            torque=block.torque_mode,
            fault=explain_fault(block.status) if block.status else "",
        )

    def check(self, bus: ServoBus, servo: int, low: int, high: int) -> None:
        """Check operating mode, limits and Phase; note the units that follow from it."""
        mode = bus.read(servo, f.OPERATING_MODE)
        if mode != f.StsMode.POSITION:
            raise ConfigurationError(_wrong(servo, f.OPERATING_MODE.name, mode, "0 (position)", self.tool))
        phase = bus.read(servo, f.PHASE)
        if phase & f.MULTI_TURN:
            wanted = f"{phase & ~f.MULTI_TURN} (positions of one turn)"
            raise ConfigurationError(_wrong(servo, f.PHASE.name, phase, wanted, self.tool))
        if not phase & self._ZERO_IS_FASTEST:
            wanted = f"{phase | self._ZERO_IS_FASTEST} (a goal speed of 0 is the fastest)"
            raise ConfigurationError(_wrong(servo, f.PHASE.name, phase, wanted, self.tool))
        least, most = bus.read(servo, f.MIN_POSITION), bus.read(servo, f.MAX_POSITION)
        if (least or most) and not least <= low <= high <= most:
            raise ConfigurationError(_limited(servo, low, high, least, most, self.tool))
        self._ticks_s[servo] = 1.0 if phase & self._SPEED_IN_TICKS else self._COARSE_TICKS_S
        self._most_torque[servo] = bus.read(servo, f.MAX_TORQUE)

    def version_problem(self, bus: ServoBus, servo: int, answer: Answer | None) -> str:
        """Return whether a servo's firmware is too old for answers to a request to several servos."""
        if answer is None or answer.firmware >= self._LEAST_FIRMWARE:
            return ""
        major, minor = divmod(answer.firmware, 100)
        return (
            f"has firmware {major}.{minor}; update it to 3.10 or later with {self.tool}: servos with older "
            "ones spoil the answers of the others"
        )

    def prepare(self, servos: Sequence[int]) -> Writes:
        """Return what locks the EEPROM, so that gains are not kept in it, and lets goals act at once."""
        return [
            (f.LOCK.address, dict.fromkeys(servos, bytes([f.LOCKED]))),
            (f.ACCELERATION.address, dict.fromkeys(servos, b"\0")),
            (f.GOAL_TIME.address, dict.fromkeys(servos, bytes(4))),
        ]

    def gains(self, gains: Mapping[int, LoopGains]) -> Writes:
        """Return the writes of gains: P, D and I lie in this order."""
        return [(f.P_GAIN.address, {servo: bytes((one.p, one.d, one.i)) for servo, one in gains.items()})]

    def efforts(self, shares: Mapping[int, float]) -> Writes:
        """Return the writes of torque limits, at most the servo's own Max Torque."""
        return [
            (
                f.TORQUE_LIMIT.address,
                {
                    servo: f.encode(f.TORQUE_LIMIT, round(share * self._most_torque.get(servo, 1000)))
                    for servo, share in shares.items()
                },
            )
        ]

    def goals(self, ticks: Mapping[int, int]) -> Writes:
        """Return the writes of goals."""
        return [
            (f.GOAL_POSITION.address, {servo: f.encode(f.GOAL_POSITION, at) for servo, at in ticks.items()})
        ]

    def torque(self, servos: Sequence[int], state: int) -> Writes:
        """Return the writes that make the motors off, on or brake: Torque Enable has the same numbers."""
        return [(f.TORQUE_ENABLE.address, dict.fromkeys(servos, bytes([state])))]


FAMILIES: Final[Mapping[str, type[Family]]] = {"dynamixel": Dynamixel, "feetech": Feetech}
"""The kinds, by the bus in robot.yaml."""


def _wrong(servo: int, register: str, value: int, wanted: str, tool: str) -> str:
    return f"servo {servo} has {value} in its register {register}; set it to {wanted} with {tool}"


def _limited(servo: int, low: int, high: int, least: int, most: int, tool: str) -> str:
    return (
        f"servo {servo} itself allows {least} to {most} ticks, the joint's position_range in robot.yaml is "
        f"{low} to {high}: it would stop short of its targets. Narrow position_range, or widen the servo's "
        f"limits with {tool}"
    )
