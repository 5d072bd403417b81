"""The column map of a bag of a robot that ros2_control drives: its robot.yaml says which topic is what."""

from __future__ import annotations

from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.columns import ColumnMap, JointColumns, TimeColumn
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.sim.robots.ros2_section import Ros2Section


def columns_of_robot(file: RobotFile, section: Ros2Section, channels: Channels) -> ColumnMap | None:
    """Return the column map; None for a file that lacks the robot's topics, whose map is guessed.

    Times are the recorder's: a Float64MultiArray has no stamp, and that of a trajectory is when it begins.

    Args:
        file: The robot.
        section: Its topics, and the order of the joints in its commands.
        channels: A file's channels.
    """
    state, command = f"/{section.state_topic}", f"/{section.command_topic}"
    position = f"{state}.position"
    target = f"{command}.{'data' if section.command == 'position' else 'points.positions'}"
    if not channels.is_wide(position) or target not in channels.arrays:
        return None
    order = list(section.joints)
    by_order = section.command == "position"
    joints = tuple(
        JointColumns(
            name=joint.name,
            column=section.ros_name(joint.name),
            target=f"{target}[{order.index(joint.name)}]" if by_order and joint.name in order else None,
            unit=joint.unit,
        )
        for joint in file.joints
    )

    def reported(name: str) -> str | None:
        values = channels.arrays.get(f"{state}.{name}")
        alike = values is not None and values.shape == channels.arrays[position].shape
        return f"{state}.{name}" if alike else None

    return ColumnMap(
        time=TimeColumn(column=f"{state}.log_time"),
        command_time=TimeColumn(column=f"{command}.log_time"),
        position=position,
        target=None if by_order else target,
        joints=joints,
        velocity=reported("velocity"),
        effort=reported("effort"),
        source=("robot.yaml",),
    )
