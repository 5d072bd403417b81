"""The cart-pole's firmware in Python, by message and by tick, for any wire and mechanics.

The C core is the firmware. This one is its fallback: for the emulator on a computer without a C compiler
(``--firmware python``), and for benches, whose servo computes with the truth's floats instead of the chips'
integers. tests/drivers/test_cartpole_firmware.py and test_cartpole_can_firmware.py compare the two bit by bit
on random inputs.
"""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Callable
from typing import Final, Protocol

from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.link import Link, SerialLink
from deal_hw.types import Status

TICKS_PER_STATE: Final = round(DESCRIPTION.device_rate_hz / DESCRIPTION.state_rate_hz)
WATCHDOG_TICKS: Final = 200
FIRMWARE_VERSION: Final = (0, 1, 0)


class Mode(enum.Enum):
    """State of the motor; only "homing" and "armed" may have torque."""

    IDLE = enum.auto()
    HOMING = enum.auto()
    ARMED = enum.auto()


class Firmware(Protocol):
    """The firmware between a wire and the mechanics.

    One tick is :meth:`receive` (where something came), :meth:`control`, and :meth:`report` where one is due.

    """

    @property
    def homings(self) -> int:
        """Number of started homings; the mechanics end each with :meth:`finish_homing`."""
        ...

    @property
    def armings(self) -> int:
        """Number of times the motor was armed; the hand then releases the pole."""
        ...

    @property
    def mode(self) -> Mode:
        """State of the motor."""
        ...

    @property
    def watchdog(self) -> bool:
        """Whether the motor was stopped by missing commands since it was last armed."""
        ...

    @property
    def frame_errors(self) -> int:
        """Corrupt frames received so far."""
        ...

    @property
    def setpoint(self) -> float:
        """Set-point of the servo [m]."""
        ...

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """Handle the host's bytes before this tick; return the answers."""
        ...

    def control(self, motor: Motor) -> tuple[float, bool]:
        """Run one tick; return the force on the cart [N], and whether a state frame is due."""
        ...

    def report(self, reading: Reading) -> bytes:
        """Return the state frame of the tick that :meth:`control` ran last."""
        ...

    def finish_homing(self) -> None:
        """Note that the cart is in the middle and the pole upright; only has an effect while homing."""
        ...


