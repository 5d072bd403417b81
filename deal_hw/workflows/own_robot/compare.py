"""``deal-hw robot check --port``: compares robot.yaml with the servos on its bus, and changes nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from deal_hw.drivers.servo_arm.families import ON, ServoSample
from deal_hw.drivers.servo_arm.survey import ServoFacts, Survey
from deal_hw.drivers.servo_bus.interface import Answer
from deal_hw.errors import ConfigurationError, DealHwError, FrameError, TransportTimeoutError
from deal_hw.findings import Finding, Severity
from deal_hw.sim.robots.hardware_section import RAD, HardwareSection, ServoEntry
from deal_hw.sim.robots.positive import positive_directions
from deal_hw.sim.robots.robot_file import JointEntry
from deal_hw.sim.robots.travel import angles
from deal_hw.sim.robots.user_robot import UserRobot
from deal_hw.workflows.own_robot.by_hand import Hands
from deal_hw.workflows.own_robot.dialogue import Dialogue
from deal_hw.workflows.own_robot.lerobot import LeRobotMotor

_ROUNDS: Final = 100
_MOST_SHARE: Final = 0.5
"""Share of a state's period that an answer may take; the rest is for the command and for delays."""
_MOST_LOST: Final = 0.02
_NEAR_CELSIUS: Final = 10
_SLACK_RAD: Final = 0.1
"""An end of a range may lie this much beyond the joint's end by hand; then its zero is wrong [rad]."""


def bus_findings(
    robot: UserRobot,
    survey: Survey,
    motors: Mapping[str, LeRobotMotor] | None = None,
    dialogue: Dialogue | None = None,
) -> Iterator[Finding]:
    """Yield what a bus has to say about a robot.yaml.

    Args:
        robot: The robot, with its section ``hardware``.
        survey: The bus, open.
        motors: LeRobot's calibration of the arm, to compare with the servos.
        dialogue: Asks a person to turn each joint; None: directions and zeros are not checked.

    Raises:
        ConfigurationError: robot.yaml has no such section, or the person wants the torque to stay on.
        TransportTimeoutError: The servos fell silent.
    """
    section = hardware_of(robot)
    answers = survey.find()
    for servo in section.servos:
        if servo.id not in answers:
            # A broadcast's answers may be lost; a servo is absent after a question of its own.
            try:
                answers[servo.id] = survey.bus.ping(servo.id)
            except (TransportTimeoutError, FrameError):
                continue
    yield from _present(section, answers, survey)
    present = [servo for servo in section.servos if servo.id in answers]
    for servo in present:
        yield from _servo(robot, servo, answers[servo.id], survey, motors)
    if len(present) < len(section.servos):
        return
    yield _cycle(robot, section, survey)
    if dialogue is not None:
        yield from _by_hand(robot, section, survey, dialogue)


def hardware_of(robot: UserRobot) -> HardwareSection:
    """Return the section ``hardware`` of a robot.

    Raises:
        ConfigurationError: It has no servos.
    """
    if robot.file.ros2 is not None:
        raise ConfigurationError(
            f"robot {robot.file.name!r} is driven by ros2_control, and has no bus of servos to compare; "
            "`deal-hw doctor robot.yaml --port PORT` listens to its topics"
        )
    if robot.file.servo_bus is None:
        raise ConfigurationError(
            f"robot {robot.file.name!r} has no section `hardware` to compare with a port; `deal-hw robot new "
            "arm.xml --bus feetech --port PORT` writes it"
        )
    return robot.file.servo_bus


def _present(section: HardwareSection, answers: Mapping[int, Answer], survey: Survey) -> Iterator[Finding]:
    missing = [f"{one.id} ({one.joint})" for one in section.servos if one.id not in answers]
    known = {one.id for one in section.servos}
    extra = [f"{i} ({survey.family.model_name(one.model)})" for i, one in answers.items() if i not in known]
    if missing:
        there = ", ".join(map(str, answers)) or "none"
        yield Finding(
            "servos",
            Severity.FAIL,
            f"{', '.join(missing)} at {section.baud_rate} baud on {survey.where} without an answer; these "
            f"answer: {there}",
            "check supply, cables, ids and baud_rate; of two servos with one id neither may be readable",
        )
    if extra:
        yield Finding("servos", Severity.WARN, f"{', '.join(extra)} not in robot.yaml", "add or remove them")
    if not missing and not extra:
        yield Finding("servos", Severity.OK, f"all {len(known)} answer on {survey.where}, and no other")
    firmware = {one.firmware for i, one in answers.items() if i in known}
    if len(firmware) > 1:
        shown = ", ".join(map(str, sorted(firmware)))
        yield Finding(
            "servos", Severity.WARN, f"firmware differs: {shown}", f"update all with {survey.family.tool}"
        )


