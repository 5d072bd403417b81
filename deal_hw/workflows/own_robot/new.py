"""``deal-hw robot new``: writes a robot.yaml from an MJCF, alone or with what knows the arm's servos."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from deal_hw.data.files import write_bytes
from deal_hw.errors import ConfigurationError
from deal_hw.ranges import Checked, Range
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds
from deal_hw.workflows.options import FROM_PYTHON, File, from_settings
from deal_hw.workflows.own_robot.dialogue import Dialogue, required
from deal_hw.workflows.robot import check_name, user_robots

if TYPE_CHECKING:
    from deal_hw.sim.robots.robot_file import RobotFile
    from deal_hw.sim.robots.user_robot import UserRobot


@dataclass(frozen=True, kw_only=True)
class _NewSettings(Checked):
    """What every robot.yaml begins with: an MJCF."""

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

    several_trees: bool = False
    """Accept driven joints in several trees of bodies, such as two arms, as one robot."""


@dataclass(frozen=True, kw_only=True)
class NewRobotSettings(_NewSettings):
    """Write a robot.yaml from an MJCF: joints, units, gains, ranges, effort limits."""

    feet: tuple[str, ...] = ()
    """Sphere geoms of the feet of a robot with a floating base."""


@dataclass(frozen=True, kw_only=True)
class NewFromLeRobotSettings(_NewSettings):
    """Write a robot.yaml from an MJCF and LeRobot's calibration of its Feetech servos."""

    lerobot: File
    """LeRobot's calibration file of this arm (JSON). It gives the section `hardware`: ids, zeros, ranges."""

    joint_names: tuple[str, ...] = ()
    """MOTOR=JOINT for each motor whose name is not that of its joint in the MJCF."""

    zero: Literal["middle", "2048"] = "middle"
    """Where the MJCF's 0 is. middle: the middle of the calibrated range is the middle of the MJCF's range;
    2048: the pose in which the servos show 2048, where LeRobot homed the arm."""


@dataclass(frozen=True, kw_only=True)
class NewFromBusSettings(_NewSettings):
    """Write a robot.yaml from an MJCF and the servos on a bus, while you turn each joint by hand.

    It asks before it switches the torque off: the arm falls.
    """

    bus: Literal["feetech", "dynamixel"]
    """The servos: feetech (STS and SMS series) or dynamixel (X series)."""

    port: str
    """The serial port of their adapter, such as /dev/ttyACM0."""

    baud_rate: Annotated[int, Range(9600, 4_500_000, "bit/s")] = 1_000_000
    """Rate of the bus [bit/s]."""

    dialogue: Annotated[Dialogue | None, FROM_PYTHON] = None
    """From Python: who is asked and turns the joints; None: the person at the terminal."""


def _source(arguments: Arguments) -> str:
    """Return the kind of what a robot.yaml is made from."""
    return next((name for name in ("lerobot", "bus") if name in arguments.options), "mjcf")


NEW_ROBOT = Kinds(
    noun="source",
    argument="model",
    table=lambda: {
        "mjcf": InputKind(NewRobotSettings, example="new robot.xml"),
        "lerobot": InputKind(
            NewFromLeRobotSettings,
            usage="new --lerobot",
            example="new arm.xml --lerobot calibration.json",
        ),
        "bus": InputKind(
            NewFromBusSettings, usage="new --bus", example="new arm.xml --bus feetech --port /dev/ttyACM0"
        ),
    },
    find=_source,
)
"""The kinds of :func:`new_robot`: an MJCF alone, or with what knows its servos."""


@from_settings(NEW_ROBOT)
def new_robot(settings: NewRobotSettings | NewFromLeRobotSettings | NewFromBusSettings) -> Path:
    """Write a robot.yaml from an MJCF, as ``deal-hw robot new``.

    From a URDF, which holds no drives, it writes an MJCF with servos to start from first.

    :class:`NewRobotSettings` describes the arguments: ``new_robot("robot.xml", control_rate=100.0)``. With
    ``lerobot`` (:class:`NewFromLeRobotSettings`) or ``bus`` (:class:`NewFromBusSettings`) it has the arm's
    servos.

    Returns:
        The file.

    Raises:
        ConfigurationError: The MJCF cannot be used, the name is that of a robot of deal-hw, the file exists,
            or the servos are not those of this arm.
    """
    user_robot = user_robots()
    from deal_hw.sim.mjcf import urdf
    from deal_hw.sim.robots.robot_file import FILE_NAME, write_robot_file

    model = Path(settings.model)
    out = model.parent / FILE_NAME if settings.out is None else Path(settings.out)
    if out.exists():
        raise ConfigurationError(f"{out} exists; name another file with --out, or remove it")
    if urdf.is_urdf(model):
        drives = out.parent / f"{model.stem}.xml"
        out.parent.mkdir(parents=True, exist_ok=True)
        urdf.write_with_drives(model, drives)
        model = drives
    robot = user_robot.derive_robot(
        model,
        name=settings.name,
        control_rate_hz=settings.control_rate,
        state_rate_hz=settings.state_rate,
        feet=settings.feet if isinstance(settings, NewRobotSettings) else (),
        several_trees=settings.several_trees,
        mjcf_entry=os.path.relpath(model, out.parent),
    )
    check_name(robot.file.name, "--name")
    file = _with_servos(robot, settings)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out, write_robot_file(file).encode())
    return out


def _with_servos(
    robot: UserRobot, settings: NewRobotSettings | NewFromLeRobotSettings | NewFromBusSettings
) -> RobotFile:
    """Return the robot with the servos that a source knows."""
    if isinstance(settings, NewRobotSettings):
        return robot.file
    if isinstance(settings, NewFromBusSettings):
        from deal_hw.workflows.own_robot import link
        from deal_hw.workflows.own_robot.ask_bus import ask_bus

        dialogue = required(settings.dialogue, "robot new --bus")
        rate = settings.baud_rate
        with link.open_bus(settings.bus, settings.port, rate) as survey:
            return ask_bus(robot, survey, dialogue, bus=settings.bus, baud_rate=rate)
    from deal_hw.workflows.own_robot import lerobot

    names = lerobot.parse_names(settings.joint_names)
    motors = lerobot.read_calibration(Path(settings.lerobot))
    return lerobot.with_calibration(robot.file, motors, names, settings.zero, str(settings.lerobot))
