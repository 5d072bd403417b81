"""LeRobot's SO-101 at a port, with a calibration of its own: calibrated, configured, read and moved.

    so_arm.py PORT CALIBRATION

CALIBRATION is the folder of its file, so101.json. LeRobot asks whether to write it to the servos: Enter does.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

_TARGET = 15.0
"""Of each joint [degrees], and of the gripper [% of its range]."""
_WITHIN = 4.0
"""The arm's weight bends it: LeRobot halves the P gain."""


def main() -> int:
    """Return 0 if the arm goes where LeRobot sends it."""
    port, folder = sys.argv[1:]
    robot = SO101Follower(SO101FollowerConfig(port=port, id="so101", calibration_dir=Path(folder)))
    robot.connect()
    print("calibrated:", robot.is_calibrated, "P gains:", robot.bus.sync_read("P_Coefficient"))
    at = robot.get_observation()
    print("at:", {name: round(value, 1) for name, value in at.items()})
    target = {name: _TARGET for name in robot.action_features}
    for step in range(100):
        goal = {name: value + (target[name] - value) * (step + 1) / 100 for name, value in at.items()}
        robot.send_action(goal)
        time.sleep(0.02)
    time.sleep(0.5)
    moved = robot.get_observation()
    print("after a move:", {name: round(value, 1) for name, value in moved.items()})
    off = max(abs(moved[name] - value) for name, value in target.items())
    print(f"off by at most {off:.1f}")
    robot.disconnect()
    print("torque:", "disconnected" if not robot.is_connected else "connected")
    return 0 if off < _WITHIN else 1


if __name__ == "__main__":
    sys.exit(main())