def _servo(
    robot: UserRobot,
    servo: ServoEntry,
    answer: Answer,
    survey: Survey,
    motors: Mapping[str, LeRobotMotor] | None,
) -> Iterator[Finding]:
    code = f"servo {servo.id} ({servo.joint})"
    joint = next(one for one in robot.file.joints if one.name == servo.joint)
    try:
        facts = survey.facts(servo.id, answer)
        sample = survey.samples([servo.id])[servo.id]
    except TransportTimeoutError as error:
        yield Finding(code, Severity.FAIL, str(error))
        return
    found = list(_problems(code, robot, servo, joint, answer, facts, sample, survey))
    if motors is not None:
        found += _of_lerobot(code, servo, facts, motors)
    yield from found
    if all(one.severity is Severity.NOTE for one in found):
        at = servo.position(sample.ticks)
        seen = (
            f"{facts.model}, at {sample.ticks} ticks = {at:.3f} rad, limits {facts.least} to {facts.most}, "
            f"homing offset {facts.offset}, {facts.volts:.1f} V, {facts.celsius} °C, "
            f"torque {'on' if sample.torque == ON else 'off'}"
        )
        yield Finding(code, Severity.OK, seen)


def _problems(
    code: str,
    robot: UserRobot,
    servo: ServoEntry,
    joint: JointEntry,
    answer: Answer,
    facts: ServoFacts,
    sample: ServoSample,
    survey: Survey,
) -> Iterator[Finding]:
    def fail(seen: str, do: str = "") -> Finding:
        return Finding(code, Severity.FAIL, seen, do)

    if answer.model not in survey.family.models:
        yield fail(f"{facts.model}, which deal-hw does not know as {survey.family.name}", "use another servo")
    elif servo.model and servo.model.lower() != facts.model:
        yield fail(f"a {facts.model}, robot.yaml says {servo.model}", "correct id or model in robot.yaml")
    if problem := survey.family.version_problem(survey.bus, servo.id, answer):
        yield fail(problem)
    low, high = joint.position_range or (0.0, 0.0)
    try:
        ends = sorted((servo.ticks(low), servo.ticks(high)))
        survey.family.check(survey.bus, servo.id, ends[0], ends[1])
    except DealHwError as error:
        yield fail(str(error))
    if sample.fault:
        yield fail(f"reports {sample.fault}")
    at = servo.position(sample.ticks)
    limits = robot.description().limits.trip_position[robot.joint_names.index(joint.name)]
    if not limits[0] <= at <= limits[1]:
        yield fail(
            f"is at {at:.2f} rad, far outside its position_range {low:.2f} to {high:.2f}",
            "move it by hand (without torque: deal-hw stop); if it stands inside, its zero or direction in "
            "robot.yaml is wrong: --by-hand",
        )
    elif not low - RAD <= at <= high + RAD:
        yield Finding(
            code,
            Severity.NOTE,
            f"is at {at:.2f} rad, outside its position_range {low:.2f} to {high:.2f}",
            "a run first moves it inside, slowly",
        )
    if facts.celsius > facts.most_celsius - _NEAR_CELSIUS:
        seen = f"{facts.celsius} °C; it switches off above {facts.most_celsius} °C"
        yield Finding(code, Severity.WARN, seen, "let it cool")
    if not facts.volt_range[0] <= facts.volts <= facts.volt_range[1]:
        allowed = f"{facts.volt_range[0]:.1f} to {facts.volt_range[1]:.1f}"
        yield fail(f"{facts.volts:.1f} V; it allows {allowed} V", "use the supply for this servo")


