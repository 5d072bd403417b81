"""An emulated ODrive and pole encoder on a CAN bus, with the mechanics of the emulated cart-pole behind."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from deal_hw.drivers.cartpole import protocol
from deal_hw.drivers.cartpole.can_emulator import SECOND_DEVICE, adapter_emulator
from deal_hw.drivers.cartpole.can_link import FRAME, Angle, CanLink
from deal_hw.drivers.cartpole.controller import TICKS_PER_STATE, Controller, Firmware, Mode
from deal_hw.drivers.cartpole.description import DAMPING_NS_M, DESCRIPTION, EFFORT_LIMIT_N, STIFFNESS_N_M
from deal_hw.drivers.cartpole.device import CartpoleDevice, EmulatedDevice
from deal_hw.drivers.cartpole.emulator import CartpoleEmulator
from deal_hw.drivers.cartpole.faults import CanFaults, Hazards
from deal_hw.drivers.cartpole.firmwares import CAN_FIRMWARES, usable_firmware
from deal_hw.drivers.cartpole.host_firmware import CanHostFirmware, settings_of
from deal_hw.drivers.cartpole.mechanics import Mechanics
from deal_hw.drivers.cartpole.odrive_frames import (
    CLOSED_LOOP,
    IDLE,
    LAYOUT,
    NODE_SHIFT,
    READ,
    AxisError,
    Command,
    pack,
)
from deal_hw.drivers.cartpole.odrive_link import ENCODER_KIND, OdriveSettings
from deal_hw.drivers.cartpole.sensor import Motor, Reading
from deal_hw.drivers.cartpole.servo import Servo
from deal_hw.drivers.cartpole.truth import CartpoleTruth, unique_id
from deal_hw.errors import UnknownNameError

ENABLE_WATCHDOG, WATCHDOG_TIMEOUT = 437, 438
"""Numbers of the emulated drive's settings; a real one's are in its firmware's flat_endpoints.json."""
_TURNS_AT_ZERO: Final = 12.25
"""Reading of the drive's encoder in the middle of the rail: it counts from its power-on."""
_REPORTS_PER_HEARTBEAT: Final = 4


@dataclass(frozen=True, slots=True)
class _Settings:
    """The newest settings from the host; the position acts late, with the gains of that moment."""

    pos_gain: float = 0.0
    vel_gain: float = 0.0
    velocity_limit: float = 0.0
    current_limit: float = 0.0
    turns: float = _TURNS_AT_ZERO


class PoleEncoder(Controller):
    """The pole encoder node's firmware in Python, as the C core has it: a cart-pole without a motor.

    Args:
        servo: Never used.
        unique_id: Serial number.
        link: The node's side of the bus.
    """

    def __init__(self, servo: Servo, unique_id: int, link: CanLink) -> None:
        super().__init__(servo, unique_id, lambda: 0, link)
        self._wire = link

    def handle(self, message: protocol.AnyMessage, motor: Motor) -> protocol.AnyMessage | None:
        """Handle one message; return the answer, or None."""
        answer = super().handle(message, motor)
        return replace(answer, kind=ENCODER_KIND) if isinstance(answer, protocol.Info) else answer

    def report(self, reading: Reading) -> bytes:
        """Return the frames of the tick that :meth:`control` ran last."""
        s = self.state(reading)
        return self._wire.encode(
            Angle(s.sequence, s.device_us & 0xFFFF_FFFF, s.pole_urad, s.pole_urad_s, s.status)
        )

    def _act(self, request: protocol.Arm | protocol.Stop | protocol.Home, motor: Motor) -> protocol.Result:
        if isinstance(request, protocol.Arm) and self.mode is not Mode.HOMING:
            return protocol.Result.NOT_HOMED
        return super()._act(request, motor)


