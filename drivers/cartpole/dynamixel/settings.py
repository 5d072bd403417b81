"""Wiring and gearing of the servos, and the SI units of their registers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from deal_hw.drivers.servo_bus.registers import (
    BAUD_RATES,
    PULSES,
    RAD_S_PER_COUNT,
    Block,
    OperatingMode,
)
from deal_hw.errors import ConfigurationError, SafetyError
from deal_hw.schema import STRICT
from deal_hw.types import FloatArray, JointCommand

_MOST_GAIN, _MOST_VELOCITY, _MOST_POSITION = 16383, 32767, 0x7FFF_FFFF
_MOST_CURRENT = 32767


class Goal(NamedTuple):
    """The belt servo's registers for one command."""

    d_gain: int
    p_gain: int
    effort: int
    profile_velocity: int
    position: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DynamixelSettings:
    """Wiring and gearing of the two servos.

    The three factors of gains and effort are nominal: the e-Manual gives the gains' divisors (128 and 16),
    not the unit behind them. Here they follow from 1 mA for an output unit and a 1 ms control period.
    The servo is an XL330-M077 at 5 V (0.215 N·m at 1.47 A), the pulley has 0.16 m for a revolution.
    ``calibrate`` finds the true factors.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    cart_id: int = 1
    """Id of the servo that drives the belt."""
    pole_id: int = 2
    """Id of the servo that reads the pole; its torque stays off."""
    baud_rate: int = 1_000_000
    """Baud rate of both servos [bit/s]."""
    mode: Literal["current", "extended"] = "current"
    """Operating mode of the belt servo: current-based position (5) or, for servos without a current sensor,
    extended position (4), where the effort limit is a PWM limit."""
    metres_per_revolution: float = 0.16
    """Travel of the belt in one revolution of the pulley: teeth times pitch [m]; default: 80 teeth of GT2."""
    cart_direction: Literal[1, -1] = 1
    """1: a growing position of the belt servo moves the cart towards +x; -1: towards -x."""
    pole_direction: Literal[1, -1] = 1
    """1: a growing position of the pole servo leans the pole towards +x; -1: towards -x."""
    pole_zero: int = 2048
    """Reading of the pole servo while the pole is upright, 0 to 4095."""
    cart_zero: int | None = None
    """Reading of the belt servo, within a revolution, while the cart is in the middle. Put the cart within
    half a revolution of it before homing. None: homing finds both end stops and takes the middle."""
    rail_m: float = 0.8
    """Travel of the cart from stop to stop [m]."""
    rail_tolerance_m: float = 0.02
    """Largest difference between that and the travel that homing finds [m]."""
    homing_speed_m_s: float = 0.4
    """Speed of the cart while homing [m/s]."""
    homing_effort_n: float = 4.0
    """Effort limit while homing [N]."""
    stall_s: float = 0.5
    """The cart stands at a stop once it has not moved 3 mm for this long [s]."""
    upright_rad: float = 0.1
    """The pole counts as upright within this angle [rad]."""
    still_s: float = 0.3
    """Homing ends once the pole was upright and still for this long [s]."""
    stiffness_per_gain: float = 1.148
    """Stiffness of one unit of Position P Gain [N/m]: 1/128 mA a pulse, 25600 pulses/m, 0.00574 N/mA."""
    damping_per_gain: float = 0.00918
    """Damping of one unit of Position D Gain [N·s/m]: 1/16 mA a pulse in 1 ms, 25600 pulses/m, 0.00574
    N/mA."""
    effort_per_current: float = 0.00574
    """Effort of one unit of Goal Current, 1 mA on an XL330, 2.69 mA on an XM430 [N]."""
    effort_per_pwm: float = 0.00954
    """Effort of one unit of Goal PWM at standstill [N]; for the mode "extended"."""
    answer_s: float = 0.003
    """Longest delay of an answer beyond its bytes' time on the wire [s]: USB, adapter, return delay. An
    absent servo costs this time for each sample; the SDK waits 34 ms."""

    def __post_init__(self) -> None:
        for name in ("cart_id", "pole_id"):
            if not 0 <= getattr(self, name) <= 252:
                raise ConfigurationError(f"{name} is {getattr(self, name)}; ids are 0 to 252")
        if self.cart_id == self.pole_id:
            raise ConfigurationError(
                f"cart_id and pole_id are both {self.cart_id}; give one servo another id (register ID, 7)"
            )
        if self.baud_rate not in BAUD_RATES:
            raise ConfigurationError(
                f"baud_rate {self.baud_rate}: allowed for X-series servos are "
                f"{', '.join(map(str, BAUD_RATES))}"
            )
        for name in (
            "metres_per_revolution",
            "rail_m",
            "rail_tolerance_m",
            "homing_speed_m_s",
            "homing_effort_n",
            "stall_s",
            "upright_rad",
            "still_s",
            "stiffness_per_gain",
            "damping_per_gain",
            "effort_per_current",
            "effort_per_pwm",
            "answer_s",
        ):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise ConfigurationError(f"{name} is {value!r}; it must be a number above 0")
        if not 0 <= self.pole_zero < PULSES:
            raise ConfigurationError(f"pole_zero is {self.pole_zero}; allowed are 0 to {PULSES - 1}")

    @property
    def operating_mode(self) -> OperatingMode:
        """Required Operating Mode of the belt servo."""
        return (
            OperatingMode.CURRENT_BASED_POSITION
            if self.mode == "current"
            else OperatingMode.EXTENDED_POSITION
        )

    @property
    def metres_per_pulse(self) -> float:
        """Travel of the belt in one pulse [m]; negative if the servo is mounted the other way round."""
        return self.cart_direction * self.metres_per_revolution / PULSES

    @property
    def effort_per_unit(self) -> float:
        """Effort of one unit of the register that limits it [N]."""
        return self.effort_per_current if self.mode == "current" else self.effort_per_pwm

    @property
    def metres_s_per_count(self) -> float:
        """Speed of the belt in one unit of a velocity register [m/s]."""
        return RAD_S_PER_COUNT * self.metres_per_revolution / (2 * math.pi)

    def to_goal(self, command: JointCommand, zero: int, most_effort: int = _MOST_CURRENT) -> Goal:
        """Round a command to the registers, and clip it to their ranges.

        Args:
            command: The command.
            zero: Reading of the belt servo in the middle of the rail.
            most_effort: The servo's own Current Limit or PWM Limit.

        Raises:
            SafetyError: A value is not finite.
        """
        # A profile velocity of 0 means no limit: the slowest limit is 1.
        return Goal(
            _integer(command.damping, self.damping_per_gain, 0, _MOST_GAIN, "damping"),
            _integer(command.stiffness, self.stiffness_per_gain, 0, _MOST_GAIN, "stiffness"),
            _integer(command.effort_limit, self.effort_per_unit, 0, most_effort, "effort_limit"),
            _integer(command.speed_limit, self.metres_s_per_count, 1, _MOST_VELOCITY, "speed_limit"),
            zero
            + _integer(
                command.position_target,
                self.metres_per_pulse,
                -_MOST_POSITION // 2,
                _MOST_POSITION // 2,
                "position_target",
            ),
        )

    def from_goal(self, goal: Goal, zero: int) -> JointCommand:
        """Return the command that the registers mean; quantities without a register are 0."""
        return JointCommand(
            position_target=np.array([(goal.position - zero) * self.metres_per_pulse]),
            velocity_target=np.zeros(1),
            stiffness=np.array([goal.p_gain * self.stiffness_per_gain]),
            damping=np.array([goal.d_gain * self.damping_per_gain]),
            effort=np.zeros(1),
            effort_limit=np.array([goal.effort * self.effort_per_unit]),
            speed_limit=np.array([goal.profile_velocity * self.metres_s_per_count]),
        )

    def read_goal(self, block: Block) -> Goal:
        """Return the goals that the belt servo reports."""
        effort = block.goal_current if self.mode == "current" else block.goal_pwm
        return Goal(block.d_gain, block.p_gain, effort, block.profile_velocity, block.goal_position)


def _integer(values: FloatArray, unit: float, low: int, high: int, name: str) -> int:
    value = float(values[0])
    if not math.isfinite(value):
        raise SafetyError(f"cartpole: {name} is {value}; nothing was sent")
    return min(max(round(value / unit), low), high)
