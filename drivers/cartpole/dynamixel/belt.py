"""The belt servo's motor: from its registers, by its operating mode, to a force on the cart."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.wire.protocol import Target
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus import xl330
from deal_hw.drivers.servo_bus.emulated_servo import EmulatedServo
from deal_hw.drivers.servo_bus.registers import OperatingMode

_NO_LIMIT_M_S = 1000.0
_FREE_M = 10.0
"""A servo does not know the rail, so its goals may lie beyond the stops."""
_ACCELERATION: Final = 214.577 / 0.229 / 60 / 1000
"""One unit of Profile Acceleration, 214.577 rev/min^2, in units of velocity a millisecond."""
_P_DIVISOR, _I_DIVISOR = 128, 65536
"""Of the velocity gains (e-Manual); their output is taken as units of PWM, the integral's step as 1 ms."""
_IN_POSITION_PULSES: Final = 10


@dataclass(frozen=True, slots=True)
class Drive:
    """What the motor does in a mode without a position loop: velocity, current or PWM, in register units."""

    mode: int
    value: int


class BeltMotor:
    """Turns the belt servo's goals into forces; goals act late, as in other emulated devices.

    Attributes:
        on: Whether the motor has torque.

    Args:
        truth: Hidden factors of gains and limits.
        settings: Gearing and units.
        servo: The belt servo.
        start: Position of its shaft with the cart in the middle [pulses].
        period_s: Control period [s].
        command_delay: Called for every goal; returns its delay from reception to effect [ticks].
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        settings: DynamixelSettings,
        servo: EmulatedServo,
        start: int,
        period_s: float,
        command_delay: Callable[[], int],
    ) -> None:
        self.on = False
        self._settings, self._servo, self._start = settings, servo, start
        self._delay = command_delay
        self._loop = Servo(truth.parameters, period_s, reach_m=_FREE_M)
        self._orders: deque[tuple[int, Target | Drive]] = deque()
        self._told: Target | Drive | None = None
        self._told_ns = -1
        self._drive: Drive | None = None
        self._velocity = self._integral = self._force_n = 0.0
        self._stopped = False

    @property
    def setpoint(self) -> float:
        """Set-point of the position loop [m]; without one the measured position."""
        return self._loop.setpoint

    def follow(self, motor: Motor) -> bool:
        """Switch the motor as the servo's registers say; return whether the torque was switched."""
        torque = bool(self._servo.get(r.TORQUE_ENABLE))
        switched, self.on = torque != self.on, torque
        if switched:
            self._orders.clear()
            self._told = None
            self._begin(motor)
            if torque:
                self._accept(self._order())
        stopped = self._servo.watchdog_tripped
        if stopped and not self._stopped:
            # "The DYNAMIXEL will stop": it holds its position with its gains, or turns no more.
            self._orders.clear()
            order = self._order()
            self._begin(motor)
            self._accept(
                dataclasses.replace(order, value=0)
                if isinstance(order, Drive)
                else dataclasses.replace(order, position_um=round(motor.position * 1e6))
            )
        self._stopped = stopped
        return switched

    def schedule(self, tick: int, now_ns: int) -> None:
        """Let the registers act after the latency; writes of one time act at one time."""
        order = self._order()
        if not self.on or not self._servo.get(r.TORQUE_ENABLE) or order == self._told:
            return
        self._told = order
        if self._orders and self._told_ns == now_ns:
            self._orders[-1] = (self._orders[-1][0], order)
            return
        self._told_ns = now_ns
        due = tick + self._delay()
        self._orders.append((max(due, self._orders[-1][0]) if self._orders else due, order))

    def update(self, tick: int, motor: Motor) -> float:
        """Run one tick; return the force on the cart [N]."""
        while self._orders and self._orders[0][0] <= tick:
            self._accept(self._orders.popleft()[1])
        if not self.on:
            self._force_n = 0.0
        elif self._drive is None:
            self._force_n = self._loop.update(motor.position, motor.velocity)
            if self._servo.get(r.OPERATING_MODE) == OperatingMode.POSITION:
                # The modes that the cart-pole's driver uses have no back-EMF: neither has its truth.
                self._force_n -= self._back_emf(self._counts(motor.velocity)) * self._settings.cart_direction
        else:
            self._loop.reset(motor.position)
            self._force_n = self._drive_force(self._drive, self._counts(motor.velocity))
        return self._force_n

    def sense(self, motor: Motor, reading: Reading) -> None:
        """Set the servo's registers of what it measures and wants.

        Args:
            motor: The motor's true state.
            reading: What the sensors say.
        """
        s, servo = self._settings, self._servo
        shaft = self._start + round(reading.cart_um * 1e-6 / s.metres_per_pulse)
        velocity = round(reading.cart_um_s * 1e-6 / s.metres_s_per_count) * s.cart_direction
        force = 0.0
        if self.on and self._drive is None:
            force, _ = self._loop.estimate(reading.setpoint, motor.position, motor.velocity)
        elif self.on:
            force = self._force_n
        force *= s.cart_direction
        voltage = force / s.effort_per_pwm + xl330.MOST_PWM * velocity / xl330.NO_LOAD_VELOCITY
        servo.sense(
            shaft,
            velocity=velocity,
            current=round(force / s.effort_per_current),
            pwm=round(voltage) if self.on else 0,
            trajectory=self._trajectory(shaft),
            status=self._status(shaft),
        )

    # Goals.

    def _order(self) -> Target | Drive:
        """Return what the servo's registers ask for."""
        s, block, mode = self._settings, self._servo.block, self._servo.get(r.OPERATING_MODE)
        match mode:
            case OperatingMode.CURRENT:
                return Drive(mode, self._servo.get(r.GOAL_CURRENT))
            case OperatingMode.VELOCITY:
                return Drive(mode, self._servo.get(r.GOAL_VELOCITY))
            case OperatingMode.PWM:
                return Drive(mode, self._servo.get(r.GOAL_PWM))
        # A profile velocity of 0 is no limit.
        speed = block.profile_velocity * s.metres_s_per_count if block.profile_velocity else _NO_LIMIT_M_S
        if mode == OperatingMode.CURRENT_BASED_POSITION:
            effort = abs(block.goal_current) * s.effort_per_current
        else:
            effort = abs(block.goal_pwm) * s.effort_per_pwm
        return Target(
            sequence=0,
            position_um=round((self._servo.goal_shaft - self._start) * s.metres_per_pulse * 1e6),
            stiffness_mn_m=round(block.p_gain * s.stiffness_per_gain * 1e3),
            damping_mns_m=round(block.d_gain * s.damping_per_gain * 1e3),
            effort_limit_mn=round(effort * 1e3),
            speed_limit_um_s=round(speed * 1e6),
        )

    def _begin(self, motor: Motor) -> None:
        self._loop.reset(motor.position)
        self._drive, self._velocity, self._integral = None, 0.0, 0.0

    def _accept(self, order: Target | Drive) -> None:
        if isinstance(order, Drive):
            self._drive = order
        else:
            self._drive = None
            self._loop.accept(order)

    # Modes without a position loop.

    def _counts(self, velocity: float) -> float:
        return velocity / self._settings.metres_s_per_count * self._settings.cart_direction

    def _back_emf(self, velocity: float) -> float:
        """Return the effort that the motor's own voltage takes at a velocity of the shaft [N]."""
        return xl330.MOST_PWM * velocity / xl330.NO_LOAD_VELOCITY * self._settings.effort_per_pwm

    def _drive_force(self, drive: Drive, velocity: float) -> float:
        """Return the force on the cart [N]; voltage and speed limit it as the motor's line says."""
        s = self._settings
        back = self._back_emf(velocity) / s.effort_per_pwm
        most = self._servo.get(r.PWM_LIMIT)
        if drive.mode == OperatingMode.CURRENT:
            pwm = drive.value * s.effort_per_current / s.effort_per_pwm + back
        elif drive.mode == OperatingMode.VELOCITY:
            most = min(most, abs(self._servo.get(r.GOAL_PWM)))
            pwm = self._velocity_control(drive.value, velocity, most)
        else:
            pwm = drive.value
        return (min(max(pwm, -most), most) - back) * s.effort_per_pwm * s.cart_direction

    def _velocity_control(self, goal: int, velocity: float, most: int) -> float:
        rate = self._servo.get(r.PROFILE_ACCELERATION) * _ACCELERATION
        step = goal - self._velocity
        self._velocity = self._velocity + min(max(step, -rate), rate) if rate else float(goal)
        error = self._velocity - velocity
        self._integral += self._servo.get(r.VELOCITY_I_GAIN) / _I_DIVISOR * error
        self._integral = min(max(self._integral, -most), most)
        return self._servo.get(r.VELOCITY_P_GAIN) / _P_DIVISOR * error + self._integral

    # Registers.

    def _trajectory(self, shaft: int) -> tuple[int, int] | None:
        s = self._settings
        if not self.on:
            return None
        if self._drive is not None:
            # Position Trajectory is only of use with a position loop.
            return shaft, round(self._velocity)
        wanted = self._start + round(self._loop.setpoint / s.metres_per_pulse)
        if not self._loop.slewing:
            return wanted, 0
        speed = self._servo.block.profile_velocity
        return wanted, speed if self._servo.goal_shaft > wanted else -speed

    def _status(self, shaft: int) -> int:
        if not self.on or self._drive is not None:
            return 0
        profile = r.RECTANGULAR_PROFILE if self._servo.block.profile_velocity else 0
        if self._loop.slewing:
            return profile | r.PROFILE_ONGOING
        near = abs(self._servo.goal_shaft - shaft) <= _IN_POSITION_PULSES
        return profile | (r.IN_POSITION if near else 0)
