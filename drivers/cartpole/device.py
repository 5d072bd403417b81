"""The emulated device: what firmware and mechanics do, in virtual device time. Bytes in, bytes out."""

from __future__ import annotations

import enum
import math
from array import array
from collections import deque
from dataclasses import dataclass

import numpy as np

from deal_hw.drivers.cartpole import protocol
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.mechanics import build_simulation
from deal_hw.drivers.cartpole.profiles import profile as find_profile
from deal_hw.drivers.cartpole.sensor import Sample, Sensor
from deal_hw.drivers.cartpole.servo import Servo
from deal_hw.drivers.cartpole.truth import Truth
from deal_hw.errors import ProtocolError
from deal_hw.types import FloatArray, Status

TICK_NS = 1_000_000
TICKS_PER_STATE = round(DESCRIPTION.device_rate_hz / DESCRIPTION.state_rate_hz)
WATCHDOG_TICKS = 200
HOMING_TICKS = 500
START_ANGLE_RAD = 0.03
FIRMWARE = (0, 1, 0)
_END_STOP_M = 0.399
_CART, _POLE = 0, 1


class _Mode(enum.Enum):
    IDLE = enum.auto()
    HOMING = enum.auto()
    HELD = enum.auto()
    ARMED = enum.auto()


@dataclass(frozen=True, slots=True)
class TrueTrajectory:
    """What really happened, for benches; it never goes over the wire and never to a calibrator.

    Attributes:
        tick: Device ticks, (T,).
        position: Cart and pole before each tick's physics step, (T, 2) [m, rad].
        velocity: (T, 2) [m/s, rad/s].
        force: Force on the cart held during the tick, (T,) [N].
        setpoint: Set-point of the servo, (T,) [m].
    """

    tick: np.ndarray[tuple[int], np.dtype[np.int64]]
    position: FloatArray
    velocity: FloatArray
    force: FloatArray
    setpoint: FloatArray


