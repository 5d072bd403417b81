"""A cart-pole of parts: an ODrive on the belt (its public CANSimple frames) and a pole encoder node.

The host side of the wire. It converts the messages of the cart-pole to CANSimple frames and back, so the
robot class is the same as on other wires. docs/how-to/cartpole-odrive.md shows how to set up the parts.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Final

from deal_hw.clock import Clock
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, Angle, CanLink, check_node, second_host
from deal_hw.drivers.cartpole.wire.odrive_frames import (
    CLOSED_LOOP,
    IDLE,
    LAYOUT,
    MOVING,
    NODE_SHIFT,
    PASSTHROUGH,
    POSITION_CONTROL,
    READ,
    SDO_HEAD,
    WRITE,
    AxisError,
    Command,
    pack,
)
from deal_hw.drivers.command_echo import ClockOffset, CommandEcho
from deal_hw.errors import ConfigurationError, FrameError
from deal_hw.types import Status

ENCODER_KIND: Final = "pole-encoder"
DRIVE_NODE: Final = 0
ENCODER_NODE: Final = 2
_U32 = 0xFFFF_FFFF


HEARTBEAT_AGE_S: Final = 0.2
"""Largest age of the drive's heartbeat [s]."""
WATCHDOG_S: Final = 0.2
"""The drive switches off after this time without a command [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OdriveSettings:
    """Numbers of the parts on the bus, and the mechanics between them.

    Attributes:
        drive: Node number of the ODrive.
        encoder: Node number of the pole encoder.
        metres_per_turn: Travel of the cart for one turn of the motor [m]; 0.04 for a pulley with 20 teeth of
            2 mm.
        torque_constant: Torque constant of the motor [N*m/A]: 8.27 / KV; the default is for 270 KV.
        velocity_limit_m_s: The drive's own speed limit [m/s]. It is above the trip speed of the safety
            filter, because a drive that exceeds it switches off.
        enable_watchdog: Number of the drive's setting axis0.config.enable_watchdog; it differs between
            firmware versions. 0: the watchdog is not set.
        watchdog_timeout: Number of axis0.config.watchdog_timeout.
    """

    drive: int = DRIVE_NODE
    encoder: int = ENCODER_NODE
    metres_per_turn: float = 0.04
    torque_constant: float = 8.27 / 270
    velocity_limit_m_s: float = 8.0
    enable_watchdog: int = 0
    watchdog_timeout: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.drive <= 62:
            raise ConfigurationError(f"drive node {self.drive}: an ODrive's number is 0 to 62")
        check_node(self.encoder)
        if self.drive == self.encoder:
            raise ConfigurationError(
                f"drive and encoder have the same node number {self.drive}; give them different ones"
            )
        if bool(self.enable_watchdog) != bool(self.watchdog_timeout):
            raise ConfigurationError(
                "enable_watchdog and watchdog_timeout belong together: give both or neither"
            )
        for name in (
            "metres_per_turn",
            "torque_constant",
            "velocity_limit_m_s",
        ):
            if not 0 < getattr(self, name) < 1000:
                raise ConfigurationError(f"{name} is {getattr(self, name)!r}; allowed: above 0, below 1000")

    @property
    def newtons_per_nm(self) -> float:
        """Force on the belt for a motor torque of 1 N*m [N/(N*m)]."""
        return 2 * math.pi / self.metres_per_turn


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """Gains and limits that the host sends with a target; float32, as on the wire.

    Attributes:
        pos_gain: [(rev/s)/rev].
        vel_gain: [N*m/(rev/s)].
        velocity_limit: [rev/s].
        current_limit: [A].
    """

    pos_gain: float
    vel_gain: float
    velocity_limit: float
    current_limit: float


def drive_command(target: protocol.Target, s: OdriveSettings) -> DriveCommand:
    """Return the gains and limits of a target: force = kp * (target - x) - kd * v is the drive's own cascade.

    The drive's law is torque = vel_gain * (pos_gain * (target - pos) - vel) without its integrator, so
    pos_gain is kp / kd and vel_gain is kd in its units.

    Raises:
        FrameError: Stiffness without damping, which the cascade cannot have.
    """
    if target.stiffness_mn_m and not target.damping_mns_m:
        raise FrameError("an ODrive has no stiffness without damping; send a damping above 0")
    gain = target.stiffness_mn_m / target.damping_mns_m if target.damping_mns_m else 0.0
    torque_nm = target.effort_limit_mn / 1e3 / s.newtons_per_nm
    return DriveCommand(
        gain,
        target.damping_mns_m / 1e3 * s.metres_per_turn / s.newtons_per_nm,
        s.velocity_limit_m_s / s.metres_per_turn,
        torque_nm / s.torque_constant,
    )


class OdriveLink:
    """The host's side of a bus with an ODrive and a pole encoder.

    The encoder node samples when it receives the drive's estimates, so cart and pole are of the same moment.
    A sample without the drive's part is refused. This class moves the set-point towards its target, because
    the drive has no speed limit that leaves its control law unchanged.

    The drive does not report which command it received. A state names the newest command sent before the
    state was sampled, by the encoder's clock.

    Attributes:
        errors: Number of corrupt or unknown messages.

    Args:
        settings: Numbers and mechanics of the parts.
        clock: The clock of commands, and of samples as they arrive.
    """

    resync: ClassVar[bytes] = b""

    def __init__(self, settings: OdriveSettings, clock: Clock) -> None:
        self.errors = 0
        self._s, self._clock = settings, clock
        self._encoder = CanLink(settings.encoder)
        self._axis_state, self._axis_errors = 0, AxisError(0)
        self._cart: tuple[float, float] | None = None
        self._force_mn = 0
        self._turns = 0.0
        self._zero_m: float | None = None
        self._homing = self._homed = self._home_taken = False
        self._device_us, self._sequence = 0, -1
        self._heartbeat_us: int | None = None
        self._offset, self._echo = ClockOffset(), CommandEcho()
        self._setpoint_um: int | None = None
        self._info: protocol.Info | None = None
        self._written: dict[int, bytes] = {}
        self._answers: list[protocol.Ack] = []
        self._arming: int | None = None
        self._armed = self._commands = False
        self._second_host = ""

    @property
    def fault(self) -> str:
        """Fault after which the host must not continue; "" for none."""
        if self._second_host or self._encoder.fault:
            return self._second_host or self._encoder.fault
        if self._armed and self._axis_errors:
            names = ", ".join(flag.name or "" for flag in AxisError if flag in self._axis_errors)
            return (
                f"the ODrive reports {names or hex(self._axis_errors)}; look it up in ODrive's documentation"
            )
        if self._armed and not self._homed:
            return "the pole encoder is no longer homed: it restarted; check its supply, then home again"
        age_us = 0 if self._heartbeat_us is None else self._device_us - self._heartbeat_us
        if age_us > HEARTBEAT_AGE_S * 1e6:
            return f"the ODrive's heartbeat is {age_us / 1e3:.0f} ms old; set its heartbeat_msg_rate_ms to 20"
        return ""

    @property
    def hint(self) -> str:
        """Advice for the case that frames arrive but no answer."""
        drive, encoder = self._s.drive, self._s.encoder
        if self._heartbeat_us is None:
            return f"no heartbeat of an ODrive at node {drive}; check its axis0.config.can.node_id"
        if self._info is None:
            return f"the pole encoder at node {encoder} does not answer; check its node number"
        return (
            "the ODrive did not confirm its watchdog; compare enable_watchdog and watchdog_timeout with its "
            "firmware's flat_endpoints.json"
        )

    def feasible(self, target: protocol.Target) -> protocol.Target:
        """Return the target with its set-point moved no further than the speed limit allows in one cycle.

        The speed limit in the sent target is the drive's own.
        """
        here = target.position_um if self._setpoint_um is None else self._setpoint_um
        step = round(target.speed_limit_um_s / DESCRIPTION.control_rate_hz)
        return protocol.Target(
            target.sequence,
            min(max(target.position_um, here - step), here + step),
            target.stiffness_mn_m,
            target.damping_mns_m,
            target.effort_limit_mn,
            round(self._s.velocity_limit_m_s * 1e6),
        )

    def encode(self, message: protocol.AnyMessage) -> bytes:
        """Return a message's frames for drive and encoder.

        Raises:
            FrameError: A value does not fit its field.
        """
        idle = self._pack(Command.SET_AXIS_STATE, IDLE)
        self._commands = isinstance(message, protocol.Target | protocol.Arm | protocol.Home)
        match message:
            case protocol.Hello():
                self._info, self._heartbeat_us, self._written = None, None, {}
                self._armed, self._arming = False, None
                self._offset, self._echo = ClockOffset(), CommandEcho()
                return idle + self._watchdog_frames() + self._encoder.encode(message)
            case protocol.Home():
                self._homing, self._zero_m, self._armed = True, None, False
                self._home_taken = False
                return idle + self._encoder.encode(message)
            case protocol.Arm():
                return self._arm(message, idle)
            case protocol.Target():
                return self._target(message)
        self._armed, self._arming = False, None
        return idle

    def decode(self, data: bytes) -> Iterator[protocol.AnyMessage]:
        """Take frames; return the messages that they complete, and count invalid ones."""
        if len(data) % FRAME.size:
            self.errors += 1
            return
        for begin in range(0, len(data), FRAME.size):
            frame = data[begin : begin + FRAME.size]
            identifier, length, payload = FRAME.unpack(frame)
            if identifier >> NODE_SHIFT == self._s.drive:
                self._take_drive(identifier & 0x1F, payload[:length])
            elif identifier >> NODE_SHIFT == self._s.encoder:
                before = self._encoder.errors
                for found in self._encoder.decode_all(frame):
                    yield from self._take_encoder(found)
                self.errors += self._encoder.errors - before
            if self._info is not None and self._heartbeat_us is not None and self._watchdog_is_set:
                info, self._info = self._info, None
                yield info
            while self._answers:
                yield self._answers.pop(0)

    # Requests of the host.

    def _pack(self, command: Command, *values: float | bytes) -> bytes:
        try:
            return pack(self._s.drive, command, *values)
        except (struct.error, OverflowError) as error:
            raise FrameError(f"{command.name} {values}: {error}") from error

    def _watchdog_frames(self) -> bytes:
        s = self._s
        if not s.enable_watchdog:
            return b""
        values = {s.watchdog_timeout: struct.pack("<f", WATCHDOG_S), s.enable_watchdog: b"\1\0\0\0"}
        return b"".join(
            self._pack(Command.RX_SDO, WRITE, number, value)
            + self._pack(Command.RX_SDO, READ, number, bytes(4))
            for number, value in values.items()
        )

    @property
    def _watchdog_is_set(self) -> bool:
        s = self._s
        if not s.enable_watchdog:
            return True
        timeout = self._written.get(s.watchdog_timeout) == struct.pack("<f", WATCHDOG_S)
        return timeout and self._written.get(s.enable_watchdog, b"\0")[0] == 1

    def _arm(self, message: protocol.Arm, idle: bytes) -> bytes:
        if self._homing or not self._homed or self._zero_m is None:
            result = protocol.Result.HOMING if self._homing else protocol.Result.NOT_HOMED
            self._answers.append(protocol.Ack(message.request, message.TYPE, result))
            return idle
        self._arming = message.request
        self._setpoint_um = round((self._turns * self._s.metres_per_turn - self._zero_m) * 1e6)
        # Until the first target the force is zero, because only targets have gains. A command is sent
        # first: it feeds the watchdog, whose error would prevent arming.
        return (
            self._pack(Command.SET_CONTROLLER_MODE, POSITION_CONTROL, PASSTHROUGH)
            + self._pack(Command.SET_POS_GAIN, 0.0)
            + self._pack(Command.SET_VEL_GAINS, 0.0, 0.0)
            + self._pack(Command.SET_INPUT_POS, self._turns, 0, 0)
            + self._pack(Command.CLEAR_ERRORS, 0)
            + self._pack(Command.SET_AXIS_STATE, CLOSED_LOOP)
        )

    def _target(self, target: protocol.Target) -> bytes:
        self._setpoint_um = target.position_um
        self._echo.note(target.sequence, self._clock.now_ns())
        wanted = drive_command(target, self._s)
        turns = (target.position_um / 1e6 + (self._zero_m or 0.0)) / self._s.metres_per_turn
        return (
            self._pack(Command.SET_POS_GAIN, wanted.pos_gain)
            + self._pack(Command.SET_VEL_GAINS, wanted.vel_gain, 0.0)
            + self._pack(Command.SET_LIMITS, wanted.velocity_limit, wanted.current_limit)
            + self._pack(Command.SET_INPUT_POS, turns, 0, 0)
        )

    # Messages of drive and encoder.

    def _take_drive(self, number: int, data: bytes) -> None:
        # A drive that somebody else switches off reports it by itself.
        if self._commands and number in MOVING and data != LAYOUT[Command.SET_AXIS_STATE].pack(IDLE):
            self._second_host = second_host(f"the ODrive at node {self._s.drive}", Command(number).name)
        if number not in (Command.HEARTBEAT, Command.ENCODER_ESTIMATES, Command.TORQUES, Command.TX_SDO):
            return
        if number == Command.TX_SDO and len(data) == SDO_HEAD.size:
            return  # From 0.6.11 on a drive confirms a write; the value is read back in any case.
        layout = LAYOUT[Command(number)]
        if len(data) != layout.size:
            self.errors += 1
            return
        values = layout.unpack(data)
        if number == Command.HEARTBEAT:
            self._axis_errors, self._axis_state = AxisError(values[0]), values[1]
            self._heartbeat_us = self._device_us
            if self._arming is not None and self._axis_state == CLOSED_LOOP:
                self._answers.append(
                    protocol.Ack(self._arming, protocol.MessageType.ARM, protocol.Result.DONE)
                )
                self._arming, self._armed = None, True
        elif number == Command.TX_SDO:
            self._written[values[0]] = values[1]
        elif not all(map(math.isfinite, values)):
            self.errors += 1
        elif number == Command.TORQUES:
            force_mn = values[0] * self._s.newtons_per_nm * 1e3
            self._force_mn = round(min(max(force_mn, -32767), 32767))
        else:
            self._cart = self._turns, _ = values

    def _take_encoder(self, found: protocol.AnyMessage | Angle) -> Iterator[protocol.AnyMessage]:
        if isinstance(found, Angle):
            yield from self._take_angle(found)
        elif isinstance(found, protocol.Info):
            kind = protocol.DEVICE_KIND if found.kind == ENCODER_KIND else found.kind
            self._info = protocol.Info(
                found.request,
                kind,
                found.firmware,
                found.device_rate_hz,
                found.state_rate_hz,
                found.unique_id,
                found.version,
            )
        elif isinstance(found, protocol.Ack):
            self._home_taken |= found.of is protocol.MessageType.HOME
            yield found

    def _take_angle(self, angle: Angle) -> Iterator[protocol.State]:
        cart, self._cart = self._cart, None
        # Number and time advanced by less than their fields can hold, or the host restarted.
        passed_us = (angle.device_us - self._device_us) & _U32
        self._sequence = (self._sequence + (((angle.sequence - self._sequence - 1) & 0xFF) + 1)) & _U32
        self._device_us += passed_us
        self._offset.take(self._clock.now_ns(), 1000 * self._device_us)
        # After a silence, as between two processes, the heartbeat's time is set anew.
        if self._heartbeat_us is not None and passed_us > HEARTBEAT_AGE_S * 1e6:
            self._heartbeat_us = self._device_us
        if cart is None:
            return  # Its number is missing from the states, and the gap is counted.
        position_m = cart[0] * self._s.metres_per_turn
        status = Status(angle.status) & (Status.HOMED | Status.HOMING)
        self._homed = Status.HOMED in status
        # Samples from before the request may still say homed, with the cart anywhere.
        if self._homing and self._home_taken and status & Status.HOMED and not status & Status.HOMING:
            self._homing, self._zero_m = False, position_m
        if self._zero_m is None:
            status &= ~Status.HOMED
        status |= Status.ARMED if self._axis_state == CLOSED_LOOP else Status.NONE
        lost = AxisError.WATCHDOG_TIMER_EXPIRED
        status |= Status.WATCHDOG if self._axis_errors & lost else Status.NONE
        status |= Status.FAULT if self._axis_errors & ~lost else Status.NONE
        newest, age_ns = self._echo.at(1000 * self._device_us, self._offset.offset_ns)
        yield protocol.State(
            sequence=self._sequence,
            device_us=self._device_us,
            cart_um=_clip((position_m - (self._zero_m or 0.0)) * 1e6),
            cart_um_s=_clip(cart[1] * self._s.metres_per_turn * 1e6),
            pole_urad=angle.pole_urad,
            pole_urad_s=angle.pole_urad_s,
            effort_mn=self._force_mn if status & Status.ARMED else 0,
            status=int(status),
            command_sequence=newest if newest >= 0 else protocol.NO_COMMAND,
            command_age_us=min(age_ns // 1000, _U32) if newest >= 0 else 0,
        )


def _clip(value: float) -> int:
    return round(min(max(value, -0x7FFF_FFFF), 0x7FFF_FFFF))
