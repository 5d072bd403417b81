"""Robots of users: ``deal-hw robot new`` and ``check``, and the robot that a verb's argument names."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from deal_hw.data.files import dataset_of, write_bytes
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, DatasetError, MissingExtraError
from deal_hw.findings import Finding, Severity
from deal_hw.parameters import ParameterSpace
from deal_hw.ranges import Checked, Range
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
from deal_hw.workflows.options import File, from_settings
from deal_hw.workflows.say import html_table

if TYPE_CHECKING:
    from deal_hw.sim.robots.user_robot import UserRobot

_HEAD = ("", "what", "found", "do")


@dataclass(frozen=True, kw_only=True)
class NewRobotSettings(Checked):
    """Settings of :func:`new_robot`."""

    model: File = field(kw_only=False)
    """The robot's MJCF."""

    out: File | None = None
    """The file to write; by default robot.yaml beside the MJCF."""

    name: str = ""
    """The robot's name; by default the file name of the MJCF."""

    control_rate: Annotated[float, Range(0.001, 1e5, "Hz")] = 50.0
    """Commands per second [Hz]; an MJCF does not define it."""

    state_rate: Annotated[float | None, Range(0.001, 1e5, "Hz")] = None
    """State samples per second [Hz], a whole multiple of the control rate; by default the control rate."""

    feet: tuple[str, ...] = ()
    """Sphere geoms of the feet of a robot with a floating base."""

    several_trees: bool = False
    """Accept driven joints in several trees of bodies, such as two arms, as one robot."""


@dataclass(frozen=True, kw_only=True)
class CheckRobotSettings:
    """Settings of :func:`check_robot`."""

    robot: File = field(kw_only=False)
    """The robot.yaml."""


@dataclass(frozen=True, kw_only=True)
class RobotCheck:
    """What an examination of a robot.yaml found.

    Attributes:
        robot: The robot.
        findings: The findings.
    """

    robot: UserRobot
    findings: tuple[Finding, ...]

    @property
    def exit_code(self) -> int:
        """For the shell: 0, or 1 if a check failed."""
        return int(any(finding.severity is Severity.FAIL for finding in self.findings))

    def table(self) -> str:
        """Return one line per finding, as text."""
        return "\n".join(
            f"{level:<4} {area}: {'; '.join(filter(None, words))}" for level, area, *words in self._cells()
        )

    def _repr_html_(self) -> str:
        return html_table(_HEAD, self._cells())

    def _cells(self) -> list[tuple[str, ...]]:
        return [(f.severity.value, f.code, f.seen, f.do) for f in self.findings]


@from_settings(NewRobotSettings)
def new_robot(settings: NewRobotSettings) -> Path:
    """Write a robot.yaml from an MJCF, as ``deal-hw robot new``.

    :class:`NewRobotSettings` describes the arguments: ``new_robot("robot.xml", control_rate=100.0)``.

    Returns:
        The file.

    Raises:
        ConfigurationError: The MJCF cannot be used, the name is that of a robot of deal-hw, or the file
            exists.
    """
    user_robot = _sim()
    from deal_hw.sim.robots.robot_file import FILE_NAME, write_robot_file

    model = Path(settings.model)
    out = model.parent / FILE_NAME if settings.out is None else Path(settings.out)
    if out.exists():
        raise ConfigurationError(f"{out} exists; name another file with --out, or remove it")
    robot = user_robot.derive_robot(
        model,
        name=settings.name,
        control_rate_hz=settings.control_rate,
        state_rate_hz=settings.state_rate,
        feet=settings.feet,
        several_trees=settings.several_trees,
        mjcf_entry=os.path.relpath(model, out.parent),
    )
    _check_name(robot.file.name, "--name")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out, write_robot_file(robot.file).encode())
    return out


@from_settings(CheckRobotSettings)
def check_robot(settings: CheckRobotSettings) -> RobotCheck:
    """Compare a robot.yaml with its MJCF and simulate a second of holding, as ``deal-hw robot check``.

    The argument is the file: ``check_robot("robot.yaml")``.

    Returns:
        What was found.

    Raises:
        ConfigurationError: A file cannot be used, or the two contradict each other.
    """
    robot = load_robot(Path(settings.robot))
    return RobotCheck(robot=robot, findings=(*_agreement(robot), *_missing(robot), *_held(robot)))


def load_robot(path: Path) -> UserRobot:
    """Read a robot.yaml; errors as :func:`check_robot`."""
    robot: UserRobot = _sim().read_robot(path)
    _check_name(robot.file.name, f"{path}: name")
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
    found = _sim().read_robot(robot_yaml(robot))
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


def _sim() -> Any:
    try:
        from deal_hw.sim.robots import user_robot
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "sim") from err
    return user_robot


def _check_name(name: str, where: str) -> None:
    if is_ours(name):
        raise ConfigurationError(f"{where} {name!r} is the name of a robot of deal-hw; choose another name")


def _agreement(robot: UserRobot) -> list[Finding]:
    driven = sum(joint.actuator is not None for joint in robot.file.joints)
    base = "floating" if robot.file.floating_base else "fixed"
    message = (
        f"{len(robot.file.joints)} joints, {driven} of them driven, {base} base; robot.yaml and MJCF agree"
    )
    return [Finding(robot.mjcf.name, Severity.OK, message)]


def _missing(robot: UserRobot) -> list[Finding]:
    """Return the missing fields of robot.yaml, and the verbs that need them."""
    joints = robot.file.joints
    driven = [joint for joint in joints if joint.actuator is not None]
    rows = (
        (
            "position_range",
            [j.name for j in driven if j.position_range is None and robot.file.actuation == "position"],
            "collect and design-excitation need it, as the limit of position targets",
        ),
        (
            "velocity_limit",
            [j.name for j in driven if j.velocity_limit is None],
            "excitations may be too fast",
        ),
        (
            "effort_limit",
            [j.name for j in driven if j.actuator and j.actuator.effort_limit is None],
            "the simulated motor has no torque limit; give the MJCF a forcerange",
        ),
        (
            "sensor_noise",
            [j.name for j in joints if j.sensor_noise == 0],
            "collect --simulated is noise-free",
        ),
    )
    return [
        Finding(name, Severity.NOTE, f"missing for {', '.join(found)}", f"{why}")
        for name, found, why in rows
        if found
    ]


def _held(robot: UserRobot) -> list[Finding]:
    from deal_hw.sim.robots.holding import hold

    found = hold(robot)
    what = f"holding for {found.seconds:g} s"
    if found.diverged:
        return [
            Finding(what, Severity.FAIL, "the simulation diverges", "reduce timestep or gains of the MJCF")
        ]
    if found.unstable:
        return [
            Finding(
                what,
                Severity.FAIL,
                f"the speed of {', '.join(found.unstable)} keeps growing",
                "reduce stiffness, or raise damping or armature, in the MJCF and in robot.yaml",
            )
        ]
    names = robot.description().actuated
    worst = int(np.argmax(np.abs(found.sag)))
    unit = robot.file.joints[robot.joint_names.index(names[worst])].unit
    moved = "moved, without effort, by" if robot.file.actuation == "motor" else "is off by"
    message = f"stable; largest offset: {names[worst]} {moved} {found.sag[worst]:.3g} {unit}"
    return [Finding(what, Severity.OK, message)]
