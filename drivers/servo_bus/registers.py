"""The X-series control table, and the units of its registers.

Source: ROBOTIS e-Manual, control tables of XL330-M077-T and the other X models, which agree in these
addresses (``dynamixel_easy_sdk`` carries the same tables; a test compares).
"""

from __future__ import annotations

import enum
import math
import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

PULSES: Final = 4096
"""Counts of the position sensor in one revolution."""
RAD_S_PER_COUNT: Final = 0.229 * 2 * math.pi / 60
"""Unit of velocities: 0.229 rev/min."""
WATCHDOG_UNIT_S: Final = 0.02
WATCHDOG_TRIPPED: Final = 0xFF
"""Value of Bus Watchdog after it has stopped the servo: -1."""
TICK_PERIOD_MS: Final = 32768
"""Realtime Tick counts milliseconds from 0 and starts again here."""
RETURN_DELAY_UNIT_S: Final = 2e-6
REVERSE_MODE, TIME_BASED_PROFILE, TORQUE_BY_GOAL = 1, 4, 8
"""Bits of Drive Mode."""
IN_POSITION, PROFILE_ONGOING, RECTANGULAR_PROFILE = 1, 2, 0x10
"""Bits of Moving Status: at the goal; the set-point has not reached the goal; Profile Velocity limits it."""


class Register(NamedTuple):
    """One entry: its address, its bytes, and the name that the e-Manual and Dynamixel Wizard give it."""

    address: int
    size: int
    name: str


MODEL_NUMBER = Register(0, 2, "Model Number")
MODEL_INFORMATION = Register(2, 4, "Model Information")
FIRMWARE_VERSION = Register(6, 1, "Firmware Version")
ID = Register(7, 1, "ID")
BAUD_RATE = Register(8, 1, "Baud Rate")
RETURN_DELAY_TIME = Register(9, 1, "Return Delay Time")
DRIVE_MODE = Register(10, 1, "Drive Mode")
OPERATING_MODE = Register(11, 1, "Operating Mode")
SECONDARY_ID = Register(12, 1, "Secondary(Shadow) ID")
PROTOCOL_TYPE = Register(13, 1, "Protocol Type")
HOMING_OFFSET = Register(20, 4, "Homing Offset")
MOVING_THRESHOLD = Register(24, 4, "Moving Threshold")
TEMPERATURE_LIMIT = Register(31, 1, "Temperature Limit")
MAX_VOLTAGE_LIMIT = Register(32, 2, "Max Voltage Limit")
MIN_VOLTAGE_LIMIT = Register(34, 2, "Min Voltage Limit")
PWM_LIMIT = Register(36, 2, "PWM Limit")
CURRENT_LIMIT = Register(38, 2, "Current Limit")
VELOCITY_LIMIT = Register(44, 4, "Velocity Limit")
MAX_POSITION_LIMIT = Register(48, 4, "Max Position Limit")
MIN_POSITION_LIMIT = Register(52, 4, "Min Position Limit")
STARTUP_CONFIGURATION = Register(60, 1, "Startup Configuration")
PWM_SLOPE = Register(62, 1, "PWM Slope")
SHUTDOWN = Register(63, 1, "Shutdown")
TORQUE_ENABLE = Register(64, 1, "Torque Enable")
LED = Register(65, 1, "LED")
STATUS_RETURN_LEVEL = Register(68, 1, "Status Return Level")
REGISTERED_INSTRUCTION = Register(69, 1, "Registered Instruction")
HARDWARE_ERROR = Register(70, 1, "Hardware Error Status")
VELOCITY_I_GAIN = Register(76, 2, "Velocity I Gain")
VELOCITY_P_GAIN = Register(78, 2, "Velocity P Gain")
POSITION_D_GAIN = Register(80, 2, "Position D Gain")
POSITION_I_GAIN = Register(82, 2, "Position I Gain")
POSITION_P_GAIN = Register(84, 2, "Position P Gain")
FEEDFORWARD_2ND = Register(88, 2, "Feedforward 2nd Gain")
FEEDFORWARD_1ST = Register(90, 2, "Feedforward 1st Gain")
BUS_WATCHDOG = Register(98, 1, "Bus Watchdog")
GOAL_PWM = Register(100, 2, "Goal PWM")
GOAL_CURRENT = Register(102, 2, "Goal Current")
GOAL_VELOCITY = Register(104, 4, "Goal Velocity")
PROFILE_ACCELERATION = Register(108, 4, "Profile Acceleration")
PROFILE_VELOCITY = Register(112, 4, "Profile Velocity")
GOAL_POSITION = Register(116, 4, "Goal Position")
REALTIME_TICK = Register(120, 2, "Realtime Tick")
MOVING = Register(122, 1, "Moving")
MOVING_STATUS = Register(123, 1, "Moving Status")
PRESENT_PWM = Register(124, 2, "Present PWM")
PRESENT_CURRENT = Register(126, 2, "Present Current")
PRESENT_VELOCITY = Register(128, 4, "Present Velocity")
PRESENT_POSITION = Register(132, 4, "Present Position")
VELOCITY_TRAJECTORY = Register(136, 4, "Velocity Trajectory")
POSITION_TRAJECTORY = Register(140, 4, "Position Trajectory")
PRESENT_INPUT_VOLTAGE = Register(144, 2, "Present Input Voltage")
PRESENT_TEMPERATURE = Register(146, 1, "Present Temperature")
INDIRECT_ADDRESS = Register(168, 2, "Indirect Address 1")
INDIRECT_DATA = Register(224, 1, "Indirect Data 1")
INDIRECT_COUNT: Final = 28
"""Number of indirect addresses (168 to 223) and of indirect data bytes (224 to 251)."""

