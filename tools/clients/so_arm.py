"""LeRobot's FeetechMotorsBus at a port: an SO-101 is calibrated, configured, read and moved.

    so_arm.py PORT CALIBRATION

CALIBRATION is the file of LeRobot. The calls are those of its SO-101 (connect, configure, get_observation,
send_action), without cameras.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus, OperatingMode

_TARGET, _GRIPPER = 15.0, 50.0
"""Of each joint [degrees], and of the gripper [% of its range]."""
_WITHIN = 4.0
"""The arm's weight bends it: LeRobot halves the P gain."""


def main() -> int:
    """Return 0 if the arm goes where LeRobot sends it."""
    port, file = sys.argv[1:]
    values = json.loads(Path(file).read_text())
    calibration = {name: MotorCalibration(**one) for name, one in values.items()}
    modes = {name: MotorNormMode.DEGREES for name in values} | {"gripper": MotorNormMode.RANGE_0_100}
    motors = {name: Motor(one.id, "sts3215", modes[name]) for name, one in calibration.items()}
    bus = FeetechMotorsBus(port, motors, calibration)
    bus.connect()
    bus.write_calibration(calibration)
    with bus.torque_disabled():
        bus.configure_motors()
        for name in motors:
            bus.write("Operating_Mode", name, OperatingMode.POSITION.value)
            bus.write("P_Coefficient", name, 16)
            bus.write("I_Coefficient", name, 0)
            bus.write("D_Coefficient", name, 32)
    print("calibrated:", bus.is_calibrated, "P gains:", bus.sync_read("P_Coefficient", normalize=False))
    at = bus.sync_read("Present_Position")
    print("at:", {name: round(value, 1) for name, value in at.items()})
    target = {name: _GRIPPER if name == "gripper" else _TARGET for name in at}
    for step in range(100):
        goal = {name: value + (target[name] - value) * (step + 1) / 100 for name, value in at.items()}
        bus.sync_write("Goal_Position", goal)
        time.sleep(0.02)
    time.sleep(0.5)
    moved = bus.sync_read("Present_Position")
    print("after a move:", {name: round(value, 1) for name, value in moved.items()})
    off = max(abs(value - target[name]) for name, value in moved.items())
    print(f"off by at most {off:.1f}")
    bus.disconnect()
    print("connected:", bus.is_connected)
    return 0 if off < _WITHIN else 1


if __name__ == "__main__":
    sys.exit(main())
