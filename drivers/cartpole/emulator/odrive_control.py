"""The control law of an emulated ODrive: position, velocity and torque control, with its settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from deal_hw.drivers.cartpole.description import DAMPING_NS_M, DESCRIPTION, EFFORT_LIMIT_N, STIFFNESS_N_M
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.wire.odrive_frames import PASSTHROUGH, POSITION_CONTROL, TORQUE_CONTROL
from deal_hw.drivers.cartpole.wire.odrive_link import OdriveSettings, drive_command
from deal_hw.drivers.cartpole.wire.protocol import Target

CONTROLLER: Final = "axis0.controller.config."
"""Beginning of the names of the controller's settings."""
TURNS_AT_ZERO: Final = 12.25
"""Reading of the drive's encoder in the middle of the rail: it counts from its power-on."""
_MOST: Final = 1e9
"""Larger gains and set-points act like this one; products of three of them are finite."""
_MOST_CURRENT_A: Final = 120.0
"""Of the inverter of an ODrive Pro, whatever limit is set (ODrive's data sheet)."""


@dataclass(frozen=True, slots=True)
class DriveInput:
    """The newest input with the gains of its moment; it acts late.

    Attributes:
        pos_gain: [(rev/s)/rev].
        vel_gain: [N*m/(rev/s)].
        integrator_gain: [N*m/rev].
        velocity_limit: [rev/s].
        current_limit: [A].
        control_mode: As in Set_Controller_Mode.
        turns: Position [rev].
        speed: Velocity, or its feed-forward [rev/s].
        torque: Torque, or its feed-forward [N*m].
    """

    pos_gain: float
    vel_gain: float
    integrator_gain: float
    velocity_limit: float
    current_limit: float
    control_mode: int
    turns: float = TURNS_AT_ZERO
    speed: float = 0.0
    torque: float = 0.0


class DriveLaw:
    """Computes the force on the belt from an input, with the drive's hidden factors.

    Args:
        truth: Hidden factors of gains and effort limit.
        parts: Mechanics and motor.
    """

    def __init__(self, truth: CartpoleTruth, parts: OdriveSettings) -> None:
        self._parts = parts
        self._stiffness_factor = truth.parameters["servo.stiffness"] / STIFFNESS_N_M
        self._damping_factor = truth.parameters["servo.damping"] / DAMPING_NS_M
        self._effort_factor = truth.parameters["servo.effort_limit"] / EFFORT_LIMIT_N
        self._integral = 0.0

    def reset(self) -> None:
        """Set the integrator to 0."""
        self._integral = 0.0

    def force(self, now: DriveInput, turns: float, speed: float, most_integral: float) -> float:
        """Run one period; return the force [N].

        Args:
            now: The input in force.
            turns: Position [rev].
            speed: Velocity [rev/s].
            most_integral: Limit of the integrator [N*m].
        """
        parts = self._parts
        limit = now.current_limit * parts.torque_constant * self._effort_factor
        if now.control_mode <= TORQUE_CONTROL:
            return min(max(now.torque, -limit), limit) * parts.newtons_per_nm
        # Hidden: the drive's true gains and current limit.
        pos_gain = now.pos_gain * self._stiffness_factor / self._damping_factor
        vel_gain = now.vel_gain * self._damping_factor
        wanted = now.speed
        if now.control_mode == POSITION_CONTROL:
            wanted += pos_gain * (now.turns - turns)
        wanted = min(max(wanted, -now.velocity_limit), now.velocity_limit)
        demand = vel_gain * (wanted - speed) + now.torque + self._integral
        torque = min(max(demand, -limit), limit)
        if torque == demand:
            # At its limit the integrator stands still, or it would wind up.
            step = now.integrator_gain / DESCRIPTION.device_rate_hz * (wanted - speed)
            most = max(0.0, bounded(most_integral))
            self._integral = min(max(self._integral + step, -most), most)
        return torque * parts.newtons_per_nm


def drive_input(config: Mapping[str, float], before: DriveInput | None = None) -> DriveInput:
    """Return the gains of the settings with the set-points of an earlier input.

    Args:
        config: The drive's settings, by their names.
        before: The earlier input; None: all set-points are at rest.
    """
    gains = DriveInput(
        bounded(config[CONTROLLER + "pos_gain"]),
        bounded(config[CONTROLLER + "vel_gain"]),
        bounded(config[CONTROLLER + "vel_integrator_gain"]),
        max(0.0, bounded(config[CONTROLLER + "vel_limit"])),
        min(max(0.0, config["axis0.config.motor.current_soft_max"]), _MOST_CURRENT_A),
        int(config[CONTROLLER + "control_mode"]),
    )
    if before is None:
        return gains
    return replace(gains, turns=before.turns, speed=before.speed, torque=before.torque)


def bounded(value: float) -> float:
    """Return a number of a frame, cut where larger ones make no difference."""
    return min(max(value, -_MOST), _MOST)


def configured(parts: OdriveSettings) -> dict[str, float]:
    """Return the settings of a drive that was set up for this cart-pole, by their names."""
    gains = drive_command(
        Target(
            sequence=0,
            position_um=0,
            stiffness_mn_m=round(STIFFNESS_N_M * 1e3),
            damping_mns_m=round(DAMPING_NS_M * 1e3),
            effort_limit_mn=round(EFFORT_LIMIT_N * 1e3),
            speed_limit_um_s=0,
        ),
        parts,
    )
    values = {
        "control_mode": POSITION_CONTROL,
        "input_mode": PASSTHROUGH,
        "pos_gain": gains.pos_gain,
        "vel_gain": gains.vel_gain,
        "vel_integrator_gain": 0.0,
        "vel_integrator_limit": math.inf,
        "vel_limit": gains.velocity_limit,
    }
    return {
        **{CONTROLLER + name: value for name, value in values.items()},
        "axis0.config.motor.current_soft_max": gains.current_limit,
        "axis0.config.motor.torque_constant": parts.torque_constant,
        "axis0.config.can.node_id": parts.drive,
        "axis0.config.enable_watchdog": False,
        "axis0.config.watchdog_timeout": 0.0,
    }
