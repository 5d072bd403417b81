"""Homing: the motor finds the middle of the rail and moves there; a hand sets the pole upright."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.dynamixel.servos import PoleAngle, Servos
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings, Goal
from deal_hw.drivers.servo_bus.registers import (
    PULSES,
    WATCHDOG_TRIPPED,
    Block,
    explain_hardware_error,
)
from deal_hw.errors import SafetyError, TransportTimeoutError
from deal_hw.motions.behaviours import position_command

_PERIOD_NS = 10_000_000
"""Time between two requests; short enough for the belt servo's watchdog."""
_MOVED_M = 0.003
_ARRIVED_M = 0.003
_STILL_RAD = 0.05


class Homing:
    """One homing.

    Args:
        servos: The servos, without torque.
        clock: For the waiting.
        settings: How to home.
        description: Gains while homing.
    """

    def __init__(
        self, servos: Servos, clock: Clock, settings: DynamixelSettings, description: RobotDescription
    ) -> None:
        self._servos, self._clock, self._settings = servos, clock, settings
        self._description = description
        self._deadline_ns = 0

    def run(self, timeout_s: float) -> int:
        """Return the belt servo's position in the middle of the rail, with the cart there.

        Raises:
            TransportTimeoutError: It did not finish in time; the message names the missing part.
            SafetyError: The rail has another length than in the settings, or a servo reports an error.
        """
        self._deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        zero = self._middle()
        self._go_to(zero)
        self._servos.torque_off()
        self._await_hand()
        return zero

    def _middle(self) -> int:
        s = self._settings
        here = self._look()[0].present_position
        if s.cart_zero is not None:
            return s.cart_zero + PULSES * round((here - s.cart_zero) / PULSES)
        ends = [self._seek_stop(direction) for direction in (-1, 1)]
        way_m = abs((ends[1] - ends[0]) * s.metres_per_pulse)
        if abs(way_m - s.rail_m) > s.rail_tolerance_m:
            raise SafetyError(
                f"cartpole: homing found {way_m:.3f} m between the end stops, but the settings have "
                f"{s.rail_m:g} m: check that nothing blocks the cart and that the belt does not "
                "slip; then correct metres_per_revolution or rail_m"
            )
        return round((ends[0] + ends[1]) / 2)

    def _seek_stop(self, direction: int) -> int:
        """Move the cart until it stops; return its position there."""
        beyond = round(direction * (self._settings.rail_m + 0.2) / abs(self._settings.metres_per_pulse))
        start = self._look()[0].present_position
        end = self._move(start + beyond)
        if abs(end - start) >= abs(beyond) - 1:
            raise SafetyError(
                f"cartpole: the cart went {self._settings.rail_m + 0.2:g} m without reaching an end stop; "
                "check metres_per_revolution, and that the belt does not slip"
            )
        return end

    def _go_to(self, position: int) -> None:
        """Move the cart to a place. Friction stops it short, so the goal is moved beyond."""
        m = abs(self._settings.metres_per_pulse)
        aim = position
        while abs(missing := position - self._move(aim, near=position)) * m > _ARRIVED_M:
            aim += missing
            if abs(aim - position) * m > 0.5 * self._settings.rail_m:
                raise SafetyError(
                    "cartpole: the cart does not reach the middle of the rail; check that nothing blocks "
                    "it, and that homing_effort_n and the supply are large enough"
                )

    def _move(self, target: int, near: int | None = None) -> int:
        """Move the cart; return where it is once it is at the target, near a place, or does not move."""
        here = self._look()[0].present_position
        goal = self._goal(here)
        self._servos.torque_on(goal, self._deadline_ns)
        self._servos.send(goal._replace(position=target), goal)
        moved = _MOVED_M / abs(self._settings.metres_per_pulse)
        since_ns = self._clock.now_ns()
        while True:
            block = self._look()[0]
            if abs(block.present_position - target) <= 1:
                return block.present_position
            if near is not None and abs(block.present_position - near) <= moved:
                return block.present_position
            if abs(block.present_position - here) >= moved:
                here, since_ns = block.present_position, self._clock.now_ns()
            elif self._clock.now_ns() - since_ns >= round(self._settings.stall_s * 1e9):
                return block.present_position
            if not block.torque_enable or block.bus_watchdog == WATCHDOG_TRIPPED:
                raise SafetyError(
                    f"cartpole: servo {self._settings.cart_id} stopped while homing: it restarted, or got "
                    "no request from this computer for 0.2 s; try again"
                )
            if block.goal_position != target:
                self._servos.send(goal._replace(position=target))

    def _goal(self, position: int) -> Goal:
        s = self._settings
        command = dataclasses.replace(
            position_command(self._description, np.zeros(1)),
            effort_limit=np.array([s.homing_effort_n]),
            speed_limit=np.array([s.homing_speed_m_s]),
        )
        return s.to_goal(command, position, self._servos.most_effort)

    def _await_hand(self) -> None:
        s = self._settings
        angle, near, low, high, since_ns = PoleAngle(s), math.pi, math.inf, -math.inf, self._clock.now_ns()
        try:
            while True:
                self._servos.light(True)
                _, pole = self._look(
                    f"the pole is at {near:.2f} rad. Set it upright by hand and hold it while the LED of "
                    f"servo {s.pole_id} is lit; if it was upright, the setting pole_zero is wrong"
                )
                near = math.remainder(angle.read(pole.present_position), math.tau)
                low, high = min(low, near), max(high, near)
                if abs(near) > s.upright_rad or high - low > _STILL_RAD:
                    low = high = near
                    since_ns = self._clock.now_ns()
                elif self._clock.now_ns() - since_ns >= round(s.still_s * 1e9):
                    return
        finally:
            self._servos.light(False)

    def _look(self, missing: str = "the cart was still moving") -> tuple[Block, Block]:
        """Wait for one period, then return both register blocks; raise if a servo reports an error."""
        self._clock.sleep_until_ns(self._clock.now_ns() + _PERIOD_NS)
        if self._clock.now_ns() >= self._deadline_ns:
            raise TransportTimeoutError(f"cartpole: homing did not finish in time: {missing}")
        blocks = self._servos.read(self._deadline_ns)
        if foreign := self._servos.foreign:
            raise SafetyError(f"cartpole: {foreign}")
        for servo, block in zip((self._settings.cart_id, self._settings.pole_id), blocks, strict=True):
            if block.hardware_error:
                raise SafetyError(
                    f"cartpole: servo {servo} reports: {explain_hardware_error(block.hardware_error)}"
                )
        return blocks