class OdriveFirmware:
    """Drive and encoder as the firmware of an emulated device.

    Attributes:
        armings: Number of armings.
        frame_errors: Number of invalid frames to the drive.

    Args:
        truth: Hidden factors of gains and effort limit.
        parts: Numbers and mechanics of the parts.
        encoder: Firmware of the encoder node.
        command_delay: Called for every position target; returns its delay from reception to effect [ticks].
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        parts: OdriveSettings,
        encoder: Firmware,
        command_delay: Callable[[], int],
    ) -> None:
        self.armings = self.frame_errors = 0
        self._parts = parts
        self._stiffness_factor = truth.parameters["servo.stiffness"] / STIFFNESS_N_M
        self._damping_factor = truth.parameters["servo.damping"] / DAMPING_NS_M
        self._effort_factor = truth.parameters["servo.effort_limit"] / EFFORT_LIMIT_N
        self._command_delay = command_delay
        self._encoder = encoder
        self._mode = Mode.IDLE
        self.watchdog = False
        self._axis_errors = AxisError(0)
        self._told, self._acting = _Settings(), _Settings()
        self._due: deque[tuple[int, _Settings]] = deque()
        self._endpoints = {ENABLE_WATCHDOG: bytes(4), WATCHDOG_TIMEOUT: bytes(4)}
        self._tick = self._fed_tick = self._reports = 0
        self._force_n = 0.0

    @property
    def homings(self) -> int:
        """Number of homings that began."""
        return self._encoder.homings

    @property
    def mode(self) -> Mode:
        """Mode of the motor, or homing."""
        return self._mode if self._mode is Mode.ARMED else self._encoder.mode

    @property
    def setpoint(self) -> float:
        """Set-point of the position loop [m]."""
        return (self._acting.turns - _TURNS_AT_ZERO) * self._parts.metres_per_turn

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """Handle the frames received before this tick; return the answers."""
        out = b""
        for begin in range(0, len(data), FRAME.size):
            frame = data[begin : begin + FRAME.size]
            identifier, length, payload = FRAME.unpack(frame)
            if identifier >> NODE_SHIFT == self._parts.drive:
                out += self._take_drive(identifier & 0x1F, payload[:length], motor)
            else:
                out += self._encoder.receive(frame, motor)
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
            self._disarm()
            self._axis_errors |= AxisError.WATCHDOG_TIMER_EXPIRED
            self.watchdog = True
        self._force_n = 0.0
        if self._mode is Mode.ARMED:
            while self._due and self._due[0][0] <= tick:
                self._acting = self._due.popleft()[1]
            self._force_n = self._force(motor)
        self._encoder.control(motor)
        return self._force_n, tick % TICKS_PER_STATE == 0

    def report(self, reading: Reading) -> bytes:
        """Return the frames of the tick that :meth:`control` ran last."""
        node, parts = self._parts.drive, self._parts
        turns = reading.cart_um / 1e6 / parts.metres_per_turn + _TURNS_AT_ZERO
        speed = reading.cart_um_s / 1e6 / parts.metres_per_turn
        torque = self._force_n / parts.newtons_per_nm
        out = pack(node, Command.TORQUES, torque, torque)
        out += pack(node, Command.ENCODER_ESTIMATES, turns, speed)
        number, self._reports = self._reports, self._reports + 1
        if number % _REPORTS_PER_HEARTBEAT == 0:
            state = CLOSED_LOOP if self._mode is Mode.ARMED else IDLE
            out += pack(node, Command.HEARTBEAT, int(self._axis_errors), state, 0, 0)
        return out + self._encoder.report(reading._replace(at_end_stop=False))

    def finish_homing(self) -> None:
        """Note that the cart is in the middle and the pole upright."""
        self._encoder.finish_homing()

    def _force(self, motor: Motor) -> float:
        parts, now = self._parts, self._acting
        position = motor.position / parts.metres_per_turn + _TURNS_AT_ZERO
        speed = motor.velocity / parts.metres_per_turn
        # Hidden: the drive's true gains and current limit.
        pos_gain = now.pos_gain * self._stiffness_factor / self._damping_factor
        vel_gain = now.vel_gain * self._damping_factor
        wanted = min(max(pos_gain * (now.turns - position), -now.velocity_limit), now.velocity_limit)
        limit = now.current_limit * parts.torque_constant * self._effort_factor
        torque = min(max(vel_gain * (wanted - speed), -limit), limit)
        return torque * parts.newtons_per_nm

    @property
    def _watchdog_ticks(self) -> int:
        if not self._endpoints[ENABLE_WATCHDOG][0]:
            return 0
        seconds: float = struct.unpack("<f", self._endpoints[WATCHDOG_TIMEOUT])[0]
        return max(1, round(seconds * DESCRIPTION.device_rate_hz))

    def _take_drive(self, number: int, data: bytes, motor: Motor) -> bytes:
        try:
            command = Command(number)
            values = LAYOUT[command].unpack(data)
        except (ValueError, struct.error):
            self.frame_errors += 1
            return b""
        match command:
            case Command.SET_AXIS_STATE:
                self._set_state(values[0], motor)
            case Command.ESTOP:
                self._disarm()
                self._axis_errors |= AxisError.ESTOP_REQUESTED
            case Command.CLEAR_ERRORS:
                self._axis_errors, self.watchdog = AxisError(0), False
            case Command.SET_POS_GAIN:
                self._told = replace(self._told, pos_gain=values[0])
            case Command.SET_VEL_GAINS:
                self._told = replace(self._told, vel_gain=values[0])
            case Command.SET_LIMITS:
                self._told = replace(self._told, velocity_limit=values[0], current_limit=values[1])
            case Command.SET_INPUT_POS:
                self._take_position(values[0])
            case Command.RX_SDO:
                return self._access(*values)
        return b""

    def _take_position(self, turns: float) -> None:
        self._told = replace(self._told, turns=turns)
        self._fed_tick = self._tick
        if self._mode is Mode.ARMED:
            due = self._tick + self._command_delay()
            self._due.append((max(due, self._due[-1][0]) if self._due else due, self._told))

    def _access(self, opcode: int, number: int, value: bytes) -> bytes:
        if number not in self._endpoints:
            return b""
        if opcode == READ:
            return pack(self._parts.drive, Command.TX_SDO, number, self._endpoints[number])
        self._endpoints[number] = value
        return b""

    def _set_state(self, state: int, motor: Motor) -> None:
        if state == IDLE:
            self._disarm()
        elif state == CLOSED_LOOP and self.mode is Mode.IDLE and not self._axis_errors:
            # The set-point starts at the present position.
            turns = motor.position / self._parts.metres_per_turn + _TURNS_AT_ZERO
            self._told = self._acting = replace(self._told, turns=turns)
            self._mode, self._fed_tick = Mode.ARMED, self._tick
            self.armings += 1

    def _disarm(self) -> None:
        self._due.clear()
        if self._mode is Mode.ARMED:
            self._mode = Mode.IDLE


def odrive_device(
    truth: CartpoleTruth,
    parts: OdriveSettings,
    version: int = 1,
    identity: int = 0,
    firmware: str = "python",
) -> CartpoleDevice:
    """Return an emulated ODrive with a pole encoder; its bytes are CAN frames.

    Args:
        truth: Its hidden parameters.
        parts: Numbers and mechanics of the parts.
        version: Of the encoder's protocol.
        identity: Changes the encoder's serial number.
        firmware: Of the encoder: "python", "host" for the C core, or "auto".

    Raises:
        ConfigurationError: A compiler is missing.
        UnknownNameError: There is no such firmware on CAN.
    """
    number = unique_id(truth) ^ identity
    match usable_firmware(firmware):
        case "python":
            servo = Servo(truth.parameters, 1 / DESCRIPTION.device_rate_hz)
            link = CanLink(parts.encoder, version, number, device=True)
            encoder: Firmware = PoleEncoder(servo, number, link)
        case "host":
            settings = settings_of(truth, 0)
            settings.unique_id = number
            encoder = CanHostFirmware(settings, lambda: 0, parts.encoder, version, encoder=True)
        case _:
            raise UnknownNameError("firmware on CAN", firmware, CAN_FIRMWARES)

    def drive(truth: CartpoleTruth, mechanics: Mechanics) -> Firmware:
        return OdriveFirmware(truth, parts, encoder, mechanics.command_delay)

    return CartpoleDevice(truth, firmware=drive)


def odrive_emulator(
    truth: CartpoleTruth, *, link: Path | None, hazards: Hazards, firmware: str = "auto"
) -> CartpoleEmulator:
    """Return an emulated ODrive and pole encoder behind a serial CAN adapter; node is the drive's.

    Raises:
        ConfigurationError: The encoder's firmware needs a compiler, which is missing.
    """
    faults = hazards.can
    parts = OdriveSettings(drive=faults.node)
    identities = (0, SECOND_DEVICE) if faults.duplicate_node else (0,)
    devices: list[EmulatedDevice] = [
        odrive_device(truth, parts, faults.dbc_version, identity, firmware) for identity in identities
    ]
    settings = [f"enable_watchdog={ENABLE_WATCHDOG}", f"watchdog_timeout={WATCHDOG_TIMEOUT}"]
    settings += [f"node={faults.node}"]
    settings += [f"bitrate={faults.bitrate}"] if faults.bitrate != CanFaults().bitrate else []
    return adapter_emulator(
        devices, link=link, hazards=hazards, port=lambda path: f"{path}?{'&'.join(settings)}"
    )
