"""``deal-hw robot check``: compares a robot.yaml with its MJCF, its simulation, and the servos on its bus."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.findings import Finding, Severity
from deal_hw.workflows.kinds import InputKind, Kinds
from deal_hw.workflows.options import FROM_PYTHON, File, from_settings
from deal_hw.workflows.own_robot.dialogue import Dialogue, required
from deal_hw.workflows.robot import load_robot
from deal_hw.workflows.say import html_table

if TYPE_CHECKING:
    from deal_hw.sim.robots.user_robot import UserRobot

_HEAD = ("", "what", "found", "do")


@dataclass(frozen=True, kw_only=True)
class CheckRobotSettings:
    """Compare a robot.yaml with its MJCF, list what is missing, and simulate a second of holding."""

    robot: File = field(kw_only=False)
    """The robot.yaml."""


@dataclass(frozen=True, kw_only=True)
class CheckBusSettings(CheckRobotSettings):
    """Compare a robot.yaml with its MJCF and with the servos on its bus; change nothing on them."""

    port: str
    """The serial port of the servos' adapter, such as /dev/ttyACM0."""

    lerobot: File | None = None
    """LeRobot's calibration file of this arm, to compare with what the servos have."""

    by_hand: bool = False
    """You turn each joint by hand, and so its servo, direction and zero are compared. It asks before it
    switches the torque off: the arm falls."""

    dialogue: Annotated[Dialogue | None, FROM_PYTHON] = None
    """From Python: who is asked and turns the joints; None: the person at the terminal."""


CHECK_ROBOT = Kinds(
    noun="check",
    argument="robot",
    table=lambda: {
        "file": InputKind(CheckRobotSettings, example="check robot.yaml"),
        "port": InputKind(
            CheckBusSettings, usage="check --port", example="check robot.yaml --port /dev/ttyACM0"
        ),
    },
    find=lambda arguments: "port" if "port" in arguments.options else "file",
)
"""The kinds of :func:`check_robot`: the file alone, or with its servos."""


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


@from_settings(CHECK_ROBOT)
def check_robot(settings: CheckRobotSettings | CheckBusSettings) -> RobotCheck:
    """Compare a robot.yaml with its MJCF and simulate a second of holding, as ``deal-hw robot check``.

    The argument is the file: ``check_robot("robot.yaml")``. With ``port`` (:class:`CheckBusSettings`) it is
    compared with its servos, too.

    Returns:
        What was found.

    Raises:
        ConfigurationError: A file cannot be used, or the two contradict each other.
    """
    robot = load_robot(Path(settings.robot))
    findings = [*_agreement(robot), *_missing(robot), *_held(robot)]
    if isinstance(settings, CheckBusSettings):
        findings += _on_bus(robot, settings)
    return RobotCheck(robot=robot, findings=tuple(findings))


def _on_bus(robot: UserRobot, settings: CheckBusSettings) -> list[Finding]:
    """Return what the servos on a port have to say."""
    from deal_hw.workflows.own_robot import link
    from deal_hw.workflows.own_robot.compare import bus_findings, hardware_of
    from deal_hw.workflows.own_robot.lerobot import read_calibration

    section = hardware_of(robot)
    motors = None if settings.lerobot is None else read_calibration(Path(settings.lerobot))
    if motors is not None and section.bus != "feetech":
        raise ConfigurationError(
            f"--lerobot: LeRobot's file is compared with Feetech servos, and the bus is {section.bus}; leave "
            "it out"
        )
    dialogue = settings.dialogue
    if settings.by_hand:
        dialogue = required(dialogue, "robot check --by-hand")
    with link.open_bus(section.bus, settings.port, section.baud_rate) as survey:
        return list(bus_findings(robot, survey, motors, dialogue))


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

    if not robot.description().actuated:
        use = "its recordings can be imported and calibrated; collect, replay and train need actuators"
        return [Finding("actuators", Severity.NOTE, "no joint has one", use)]
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
