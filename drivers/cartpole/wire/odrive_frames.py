"""CANSimple: the public CAN frames of ODrive motor drives, as firmware 0.6 has them.

An id is ``node * 32 + number``. Source: ODrive's page "CAN Protocol", and the DBC that it publishes.
"""

from __future__ import annotations

import enum
import struct
from typing import Final

from deal_hw.drivers.cartpole.wire.can_link import FRAME

IDLE, CLOSED_LOOP = 1, 8
"""States of an ODrive's axis."""
TORQUE_CONTROL, VELOCITY_CONTROL, POSITION_CONTROL = 1, 2, 3
PASSTHROUGH: Final = 1
READ, WRITE = 0, 1
"""Opcodes of the frame that reads and writes an ODrive's settings."""
NODE_SHIFT: Final = 5
BROADCAST_NODE: Final = 0x3F
"""Every drive takes frames to this number; a drive without a number of its own has it, too."""


class Command(enum.IntEnum):
    """Numbers of CANSimple frames, as firmware 0.6 has them."""

    VERSION = 0x00
    HEARTBEAT = 0x01
    ESTOP = 0x02
    ERROR = 0x03
    RX_SDO = 0x04
    TX_SDO = 0x05
    ADDRESS = 0x06
    SET_AXIS_STATE = 0x07
    ENCODER_ESTIMATES = 0x09
    SET_CONTROLLER_MODE = 0x0B
    SET_INPUT_POS = 0x0C
    SET_INPUT_VEL = 0x0D
    SET_INPUT_TORQUE = 0x0E
    SET_LIMITS = 0x0F
    SET_TRAJ_VEL_LIMIT = 0x11
    SET_TRAJ_ACCEL_LIMITS = 0x12
    SET_TRAJ_INERTIA = 0x13
    IQ = 0x14
    TEMPERATURE = 0x15
    REBOOT = 0x16
    BUS_VOLTAGE_CURRENT = 0x17
    CLEAR_ERRORS = 0x18
    SET_ABSOLUTE_POSITION = 0x19
    SET_POS_GAIN = 0x1A
    SET_VEL_GAINS = 0x1B
    TORQUES = 0x1C
    POWERS = 0x1D
    ENTER_DFU_MODE = 0x1F


MOVING: Final = (
    Command.SET_AXIS_STATE,
    Command.SET_CONTROLLER_MODE,
    Command.SET_INPUT_POS,
    Command.SET_INPUT_VEL,
    Command.SET_INPUT_TORQUE,
    Command.SET_LIMITS,
    Command.SET_POS_GAIN,
    Command.SET_VEL_GAINS,
)
"""Frames to a drive that arm it or change what its motor does."""
LAYOUT: Final = {
    Command.VERSION: struct.Struct("<8B"),
    Command.HEARTBEAT: struct.Struct("<IBBBx"),
    Command.ESTOP: struct.Struct(""),
    Command.ERROR: struct.Struct("<II"),
    Command.RX_SDO: struct.Struct("<BHx4s"),
    Command.TX_SDO: struct.Struct("<xHx4s"),
    Command.ADDRESS: struct.Struct("<B6sB"),
    Command.SET_AXIS_STATE: struct.Struct("<I"),
    Command.ENCODER_ESTIMATES: struct.Struct("<ff"),
    Command.SET_CONTROLLER_MODE: struct.Struct("<II"),
    Command.SET_INPUT_POS: struct.Struct("<fhh"),
    Command.SET_INPUT_VEL: struct.Struct("<ff"),
    Command.SET_INPUT_TORQUE: struct.Struct("<f"),
    Command.SET_LIMITS: struct.Struct("<ff"),
    Command.SET_TRAJ_VEL_LIMIT: struct.Struct("<f"),
    Command.SET_TRAJ_ACCEL_LIMITS: struct.Struct("<ff"),
    Command.SET_TRAJ_INERTIA: struct.Struct("<f"),
    Command.IQ: struct.Struct("<ff"),
    Command.TEMPERATURE: struct.Struct("<ff"),
    Command.REBOOT: struct.Struct("<B"),
    Command.BUS_VOLTAGE_CURRENT: struct.Struct("<ff"),
    Command.CLEAR_ERRORS: struct.Struct("<B"),
    Command.SET_ABSOLUTE_POSITION: struct.Struct("<f"),
    Command.SET_POS_GAIN: struct.Struct("<f"),
    Command.SET_VEL_GAINS: struct.Struct("<ff"),
    Command.TORQUES: struct.Struct("<ff"),
    Command.POWERS: struct.Struct("<ff"),
    Command.ENTER_DFU_MODE: struct.Struct(""),
}
"""Data of every frame; rev, rev/s, N*m, A, V, degrees Celsius, W."""
SDO_HEAD: Final = struct.Struct("<BHx")
"""Beginning of the frames that read and write settings: opcode (0 in answers), number of the setting."""
FEED_FORWARD: Final = 1e-3
"""Unit of the two integers of Set_Input_Pos [rev/s, N*m]."""


class AxisError(enum.IntFlag):
    """Error bits of an ODrive, as firmware 0.6 has them."""

    INITIALIZING = 0x1
    SYSTEM_LEVEL = 0x2
    TIMING_ERROR = 0x4
    MISSING_ESTIMATE = 0x8
    BAD_CONFIG = 0x10
    DRV_FAULT = 0x20
    MISSING_INPUT = 0x40
    DC_BUS_OVER_VOLTAGE = 0x100
    DC_BUS_UNDER_VOLTAGE = 0x200
    DC_BUS_OVER_CURRENT = 0x400
    DC_BUS_OVER_REGEN_CURRENT = 0x800
    CURRENT_LIMIT_VIOLATION = 0x1000
    MOTOR_OVER_TEMP = 0x2000
    INVERTER_OVER_TEMP = 0x4000
    VELOCITY_LIMIT_VIOLATION = 0x8000
    POSITION_LIMIT_VIOLATION = 0x1_0000
    WATCHDOG_TIMER_EXPIRED = 0x100_0000
    ESTOP_REQUESTED = 0x200_0000
    SPINOUT_DETECTED = 0x400_0000
    BRAKE_RESISTOR_DISARMED = 0x800_0000
    THERMISTOR_DISCONNECTED = 0x1000_0000
    CALIBRATION_ERROR = 0x4000_0000


def pack(node: int, command: Command, *values: float | bytes) -> bytes:
    """Return a CANSimple frame as :data:`FRAME` lays it out."""
    data = LAYOUT[command].pack(*values)
    return FRAME.pack(node << NODE_SHIFT | command, len(data), data)
