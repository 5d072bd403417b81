"""Robots of users: the robot that a verb's argument names, and what a dataset holds of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.data.files import dataset_of
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, DatasetError, MissingExtraError
from deal_hw.parameters import ParameterSpace
from deal_hw.robots import (
    API_VERSION,
    RobotEntry,
    driver_description,
    is_file,
    is_known,
    recorded_description,
    robot_entry,
)
from deal_hw.robots.file_robot import machine_of, robot_yaml
from deal_hw.workflows.options import File

if TYPE_CHECKING:
    from deal_hw.sim.robots.user_robot import UserRobot


def load_robot(path: Path) -> UserRobot:
    """Read a robot.yaml; errors as :func:`check_robot`."""
    robot: UserRobot = user_robots().read_robot(path)
    check_name(robot.file.name, f"{path}: name")
    return robot


def is_ours(name: str) -> bool:
    """Return whether a name is that of a robot of deal-hw."""
    return is_known(name)


def is_user_robot(robot: str) -> bool:
    """Return whether a verb's robot is a file or a folder, and not the name of a robot of deal-hw."""
    return is_file(robot)


def user_robot(robot: str) -> UserRobot:
    """Return the robot of a robot.yaml, or of a dataset with its own robot.yaml.

    Raises:
        ConfigurationError: It is neither, or cannot be used.
        DatasetError: The dataset's robot is missing or changed.
    """
    if not is_user_robot(robot):
        raise ConfigurationError(
            f"--simulated takes a robot.yaml (`deal-hw robot new robot.xml` writes one), not {robot!r}; "
            "for a robot of deal-hw start its emulator: deal-hw emulate"
        )
    if not Path(robot).is_dir():
        return load_robot(Path(robot))
    described(robot)
    return load_robot(dataset_of(robot) / "robot" / "robot.yaml")


def entry_of(robot: str) -> RobotEntry:
    """Return the entry of a robot: by its name from the table, or made of a robot.yaml or a dataset's robot.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It is a plug-in's that cannot be used.
    """
    if not is_user_robot(robot):
        return robot_entry(robot)
    return RobotEntry(
        name=robot,
        api_version=API_VERSION,
        description=lambda: _described_by_file(robot),
        spaces=lambda: {"default": lambda: default_space(_described_by_file(robot))},
    )


def name_of(robot: str) -> str:
    """Return the name that a robot's recordings carry: its own, where a robot.yaml describes it."""
    return driver_description(robot).name if is_user_robot(robot) else robot


def named(robot: str) -> str:
    """Return a robot's name for other processes: that of the table, or the whole path of its robot.yaml."""
    return machine_of(robot) if is_user_robot(robot) else robot


def described(robot: str) -> RobotDescription:
    """Return the description of a robot of deal-hw by its name, of a robot.yaml, or of a dataset's robot.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: The robot.yaml or its MJCF cannot be used.
        DatasetError: The dataset cannot be read, or its robot is missing or changed.
    """
    return entry_of(robot).recorded_description()


def described_spaces(robot: str) -> Mapping[str, Callable[[], ParameterSpace]]:
    """Return a robot's parameter sets by name, the default first; errors as :func:`described`."""
    return entry_of(robot).parameter_spaces()


def _described_by_file(robot: str) -> RobotDescription:
    if Path(robot).is_dir():
        from deal_hw.data.recording.dataset import Dataset

        folder = dataset_of(robot)
        return recorded_robot(Dataset.open(folder).description, folder)
    return load_robot(Path(robot)).description()


def keep_robot(robot: str, dataset: Path) -> None:
    """Copy a user's robot into a dataset, so that its recordings can be calibrated anywhere.

    Raises:
        MissingExtraError: MuJoCo is not installed, which finds the files of the MJCF.
        DatasetError: The dataset holds another robot, or cannot be written.
    """
    found = user_robots().read_robot(robot_yaml(robot))
    from deal_hw.sim.robots.dataset_robot import store_robot

    store_robot(found, dataset)


def default_space(description: RobotDescription) -> ParameterSpace:
    """Return the default parameters of a user's robot: friction, damping, armature and gains of the MJCF."""
    from deal_hw.sim.robots import simulated

    return simulated.default_space(description)


def carries_robot(dataset: File | None) -> bool:
    """Return whether a dataset contains a user's robot."""
    # The same as deal_hw.sim.robots.dataset_robot, which needs mujoco; this one also runs without it.
    return dataset is not None and (Path(dataset) / "robot" / "files.json").is_file()


def carried_problems(dataset: Path) -> list[str]:
    """Return the problems of a dataset's own robot; empty if the dataset has none."""
    if not carries_robot(dataset) or not (Path(dataset) / "dataset.json").is_file():
        return []
    from deal_hw.data.recording.dataset import Dataset

    try:
        recorded_robot(Dataset.open(Path(dataset), lambda text: None).description, Path(dataset))
    except DatasetError as error:
        return [str(error)]
    return []


def recorded_robot(values: Mapping[str, Any], dataset: Path) -> RobotDescription:
    """Return the recorded robot: the dataset's own one, or a robot of deal-hw.

    Args:
        values: The description in the dataset's index, or in an episode.
        dataset: The dataset's folder.

    Raises:
        DatasetError: The robot is not one of deal-hw, and the dataset's own one is missing or changed.
    """
    if not carries_robot(dataset) and is_ours(str(values["name"])):
        return recorded_description(str(values["name"]))
    try:
        from deal_hw.sim.robots.dataset_robot import stored_description
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "sim") from err
    return stored_description(dataset, values)


def user_robots() -> Any:
    """Return the module that reads robots of users.

    Raises:
        MissingExtraError: MuJoCo is not installed.
    """
    try:
        from deal_hw.sim.robots import user_robot
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "sim") from err
    return user_robot


def check_name(name: str, where: str) -> None:
    """Check that a user's robot has no name of deal-hw's.

    Raises:
        ConfigurationError: It has.
    """
    if is_ours(name):
        raise ConfigurationError(f"{where} {name!r} is the name of a robot of deal-hw; choose another name")
