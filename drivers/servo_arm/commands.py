"""From joint commands to servos' registers and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.families import LoopGains, ServoSample
from deal_hw.errors import SafetyError
from deal_hw.sim.robots.hardware_section import MOST_GAIN, RAD, TICKS, HardwareSection, ServoEntry
from deal_hw.types import FloatArray, JointCommand

_SHARE_DIGITS: Final = 3
"""Effort limits are sent in steps of 0.1 %, as Feetech's register has them."""


@dataclass(frozen=True, slots=True)
class Registers:
    """A command as the servos get it, by their id.

    Attributes:
        goals: Positions [ticks].
        gains: LoopGains of the position loops.
        shares: Effort limits, as shares of the description's.
    """

    goals: Mapping[int, int]
    gains: Mapping[int, LoopGains]
    shares: Mapping[int, float]


class CommandCodec:
    """Turns commands into registers.

    Args:
        description: The robot; all its joints are actuated, in any order.
        hardware: Its servos.
        limits: Lowest and highest position that a servo takes as its goal, by id [ticks]; none by default.
    """

    def __init__(
        self,
        description: RobotDescription,
        hardware: HardwareSection,
        limits: Mapping[int, tuple[int, int]] | None = None,
    ) -> None:
        by_joint = {servo.joint: servo for servo in hardware.servos}
        self._description, self._limits = description, dict(limits or {})
        self._nominal = {one.id: LoopGains(one.p_gain, one.i_gain, one.d_gain) for one in hardware.servos}
        self._most_gain = MOST_GAIN[hardware.bus]
        self.joints: tuple[ServoEntry, ...] = tuple(by_joint[name] for name in description.joint_names)
        """The servos in the order of the joints."""
        self._actuated = [by_joint[name] for name in description.actuated]
        self._effort = np.where(np.isfinite(description.effort_limit), description.effort_limit, 0.0)

    def at(self, ticks: Mapping[int, int]) -> Registers:
        """Return registers with these goals and the nominal gains and limits."""
        return Registers(ticks, self._nominal, dict.fromkeys(ticks, 1.0))

    def goals(self, position: FloatArray) -> dict[int, int]:
        """Return the servos' goals for joint positions, (J,) [rad]."""
        return {servo.id: self._goal(servo, at) for servo, at in zip(self.joints, position, strict=True)}

    def _goal(self, servo: ServoEntry, position: float) -> int:
        low, high = self._limits.get(servo.id, (0, TICKS - 1))
        return min(max(servo.ticks(float(position)), low), high)

    def positions(self, samples: Mapping[int, ServoSample]) -> FloatArray:
        """Return the joints' positions, (J,) [rad]."""
        return np.array([servo.position(samples[servo.id].ticks) for servo in self.joints])

    def velocities(self, samples: Mapping[int, ServoSample]) -> FloatArray:
        """Return the joints' velocities, (J,) [rad/s]."""
        return np.array([servo.direction * samples[servo.id].ticks_s * RAD for servo in self.joints])

    def efforts(self, samples: Mapping[int, ServoSample]) -> FloatArray:
        """Return the joints' efforts as the motors' duty has them, (J,) [N·m]."""
        limit = dict(zip((servo.id for servo in self._actuated), self._effort, strict=True))
        return np.array(
            [servo.direction * samples[servo.id].duty * limit.get(servo.id, 0.0) for servo in self.joints]
        )

    def encode(self, command: JointCommand) -> Registers:
        """Round a command to the registers, and clip it to their ranges.

        Raises:
            SafetyError: A value is not finite.
        """
        d = self._description
        self._check(command)
        goals, gains, shares = {}, {}, {}
        for a, servo in enumerate(self._actuated):
            goals[servo.id] = self._goal(servo, command.position_target[a])
            nominal = self._nominal[servo.id]
            gains[servo.id] = LoopGains(
                self._gain(nominal.p, command.stiffness[a], d.stiffness[a]),
                nominal.i,
                self._gain(nominal.d, command.damping[a], d.damping[a]),
            )
            share = command.effort_limit[a] / d.effort_limit[a] if self._effort[a] else 1.0
            shares[servo.id] = round(min(max(float(share), 0.0), 1.0), _SHARE_DIGITS)
        return Registers(goals, gains, shares)

    def decode(self, registers: Registers) -> JointCommand:
        """Return the command that the registers mean; quantities without a register are 0."""
        d, servos = self._description, self._actuated
        zeros = np.zeros(len(servos))
        gains = [(registers.gains[servo.id], self._nominal[servo.id]) for servo in servos]
        shares = np.array([registers.shares[servo.id] for servo in servos])
        return JointCommand(
            position_target=np.array([servo.position(registers.goals[servo.id]) for servo in servos]),
            velocity_target=zeros,
            stiffness=np.array(
                [kp * _ratio(new.p, own.p) for kp, (new, own) in zip(d.stiffness, gains, strict=True)]
            ),
            damping=np.array(
                [kd * _ratio(new.d, own.d) for kd, (new, own) in zip(d.damping, gains, strict=True)]
            ),
            effort=zeros.copy(),
            effort_limit=np.array(d.effort_limit) * np.where(self._effort > 0, shares, 1.0),
            speed_limit=np.array(d.speed_limit),
        )

    def _check(self, command: JointCommand) -> None:
        for name in ("position_target", "stiffness", "damping", "effort_limit"):
            values = getattr(command, name)
            # Where the description has no effort limit, a command has none, too.
            known = self._effort > 0 if name == "effort_limit" else np.ones(len(values), dtype=bool)
            if np.isnan(values).any() or not np.isfinite(values[known]).all():
                raise SafetyError(f"{self._description.name}: {name} is {values}; nothing was sent")

    def _gain(self, nominal: int, wanted: float, usual: float) -> int:
        scaled = nominal * wanted / usual if usual else nominal
        return min(max(round(scaled), 0), self._most_gain)


def clipped(ticks: int) -> int:
    """Return the nearest position that a servo counts."""
    return min(max(ticks, 0), TICKS - 1)


def _ratio(new: int, own: int) -> float:
    return new / own if own else 1.0
