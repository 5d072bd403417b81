"""The control table of Feetech's STS and SMS servos, and the units of its registers.

Sources: Feetech's STS memory table, and the tables of LeRobot for the STS3215; where they differ it is said.
Numbers are little-endian. A negative number is its magnitude with a sign bit, not a two's complement, and
the sign bit differs from register to register.
"""

from __future__ import annotations

import enum
import math
import struct
from dataclasses import dataclass
from typing import Final

from deal_hw.drivers.servo_bus.registers import Register

TICKS: Final = 4096
"""Counts of the position sensor in one revolution."""
RAD_PER_TICK: Final = 2 * math.pi / TICKS
RAD_S_PER_COUNT: Final = RAD_PER_TICK
"""Unit of speeds: one tick/s. Bit 2 of Phase set to 0 makes it 50 ticks/s (0.732 rev/min)."""
LOAD_UNIT: Final = 0.001
"""Unit of load and torque limits: this share of the full PWM duty."""
VOLT_PER_COUNT: Final = 0.1
AMPERE_PER_COUNT: Final = 0.0065
RETURN_DELAY_UNIT_S: Final = 2e-6
ACCELERATION_UNIT: Final = 100
"""Unit of Acceleration [ticks/s^2]: 8.7 deg/s^2; 0 is the largest."""
PROTECTION_TIME_UNIT_S: Final = 0.01
MIDDLE: Final = 2048
"""Middle of one revolution [ticks]."""

STS3215, STS3250, SM8512BL = 777, 2825, 11272
"""Model numbers."""
MODELS: Final = {STS3215: "STS3215", STS3250: "STS3250", SM8512BL: "SM8512BL"}

BAUD_RATES: Final = (1_000_000, 500_000, 250_000, 128_000, 115_200)
"""Rates by the number in the register Baud Rate.

The sources disagree on the codes 5 to 7 (57600, 38400 and 19200, or 76800, 57600 and 38400); they are not
used.
"""

FIRMWARE_MAJOR = Register(0, 1, "Firmware Major Version")
FIRMWARE_MINOR = Register(1, 1, "Firmware Minor Version")
ENDIANNESS = Register(2, 1, "Endianness")
MODEL_NUMBER = Register(3, 2, "Model Number")
ID = Register(5, 1, "ID")
BAUD_RATE = Register(6, 1, "Baud Rate")
RETURN_DELAY = Register(7, 1, "Return Delay Time")
RESPONSE_LEVEL = Register(8, 1, "Response Level")
MIN_POSITION = Register(9, 2, "Min Position Limit")
MAX_POSITION = Register(11, 2, "Max Position Limit")
MAX_TEMPERATURE = Register(13, 1, "Max Temperature Limit")
MAX_VOLTAGE = Register(14, 1, "Max Voltage Limit")
MIN_VOLTAGE = Register(15, 1, "Min Voltage Limit")
MAX_TORQUE = Register(16, 2, "Max Torque Limit")
PHASE = Register(18, 1, "Phase")
UNLOAD_CONDITIONS = Register(19, 1, "Unloading Condition")
LED_CONDITIONS = Register(20, 1, "LED Alarm Condition")
P_GAIN = Register(21, 1, "P Coefficient")
D_GAIN = Register(22, 1, "D Coefficient")
I_GAIN = Register(23, 1, "I Coefficient")
MIN_START_FORCE = Register(24, 1, "Minimum Startup Force")
"""LeRobot's table has two bytes here, of which Feetech's calls the second the integral limit."""
INTEGRAL_LIMIT = Register(25, 1, "Integral Limit")
CW_DEAD_ZONE = Register(26, 1, "CW Dead Zone")
CCW_DEAD_ZONE = Register(27, 1, "CCW Dead Zone")
PROTECTION_CURRENT = Register(28, 2, "Protection Current")
ANGULAR_RESOLUTION = Register(30, 1, "Angular Resolution")
HOMING_OFFSET = Register(31, 2, "Homing Offset")
OPERATING_MODE = Register(33, 1, "Operating Mode")
PROTECTIVE_TORQUE = Register(34, 1, "Protective Torque")
PROTECTION_TIME = Register(35, 1, "Protection Time")
OVERLOAD_TORQUE = Register(36, 1, "Overload Torque")
SPEED_P_GAIN = Register(37, 1, "Speed P Coefficient")
OVERCURRENT_TIME = Register(38, 1, "Over Current Protection Time")
SPEED_I_GAIN = Register(39, 1, "Speed I Coefficient")
TORQUE_ENABLE = Register(40, 1, "Torque Enable")
ACCELERATION = Register(41, 1, "Acceleration")
GOAL_POSITION = Register(42, 2, "Goal Position")
GOAL_TIME = Register(44, 2, "Goal Time")
GOAL_SPEED = Register(46, 2, "Goal Speed")
TORQUE_LIMIT = Register(48, 2, "Torque Limit")
LOCK = Register(55, 1, "Lock")
PRESENT_POSITION = Register(56, 2, "Present Position")
PRESENT_SPEED = Register(58, 2, "Present Speed")
PRESENT_LOAD = Register(60, 2, "Present Load")
PRESENT_VOLTAGE = Register(62, 1, "Present Voltage")
PRESENT_TEMPERATURE = Register(63, 1, "Present Temperature")
ASYNC_WRITE = Register(64, 1, "Async Write Flag")
STATUS = Register(65, 1, "Status")
MOVING = Register(66, 1, "Moving")
TARGET_POSITION = Register(67, 2, "Target Position")
PRESENT_CURRENT = Register(69, 2, "Present Current")
MOVING_THRESHOLD = Register(80, 1, "Moving Threshold")
DTS = Register(81, 1, "DTs")
SPEED_UNIT_FACTOR = Register(82, 1, "Speed Unit Factor")
HTS = Register(83, 1, "Hts")
MAX_SPEED = Register(84, 1, "Max Speed Limit")
MAX_ACCELERATION = Register(85, 1, "Max Acceleration Limit")
ACCELERATION_MULTIPLIER = Register(86, 1, "Acceleration Multiplier")