class Controller:
    """The firmware as a state machine over messages.

    Attributes:
        homings: How often homing began.
        armings: How often the motor was armed.
        mode: State of the motor.
        watchdog: Whether the motor was stopped by missing commands since it was last armed.
        clock_us: What the clock of its states shows at tick 0 [us].

    Args:
        servo: The position loop.
        unique_id: Serial number of the device.
        command_delay: Called for every accepted target; returns the ticks from its reception to its action.
        link: The wire; serial frames by default.
    """

    def __init__(
        self, servo: Servo, unique_id: int, command_delay: Callable[[], int], link: Link | None = None
    ) -> None:
        self.homings = self.armings = 0
        self._servo = servo
        self._unique_id = unique_id
        self._command_delay = command_delay
        self._link: Link = link or SerialLink()
        self._tick = self.clock_us = 0
        self.mode = Mode.IDLE
        self._homed = self.watchdog = False
        self._last_request: tuple[int, int] | None = None
        self._state_count = 0
        self._commands: deque[tuple[int, protocol.Target]] = deque()
        self._command_sequence = protocol.NO_COMMAND
        self._command_tick = self._alive_tick = 0

    @property
    def frame_errors(self) -> int:
        """Corrupt frames received so far."""
        return self._link.errors

    @property
    def setpoint(self) -> float:
        """Set-point of the servo [m]."""
        return self._servo.setpoint

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """Handle the host's bytes before this tick; return the answers."""
        answers = (self.handle(message, motor) for message in self._link.decode(data))
        return b"".join(self._link.encode(answer) for answer in answers if answer is not None)

    def handle(self, message: protocol.AnyMessage, motor: Motor) -> protocol.AnyMessage | None:
        """Handle one message; return the answer, or None."""
        match message:
            case protocol.Target():
                self._take_target(message)
            case protocol.Hello():
                return self._greet(message)
            case protocol.Arm() | protocol.Stop() | protocol.Home():
                return self._answer(message, motor)
        return None

    def control(self, motor: Motor) -> tuple[float, bool]:
        """Run one tick; return the force on the cart [N], and whether a state frame is due."""
        tick = self._tick
        self._tick = tick + 1
        force = 0.0
        if self.mode is Mode.ARMED and tick - self._alive_tick >= WATCHDOG_TICKS:
            self._stop()
            self.watchdog = True
        if self.mode is Mode.ARMED:
            while self._commands and self._commands[0][0] <= tick:
                self._servo.accept(self._commands.popleft()[1])
            force = self._servo.update(motor.position, motor.velocity)
        return force, tick % TICKS_PER_STATE == 0

    def report(self, reading: Reading) -> bytes:
        """Return the state frame of the tick that :meth:`control` ran last."""
        return self._link.encode(self.state(reading))

    def state(self, reading: Reading) -> protocol.State:
        """Return the same as a message."""
        tick = self._tick - 1
        armed = self.mode is Mode.ARMED
        effort, clamped = self._servo.estimate(
            reading.setpoint, reading.cart_um / 1e6, reading.cart_um_s / 1e6
        )
        status = Status.NONE
        if armed:
            status |= Status.ARMED
            status |= Status.EFFORT_CLAMPED if clamped else Status.NONE
            status |= Status.SPEED_CLAMPED if self._servo.slewing else Status.NONE
        status |= Status.HOMED if self._homed else Status.NONE
        status |= Status.HOMING if self.mode is Mode.HOMING else Status.NONE
        status |= Status.WATCHDOG if self.watchdog else Status.NONE
        status |= Status.AT_END_STOP if reading.at_end_stop else Status.NONE
        sequence = self._state_count
        self._state_count = (sequence + 1) & 0xFFFF_FFFF
        known = self._command_sequence != protocol.NO_COMMAND
        return protocol.State(
            sequence=sequence,
            device_us=self.clock_us + tick * 1000,
            cart_um=reading.cart_um,
            cart_um_s=reading.cart_um_s,
            pole_urad=reading.pole_urad,
            pole_urad_s=reading.pole_urad_s,
            effort_mn=max(-32767, min(32767, round(effort * 1e3))) if armed else 0,
            status=int(status),
            command_sequence=self._command_sequence,
            command_age_us=min((tick - self._command_tick) * 1000, 0xFFFF_FFFF) if known else 0,
        )

    def finish_homing(self) -> None:
        """Note that the cart is in the middle and the pole upright; only has an effect while homing."""
        if self.mode is Mode.HOMING:
            self.mode = Mode.IDLE
            self._homed = True

    def _take_target(self, target: protocol.Target) -> None:
        # A repeated number comes from a stuck host or adapter; it must not reset the watchdog.
        if self.mode is not Mode.ARMED or target.sequence == self._command_sequence:
            return
        self._command_sequence = target.sequence
        self._command_tick = self._alive_tick = self._tick
        due = self._tick + self._command_delay()
        if self._commands:
            due = max(due, self._commands[-1][0])
        self._commands.append((due, target))

    def _greet(self, hello: protocol.Hello) -> protocol.Info:
        self._stop()
        self._command_sequence = protocol.NO_COMMAND
        self._last_request = None
        return protocol.Info(
            request=hello.request,
            kind=protocol.DEVICE_KIND,
            firmware=FIRMWARE_VERSION,
            device_rate_hz=round(DESCRIPTION.device_rate_hz),
            state_rate_hz=round(DESCRIPTION.state_rate_hz),
            unique_id=self._unique_id,
        )

    def _answer(self, request: protocol.Arm | protocol.Stop | protocol.Home, motor: Motor) -> protocol.Ack:
        result = protocol.Result.DONE
        # A host that missed the answer repeats the request with the same number; it must not act twice.
        if (key := (request.TYPE, request.request)) != self._last_request:
            result = self._act(request, motor)
            self._last_request = key if result is protocol.Result.DONE else None
        return protocol.Ack(request.request, request.TYPE, result)

    def _act(self, request: protocol.Arm | protocol.Stop | protocol.Home, motor: Motor) -> protocol.Result:
        match request:
            case protocol.Stop():
                self._stop()
            case protocol.Home():
                self._stop()
                self._homed = self.watchdog = False
                self.mode = Mode.HOMING
                self.homings += 1
            case protocol.Arm():
                if self.mode is Mode.HOMING:
                    return protocol.Result.HOMING
                if not self._homed:
                    return protocol.Result.NOT_HOMED
                self._arm(motor)
        return protocol.Result.DONE

    def _arm(self, motor: Motor) -> None:
        self.watchdog = False
        if self.mode is not Mode.ARMED:
            self._servo.reset(motor.position)
            self.mode = Mode.ARMED
            self.armings += 1
        self._alive_tick = self._tick

    def _stop(self) -> None:
        self._commands.clear()
        self._servo.reset(self._servo.setpoint)
        self.mode = Mode.IDLE
