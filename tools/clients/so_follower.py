"""LeRobot's whole SO101Follower at a port, without cameras: connect, configure, observe, act, disconnect.

    so_follower.py PORT FOLDER

FOLDER holds so101.json, LeRobot's calibration of the arm at PORT. The arm keeps the same calibration in its
servos, so LeRobot does not ask for a new one.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

_TARGET, _GRIPPER = 10.0, 40.0
"""Of each joint [degrees], and of the gripper [% of its range]."""
_WITHIN = 8.0
"""The arm's weight bends it: at LeRobot's P gain of 16 a joint sags by some degrees."""


def main() -> int:
    """Return 0 if the arm goes where LeRobot sends it."""
    port, folder = sys.argv[1:]
    robot = SO101Follower(SO101FollowerConfig(port=port, id="so101", calibration_dir=Path(folder)))
    robot.connect(calibrate=False)
    print("calibrated:", robot.is_calibrated)
    at = robot.get_observation()
    print("at:", {name: round(value, 1) for name, value in at.items()})
    target = {name: _GRIPPER if name == "gripper.pos" else _TARGET for name in at}
    for step in range(150):
        share = (step + 1) / 150
        robot.send_action({name: value + (target[name] - value) * share for name, value in at.items()})
        time.sleep(0.02)
    time.sleep(0.5)
    moved = robot.get_observation()
    print("after a move:", {name: round(value, 1) for name, value in moved.items()})
    off = max(abs(value - target[name]) for name, value in moved.items())
    print(f"off by at most {off:.1f}")
    robot.disconnect()
    print("connected:", robot.is_connected)
    return 0 if off < _WITHIN else 1


if __name__ == "__main__":
    sys.exit(main())
