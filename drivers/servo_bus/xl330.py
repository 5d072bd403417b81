"""The XL330-M077: factory values and ranges of its registers, and which of them a host may write.

Source: ROBOTIS e-Manual, "XL330-M077-T", control table of firmware 46. ROBOTIS' own sources disagree on the
indirect addresses: the e-Manual has 20, with data from 208; here are 28, with data from 224, as in
the control tables and examples of ROBOTIS' SDK.
"""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus.registers import BAUD_RATES, OperatingMode, Register

TABLE_BYTES: Final = 256
FIRST_RAM: Final = 64
"""Registers from here on are lost at a restart; those before are locked while the torque is on."""
MODEL, FIRMWARE = 1190, 46
NO_LOAD_VELOCITY: Final = round(383 / 0.229)
"""Fastest velocity, at 5 V without load: 383 rev/min in units of 0.229 rev/min."""
MOST_PWM: Final = 885
VOLTAGE, TEMPERATURE = 50, 31
"""Of the emulated servo: 5.0 V, 31 degrees Celsius."""
MULTI_TURN: Final = 1_048_575
"""Largest goal of the multi-turn modes, in both directions: 256 turns."""
MODES: Final = frozenset(OperatingMode)
DRIVE_MODE_BITS: Final = r.REVERSE_MODE | r.TIME_BASED_PROFILE | r.TORQUE_BY_GOAL

_GAIN = (0, 16383)
_ADDRESS = (FIRST_RAM, r.INDIRECT_DATA.address + r.INDIRECT_COUNT - 1)
INDIRECT_ADDRESSES: Final = tuple(
    Register(r.INDIRECT_ADDRESS.address + 2 * k, 2, f"Indirect Address {k + 1}")
    for k in range(r.INDIRECT_COUNT)
)

EEPROM: Final[dict[Register, int]] = {
    r.MODEL_NUMBER: MODEL,
    r.FIRMWARE_VERSION: FIRMWARE,
    r.ID: 1,
    r.BAUD_RATE: BAUD_RATES.index(57600),
    r.RETURN_DELAY_TIME: 250,
    r.DRIVE_MODE: 0,
    r.OPERATING_MODE: OperatingMode.POSITION,
    r.SECONDARY_ID: 255,
    r.PROTOCOL_TYPE: 2,
    r.HOMING_OFFSET: 0,
    r.MOVING_THRESHOLD: 10,
    r.TEMPERATURE_LIMIT: 70,
    r.MAX_VOLTAGE_LIMIT: 70,
    r.MIN_VOLTAGE_LIMIT: 35,
    r.PWM_LIMIT: MOST_PWM,
    r.CURRENT_LIMIT: 1750,
    r.VELOCITY_LIMIT: 1620,
    r.MAX_POSITION_LIMIT: 4095,
    r.MIN_POSITION_LIMIT: 0,
    r.STARTUP_CONFIGURATION: 0,
    r.PWM_SLOPE: 140,
    r.SHUTDOWN: 53,
}
"""Factory values of what a restart keeps."""
GAINS: Final[dict[Register, int]] = {
    r.VELOCITY_I_GAIN: 400,
    r.VELOCITY_P_GAIN: 40,
    r.POSITION_D_GAIN: 0,
    r.POSITION_I_GAIN: 400,
    r.POSITION_P_GAIN: 400,
    r.FEEDFORWARD_2ND: 0,
    r.FEEDFORWARD_1ST: 0,
    r.PROFILE_ACCELERATION: 0,
    r.PROFILE_VELOCITY: 0,
    r.GOAL_VELOCITY: 0,
}
"""Values after a restart and after a change of the operating mode."""
RAM: Final[dict[Register, int]] = {
    r.TORQUE_ENABLE: 0,
    r.LED: 0,
    r.STATUS_RETURN_LEVEL: 2,
    r.BUS_WATCHDOG: 0,
    r.PRESENT_INPUT_VOLTAGE: VOLTAGE,
    r.PRESENT_TEMPERATURE: TEMPERATURE,
    **GAINS,
    **{address: r.INDIRECT_DATA.address + k for k, address in enumerate(INDIRECT_ADDRESSES)},
}
"""Values after a restart; the goals are the limits and the present position."""
RANGES: Final[dict[Register, tuple[int, int]]] = {
    r.ID: (0, 252),
    r.BAUD_RATE: (0, 6),
    r.RETURN_DELAY_TIME: (0, 254),
    r.OPERATING_MODE: (0, 16),
    r.HOMING_OFFSET: (-1_044_479, 1_044_479),
    r.MOVING_THRESHOLD: (0, 1023),
    r.TEMPERATURE_LIMIT: (0, 100),
    r.MAX_VOLTAGE_LIMIT: (31, 70),
    r.MIN_VOLTAGE_LIMIT: (31, 70),
    r.PWM_LIMIT: (0, MOST_PWM),
    r.CURRENT_LIMIT: (0, 1750),
    r.VELOCITY_LIMIT: (0, 2047),
    r.MAX_POSITION_LIMIT: (0, 4095),
    r.MIN_POSITION_LIMIT: (0, 4095),
    r.STARTUP_CONFIGURATION: (0, 3),
    r.PWM_SLOPE: (1, 255),
    r.TORQUE_ENABLE: (0, 1),
    r.LED: (0, 1),
    r.STATUS_RETURN_LEVEL: (0, 2),
    r.VELOCITY_I_GAIN: _GAIN,
    r.VELOCITY_P_GAIN: _GAIN,
    r.POSITION_D_GAIN: _GAIN,
    r.POSITION_I_GAIN: _GAIN,
    r.POSITION_P_GAIN: _GAIN,
    r.FEEDFORWARD_2ND: _GAIN,
    r.FEEDFORWARD_1ST: _GAIN,
    r.BUS_WATCHDOG: (0, 127),
    r.PROFILE_ACCELERATION: (0, 32767),
    r.PROFILE_VELOCITY: (0, 32767),
    **dict.fromkeys(INDIRECT_ADDRESSES, _ADDRESS),
}
"""What a host may write; another value is answered with a data range error."""
SIGNED: Final = frozenset(
    (r.HOMING_OFFSET, r.BUS_WATCHDOG, r.GOAL_PWM, r.GOAL_CURRENT, r.GOAL_VELOCITY, r.GOAL_POSITION)
)
LIMITED: Final = (
    (r.GOAL_PWM, r.PWM_LIMIT),
    (r.GOAL_CURRENT, r.CURRENT_LIMIT),
    (r.GOAL_VELOCITY, r.VELOCITY_LIMIT),
)
"""Goals and the register that limits each; beyond it a write is answered with a data limit error."""
GOALS: Final = frozenset((*range(100, 108), *range(116, 120)))
"""Addresses that a servo does not take after its Bus Watchdog has stopped it."""
READ_ONLY: Final = frozenset((*range(7), 69, 70, *range(r.REALTIME_TICK.address, 148)))
