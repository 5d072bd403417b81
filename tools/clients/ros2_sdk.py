"""zenoh-ros2-sdk reads the states of an emulated robot of ros2_control, and moves it.

    ros2_sdk.py END_POINT ROBOT PYTHON

END_POINT is tcp/HOST:PORT, ROBOT a robot.yaml of ros2_control with a position controller, PYTHON that of
deal-hw. While the SDK publishes commands, ``deal-hw collect`` must refuse the robot and name the SDK's node.
The SDK fetches definitions of messages from the internet; here they are written from those of rosbags.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.message_registry import get_message_class, get_registry

STATE, COMMAND = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
HELD = (
    "std_msgs/msg/Header",
    "builtin_interfaces/msg/Time",
    "std_msgs/msg/MultiArrayLayout",
    "std_msgs/msg/MultiArrayDimension",
)
NODE = "sdk_commander"
MOVE, WITHIN = 0.15, 0.1
"""How far each joint is sent, and how near it must come: the arm's weight bends it [rad]."""


def write_definitions(folder: Path) -> None:
    """Write the definitions of the two messages, and of those that they hold."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name in (STATE, COMMAND, *HELD):
        file = folder / f"{name}.msg"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(store.generate_msgdef(name, ros_version=2)[0].partition("=" * 80)[0])


def main() -> int:
    """Return 0 if the robot goes where the SDK sends it, and deal-hw refuses it meanwhile."""
    end_point, robot, python = sys.argv[1:]
    host, port = end_point.removeprefix("tcp/").rsplit(":", 1)
    hardware = yaml.safe_load(Path(robot).read_text())["hardware"]
    space = f"/{hardware['namespace']}" if hardware.get("namespace") else ""
    names = [hardware.get("names", {}).get(joint, joint) for joint in hardware["joints"]]
    place: dict[str, Any] = {"router_ip": host, "router_port": int(port), "domain_id": 0}
    seen: list[Any] = []
    with tempfile.TemporaryDirectory() as folder:
        write_definitions(Path(folder))
        get_registry(folder)
        states = ROS2Subscriber(f"{space}/joint_states", STATE, seen.append, **place)
        topic = f"{space}/{hardware['controller']}/commands"
        commands = ROS2Publisher(topic, COMMAND, node_name=NODE, **place)
    time.sleep(1.0)
    if not seen:
        print("no states in 1 s")
        return 1
    print(f"{len(seen)} states in 1 s, joints {', '.join(seen[-1].name)}")
    at = dict(zip(seen[-1].name, seen[-1].position, strict=True))
    targets = np.array([at[name] + MOVE for name in names])
    layout = get_message_class("std_msgs/msg/MultiArrayLayout")(dim=[], data_offset=0)

    def publish(seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            commands.publish(layout=layout, data=targets)
            time.sleep(0.02)

    publish(2.0)
    held = dict(zip(seen[-1].name, seen[-1].position, strict=True))
    off = max(abs(held[name] - target) for name, target in zip(names, targets, strict=True))
    line = ["collect", robot, "--transport", "zenoh", "--port", end_point, "--out", "refused"]
    with subprocess.Popen(
        [python, "-m", "deal_hw.cli.main", *line],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        while process.poll() is None:
            publish(0.2)
        assert process.stdout is not None
        said = process.stdout.read()
    print(said.strip())
    refused = process.returncode != 0 and NODE in said
    print(f"sent {MOVE} rad on, off by at most {off:.3f} rad; refused: {refused}")
    for one in (states, commands, commands.session_mgr):
        one.close()
    return 0 if off < WITHIN and refused else 1


if __name__ == "__main__":
    sys.exit(main())