def _of_lerobot(
    code: str, servo: ServoEntry, facts: ServoFacts, motors: Mapping[str, LeRobotMotor]
) -> Iterator[Finding]:
    motor = next((one for one in motors.values() if one.id == servo.id), None)
    if motor is None:
        yield Finding(
            code,
            Severity.FAIL,
            "LeRobot's calibration has no motor of this id",
            "name this arm's calibration",
        )
        return
    if facts.offset != motor.homing_offset:
        yield Finding(
            code,
            Severity.FAIL,
            f"homing offset {facts.offset}, LeRobot's calibration says {motor.homing_offset}: it counts from "
            f"elsewhere, by {(facts.offset - motor.homing_offset) * RAD:.2f} rad",
            "it was homed again, replaced, or is another arm's: calibrate with LeRobot, and write robot.yaml "
            "anew",
        )
    if (facts.least, facts.most) != (motor.range_min, motor.range_max):
        yield Finding(
            code,
            Severity.WARN,
            f"limits {facts.least} to {facts.most}, LeRobot's calibration says {motor.range_min} to "
            f"{motor.range_max}",
            "if it is this arm's, LeRobot writes them when it connects",
        )


def _cycle(robot: UserRobot, section: HardwareSection, survey: Survey) -> Finding:
    ids = [servo.id for servo in section.servos]
    times = survey.round_trips_s(ids, _ROUNDS)
    lost, period_ms = _ROUNDS - len(times), 1e3 / robot.file.state_rate_hz
    wire_ms = 1e3 * survey.family.cycle_s(survey.bus, len(ids), section.baud_rate)
    if not times:
        return Finding("cycle", Severity.FAIL, f"no answer of all servos in {_ROUNDS}", "look for noise")
    median_ms, late_ms = 1e3 * times[len(times) // 2], 1e3 * times[len(times) * 99 // 100]
    seen = (
        f"all servos answer after {median_ms:.1f} ms (median) and {late_ms:.1f} ms (99 %), {lost} of "
        f"{_ROUNDS} lost; on the wire a cycle takes {wire_ms:.1f} ms of the {period_ms:g} ms between states"
    )
    slow = late_ms > _MOST_SHARE * period_ms or wire_ms > _MOST_SHARE * period_ms
    if slow or lost > _MOST_LOST * _ROUNDS:
        do = (
            "raise baud_rate on the servos and in robot.yaml, set an FTDI adapter's latency timer to 1 ms, "
            "or lower state_rate_hz; where answers are lost, check cables and supply"
        )
        return Finding("cycle", Severity.WARN, seen, do)
    return Finding("cycle", Severity.OK, seen)


def _by_hand(
    robot: UserRobot, section: HardwareSection, survey: Survey, dialogue: Dialogue
) -> Iterator[Finding]:
    hands = Hands(survey, [servo.id for servo in section.servos], dialogue)
    hands.free()
    directions = positive_directions(robot)
    for servo in section.servos:
        turned = hands.turn(servo.joint, directions(servo.joint))
        code = f"{servo.joint} by hand"
        joint = next(one for one in robot.file.joints if one.name == servo.joint)
        low, high = joint.position_range or (0.0, 0.0)
        ends = angles(turned.low, turned.high, servo.zero, servo.direction)
        if turned.servo != servo.id:
            yield Finding(
                code,
                Severity.FAIL,
                f"servo {turned.servo} moved, robot.yaml says {servo.id}",
                "correct its id",
            )
        elif turned.direction != servo.direction:
            side = "grows" if turned.direction > 0 else "falls"
            yield Finding(
                code,
                Severity.FAIL,
                f"its servo's position {side} towards the positive end, robot.yaml says direction "
                f"{servo.direction}",
                f"write direction: {turned.direction}, and measure its zero anew",
            )
        elif low < ends[0] - _SLACK_RAD or high > ends[1] + _SLACK_RAD:
            yield Finding(
                code,
                Severity.FAIL,
                f"it can be turned from {ends[0]:.2f} to {ends[1]:.2f} rad as robot.yaml counts, its "
                f"position_range is {low:.2f} to {high:.2f}",
                "its zero is wrong, it was not turned to its ends, or its range is too wide: `robot new` "
                "measures it anew",
            )
        else:
            seen = f"servo {servo.id}, right direction, {ends[0]:.2f} to {ends[1]:.2f} rad"
            yield Finding(code, Severity.OK, seen)
