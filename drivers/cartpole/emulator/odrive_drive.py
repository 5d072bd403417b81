"""The firmware of an emulated ODrive: its CANSimple frames, its control law and its watchdog."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from deal_hw.drivers.cartpole.chips.controller import TICKS_PER_STATE, Firmware, Mode
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.emulator.odrive_control import (
    CONTROLLER,
    TURNS_AT_ZERO,
    DriveInput,
    DriveLaw,
    bounded,
    configured,
    drive_input,
)
from deal_hw.drivers.cartpole.emulator.odrive_endpoints import (
    ADC_VOLTAGE,
    ENDPOINTS,
    ERASE,
    FIRMWARE,
    HARDWARE,
    REBOOT,
    SAVE,
    DriveSetting,
)
from deal_hw.drivers.cartpole.emulator.odrive_endpoints import CLEAR_ERRORS as CLEAR_ERRORS_FUNCTION
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.wire.can_link import FRAME, REMOTE
from deal_hw.drivers.cartpole.wire.odrive_frames import (
    BROADCAST_NODE,
    CLOSED_LOOP,
    FEED_FORWARD,
    IDLE,
    LAYOUT,
    NODE_SHIFT,
    READ,
    SDO_HEAD,
    WRITE,
    AxisError,
    Command,
    pack,
)
from deal_hw.drivers.cartpole.wire.odrive_link import DRIVE_NODE, OdriveSettings

BOOT_TICKS: Final = 500
"""How long a starting drive is silent [ticks of 1 ms]; assumed."""
BUS_VOLTAGE_V: Final = 24.0
TEMPERATURE_C: Final = 30.0
"""Of inverter and motor: nothing heats them."""
_REPORTS_PER_HEARTBEAT: Final = 4
_PROTOCOL_VERSION: Final = 2
_REBOOT_ACTIONS: Final = {0: REBOOT, 1: SAVE, 2: ERASE}


class OdriveFirmware:
    """Drive and encoder as the firmware of an emulated device.

    Attributes:
        armings: Number of armings.
        frame_errors: Number of invalid frames to the drive.
        watchdog: Whether the watchdog stopped the motor since errors were cleared.
        encoder: Firmware of the encoder node.

    Args:
        truth: Hidden factors of gains and effort limit.
        parts: Numbers and mechanics of the parts.
        encoder: Firmware of the encoder node.
        command_delay: Called for every input; returns its delay from reception to effect [ticks].
        serial_number: The drive's own, 48 bits.
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        parts: OdriveSettings,
        encoder: Firmware,
        command_delay: Callable[[], int],
        serial_number: int = 0x3854_3258_3037,
    ) -> None:
        self.armings = self.frame_errors = 0
        self.watchdog = False
        self._parts, self._serial = parts, serial_number.to_bytes(6, "little")
        self._law = DriveLaw(truth, parts)
        self._command_delay = command_delay
        self.encoder = encoder
        self._mode = Mode.IDLE
        self._errors = self._disarm_reason = AxisError(0)
        self._config = self._saved = configured(parts)
        self._due: deque[tuple[int, DriveInput]] = deque()
        self._tick = self._fed_tick = self._reports = self._silent_until = 0
        self._force_n = 0.0
        self._state = (0.0, 0.0)
        self._offset_turns = TURNS_AT_ZERO
        self._told = self._acting = drive_input(self._config)

    @property
    def homings(self) -> int:
        """Number of homings that began."""
        return self.encoder.homings

    @property
    def mode(self) -> Mode:
        """Mode of the motor, or homing."""
        return self._mode if self._mode is Mode.ARMED else self.encoder.mode

    @property
    def setpoint(self) -> float:
        """Set-point of the position loop [m]."""
        return (self._acting.turns - self._offset_turns) * self._parts.metres_per_turn

    @property
    def node(self) -> int:
        """The drive's number on the bus; 63 if it has none."""
        return int(self._config["axis0.config.can.node_id"])

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """Handle the frames received before this tick; return the answers."""
        out = b""
        self._state = self._turns(motor.position), motor.velocity / self._parts.metres_per_turn
        for begin in range(0, len(data) - FRAME.size + 1, FRAME.size):
            frame = data[begin : begin + FRAME.size]
            identifier, length, payload = FRAME.unpack(frame)
            remote, identifier = bool(identifier & REMOTE), identifier & ~REMOTE
            if identifier >> NODE_SHIFT in (self.node, BROADCAST_NODE):
                if self._tick >= self._silent_until:
                    out += self._take(identifier, payload[: min(length, 8)], motor, remote=remote)
            elif not remote:
                out += self.encoder.receive(frame, motor)
        return out

    def control(self, motor: Motor) -> tuple[float, bool]:
        """Run one tick; return the force on the cart [N], and whether a sample is due."""
        tick = self._tick
        self._tick = tick + 1
        if (
            self._mode is Mode.ARMED
            and self._watchdog_ticks
            and tick - self._fed_tick >= self._watchdog_ticks
        ):
            self._fail(AxisError.WATCHDOG_TIMER_EXPIRED)
            self.watchdog = True
        self._force_n = 0.0
        if self._mode is Mode.ARMED:
            while self._due and self._due[0][0] <= tick:
                self._acting = self._due.popleft()[1]
            turns, speed = self._turns(motor.position), motor.velocity / self._parts.metres_per_turn
            most = self._config[CONTROLLER + "vel_integrator_limit"]
            self._force_n = self._law.force(self._acting, turns, speed, most)
        self.encoder.control(motor)
        return self._force_n, tick % TICKS_PER_STATE == 0

    def report(self, reading: Reading) -> bytes:
        """Return the frames of the tick that :meth:`control` ran last."""
        encoder = self.encoder.report(reading._replace(at_end_stop=False))
        if self._tick < self._silent_until or self.node == BROADCAST_NODE:
            return encoder
        parts = self._parts
        turns = reading.cart_um / 1e6 / parts.metres_per_turn + self._offset_turns
        speed = reading.cart_um_s / 1e6 / parts.metres_per_turn
        self._state = turns, speed
        out = self._answer(Command.TORQUES) + self._answer(Command.ENCODER_ESTIMATES)
        number, self._reports = self._reports, self._reports + 1
        if number % _REPORTS_PER_HEARTBEAT == 0:
            out += self._answer(Command.HEARTBEAT)
        return out + encoder

    def finish_homing(self) -> None:
        """Note that the cart is in the middle and the pole upright."""
        self.encoder.finish_homing()

    # The control law.

    def _turns(self, position_m: float) -> float:
        return position_m / self._parts.metres_per_turn + self._offset_turns

    @property
    def _power_w(self) -> float:
        """Power of the motor [W]; the emulated drive has no losses."""
        return self._force_n / self._parts.newtons_per_nm * self._state[1] * 2 * math.pi

    @property
    def _watchdog_ticks(self) -> int:
        if not self._config["axis0.config.enable_watchdog"]:
            return 0
        seconds = self._config["axis0.config.watchdog_timeout"]
        return max(1, round(min(seconds, 1e6) * DESCRIPTION.device_rate_hz))

    # Frames.

    def _answer(self, command: Command) -> bytes:
        """Return a frame with present values; empty for frames that a drive never sends."""
        torque = self._force_n / self._parts.newtons_per_nm
        current = torque / self._parts.torque_constant
        power = self._power_w
        state = CLOSED_LOOP if self._mode is Mode.ARMED else IDLE
        match command:
            case Command.VERSION:
                values: tuple[float | bytes, ...] = (_PROTOCOL_VERSION, *HARDWARE, *FIRMWARE, 0)
            case Command.HEARTBEAT:
                values = (int(self._errors), state, 0, 0)
            case Command.ERROR:
                values = (int(self._errors), int(self._disarm_reason))
            case Command.ADDRESS:
                values = (self.node, self._serial, 0)
            case Command.ENCODER_ESTIMATES:
                values = self._state
            case Command.IQ:
                values = (current, current)
            case Command.TEMPERATURE:
                values = (TEMPERATURE_C, TEMPERATURE_C)
            case Command.BUS_VOLTAGE_CURRENT:
                values = (BUS_VOLTAGE_V, power / BUS_VOLTAGE_V)
            case Command.TORQUES:
                values = (torque, torque)
            case Command.POWERS:
                values = (power, power)
            case _:
                return b""
        return pack(self.node, command, *values)

    def _take(self, identifier: int, data: bytes, motor: Motor, *, remote: bool) -> bytes:
        """Handle a frame to this drive or to all; anything that is no frame of CANSimple is counted."""
        node, number = identifier >> NODE_SHIFT, identifier & 0x1F
        try:
            command = Command(number)
        except ValueError:
            self.frame_errors += 1
            return b""
        if remote or not data:
            # A drive is asked by a remote frame or by an empty one; all are asked for their address alone.
            if command is Command.ADDRESS or (node != BROADCAST_NODE and self._answer(command)):
                return self._answer(command)
            if remote:
                return b""
        if command is Command.ADDRESS:
            return self._readdress(data)
        if command is Command.RX_SDO:
            return self._access(data)
        size = LAYOUT[command].size
        if len(data) < size and command is not Command.CLEAR_ERRORS:
            self.frame_errors += 1
            return b""
        self._act(command, data[:size].ljust(size, b"\0"), motor)
        return b""

    def _act(self, command: Command, data: bytes, motor: Motor) -> None:
        values = LAYOUT[command].unpack(data)
        if not all(math.isfinite(v) for v in values if isinstance(v, float)):
            self.frame_errors += 1
            return
        match command:
            case Command.SET_AXIS_STATE:
                self._set_state(values[0], motor)
            case Command.ESTOP:
                self._fail(AxisError.ESTOP_REQUESTED)
            case Command.CLEAR_ERRORS:
                self._clear_errors()
            case Command.REBOOT:
                self._call(_REBOOT_ACTIONS.get(values[0], REBOOT))
            case Command.SET_CONTROLLER_MODE:
                self._set(control_mode=values[0] & 0xFF, input_mode=values[1] & 0xFF)
            case Command.SET_POS_GAIN:
                self._set(pos_gain=values[0])
            case Command.SET_VEL_GAINS:
                self._set(vel_gain=values[0], vel_integrator_gain=values[1])
            case Command.SET_LIMITS:
                self._config["axis0.config.motor.current_soft_max"] = values[1]
                self._set(vel_limit=values[0])
            case Command.SET_ABSOLUTE_POSITION:
                self._offset_turns += bounded(values[0]) - self._turns(motor.position)
            case Command.SET_INPUT_POS:
                turns, speed, torque = values
                self._take_input(turns=turns, speed=speed * FEED_FORWARD, torque=torque * FEED_FORWARD)
            case Command.SET_INPUT_VEL:
                self._take_input(speed=values[0], torque=values[1])
            case Command.SET_INPUT_TORQUE:
                self._take_input(torque=values[0])

    def _set(self, **values: float) -> None:
        self._config |= {CONTROLLER + name: value for name, value in values.items()}
        self._told = drive_input(self._config, self._told)

    def _take_input(self, *, torque: float, turns: float | None = None, speed: float | None = None) -> None:
        """Take an input; what its frame does not have stays as it was."""
        before = self._told
        self._told = replace(
            before,
            turns=before.turns if turns is None else bounded(turns),
            speed=before.speed if speed is None else bounded(speed),
            torque=bounded(torque),
        )
        self._fed_tick = self._tick
        if self._mode is Mode.ARMED:
            due = self._tick + self._command_delay()
            self._due.append((max(due, self._due[-1][0]) if self._due else due, self._told))

    def _readdress(self, data: bytes) -> bytes:
        """Take or lose a number: who has the serial number gets it, who had the number has none."""
        if len(data) < 1 + len(self._serial) or data[0] > BROADCAST_NODE:
            self.frame_errors += 1
        elif data[1:7] == self._serial:
            self._config["axis0.config.can.node_id"] = data[0]
        elif data[0] == self.node:
            self._config["axis0.config.can.node_id"] = BROADCAST_NODE
        return b""

    # Settings and functions by number.

    def _access(self, data: bytes) -> bytes:
        if len(data) < SDO_HEAD.size:
            self.frame_errors += 1
            return b""
        opcode, number = SDO_HEAD.unpack_from(data)
        value = data[SDO_HEAD.size :]
        named = next(((name, e) for name, e in ENDPOINTS.items() if e.number == number), None)
        if named is not None and opcode == READ:
            return pack(self.node, Command.TX_SDO, number, named[1].pack(self._value(named[0])))
        if opcode != WRITE:
            return b""
        if named is not None:
            written = self._write(*named, value)
            return self._confirm(number) if written else b""
        if number not in (SAVE, ERASE, REBOOT, CLEAR_ERRORS_FUNCTION, ADC_VOLTAGE):
            return b""
        if number == ADC_VOLTAGE:
            # No voltage is on an emulated drive's inputs.
            return pack(self.node, Command.TX_SDO, number, bytes(4))
        confirmed = self._confirm(number)
        if number == SAVE:
            # Without a restart: ODrive's example goes on with other settings half a second later.
            self._saved = dict(self._config)
        else:
            self._call(number)
        return confirmed

    def _confirm(self, number: int) -> bytes:
        data = SDO_HEAD.pack(0, number)
        return FRAME.pack(self.node << NODE_SHIFT | Command.TX_SDO, len(data), data)

    def _value(self, name: str) -> float:
        live = {
            "vbus_voltage": BUS_VOLTAGE_V,
            "ibus": self._power_w / BUS_VOLTAGE_V,
            "axis0.active_errors": int(self._errors),
            "axis0.disarm_reason": int(self._disarm_reason),
            "axis0.current_state": CLOSED_LOOP if self._mode is Mode.ARMED else IDLE,
            "axis0.pos_estimate": self._state[0],
            "axis0.vel_estimate": self._state[1],
        }
        value = live[name] if name in live else self._config[name]
        return value if ENDPOINTS[name].kind == "float" else int(value)

    def _write(self, name: str, endpoint: DriveSetting, data: bytes) -> bool:
        value = endpoint.unpack(data)
        if value is None or not endpoint.writable or math.isnan(value):
            return False
        if name == "axis0.config.can.node_id" and not 0 <= value <= BROADCAST_NODE:
            return False
        self._config[name] = value
        self._told = drive_input(self._config, self._told)
        return True

    def _call(self, function: int) -> None:
        if function == CLEAR_ERRORS_FUNCTION:
            self._clear_errors()
            return
        if function == SAVE:
            self._saved = dict(self._config)
        elif function == ERASE:
            self._saved = configured(self._parts) | {"axis0.config.can.node_id": DRIVE_NODE}
        # Each of the three ends with a restart, after which the saved settings are in force.
        self._disarm()
        self._errors = self._disarm_reason = AxisError(0)
        self.watchdog = False
        self._config = dict(self._saved)
        self._told = self._acting = drive_input(self._config)
        self._silent_until = self._tick + BOOT_TICKS

    # States.

    def _set_state(self, state: int, motor: Motor) -> None:
        if state == IDLE:
            self._disarm()
        elif state == CLOSED_LOOP and self.mode is Mode.IDLE and not self._errors:
            # The set-point starts at the present position.
            self._told = replace(self._told, turns=self._turns(motor.position), speed=0.0, torque=0.0)
            self._acting = self._told
            self._law.reset()
            self._mode, self._fed_tick = Mode.ARMED, self._tick
            self._disarm_reason = AxisError(0)
            self.armings += 1

    def _fail(self, error: AxisError) -> None:
        if self._mode is Mode.ARMED:
            self._disarm_reason = error
        self._disarm()
        self._errors |= error

    def _clear_errors(self) -> None:
        self._errors, self.watchdog = AxisError(0), False

    def _disarm(self) -> None:
        self._due.clear()
        if self._mode is Mode.ARMED:
            self._mode = Mode.IDLE
