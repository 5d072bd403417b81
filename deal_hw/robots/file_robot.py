"""Robots of users: what a robot.yaml, or the one inside a dataset, turns into.

With a section ``hardware`` it is a robot with a driver and an emulator, as the built-in ones. Nothing here
needs MuJoCo.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deal_hw.documentation import page
from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.robots.entry import API_VERSION, RobotEntry, WireEntry, load

if TYPE_CHECKING:
    from deal_hw.description import RobotDescription
    from deal_hw.sim.robots.robot_file import RobotFile

WIRE = "serial"
"""The wire of a servo bus: an adapter on a serial port."""
ROS2_PORTS: Final = {"dds": "127.0.0.1", "zenoh": "tcp/127.0.0.1:7447"}
"""The wires of a robot of ros2_control, and where its emulator is by default: on this machine only."""


def is_robot_file(robot: str, is_known: Callable[[str], bool]) -> bool:
    """Return whether a verb's robot is written as a file or a folder, and not as a name.

    Args:
        robot: What is written.
        is_known: Returns whether a robot of the table has a name. It is asked for a folder alone, since it
            may have to list all plug-ins, and no robot's name ends as a file's.
    """
    # An empty path would be the present folder.
    if not robot or Path(robot).suffix in (".yaml", ".yml"):
        return bool(robot)
    return Path(robot).is_dir() and not is_known(robot)


def robot_yaml(robot: str) -> Path:
    """Return a robot's robot.yaml: the named file, or the one inside a dataset."""
    path = Path(robot)
    if not path.is_dir():
        return path
    # Imported here: finding a robot's name loads no reader of recordings.
    from deal_hw.data.files import dataset_of

    return dataset_of(path) / "robot" / "robot.yaml"


def machine_of(robot: str) -> str:
    """Return one name for all spellings of a robot's file."""
    return str(robot_yaml(robot).resolve())


def has_hardware(robot: str) -> bool:
    """Return whether a robot.yaml names its bus; False for one that cannot be read, which its reader says."""
    try:
        return _read(robot_yaml(robot)).hardware is not None
    except DealHwError:
        return False


def has_servos(robot: str) -> bool:
    """Return whether a robot.yaml names a bus of servos; False for one that cannot be read."""
    try:
        return _read(robot_yaml(robot)).servo_bus is not None
    except DealHwError:
        return False


def file_entry(robot: str) -> RobotEntry:
    """Return the entry of a robot of a user.

    Raises:
        ConfigurationError: Its robot.yaml cannot be read.
    """
    path = robot_yaml(robot)
    file = _read(path)
    return RobotEntry(
        name=robot,
        api_version=API_VERSION,
        wires=_wires(path, file),
        recorded=lambda: driven_description(path, file),
        machine=machine_of(robot),
    )


def driven_description(path: Path, file: RobotFile) -> RobotDescription:
    """Return the description of a robot with hardware.

    Raises:
        ConfigurationError: Its MJCF does not exist, or robot.yaml lacks the MJCF's timestep.
    """
    mjcf = path.parent / file.mjcf
    if not mjcf.is_file():
        raise ConfigurationError(
            f"{path}: its model {file.mjcf} does not exist ({mjcf}); write its path at `mjcf`, relative to "
            "robot.yaml"
        )
    from deal_hw.sim.robots.file_description import file_description

    return file_description(file, mjcf)


def _read(path: Path) -> RobotFile:
    # Imported here: naming a robot of the table loads no YAML reader.
    from deal_hw.sim.robots.robot_file import read_robot_file

    return read_robot_file(path)


def no_driver(robot: str) -> str:
    """Return what to do with a robot.yaml that names no hardware."""
    how = page("reference/robot-file.md")
    return (
        f"{robot}: deal-hw has no driver for this robot. If its servos are on a bus, or ros2_control moves "
        f"it, write the section `hardware` into its robot.yaml ({how}); or record its simulation with "
        "--simulated, or import recordings of it: deal-hw data import"
    )


def _wires(path: Path, file: RobotFile) -> tuple[WireEntry, ...]:
    if file.ros2 is not None:
        return tuple(
            WireEntry(
                name=name,
                transport=name,
                driver=_of_file("deal_hw.robots.file_ros2:ros2_driver", path, file, name),
                opens_port=True,
                emulator=_of_file("deal_hw.robots.file_ros2:emulate_ros2", path, file),
                emulator_port=port,
                examine=_of_file("deal_hw.robots.file_ros2:examine_ros2", path, file, name),
            )
            for name, port in ROS2_PORTS.items()
        )
    if file.servo_bus is None:
        return ()
    return (
        WireEntry(
            name=WIRE,
            transport=WIRE,
            driver=_of_file("deal_hw.drivers.servo_arm.connect:servo_arm", path, file),
            opens_port=True,
            emulator=_of_file("deal_hw.robots.file_emulator:emulate_arm", path, file),
        ),
    )


def _of_file(reference: str, path: Path, file: RobotFile, *more: object) -> Callable[[], Any]:
    """Return a reference to a function that also gets the robot's file, its description, and more."""

    def made() -> Any:
        function = load(reference, f"robot {file.name!r}")
        return functools.partial(function, file, driven_description(path, file), *more)

    return made
