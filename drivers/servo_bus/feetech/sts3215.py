"""The STS3215: factory values and ranges of its registers, and which of them a host may write.

Source: Feetech's STS memory table. It leaves some factory values open; those are assumed, and marked.
"""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.servo_bus.feetech import registers as r
from deal_hw.drivers.servo_bus.registers import Register

TABLE_BYTES: Final = 128
"""Registers behind the last known one read 0 (assumed)."""
FIRMWARE: Final = (3, 10)
VOLTAGE, TEMPERATURE = 74, 30
"""Of the emulated servo: 7.4 V, 30 degrees Celsius."""
MAX_OFFSET: Final = 2047
"""Largest homing offset, in both directions [ticks]."""

EEPROM: Final[dict[Register, int]] = {
    r.FIRMWARE_MAJOR: FIRMWARE[0],
    r.FIRMWARE_MINOR: FIRMWARE[1],
    r.ENDIANNESS: 0,
    r.MODEL_NUMBER: r.STS3215,
    r.ID: 1,
    r.BAUD_RATE: 0,
    # Feetech's table; LeRobot says that it leaves the factory with 250.
    r.RETURN_DELAY: 0,
    r.RESPONSE_LEVEL: 1,
    r.MIN_POSITION: 0,
    r.MAX_POSITION: 4095,
    r.MAX_TEMPERATURE: 70,
    r.MAX_VOLTAGE: 80,  # Assumed; for the 7.4 V model.
    r.MIN_VOLTAGE: 40,
    r.MAX_TORQUE: 1000,
    # Assumed: speeds in ticks/s, speed 0 is the largest, one revolution.
    r.PHASE: 12,
    r.UNLOAD_CONDITIONS: 0x2C,  # Assumed: temperature, current, overload.
    r.LED_CONDITIONS: 0x2F,  # Assumed.
    r.P_GAIN: 32,
    r.D_GAIN: 32,
    r.I_GAIN: 0,
    r.MIN_START_FORCE: 16,  # Assumed.
    r.INTEGRAL_LIMIT: 0,
    r.CW_DEAD_ZONE: 1,
    r.CCW_DEAD_ZONE: 1,
    r.PROTECTION_CURRENT: 511,
    r.ANGULAR_RESOLUTION: 1,
    r.HOMING_OFFSET: 0,
    r.OPERATING_MODE: r.StsMode.POSITION,
    r.PROTECTIVE_TORQUE: 20,
    r.PROTECTION_TIME: 200,
    r.OVERLOAD_TORQUE: 80,
    r.SPEED_P_GAIN: 10,  # Assumed.
    r.OVERCURRENT_TIME: 200,
    r.SPEED_I_GAIN: 10,  # Assumed.
}
"""Factory values of what a restart keeps."""
RAM: Final[dict[Register, int]] = {
    r.TORQUE_ENABLE: r.TorqueMode.OFF,
    r.ACCELERATION: 0,
    r.GOAL_TIME: 0,
    r.GOAL_SPEED: 3400,  # 68 units of Max Speed Limit.
    r.LOCK: r.LOCKED,
    r.PRESENT_VOLTAGE: VOLTAGE,
    r.PRESENT_TEMPERATURE: TEMPERATURE,
    # Assumed, all of these factory parameters.
    r.MOVING_THRESHOLD: 1,
    r.SPEED_UNIT_FACTOR: 50,
    r.MAX_SPEED: 68,
    r.MAX_ACCELERATION: 254,
    r.ACCELERATION_MULTIPLIER: 1,
}
"""Values after a restart; Torque Limit is Max Torque Limit, the goal is the present position."""

_BYTE, _GAIN = (0, 254), (0, 254)
RANGES: Final[dict[Register, tuple[int, int]]] = {
    r.ID: (0, 253),
    r.BAUD_RATE: (0, len(r.BAUD_RATES) - 1),
    r.RETURN_DELAY: (0, 253),
    r.RESPONSE_LEVEL: (0, 1),
    r.MIN_POSITION: (0, 4094),
    r.MAX_POSITION: (0, 4095),
    r.MAX_TEMPERATURE: (0, 100),
    r.MAX_VOLTAGE: _BYTE,
    r.MIN_VOLTAGE: _BYTE,
    r.MAX_TORQUE: (0, 1000),
    r.PHASE: _BYTE,
    r.UNLOAD_CONDITIONS: _BYTE,
    r.LED_CONDITIONS: _BYTE,
    r.P_GAIN: _GAIN,
    r.D_GAIN: _GAIN,
    r.I_GAIN: _GAIN,
    r.MIN_START_FORCE: _BYTE,
    r.INTEGRAL_LIMIT: _BYTE,
    r.CW_DEAD_ZONE: (0, 16),
    r.CCW_DEAD_ZONE: (0, 16),
    r.PROTECTION_CURRENT: (0, 2047),
    r.ANGULAR_RESOLUTION: (1, 128),
    r.HOMING_OFFSET: (0, 0xFFF),
    r.OPERATING_MODE: (0, max(r.StsMode)),
    r.PROTECTIVE_TORQUE: _BYTE,
    r.PROTECTION_TIME: _BYTE,
    r.OVERLOAD_TORQUE: _BYTE,
    r.SPEED_P_GAIN: _GAIN,
    r.OVERCURRENT_TIME: _BYTE,
    r.SPEED_I_GAIN: _GAIN,
    r.TORQUE_ENABLE: (0, max(r.TorqueMode)),
    r.ACCELERATION: _BYTE,
    r.GOAL_POSITION: (0, 0xFFFF),
    r.GOAL_TIME: (0, 0xFFFF),
    r.GOAL_SPEED: (0, 0xFFFF),
    r.TORQUE_LIMIT: (0, 1000),
    r.LOCK: (0, 1),
    # Feetech calls these read-only; LeRobot writes the largest acceleration.
    r.MAX_SPEED: (0, 255),
    r.MAX_ACCELERATION: (0, 255),
    r.ACCELERATION_MULTIPLIER: (0, 255),
}
"""What a host may write, without sign; all other registers are read-only."""
