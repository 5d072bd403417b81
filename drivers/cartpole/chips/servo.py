"""The PD position loop in the device: received gains and limits, times hidden factors."""

from __future__ import annotations

from collections.abc import Mapping

from deal_hw.drivers.cartpole.description import (
    DAMPING_NS_M,
    EFFORT_LIMIT_N,
    SPEED_LIMIT_M_S,
    STIFFNESS_N_M,
)
from deal_hw.drivers.cartpole.wire.protocol import Target

RAIL_M = 0.4
"""The firmware accepts no target outside +-0.4 m."""


class Servo:
    """PD loop with a set-point that slews towards the target.

    Args:
        parameters: True values of the servo parameters for the description's default command, by name.
        period_s: Control period [s].
        reach_m: No target outside plus or minus this is accepted [m].
    """

    def __init__(self, parameters: Mapping[str, float], period_s: float, reach_m: float = RAIL_M) -> None:
        self._stiffness_factor = parameters["servo.stiffness"] / STIFFNESS_N_M
        self._damping_factor = parameters["servo.damping"] / DAMPING_NS_M
        self._effort_factor = parameters["servo.effort_limit"] / EFFORT_LIMIT_N
        self._speed_factor = parameters["servo.speed_limit"] / SPEED_LIMIT_M_S
        self._period_s = period_s
        self._reach_m = reach_m
        self.setpoint = 0.0
        self.reset(0.0)

    def reset(self, position: float) -> None:
        """Set the set-point to the measured position [m] and all gains to 0."""
        self.setpoint = position
        self._target = position
        self._sent_stiffness = self._sent_damping = self._sent_limit = 0.0
        self._stiffness = self._damping = self._limit = self._step = 0.0

    def accept(self, target: Target) -> None:
        """Let a target act from now on."""
        self._target = min(max(target.position_um / 1e6, -self._reach_m), self._reach_m)
        self._sent_stiffness = target.stiffness_mn_m / 1e3
        self._sent_damping = target.damping_mns_m / 1e3
        self._sent_limit = target.effort_limit_mn / 1e3
        self._stiffness = self._sent_stiffness * self._stiffness_factor
        self._damping = self._sent_damping * self._damping_factor
        self._limit = self._sent_limit * self._effort_factor
        self._step = target.speed_limit_um_s / 1e6 * self._speed_factor * self._period_s

    def update(self, position: float, velocity: float) -> float:
        """Run one period from the state at its start; return the force on the cart [N]."""
        error = self._target - self.setpoint
        self.setpoint = (
            self._target
            if abs(error) <= self._step
            else self.setpoint + (self._step if error > 0 else -self._step)
        )
        force = self._stiffness * (self.setpoint - position) - self._damping * velocity
        return min(max(force, -self._limit), self._limit)

    @property
    def slewing(self) -> bool:
        """Whether the speed limit keeps the set-point from its target."""
        return self.setpoint != self._target

    def estimate(self, setpoint: float, position: float, velocity: float) -> tuple[float, bool]:
        """Return the force that the firmware computes, without hidden factors [N]; whether it is limited."""
        demand = self._sent_stiffness * (setpoint - position) - self._sent_damping * velocity
        if abs(demand) < self._sent_limit:
            return demand, False
        return (self._sent_limit if demand > 0 else -self._sent_limit), self._sent_limit > 0
