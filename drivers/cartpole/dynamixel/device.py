"""Two emulated X-series servos on one bus, and the cart-pole on their shafts. Bytes in, bytes out."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from deal_hw.drivers.cartpole.chips.device import TICK_NS, EmulatedDevice
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.dynamixel.belt import BeltMotor
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.emulator.faults import ServoFaults
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.sensor import Motor
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.servo_bus.emulated_bus import EmulatedBus
from deal_hw.drivers.servo_bus.emulated_servo import EmulatedServo
from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.drivers.servo_bus.other_master import DOUBLED, FOREIGN, WAY_TICKS, OtherMaster
from deal_hw.drivers.servo_bus.packets import sync_write
from deal_hw.drivers.servo_bus.registers import (
    GOAL_POSITION,
    HARDWARE_ERROR,
    ID,
    OPERATING_MODE,
    PULSES,
    RAD_S_PER_COUNT,
    OperatingMode,
)

OVERLOAD = 1 << 5


class DynamixelDevice(EmulatedDevice):
    """Two servos and the cart-pole that they drive and measure.

    Control tick k, at device time k ms: set-point, force from the state at its start, one physics step.

    The pole servo's LED asks a hand to set the pole upright for homing; the hand releases it when the belt
    servo gets torque.

    Attributes:
        servos: Belt servo and pole servo.
        bus: Their side of the wire.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        settings: Wiring and gearing, as in the driver.
        faults: The faults.
        keep_truth: Whether to keep the true trajectory for :meth:`true_trajectory`.
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        settings: DynamixelSettings | None = None,
        faults: ServoFaults | None = None,
        *,
        keep_truth: bool = False,
    ) -> None:
        super().__init__(Mechanics(truth, read_rate_hz=DESCRIPTION.device_rate_hz), keep_truth=keep_truth)
        self._settings = s = settings or DynamixelSettings()
        self._faults = faults or ServoFaults()
        rng = np.random.default_rng([truth.seed, 0xD12])
        self._cart = EmulatedServo(s.cart_id, s.baud_rate, mode=s.operating_mode)
        self._pole = EmulatedServo(s.pole_id, s.baud_rate)
        self.servos = [self._cart, self._pole]
        mechanics = self._mechanics
        self._belt = BeltMotor(
            truth,
            s,
            self._cart,
            int(rng.integers(0, PULSES)),
            mechanics.timestep_s,
            mechanics.command_delay,
        )
        self.bus = EmulatedBus(self.servos, self._schedule, mechanics.loses_frame)
        self._now_ns = 0
        self._lit = self._let_go = False
        self._first_ns: int | None = None
        self._other: OtherMaster | None = None
        motor = mechanics.motor()
        mechanics.observe(motor.position)
        self._sense(motor)
        for servo in self.servos:
            # At its start a servo knows its position within a revolution, but not the revolutions.
            servo.forget_turns()
            servo.put(GOAL_POSITION, servo.block.present_position)
        self._set_up_badly()

    @property
    def device_ns(self) -> int:
        """Device time of the next tick or answer [ns]."""
        tick_ns = self._tick * TICK_NS
        reply_ns = self.bus.next_ns
        return tick_ns if reply_ns is None else min(tick_ns, max(reply_ns, self._now_ns))

    @property
    def armed(self) -> bool:
        """Whether the motor follows targets and no hand holds the pole."""
        return self.mode == "armed"

    @property
    def mode(self) -> str:
        """State of the motor: without torque in "idle" and "held"; "stopped" holds its position."""
        if self._mechanics.held:
            return "held"
        if not self._belt.on:
            return "homing" if self._mechanics.homing else "idle"
        if self._cart.watchdog_tripped:
            return "stopped"
        return "armed" if self._let_go else "homing"

    @property
    def watchdog(self) -> bool:
        """Whether the belt servo's watchdog has stopped it."""
        return self._cart.watchdog_tripped

    @property
    def trouble(self) -> str:
        """Current fault of the servos; "" for none."""
        if self._other is not None:
            return FOREIGN
        if len(self.servos) > 2:
            return DOUBLED
        if not self._pole.present:
            return "pole servo absent"
        if not self._cart.awake(self._now_ns):
            return "belt servo restarts"
        return "overload" if self._cart.get(HARDWARE_ERROR) else ""

    @property
    def frame_errors(self) -> int:
        """Corrupt packets received so far."""
        return self.bus.errors

    def receive(self, data: bytes) -> None:
        """Take bytes from the host and handle the packets that they complete."""
        self.received_bytes += len(data)
        self.bus.receive(data)

    def advance_to(self, device_ns: int) -> bytes:
        """Run all ticks and answers up to and including ``device_ns``; return the bytes sent meanwhile."""
        out = super().advance_to(device_ns)
        self._advance_clock(device_ns)
        return out

    def tick(self) -> bytes:
        """Run the next tick or answer; return the bytes sent."""
        self._advance_clock(self.device_ns)
        reply_ns = self.bus.next_ns
        if reply_ns is not None and reply_ns <= self._now_ns < self._tick * TICK_NS + TICK_NS:
            return self.bus.take_reply()
        self._run_tick()
        return b""

    def reboot(self, servo: EmulatedServo) -> None:
        """Restart a servo, as after a dip of its supply."""
        servo.reboot(self._now_ns)

    def double(self) -> None:
        """Plug in a second servo with the id of the belt's."""
        self.servos.append(self._cart.twin())

    def let_write(self, faults: BusFaults) -> None:
        """Let another program write the belt servo's goals."""
        goal = self._cart.get(GOAL_POSITION) + WAY_TICKS
        packet = sync_write(GOAL_POSITION, {self._cart.id: goal})
        self._other = OtherMaster(packet, self.bus, faults, self._now_ns)

    def mend_bus(self) -> None:
        """Unplug the second servo, and end the other program."""
        self.servos[2:] = []
        self._other = None

    def _advance_clock(self, now_ns: int) -> None:
        self.bus.now_ns = self._now_ns = max(self._now_ns, now_ns)

    def _schedule(self) -> None:
        self._belt.schedule(self._tick, self._now_ns)

    def _set_up_badly(self) -> None:
        f = self._faults
        if f.servo_duplicate_id:
            self._pole.put(ID, self._cart.id)
        if f.servo_wrong_mode:
            self._cart.put(OPERATING_MODE, OperatingMode.VELOCITY)
        self._pole.protocol = f.servo_protocol

    # What the mechanics do.

    def _run_tick(self) -> None:
        now_ns = self._tick * TICK_NS
        for servo in self.servos:
            servo.tick(now_ns, now_ns - self.bus.alive_ns)
        mechanics, belt = self._mechanics, self._belt
        motor = mechanics.motor()
        if belt.follow(motor):
            self._let_go = belt.on and mechanics.held
            if belt.on:
                mechanics.release()
                if self._let_go and self._first_ns is None:
                    self._first_ns = self._now_ns
        self._follow_hand()
        force = belt.update(self._tick, motor)
        mechanics.observe(belt.setpoint)
        self._keep(force, belt.setpoint)
        self._sense(motor)
        mechanics.step(force)
        self._tick += 1
        self._fail()
        if self._other is not None:
            self._other.advance(self._now_ns)

    def _follow_hand(self) -> None:
        lit = bool(self._pole.block.led) and self._pole.awake(self._now_ns)
        if lit and not self._lit and not self._mechanics.held and not self._belt.on:
            self._mechanics.begin_homing()
            self._let_go = False
        self._lit = lit

    def _sense(self, motor: Motor) -> None:
        """Write the sensors' values into the registers."""
        s, reading = self._settings, self._mechanics.read()
        self._belt.sense(motor, reading)
        turns = s.pole_direction * reading.pole_urad * 1e-6 / (2 * math.pi)
        self._pole.sense(
            s.pole_zero + round(turns * PULSES),
            velocity=s.pole_direction * round(reading.pole_urad_s * 1e-6 / RAD_S_PER_COUNT),
        )

    def _fail(self) -> None:
        """Apply due faults."""
        if self._first_ns is None:
            return
        passed_s = (self._now_ns - self._first_ns) / 1e9
        f = self._faults
        if f.servo_reboot_after_s is not None and passed_s > f.servo_reboot_after_s:
            self._faults = f = dataclasses.replace(f, servo_reboot_after_s=None)
            self.reboot(self._cart)
        if f.servo_overload_after_s is not None and passed_s > f.servo_overload_after_s:
            self._faults = f = dataclasses.replace(f, servo_overload_after_s=None)
            self._cart.fail(OVERLOAD)
        if f.servo_absent_after_s is not None and passed_s > f.servo_absent_after_s:
            self._pole.present = False
        if f.duplicate_id_after_s is not None and passed_s > f.duplicate_id_after_s:
            self._faults = f = dataclasses.replace(f, duplicate_id_after_s=None)
            self.double()
        if f.foreign_writer_after_s is not None and passed_s > f.foreign_writer_after_s:
            self._faults = dataclasses.replace(f, foreign_writer_after_s=None)
            self.let_write(f)
