"""LeRobot's DynamixelMotorsBus at a port: handshake, calibration, half-turn homing, a move.

    half_turn_homing.py PORT

The calls are those of LeRobot's own robots (configure and calibrate), without their prompts.
"""

from __future__ import annotations

import sys
import time

from lerobot.motors import Motor, MotorNormMode
from lerobot.motors.dynamixel import DynamixelMotorsBus, OperatingMode

_WITHIN = 20


def main() -> int:
    """Return 0 if everything is as LeRobot expects it."""
    motor = Motor(1, "xl330-m077", MotorNormMode.RANGE_M100_100)
    bus = DynamixelMotorsBus(sys.argv[1], {"belt": motor})
    bus.connect()
    print("connected:", bus.is_connected, "ids and models:", bus.broadcast_ping())
    bus.disable_torque()
    bus.configure_motors()
    print("calibration:", bus.read_calibration())
    bus.write("Operating_Mode", "belt", OperatingMode.EXTENDED_POSITION.value)
    print("offsets:", bus.set_half_turn_homings())
    middle = bus.read("Present_Position", "belt", normalize=False)
    print("position after half-turn homing:", middle)
    bus.write("Position_D_Gain", "belt", 1000)
    bus.write("Goal_Position", "belt", 2400, normalize=False)
    bus.enable_torque()
    time.sleep(1.0)
    moved = bus.read("Present_Position", "belt", normalize=False)
    print("position after a move to 2400:", moved)
    print("moving:", bus.read("Moving", "belt", normalize=False))
    bus.disconnect()
    return 0 if abs(middle - 2047) <= 1 and abs(moved - 2400) <= _WITHIN else 1


if __name__ == "__main__":
    sys.exit(main())