FIRST_RAM: Final = TORQUE_ENABLE.address
"""A restart resets the registers from here on. Those before keep what was written while Lock was 0."""

SIGN_BITS: Final = {
    HOMING_OFFSET: 11,
    GOAL_POSITION: 15,
    GOAL_SPEED: 15,
    PRESENT_POSITION: 15,
    PRESENT_SPEED: 15,
    PRESENT_LOAD: 10,
    TARGET_POSITION: 15,
}
"""Registers with a sign, and the bit of it. LeRobot reads the present current without sign."""

CLOCKWISE, MULTI_TURN = 0x80, 0x10
"""Bits of Phase: the position counts the other way; it goes on beyond one revolution."""
UNLOCKED, LOCKED = 0, 1
"""Values of :data:`LOCK`: writes to the EEPROM are kept, or lost at a restart."""


class TorqueMode(enum.IntEnum):
    """Values of Torque Enable."""

    OFF = 0
    ON = 1
    DAMPING = 2


CALIBRATE_MIDDLE: Final = 128
"""Written to Torque Enable, it makes the present position 2048 by the homing offset."""


class StsMode(enum.IntEnum):
    """Values of Operating Mode."""

    POSITION = 0
    SPEED = 1
    PWM = 2
    STEP = 3


def signed(value: int, bit: int) -> int:
    """Return the number that a register's value means.

    Args:
        value: The value, without sign.
        bit: Its sign bit; the bits below are the magnitude, those above have no meaning.
    """
    magnitude = value & ((1 << bit) - 1)
    return -magnitude if value >> bit & 1 else magnitude


def to_signed(number: int, bit: int, size: int) -> bytes:
    """Return the bytes of a register for a number.

    Args:
        number: The number.
        bit: The register's sign bit.
        size: The register's bytes.

    Raises:
        ValueError: The number does not fit below the sign bit.
    """
    if abs(number) >> bit:
        most = (1 << bit) - 1
        raise ValueError(f"{number} does not fit: allowed are -{most} to {most}")
    return (abs(number) | (number < 0) << bit).to_bytes(size, "little")


def decode(register: Register, data: bytes) -> int:
    """Return the number in a register's bytes, with its sign if it has one."""
    value = int.from_bytes(data, "little")
    return signed(value, SIGN_BITS[register]) if register in SIGN_BITS else value


def encode(register: Register, number: int) -> bytes:
    """Return a register's bytes for a number.

    Raises:
        ValueError: The number does not fit.
    """
    if register in SIGN_BITS:
        return to_signed(number, SIGN_BITS[register], register.size)
    if not 0 <= number < 1 << 8 * register.size:
        most = (1 << 8 * register.size) - 1
        raise ValueError(f"{register.name} ({register.address}): {number}: allowed are 0 to {most}")
    return number.to_bytes(register.size, "little")


BLOCK_ADDRESS: Final = TORQUE_ENABLE.address
BLOCK_BYTES: Final = PRESENT_CURRENT.address + PRESENT_CURRENT.size - BLOCK_ADDRESS
_BLOCK: Final = struct.Struct("<BB4H5xB3HBBxBB2xH")


@dataclass(frozen=True, slots=True)
class StsBlock:
    """Torque Enable (40) to Present Current (70), read from a servo with every sample.

    It includes the servo's present goals. So the next sample shows a lost command or a restarted servo.

    Attributes:
        torque_mode: A :class:`TorqueMode`.
        acceleration: [100 ticks/s^2]; 0 is the largest.
        goal_position: [ticks], after the homing offset.
        goal_time: Time of the motion, 0 for none; duty in PWM mode.
        goal_speed: Largest speed of the motion [ticks/s]; 0 is no limit, or a stop (Phase, bit 3).
        torque_limit: [0.1 %].
        lock: 1 if writes to the EEPROM are lost at a restart.
        position: [ticks], after the homing offset.
        speed: [ticks/s].
        load: Duty of the motor's PWM [0.1 %].
        voltage: [0.1 V].
        temperature: [degrees Celsius].
        status: Bits of :class:`~deal_hw.drivers.servo_bus.feetech.packets.Fault`.
        moving: 1 while it moves to its goal.
        current: Without sign [6.5 mA].
    """

    torque_mode: int
    acceleration: int
    goal_position: int
    goal_time: int
    goal_speed: int
    torque_limit: int
    lock: int
    position: int
    speed: int
    load: int
    voltage: int
    temperature: int
    status: int
    moving: int
    current: int

    @classmethod
    def unpack(cls, data: bytes) -> StsBlock:
        """Return the values of :data:`BLOCK_BYTES` bytes, with their signs."""
        (mode, acceleration, goal, time, goal_speed, limit, lock, position, speed, load, *rest) = (
            _BLOCK.unpack(data)
        )
        return cls(
            mode,
            acceleration,
            signed(goal, 15),
            time,
            signed(goal_speed, 15),
            limit,
            lock,
            signed(position, 15),
            signed(speed, 15),
            signed(load, 10),
            *rest,
        )


Block = StsBlock