class CartpoleDevice:
    """Firmware and mechanics of an emulated cart-pole.

    Control tick k, at device time k ms: (1) handle what was received, let due commands act; (2) slew the
    set-point; (3) force from the state at the start of the tick; (4) one physics step with that force. A
    state frame at tick k reports the state before step (4). Tick k runs when :meth:`advance_to` passes k ms,
    so bytes that come at k ms sharp are handled in tick k + 1.

    Until armed the motor is off: the pole hangs, or is held upright by a hand after homing. Between arming
    and the first target the force is zero, because gains come only with targets.

    Attributes:
        received_bytes: How many have come from the host.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        keep_truth: Whether to keep the true trajectory for :meth:`true_trajectory`.
        start_angle_rad: Where the hand sets the pole when homing [rad]; None: within +-0.03 rad, by the seed.
    """

    def __init__(
        self, truth: Truth, *, keep_truth: bool = False, start_angle_rad: float | None = None
    ) -> None:
        self._truth = truth
        self._profile = find_profile(truth.profile)
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence([truth.seed, 0xCA47]).spawn(4)]
        self._hand_rng, sensor_rng, self._jitter_rng, self._drop_rng = streams
        self._sim = build_simulation(truth.parameters)
        self._servo = Servo(truth.parameters, self._sim.timestep_s)
        self._sensor = Sensor(
            self._profile, truth.sensing_ticks, round(DESCRIPTION.state_rate_hz), sensor_rng
        )
        self._friction_n = truth.parameters["cart.frictionloss"]
        self._start_angle_rad = start_angle_rad
        self._motor_m = 0.0
        self._decoder = protocol.FrameDecoder()
        self._inbox = b""
        self.received_bytes = 0
        self._tick = 0
        self._mode = _Mode.IDLE
        self._homed = self._watchdog = False
        self._homing_from = (0.0, 0.0)
        self._homing_to = 0.0
        self._homing_start = 0
        self._last_request: tuple[int, int] | None = None
        self._state_count = 0
        self._commands: deque[tuple[int, protocol.Target]] = deque()
        self._command_sequence = protocol.NO_COMMAND
        self._command_tick = self._alive_tick = 0
        self._kept: array[float] | None = array("d") if keep_truth else None
        self._sim.set_state((self._hand_rng.uniform(-0.1, 0.1), math.pi), (0.0, 0.0))

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        return self._tick * TICK_NS

    @property
    def true_position(self) -> tuple[float, float]:
        """True cart position and pole angle now [m, rad]; never on the wire."""
        cart, pole = self._sim.position()
        return cart, pole

    @property
    def armed(self) -> bool:
        """Whether the motor follows targets."""
        return self._mode is _Mode.ARMED

    @property
    def mode(self) -> str:
        """What the motor does: "idle" and "held" are without torque, "homing" and "armed" are not."""
        return self._mode.name.lower()

    @property
    def watchdog(self) -> bool:
        """Whether the motor was stopped because commands stayed away, since it was last armed."""
        return self._watchdog

    @property
    def frame_errors(self) -> int:
        """Corrupt frames received so far."""
        return self._decoder.errors

    def receive(self, data: bytes) -> None:
        """Take bytes from the host; the next tick handles them."""
        self._inbox += data
        self.received_bytes += len(data)

    def advance_to(self, device_ns: int) -> bytes:
        """Run every tick up to and including ``device_ns``; return the bytes sent meanwhile."""
        out = bytearray()
        while self._tick * TICK_NS <= device_ns:
            out += self.tick()
        return bytes(out)

    def tick(self) -> bytes:
        """Run one control tick; return the bytes sent in it."""
        out = self._handle_input() if self._inbox else b""
        tick = self._tick
        if self._mode is _Mode.ARMED:
            if tick - self._alive_tick >= WATCHDOG_TICKS:
                self._stop()
                self._watchdog = True
            while self._commands and self._commands[0][0] <= tick:
                self._servo.accept(self._commands.popleft()[1])
        (cart, pole), (cart_velocity, pole_velocity) = self._sim.position(), self._sim.velocity()
        motor = self._motor_position(cart)
        armed = self._mode is _Mode.ARMED
        force = self._servo.update(motor, cart_velocity) if armed else 0.0
        self._sensor.observe(Sample(motor, cart_velocity, pole, pole_velocity, self._servo.setpoint))
        if self._kept is not None:
            self._kept.extend((tick, cart, pole, cart_velocity, pole_velocity, force, self._servo.setpoint))
        if tick % TICKS_PER_STATE == 0:
            out += self._state_frame(cart)
        self._move(cart_velocity, force)
        self._tick = tick + 1
        return out

    def true_trajectory(self) -> TrueTrajectory:
        """Return the true states of all ticks so far."""
        if self._kept is None:
            raise ValueError("the device was made with keep_truth=False")
        rows = np.array(self._kept).reshape(-1, 7)
        return TrueTrajectory(rows[:, 0].astype(np.int64), rows[:, 1:3], rows[:, 3:5], rows[:, 5], rows[:, 6])

    # What the host asks for.

    def _handle_input(self) -> bytes:
        data, self._inbox = self._inbox, b""
        out = b""
        for payload in self._decoder.feed(data):
            try:
                message = protocol.decode(payload)
            except ProtocolError:
                self._decoder.errors += 1
                continue
            match message:
                case protocol.Target():
                    self._take_target(message)
                case protocol.Hello():
                    out += self._greet(message)
                case protocol.Arm() | protocol.Stop() | protocol.Home():
                    out += self._answer(message)
        return out

    def _take_target(self, target: protocol.Target) -> None:
        # A repeated number is a stuck host or a stuck adapter: it must not keep the watchdog quiet.
        if self._mode is not _Mode.ARMED or target.sequence == self._command_sequence:
            return
        self._command_sequence = target.sequence
        self._command_tick = self._alive_tick = self._tick
        due = self._tick + self._truth.actuation_ticks
        if jitter := self._profile.actuation_jitter_ticks:
            due += int(self._jitter_rng.integers(0, jitter + 1))
        if self._commands:
            due = max(due, self._commands[-1][0])
        self._commands.append((due, target))

    def _greet(self, hello: protocol.Hello) -> bytes:
        self._stop()
        self._command_sequence = protocol.NO_COMMAND
        self._last_request = None
        return protocol.encode(
            protocol.Info(
                request=hello.request, kind=protocol.DEVICE_KIND, firmware=FIRMWARE,
                device_rate_hz=round(DESCRIPTION.device_rate_hz),
                state_rate_hz=round(DESCRIPTION.state_rate_hz),
                unique_id=0xE000_0000 + self._truth.seed % 2**28,
            )
        )  # fmt: skip

    def _answer(self, request: protocol.Arm | protocol.Stop | protocol.Home) -> bytes:
        result = protocol.Result.DONE
        # A host that missed the answer asks again under the same number; the request must not act twice.
        if (key := (request.TYPE, request.request)) != self._last_request:
            result = self._act(request)
            self._last_request = key if result is protocol.Result.DONE else None
        return protocol.encode(protocol.Ack(request.request, request.TYPE, result))

    def _act(self, request: protocol.Arm | protocol.Stop | protocol.Home) -> protocol.Result:
        match request:
            case protocol.Stop():
                self._stop()
            case protocol.Home():
                self._stop()
                self._begin_homing()
            case protocol.Arm():
                if self._mode is _Mode.HOMING:
                    return protocol.Result.HOMING
                if not self._homed:
                    return protocol.Result.NOT_HOMED
                self._arm()
        return protocol.Result.DONE

    def _arm(self) -> None:
        self._watchdog = False
        if self._mode is not _Mode.ARMED:
            self._servo.reset(self._motor_position(self._sim.position()[_CART]))
            self._mode = _Mode.ARMED
        self._alive_tick = self._tick

    def _stop(self) -> None:
        self._commands.clear()
        self._servo.reset(self._servo.setpoint)
        if self._mode is not _Mode.HELD:
            self._mode = _Mode.IDLE

    def _begin_homing(self) -> None:
        cart, pole = self._sim.position()
        self._homing_from = (cart, math.remainder(pole, math.tau))
        drawn = float(self._hand_rng.uniform(-START_ANGLE_RAD, START_ANGLE_RAD))
        self._homing_to = drawn if self._start_angle_rad is None else self._start_angle_rad
        self._homing_start = self._tick
        self._sim.set_state(self._homing_from, (0.0, 0.0))
        self._sensor.restart()
        self._homed = self._watchdog = False
        self._mode = _Mode.HOMING

    # What the mechanics do.

    def _motor_position(self, cart: float) -> float:
        play = self._profile.backlash_m / 2
        self._motor_m = min(max(self._motor_m, cart - play), cart + play)
        return self._motor_m

    def _move(self, cart_velocity: float, force: float) -> None:
        match self._mode:
            case _Mode.HELD:
                return
            case _Mode.HOMING:
                self._move_home()
                return
        if self._profile.stribeck_ratio:
            excess = self._profile.stribeck_ratio * math.exp(
                -((cart_velocity / self._profile.stribeck_speed_m_s) ** 2)
            )
            self._sim.set_frictionloss(_CART, self._friction_n * (1.0 + excess))
        self._sim.step((force, 0.0))

    def _move_home(self) -> None:
        s = min(1.0, (self._tick + 1 - self._homing_start) / HOMING_TICKS)
        blend = s * s * (3.0 - 2.0 * s)
        cart, pole = self._homing_from
        self._sim.set_state((cart * (1.0 - blend), pole + (self._homing_to - pole) * blend), (0.0, 0.0))
        if s >= 1.0:
            self._mode = _Mode.HELD
            self._homed = True

    # What the device reports.

    def _state_frame(self, cart: float) -> bytes:
        reading = self._sensor.read()
        armed = self._mode is _Mode.ARMED
        effort, clamped = self._servo.estimate(
            reading.setpoint, reading.cart_um / 1e6, reading.cart_um_s / 1e6
        )
        status = Status.NONE
        if armed:
            status |= Status.ARMED
            status |= Status.EFFORT_CLAMPED if clamped else Status.NONE
            status |= Status.SPEED_CLAMPED if self._servo.slewing else Status.NONE
        status |= Status.HOMED if self._homed else Status.NONE
        status |= Status.HOMING if self._mode is _Mode.HOMING else Status.NONE
        status |= Status.WATCHDOG if self._watchdog else Status.NONE
        status |= Status.AT_END_STOP if abs(cart) >= _END_STOP_M else Status.NONE
        sequence = self._state_count
        self._state_count = (sequence + 1) & 0xFFFF_FFFF
        if self._profile.drop_probability and self._drop_rng.random() < self._profile.drop_probability:
            return b""
        known = self._command_sequence != protocol.NO_COMMAND
        return protocol.encode(
            protocol.State(
                sequence=sequence, device_us=self._tick * 1000,
                cart_um=reading.cart_um, cart_um_s=reading.cart_um_s,
                pole_urad=reading.pole_urad, pole_urad_s=reading.pole_urad_s,
                effort_mn=max(-32767, min(32767, round(effort * 1e3))) if armed else 0, status=int(status),
                command_sequence=self._command_sequence,
                command_age_us=min((self._tick - self._command_tick) * 1000, 0xFFFF_FFFF) if known else 0,
            )
        )  # fmt: skip