NEEDED: Final = (
    OPERATING_MODE,
    TORQUE_ENABLE,
    HARDWARE_ERROR,
    POSITION_P_GAIN,
    BUS_WATCHDOG,
    PROFILE_VELOCITY,
    GOAL_POSITION,
    REALTIME_TICK,
    PRESENT_VELOCITY,
    PRESENT_POSITION,
)
"""Registers that the driver needs, at these addresses; a model without one of them is refused."""


class OperatingMode(enum.IntEnum):
    """Values of Operating Mode."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


BAUD_RATES: Final = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Rates by the number in the register Baud Rate."""

HARDWARE_ERRORS: Final = {
    0: ("input voltage out of its limits", "check the supply under load; XL330: 3.7 to 6.0 V"),
    2: ("overheated", "let it cool, then look for friction, a jam or too high a load"),
    3: ("motor encoder fault", "switch it off and on; if the error returns, the servo is broken"),
    4: ("electrical shock, or too little power for the motor", "check supply and wires"),
    5: ("overload", "look for a jam or too high a load; lower the effort limit"),
}
"""Bits of Hardware Error Status: meaning and remedy of each (e-Manual)."""
UNTIL_RESTARTED: Final = (
    "it gives no torque until it is switched off and on, or restarted with Dynamixel Wizard"
)
"""What follows from an error that is one of Shutdown's."""


def explain_hardware_error(value: int) -> str:
    """Return the bits of Hardware Error Status in words, with the remedy of each."""
    known = [f"{what} ({remedy})" for bit, (what, remedy) in HARDWARE_ERRORS.items() if value >> bit & 1]
    unknown = value & ~sum(1 << bit for bit in HARDWARE_ERRORS)
    return "; ".join([*known, *([f"unknown bits 0x{unknown:02x}"] if unknown else [])])


BLOCK_ADDRESS: Final = TORQUE_ENABLE.address
BLOCK_BYTES: Final = PRESENT_POSITION.address + PRESENT_POSITION.size - BLOCK_ADDRESS
_BLOCK: Final = struct.Struct("<BB4xB9xHHH12xBxhh4xIIiHxBxxhii")


@dataclass(frozen=True, slots=True)
class Block:
    """Torque Enable (64) to Present Position (135), read from a servo with every sample.

    It includes the servo's present goals. So the next sample shows a lost command or a restarted servo.
    """

    torque_enable: int
    led: int
    hardware_error: int
    d_gain: int
    i_gain: int
    p_gain: int
    bus_watchdog: int
    goal_pwm: int
    goal_current: int
    profile_acceleration: int
    profile_velocity: int
    goal_position: int
    tick_ms: int
    moving_status: int
    present_current: int
    present_velocity: int
    present_position: int

    @classmethod
    def unpack(cls, data: bytes) -> Block:
        """Return the values of :data:`BLOCK_BYTES` bytes, with their signs."""
        return cls(*_BLOCK.unpack(data))
