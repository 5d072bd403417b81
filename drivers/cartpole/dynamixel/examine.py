"""Checks the two servos before any motion: which ones answer, and their settings."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from deal_hw.clock import Clock
from deal_hw.documentation import page
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.servo_bus.bus import Bus
from deal_hw.drivers.servo_bus.interface import Answer
from deal_hw.drivers.servo_bus.registers import (
    BAUD_RATE,
    BLOCK_ADDRESS,
    BLOCK_BYTES,
    BUS_WATCHDOG,
    CURRENT_LIMIT,
    DRIVE_MODE,
    NEEDED,
    OPERATING_MODE,
    PWM_LIMIT,
    RETURN_DELAY_TIME,
    RETURN_DELAY_UNIT_S,
    STATUS_RETURN_LEVEL,
    TIME_BASED_PROFILE,
    TORQUE_ENABLE,
    Register,
)
from deal_hw.drivers.servo_bus.sdk import ControlTable, DxlRuntimeError
from deal_hw.errors import (
    ConfigurationError,
    FrameError,
    TransportError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)

T = TypeVar("T")

_TRIES = 5
"""Attempts of a request with corrupt answers; with 5 % corrupt answers all fail once in 10**6."""
_LISTEN_S = 0.05
_ALL_STATUS = 2
_WIZARD = f"with Dynamixel Wizard 2.0 ({page('how-to/dynamixel.md')})"


@dataclass(frozen=True, slots=True)
class ServoInfo:
    """What a servo reports about itself.

    Attributes:
        id: Its id.
        model: Name of the model.
        firmware: Version of its firmware.
        return_delay_us: Delay before its answers [us].
    """

    id: int
    model: str
    firmware: int
    return_delay_us: int


@dataclass(frozen=True, slots=True)
class DynamixelInfo:
    """The two servos that were found on the bus.

    Attributes:
        cart: The servo on the belt.
        pole: The one on the pole.
        fast_sync_read: Whether both answer in one packet.
        effort_limit: Current Limit or PWM Limit of the belt servo, in its own units.
    """

    cart: ServoInfo
    pole: ServoInfo
    fast_sync_read: bool
    effort_limit: int


def _named(servos: Sequence[int]) -> str:
    return ("servo " if len(servos) == 1 else "servos ") + " and ".join(map(str, servos))


def model_name(number: int) -> str:
    """Return a model's name, or a text with its number if the SDK knows no name."""
    try:
        return str(ControlTable.getModelName(number)).removesuffix(".model").replace("_", "-").upper()
    except DxlRuntimeError:
        return f"model number {number}"


