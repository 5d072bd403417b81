"""LeRobot's calibration of an arm of Feetech servos, as the servos' section of a robot.yaml.

LeRobot writes one JSON object a robot: motor -> id, drive_mode, homing_offset, range_min, range_max. Ranges
are positions as the servo shows them, after its homing offset, which is in the servo's EEPROM. So the same
ticks are right for us only as long as the servos keep these offsets: ``deal-hw robot check --port`` compares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

from deal_hw.errors import ConfigurationError, UnknownNameError, shown
from deal_hw.reading import read_json
from deal_hw.schema import STRICT, refusal
from deal_hw.sim.robots.hardware_section import MOST_SERVOS, TICKS
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.workflows.own_robot.fitting import STS3215_RAD_S, MeasuredServo, with_servos

MOST_OFFSET: Final = 2047
"""Largest homing offset of a Feetech servo, in both directions [ticks]."""
BAUD_RATE: Final = 1_000_000
P_GAIN, D_GAIN = 16, 32
"""What LeRobot writes to the servos of an SO arm."""
CENTRE: Final = 2048
"""Zero of `--zero 2048`. LeRobot homes to 2047, Feetech's program to 2048; a tick is 0.09 degrees."""
MODEL: Final = "sts3215"
_ADVICE: Final = "`lerobot-calibrate` writes it"

Zero = Literal["middle", "2048"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LeRobotMotor:
    """One motor of the file.

    Attributes:
        id: The servo's id.
        drive_mode: 1 if LeRobot inverts the motor's normalised positions, else 0.
        homing_offset: The servo shows its position less this [ticks].
        range_min: Lowest position of the calibrated travel, as the servo shows it [ticks].
        range_max: Highest one [ticks].
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int

    def __post_init__(self) -> None:
        if not 0 <= self.id <= 252:
            raise refusal("id", self.id, "0 to 252")
        if self.drive_mode not in (0, 1):
            raise refusal("drive_mode", self.drive_mode, "0 or 1")
        if abs(self.homing_offset) > MOST_OFFSET:
            raise refusal(
                "homing_offset",
                self.homing_offset,
                f"-{MOST_OFFSET} to {MOST_OFFSET} of a Feetech servo; a Dynamixel arm is measured with "
                "`robot new --bus dynamixel --port PORT`",
            )
        if not 0 <= self.range_min < self.range_max < TICKS:
            raise ConfigurationError(
                f"range_min {self.range_min} and range_max {self.range_max} are no range within one turn, "
                f"0 to {TICKS - 1} ticks: calibrate this motor again with LeRobot"
            )

    @property
    def swept(self) -> bool:
        """Whether its range was measured: LeRobot writes a whole turn for a motor that it does not sweep."""
        return (self.range_min, self.range_max) != (0, TICKS - 1)


def read_calibration(path: Path) -> dict[str, LeRobotMotor]:
    """Read LeRobot's calibration file.

    Returns:
        The motors by name.

    Raises:
        ConfigurationError: It cannot be read, is no such file, or two motors have one id.
    """
    motors = read_json(
        path,
        dict[str, LeRobotMotor],
        "LeRobot's calibration (JSON: motor -> id, drive_mode, homing_offset, range_min, range_max)",
        _ADVICE,
        error=ConfigurationError,
    )
    if not 0 < len(motors) <= MOST_SERVOS:
        raise ConfigurationError(f"{path} has {len(motors)} motors; 1 to {MOST_SERVOS} fit on a bus")
    by_id: dict[int, list[str]] = {}
    for name, motor in motors.items():
        by_id.setdefault(motor.id, []).append(name)
    for number, names in by_id.items():
        if len(names) > 1:
            raise ConfigurationError(
                f"{path}: motors {', '.join(map(shown, names))} have the id {number}; give each servo an id "
                "of its own with `lerobot-setup-motors`, then calibrate again"
            )
    return motors


def parse_names(pairs: Sequence[str]) -> dict[str, str]:
    """Return motor -> joint of ``MOTOR=JOINT`` words.

    Raises:
        ConfigurationError: A word has another form, or a name comes twice.
    """
    found: dict[str, str] = {}
    for pair in pairs:
        motor, equals, joint = pair.partition("=")
        if not (motor and equals and joint) or motor in found or joint in found.values():
            raise ConfigurationError(
                f"--joint-names {shown(pair)}: write MOTOR=JOINT, each motor and each joint once"
            )
        found[motor] = joint
    return found


def with_calibration(
    file: RobotFile, motors: Mapping[str, LeRobotMotor], names: Mapping[str, str], zero: Zero, where: str
) -> RobotFile:
    """Return a robot with the servos of LeRobot's calibration.

    Args:
        file: The robot as its MJCF describes it.
        motors: The calibration.
        names: Motor -> joint where the names differ.
        zero: Where the MJCF's 0 is: "middle": where the middles of calibrated range and MJCF's range agree;
            "2048": where the servo shows 2048, the pose in which LeRobot homes.
        where: The calibration's file, for messages.

    Raises:
        ConfigurationError: It is the calibration of another arm.
    """
    for name in names:
        if name not in motors:
            raise UnknownNameError(f"motor of {where}", name, motors)
    by_joint = {names.get(name, name): name for name in motors}
    joints = [joint.name for joint in file.joints]
    absent = [name for name in joints if name not in by_joint]
    strange = [name for joint, name in by_joint.items() if joint not in joints]
    if absent or strange:
        parts = [f"the MJCF's joints {', '.join(absent)} have no motor" if absent else ""]
        parts += [f"the motors {', '.join(map(shown, strange))} are no joints of the MJCF" if strange else ""]
        raise ConfigurationError(
            f"{where}: {'; '.join(filter(None, parts))}. Where only the names differ, give them by "
            "--joint-names MOTOR=JOINT ...; otherwise it is the calibration of another arm: name the right "
            "file, or an MJCF of this arm"
        )
    measured = []
    for name in joints:
        motor = motors[by_joint[name]]
        measured.append(
            MeasuredServo(
                joint=name,
                id=motor.id,
                model=MODEL,
                direction=-1 if motor.drive_mode else 1,
                low=motor.range_min,
                high=motor.range_max,
                zero=None if zero == "middle" else CENTRE,
                velocity_limit=STS3215_RAD_S,
                p_gain=P_GAIN,
                d_gain=D_GAIN,
                measured=motor.swept,
            )
        )
    again = "calibrate it again with LeRobot"
    if zero != "middle":
        again += ", try --zero middle"
    try:
        return with_servos(file, measured, bus="feetech", baud_rate=BAUD_RATE, again=again)
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from error
