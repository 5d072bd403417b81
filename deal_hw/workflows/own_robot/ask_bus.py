"""``deal-hw robot new --bus``: finds an arm's servos, and measures each joint while a person turns it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

from deal_hw.drivers.servo_arm.survey import ServoFacts, Survey
from deal_hw.errors import (
    ConfigurationError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.sim.robots.hardware_section import TICKS
from deal_hw.sim.robots.positive import positive_directions
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.sim.robots.travel import middle_zero
from deal_hw.sim.robots.user_robot import UserRobot
from deal_hw.workflows.own_robot.by_hand import Hands, Turned
from deal_hw.workflows.own_robot.dialogue import Dialogue
from deal_hw.workflows.own_robot.fitting import STS3215_RAD_S, MeasuredServo, with_servos

_AGAIN: Final = "turn it from one end to the other again"


def ask_bus(
    robot: UserRobot,
    survey: Survey,
    dialogue: Dialogue,
    *,
    bus: Literal["feetech", "dynamixel"],
    baud_rate: int,
) -> RobotFile:
    """Return a robot with the servos that were found and measured.

    Args:
        robot: The robot as its MJCF describes it.
        survey: The bus, open.
        dialogue: Asks the person at the arm.
        bus: Its kind.
        baud_rate: Its rate [bit/s].

    Raises:
        ConfigurationError: The MJCF is no arm of servos, it stayed unclear which servo is which joint's, or a
            joint's travel is not that of the MJCF.
        TransportTimeoutError: Servos are silent, or fewer than there are joints.
        WrongDeviceError: A servo's model is unknown.
        VersionMismatchError: A servo's firmware is too old.
    """
    _check_arm(robot.file)
    servos = _found(robot.file, survey, baud_rate)
    listed = "; ".join(_listed(one) for one in servos.values())
    dialogue.say(f"{len(servos)} servos answer: {listed}")
    hands = Hands(survey, list(servos), dialogue)
    hands.free()
    directions = positive_directions(robot)
    turned: dict[str, Turned] = {}
    for joint in robot.file.joints:
        taken = [(one.servo, name) for name, one in turned.items()]
        found = hands.turn(joint.name, directions(joint.name), taken)
        if found.low < 0 or found.high >= TICKS:
            raise ConfigurationError(
                f"joint {joint.name}: servo {found.servo} went over the end of its {TICKS} ticks "
                f"({found.low} to {found.high}). Turn its horn, or set its homing offset so that the middle "
                f"of the travel is {TICKS // 2} (with {survey.family.tool}, or LeRobot's calibration), then "
                "begin again"
            )
        turned[joint.name] = found
        side = "falls" if found.direction < 0 else "grows"
        dialogue.say(
            f"{joint.name} is servo {found.servo}: {found.low} to {found.high} ticks, which {side} towards "
            "its positive end"
        )
    zeros = _zeros(robot.file, turned, hands, dialogue)
    measured = [_measured(name, one, servos[one.servo], zeros[name]) for name, one in turned.items()]
    return with_servos(robot.file, measured, bus=bus, baud_rate=baud_rate, again=_AGAIN)


def _check_arm(file: RobotFile) -> None:
    """Refuse before anybody turns a joint what no servo can drive."""
    if file.actuation != "position":
        raise ConfigurationError(
            "the MJCF's actuators are motors; servos on a bus take positions: use position actuators"
        )
    if file.floating_base is not None:
        raise ConfigurationError("the MJCF's base floats; an arm on a servo bus has a fixed base")
    for joint in file.joints:
        if joint.unit != "rad" or joint.actuator is None or joint.position_range is None:
            raise ConfigurationError(
                f"joint {joint.name} of the MJCF must be a hinge with a range and a position actuator"
            )


def _found(file: RobotFile, survey: Survey, baud_rate: int) -> dict[int, ServoFacts]:
    answers = survey.find()
    if not answers:
        raise TransportTimeoutError(
            f"{survey.where}: no servo answers at {baud_rate} baud; check the servos' supply, the adapter's "
            "cable, the port, and --baud-rate"
        )
    if len(answers) < len(file.joints):
        raise TransportTimeoutError(
            f"{survey.where}: {len(answers)} servos answer ({', '.join(map(str, answers))}), the MJCF has "
            f"{len(file.joints)} joints. Check the cables between the servos; of servos with one id only one "
            "counts: connect them one by one, and give each an id of its own"
        )
    found = {}
    for servo, answer in answers.items():
        if problem := survey.family.unknown_model(answer.model):
            raise WrongDeviceError(f"{survey.where}: servo {servo} {problem}")
        if problem := survey.family.version_problem(survey.bus, servo, answer):
            raise VersionMismatchError(f"{survey.where}: servo {servo} {problem}")
        facts = found[servo] = survey.facts(servo, answer)
        # Its own limits are compared when its range is known.
        survey.family.check(survey.bus, servo, facts.least, facts.most)
    return found


def _listed(one: ServoFacts) -> str:
    return f"{one.id} ({one.model}, {one.volts:.1f} V, {one.celsius} °C)"


def _zeros(file: RobotFile, turned: Mapping[str, Turned], hands: Hands, dialogue: Dialogue) -> dict[str, int]:
    answer = dialogue.ask(
        "\nWhere is each joint's 0? m: the middle of its travel is the middle of its range in the MJCF; p: "
        "you put the arm into the pose where all joints of the MJCF are 0.",
        ("p", "m"),
    )
    if answer == "p":
        ticks = hands.pose("Put the arm into the pose where all joints of the MJCF are 0, and hold it there.")
        return {name: ticks[one.servo] for name, one in turned.items()}
    ranges = {joint.name: joint.position_range for joint in file.joints}
    return {
        name: middle_zero(one.low, one.high, one.direction, ranges[name] or (0.0, 0.0))
        for name, one in turned.items()
    }


def _measured(joint: str, turned: Turned, servo: ServoFacts, zero: int) -> MeasuredServo:
    low, high = turned.low, turned.high
    if servo.least < servo.most:
        # Beyond its own limits it would not go.
        low, high = max(low, servo.least), min(high, servo.most)
    limit = servo.velocity_limit
    return MeasuredServo(
        joint=joint,
        id=servo.id,
        model=servo.model,
        direction=turned.direction,
        low=low,
        high=high,
        zero=zero,
        velocity_limit=STS3215_RAD_S if limit is None else round(limit, 2),
        p_gain=max(servo.gains.p, 1),
        d_gain=servo.gains.d,
    )