class Examination:
    """Examines both servos; leaves both without torque.

    Args:
        bus: The bus.
        settings: How the servos should be set up.
        clock: For the waiting.
        where: The port, for messages.
    """

    def __init__(self, bus: Bus, settings: DynamixelSettings, clock: Clock, where: str) -> None:
        self._bus, self._settings, self._clock, self._where = bus, settings, clock, where
        self.repeated = 0
        """Number of repeated requests."""
        self._silent = self._corrupt = 0

    def run(self, state_rate_hz: float) -> DynamixelInfo:
        """Return what was found.

        Raises:
            TransportTimeoutError: A servo is silent.
            WrongDeviceError: Another device answers, or a servo that cannot be used.
            VersionMismatchError: A servo speaks protocol 1.0.
            ConfigurationError: A servo has other settings; the message names the register.
        """
        s = self._settings
        self._check_speed(state_rate_hz)
        answers = self._find()
        for servo in (s.cart_id, s.pole_id):
            self._check_model(servo, answers[servo])
        infos = {}
        for servo, answer in answers.items():
            # Checked before any write: a servo with another level does not answer writes, and these would
            # look lost.
            level = self._read(servo, STATUS_RETURN_LEVEL)
            if level != _ALL_STATUS:
                raise self._wrong(servo, STATUS_RETURN_LEVEL, level, str(_ALL_STATUS))
            for register in (TORQUE_ENABLE, BUS_WATCHDOG):
                self._ask(servo, partial(self._bus.write, servo, register, 0))
            delay = self._read(servo, RETURN_DELAY_TIME)
            infos[servo] = ServoInfo(
                servo, model_name(answer.model), answer.firmware, round(delay * RETURN_DELAY_UNIT_S * 1e6)
            )
        return DynamixelInfo(
            infos[s.cart_id], infos[s.pole_id], self._has_fast_read(), self._check_belt_servo()
        )

    def _check_belt_servo(self) -> int:
        s = self._settings
        mode = self._read(s.cart_id, OPERATING_MODE)
        if mode != s.operating_mode:
            raise self._wrong(s.cart_id, OPERATING_MODE, mode, f'{s.operating_mode.value} (mode="{s.mode}")')
        drive = self._read(s.cart_id, DRIVE_MODE)
        if drive & TIME_BASED_PROFILE:
            plain = drive & ~TIME_BASED_PROFILE
            raise self._wrong(s.cart_id, DRIVE_MODE, drive, f"{plain} (velocity-based profile)")
        return self._read(s.cart_id, CURRENT_LIMIT if s.mode == "current" else PWM_LIMIT)

    def _wrong(self, servo: int, register: Register, value: int, wanted: str) -> ConfigurationError:
        return ConfigurationError(
            f"{self._where}: servo {servo} has {value} in its register {register.name} ({register.address}); "
            f"set it to {wanted} {_WIZARD}"
        )

    def _check_speed(self, state_rate_hz: float) -> None:
        bits = 10 * (self._bus.answer_bytes(2, BLOCK_BYTES, True) + 16)
        need_s = bits / self._settings.baud_rate
        if need_s > 0.5 / state_rate_hz:
            raise ConfigurationError(
                f"at {self._settings.baud_rate} baud one sample of both servos takes {1e3 * need_s:.1f} ms "
                f"of the {1e3 / state_rate_hz:g} ms between samples; set both servos to 1000000 baud or more "
                f"(register {BAUD_RATE.name}, {BAUD_RATE.address}) {_WIZARD}"
            )

    def _find(self) -> dict[int, Answer]:
        s = self._settings
        found: dict[int, Answer] = {}
        for servo in (s.cart_id, s.pole_id):
            try:
                found[servo] = self._retry(partial(self._bus.ping, servo))
            except (TransportTimeoutError, FrameError):
                continue
        if len(found) == 2:
            return found
        for servo in {s.cart_id, s.pole_id} - set(found):
            if self._bus.ping_protocol_1(servo):
                raise VersionMismatchError(
                    f"{self._where}: servo {servo} speaks Dynamixel protocol 1.0, deal-hw speaks 2.0; set "
                    f"its register Protocol Type (13) to 2 {_WIZARD}, or update its firmware"
                )
        others = self._bus.broadcast_ping(_LISTEN_S)
        self._ask_again(found, others)
        missing = [servo for servo in (s.cart_id, s.pole_id) if servo not in found]
        if not missing:
            return found
        if late := [servo for servo in missing if servo in others]:
            raise TransportTimeoutError(
                f"{self._where}: {_named(late)} answered a request to all servos, but none of {2 * _TRIES} "
                f"requests to each alone ({self._silent} without an answer within "
                f"{1e3 * s.answer_s:g} ms, {self._corrupt} corrupt): the computer is too busy, the line is "
                "noisy, or another program uses the port. End other programs, check cable and supply, or "
                "allow more time: --port 'PORT?answer_s=0.02'"
            )
        if found or others:
            there = {**others, **found}
            verb = "does" if len(missing) == 1 else "do"
            listed = ", ".join(f"{i} ({model_name(a.model)})" for i, a in sorted(there.items()))
            raise TransportTimeoutError(
                f"{self._where}: {_named(missing)} {verb} not answer; these do: {listed}. Every new servo "
                "has id 1, and two servos with the same id corrupt each other's answers: connect one alone, "
                f"set its id {_WIZARD}, then connect both"
            )
        if self._bus.received_bytes:
            raise WrongDeviceError(
                f"{self._where}: {self._bus.received_bytes} bytes came, but no valid answer of a Dynamixel; "
                f"check for another device on this port, another rate than {s.baud_rate} baud, and two "
                "servos with the same id"
            )
        raise TransportTimeoutError(
            f"{self._where}: no servo answers at {s.baud_rate} baud; check their supply and the port. New "
            "servos use 57600 baud: `deal-hw doctor cartpole --transport dynamixel` tries every rate"
        )

    def _ask_again(self, found: dict[int, Answer], others: dict[int, Answer]) -> None:
        """Ping those again that only answered a request to all: a pause of the computer may be over."""
        for servo in (self._settings.cart_id, self._settings.pole_id):
            if servo in others and servo not in found:
                with contextlib.suppress(TransportTimeoutError, FrameError):
                    found[servo] = self._retry(partial(self._bus.ping, servo))

    def _check_model(self, servo: int, answer: Answer) -> None:
        needed = [register.name for register in NEEDED]
        if servo == self._settings.cart_id:
            needed.append("Goal Current" if self._settings.mode == "current" else "Goal PWM")
        try:
            table = ControlTable.getControlTable(answer.model)
        except DxlRuntimeError:
            table = {}
        lacking = [name for name in needed if name not in table]
        if lacking and lacking == ["Goal Current"]:
            raise WrongDeviceError(
                f"{self._where}: servo {servo} is a {model_name(answer.model)}, which controls no current; "
                'use the setting mode="extended", or a servo with current-based position control'
            )
        if lacking:
            raise WrongDeviceError(
                f"{self._where}: servo {servo} is a {model_name(answer.model)}; deal-hw drives X-series "
                f"servos, and this one has no {', '.join(lacking[:3])}"
            )

    def _has_fast_read(self) -> bool:
        s = self._settings
        for _ in range(_TRIES):
            self._bus.ask((s.cart_id, s.pole_id), BLOCK_ADDRESS, BLOCK_BYTES, fast=True)
            try:
                if self._bus.take(self._clock.now_ns() + 10**9):
                    return True
            except (TransportTimeoutError, FrameError):
                self.repeated += 1
        return False

    def _read(self, servo: int, register: Register) -> int:
        return self._ask(servo, partial(self._bus.read, servo, register))

    def _ask(self, servo: int, question: Callable[[], T]) -> T:
        try:
            return self._retry(question)
        except FrameError as error:
            raise WrongDeviceError(
                f"{self._where}: the answers of servo {servo} are corrupt at every attempt: two servos have "
                "that id, another program uses the port, or the cable is bad. Connect one servo alone and "
                "try again"
            ) from error

    def _retry(self, question: Callable[[], T]) -> T:
        error: TransportError | FrameError | None = None
        for _ in range(_TRIES):
            try:
                return question()
            except (TransportTimeoutError, FrameError) as caught:
                error = caught
                self.repeated += 1
                self._silent += isinstance(caught, TransportTimeoutError)
                self._corrupt += isinstance(caught, FrameError)
        if error is None:
            raise RuntimeError("unreachable: _TRIES is above 0")
        raise error
