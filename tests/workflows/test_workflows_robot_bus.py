"""`robot new --bus` and `robot check --port`: an emulated arm is asked, its joints are turned by hand."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm_rig import BUSES, Rig

import deal_hw
from deal_hw.cli import dialogue as dialogues
from deal_hw.cli.main import EXIT_ERROR, main
from deal_hw.drivers.servo_arm.families import FAMILIES, OFF, ON
from deal_hw.drivers.servo_arm.survey import Survey
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus.emulated_servo import EmulatedServo
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.servo_bus.feetech.emulated_servo import StsServo
from deal_hw.errors import (
    ConfigurationError,
    DealHwError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.findings import Finding, Severity
from deal_hw.sim.robots.hardware_section import RAD
from deal_hw.sim.robots.robot_file import read_robot_file, write_robot_file
from deal_hw.sim.robots.user_robot import read_robot
from deal_hw.workflows.own_robot.compare import bus_findings
from deal_hw.workflows.own_robot.lerobot import LeRobotMotor

MODEL = {"dynamixel": r.MODEL_NUMBER, "feetech": f.MODEL_NUMBER}
END = 1.6
"""Where a joint is turned to, both ways [rad]; the MJCF's range is +-1.5."""


class Person:
    """Turns the joints of an emulated arm as asked: some steps until each Enter.

    Args:
        rig: The arm.
        answers: What is answered to each question.
        moves: Joint that is turned instead of the one that was asked for -> the joints to turn.
        flips: Whether it takes the negative ends for the positive ones.
        ends: Lowest and highest position of each joint [rad].
    """

    def __init__(
        self,
        rig: Rig,
        answers: Sequence[str] = ("m",),
        moves: Callable[[str], Sequence[str]] = lambda joint: (joint,),
        flips: bool = False,
        ends: tuple[float, float] = (-END, END),
    ) -> None:
        self.rig, self.answers, self.moves, self.flips = rig, list(answers), moves, flips
        self.low, self.high = ends
        self.said: list[str] = []
        self._ways: list[dict[str, float]] = []

    def say(self, text: str) -> None:
        """Note it."""
        self.said.append(text)

    def ask(self, question: str, answers: Sequence[str]) -> str:
        """Give the next answer."""
        self.said.append(question)
        answer = self.answers.pop(0)
        assert answer in answers
        return answer

    def begin(self, text: str) -> None:
        """Begin to turn what the text names."""
        self.said.append(text)
        names = self.rig.description.joint_names
        joints = [name for name in names if f"turn {name} " in text.lower()]
        now = dict(zip(names, self.rig.true_position(), strict=True))
        for name in names:
            self.rig.device.turn(name, float(now[name]))
        if not joints:
            self._ways = [dict.fromkeys(names, 0.0)]
            return
        end = self.high if ("POSITIVE" in text) != self.flips else self.low
        turned = self.moves(joints[0])
        self._ways = [
            {name: float(now[name] + (end - now[name]) * step / 20) for name in turned}
            for step in range(1, 21)
        ]

    def done(self) -> bool:
        """Turn a step further; Enter at the end."""
        for name, at in self._ways.pop(0).items():
            self.rig.device.turn(name, at)
        self.rig.advance(0.01)
        return not self._ways


@pytest.fixture(params=BUSES)
def bus(request: pytest.FixtureRequest) -> str:
    """The bus."""
    return str(request.param)


@pytest.fixture
def rig(tmp_path: Path, bus: str) -> Rig:
    """An arm on that bus: the shoulder's servo 1 is mounted the other way round."""
    return Rig(tmp_path, bus)


def survey(rig: Rig) -> Survey:
    """Return the questions to an arm's bus, open."""
    section = rig.file.servo_bus
    assert section is not None
    family = FAMILIES[section.bus]()
    rig.virtual.open()
    made = family.bus(rig.virtual, rig.clock, section.baud_rate, 0.02)
    return Survey(made, family, rig.clock, "PORT")


@pytest.fixture
def opened(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """An arm that the verbs reach by its port."""

    @contextlib.contextmanager
    def open_bus(*args: Any) -> Iterator[Survey]:
        yield survey(rig)

    monkeypatch.setattr("deal_hw.workflows.own_robot.link.open_bus", open_bus)
    return rig


def new(rig: Rig, person: Person, folder: Path) -> Path:
    """Return the robot.yaml that the verb writes."""
    section = rig.file.servo_bus
    assert section is not None
    return deal_hw.new_robot(
        folder / "arm.xml",
        bus=section.bus,
        port="PORT",
        out=folder / "new.yaml",
        name="two joints",
        dialogue=person,
    )


def test_each_joint_is_found_with_direction_zero_and_range(opened: Rig, bus: str, tmp_path: Path) -> None:
    """As the arm was built, within a tick or two; ranges are the MJCF's, which are narrower."""
    person = Person(opened)
    if bus == "feetech":
        # Writes to the EEPROM would be lost: nothing is written there.
        assert {servo.get(f.LOCK) for servo in opened.servos} == {f.LOCKED}
    made = read_robot_file(new(opened, person, tmp_path))
    assert made.servo_bus is not None and made.servo_bus.bus == bus
    built = opened.file.servo_bus
    assert built is not None
    for one, true in zip(made.servo_bus.servos, built.servos, strict=True):
        assert (one.joint, one.id, one.direction) == (true.joint, true.id, true.direction)
        assert abs(one.zero - true.zero) <= 1
        assert one.p_gain > 1 and one.model in FAMILIES[bus].models.values()
    assert [joint.position_range for joint in made.joints] == [(-1.5, 1.5), (-1.5, 1.5)]
    assert all(joint.velocity_limit and joint.velocity_limit > 1 for joint in made.joints)
    # Positive is explained by the MJCF: about +y the tip above the joint moves towards +x.
    assert any("(0, 1, 0)" in text and "towards +x" in text for text in person.said)


def test_a_pose_gives_the_zeros(opened: Rig, tmp_path: Path) -> None:
    """The travel is not symmetric, as where a table is in the way; the MJCF's range becomes narrower."""
    person = Person(opened, answers=["p"], ends=(-1.2, 1.5))
    made = read_robot_file(new(opened, person, tmp_path))
    assert made.servo_bus is not None
    assert [abs(one.zero - true) <= 1 for one, true in zip(made.servo_bus.servos, (2048, 2000), strict=True)]
    for joint in made.joints:
        assert joint.position_range == pytest.approx((-1.2, 1.5), abs=2 * RAD)


def test_the_torque_goes_off_only_after_a_question(opened: Rig, tmp_path: Path) -> None:
    """No: nothing changes, nothing is written. Yes: it is off."""
    opened.armed()
    with pytest.raises(ConfigurationError, match="the torque stays on"):
        new(opened, Person(opened, answers=["n"]), tmp_path)
    assert {joint.torque for joint in opened.device.joints} == {ON}
    assert not (tmp_path / "new.yaml").exists()
    person = Person(opened, answers=["y", "m"])
    new(opened, person, tmp_path)
    assert {joint.torque for joint in opened.device.joints} == {OFF}
    assert any("THE ARM FALLS" in text for text in person.said)


def test_ctrl_c_writes_nothing(opened: Rig, tmp_path: Path) -> None:
    """In the middle of a joint."""

    class Impatient(Person):
        def done(self) -> bool:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        new(opened, Impatient(opened), tmp_path)
    assert not (tmp_path / "new.yaml").exists()


@pytest.mark.parametrize(
    ("moves", "words"),
    [
        (lambda joint: ("shoulder", "elbow"), "joint shoulder: servos 1, 2 moved alike: hold the other"),
        (lambda joint: (), "joint shoulder: no servo moved by more than"),
        (lambda joint: ("shoulder",), "joint elbow: servo 1 moved, which is that of shoulder"),
    ],
)
def test_an_unclear_turn_is_asked_again_and_then_refused(
    opened: Rig, tmp_path: Path, moves: Callable[[str], Sequence[str]], words: str
) -> None:
    """Three times; then nothing is written."""
    person = Person(opened, moves=moves)
    with pytest.raises(ConfigurationError, match=f"{words}.*asked 3 times"):
        new(opened, person, tmp_path)
    assert sum("Once more" in text for text in person.said) == 3
    assert not (tmp_path / "new.yaml").exists()


def test_a_travel_that_is_not_the_mjcfs_is_refused(opened: Rig, tmp_path: Path) -> None:
    """Such as a joint that was turned a little only."""
    with pytest.raises(ConfigurationError, match=r"shoulder.*have \d+ % in common.*turn it from one end"):
        new(opened, Person(opened, ends=(-0.3, 0.4)), tmp_path)


def test_a_servo_that_wraps_around_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its zero lies near the end of its turn: the horn or the homing offset must move it."""
    rig = Rig(tmp_path, "feetech")
    rig.servos[0].keep(f.HOMING_OFFSET, 1500)
    monkeypatch.setattr(
        "deal_hw.workflows.own_robot.link.open_bus", lambda *args: contextlib.nullcontext(survey(rig))
    )
    with pytest.raises(ConfigurationError, match="shoulder: servo 1 went over the end of its 4096 ticks"):
        new(rig, Person(rig), tmp_path)


# Who is on the bus.


def refused(rig: Rig, folder: Path, error: type[DealHwError], words: str) -> None:
    """Check that nothing is asked of the person, and that the message has the words."""
    person = Person(rig, answers=[])
    with pytest.raises(error, match=words):
        new(rig, person, folder)
    assert person.said == [] and not (folder / "new.yaml").exists()


def test_a_silent_bus(opened: Rig, tmp_path: Path) -> None:
    """What to check is said."""
    for servo in opened.servos:
        servo.present = False
    refused(
        opened, tmp_path, TransportTimeoutError, "no servo answers at 1000000 baud; check the servos' supply"
    )


def test_fewer_servos_than_joints(opened: Rig, tmp_path: Path) -> None:
    """One is absent, or two have one id."""
    opened.servos[1].present = False
    refused(
        opened, tmp_path, TransportTimeoutError, r"1 servos answer \(1\), the MJCF has 2 joints.*one by one"
    )


def test_two_servos_of_one_id(opened: Rig, bus: str, tmp_path: Path) -> None:
    """At different positions their answers collide."""
    twin: Any = EmulatedServo(1, 1_000_000, mode=3) if bus == "dynamixel" else StsServo(1, 1_000_000)
    twin.sense(1234)
    opened.device.bus.servos.append(twin)
    opened.servos[1].present = False
    refused(opened, tmp_path, TransportTimeoutError, "one id|of one id|with one id")


def test_a_servo_of_another_model(opened: Rig, bus: str, tmp_path: Path) -> None:
    """Known models are listed."""
    opened.servos[1].put(MODEL[bus], 350)
    refused(opened, tmp_path, WrongDeviceError, "servo 2 is of model number 350.*known: ")


def test_old_firmware(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a run refuses it."""
    rig = Rig(tmp_path, "feetech")
    rig.servos[0].put(f.FIRMWARE_MINOR, 5)
    monkeypatch.setattr(
        "deal_hw.workflows.own_robot.link.open_bus", lambda *args: contextlib.nullcontext(survey(rig))
    )
    refused(rig, tmp_path, VersionMismatchError, r"servo 1 has firmware 3\.5; update it")


def test_a_verb_without_a_terminal_is_refused(
    opened: Rig, bus: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before the bus is asked."""
    line = ["robot", "new", str(tmp_path / "arm.xml"), "--bus", bus, "--port", "PORT", "--out", "new.yaml"]
    assert main(line) == EXIT_ERROR
    assert "run it in a terminal" in capsys.readouterr().err


# robot check --port.


def found(rig: Rig, folder: Path, **rest: Any) -> list[Finding]:
    """Return the findings of the arm's robot.yaml."""
    return list(bus_findings(read_robot(folder / "robot.yaml"), survey(rig), **rest))


def failures(findings: Sequence[Finding]) -> str:
    """Return what failed, one line each."""
    return "\n".join(f"{one.code}: {one.message}" for one in findings if one.severity is Severity.FAIL)


def written(rig: Rig, folder: Path, servo: int, **changes: Any) -> None:
    """Write the arm's robot.yaml with other values of a servo; with another joint both are exchanged."""
    section = rig.file.servo_bus
    assert section is not None
    servos = list(section.servos)
    servos[servo] = dataclasses.replace(servos[servo], **changes)
    if "joint" in changes:
        servos[1] = dataclasses.replace(servos[1], joint="shoulder")
    changed = dataclasses.replace(rig.file, hardware=dataclasses.replace(section, servos=tuple(servos)))
    (folder / "robot.yaml").write_text(write_robot_file(changed), encoding="utf-8")


def test_an_arm_as_described_has_no_failure(rig: Rig, tmp_path: Path) -> None:
    """One line a servo, and the cycle; no register was written."""
    tables = [bytes(servo._table) for servo in rig.servos]
    findings = found(rig, tmp_path)
    assert failures(findings) == ""
    assert [one.code for one in findings] == ["servos", "servo 1 (shoulder)", "servo 2 (elbow)", "cycle"]
    assert "torque off" in findings[1].seen and "of the 20 ms between states" in findings[-1].seen
    writable = slice(0, 56)
    assert [bytes(servo._table)[writable] for servo in rig.servos] == [one[writable] for one in tables]


def test_each_fault_of_a_bus_is_a_finding(rig: Rig, bus: str, tmp_path: Path) -> None:
    """All of them in one check."""
    other = {"dynamixel": "xm430-w350", "feetech": "sts3250"}[bus]
    written(rig, tmp_path, 0, model=other)
    mode = {"dynamixel": r.OPERATING_MODE, "feetech": f.OPERATING_MODE}[bus]
    rig.servos[0].put(mode, 1)
    rig.virtual.open()
    rig.device.turn("elbow", 2.9)
    rig.advance(0.01)
    text = failures(found(rig, tmp_path))
    assert "servo 1 (shoulder): a " in text and f"robot.yaml says {other}" in text
    assert "has 1 in its register Operating Mode" in text
    assert "servo 2 (elbow): is at 2.90 rad, far outside its position_range -1.50 to 1.50" in text
    rig.servos[0].present = False
    assert "1 (shoulder) at 1000000 baud on PORT without an answer; these answer: 2" in failures(
        found(rig, tmp_path)
    )


def test_lerobots_calibration_is_compared_with_the_servos(tmp_path: Path) -> None:
    """Its homing offset, its limits, its ids."""
    rig = Rig(tmp_path, "feetech")
    rig.servos[0].keep(f.HOMING_OFFSET, -100)
    motors = {
        name: LeRobotMotor(id=i, drive_mode=0, homing_offset=at, range_min=0, range_max=4095)
        for i, name, at in ((1, "shoulder", -100), (2, "elbow", 0))
    }
    assert failures(found(rig, tmp_path, motors=motors)) == ""
    rig.servos[1].keep(f.HOMING_OFFSET, 40)
    text = failures(found(rig, tmp_path, motors=motors))
    assert "servo 2 (elbow): homing offset 40, LeRobot's calibration says 0" in text and "homed again" in text
    del motors["elbow"]
    assert "servo 2 (elbow): LeRobot's calibration has no motor" in failures(
        found(rig, tmp_path, motors=motors)
    )
    motors["shoulder"] = dataclasses.replace(motors["shoulder"], range_min=700)
    warned = [one.seen for one in found(rig, tmp_path, motors=motors) if one.severity is Severity.WARN]
    assert warned == ["limits 0 to 4095, LeRobot's calibration says 700 to 4095"]


def test_hands_confirm_what_is_right(rig: Rig, tmp_path: Path) -> None:
    """A line for each joint."""
    findings = found(rig, tmp_path, dialogue=Person(rig))
    assert failures(findings) == ""
    assert "servo 1, right direction" in findings[-2].seen


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"direction": 1},
            "falls towards the positive end, robot.yaml says direction 1; write direction: -1",
        ),
        ({"zero": 1600}, "its zero is wrong"),
        ({"joint": "elbow"}, "servo 1 moved, robot.yaml says 2"),
    ],
)
def test_hands_find_what_is_wrong(rig: Rig, tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    """Direction, zero, and servos that were exchanged."""
    written(rig, tmp_path, 0, **changes)
    assert words in failures(found(rig, tmp_path, dialogue=Person(rig)))


def test_a_file_without_servos_cannot_be_compared(rig: Rig, tmp_path: Path) -> None:
    """The message says what writes them."""
    text = write_robot_file(dataclasses.replace(rig.file, hardware=None))
    (tmp_path / "robot.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"no section `hardware`.*robot new arm\.xml --bus"):
        found(rig, tmp_path)


def test_the_verb_checks_file_and_bus(
    opened: Rig, bus: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One table; the exit code is that of its failures; LeRobot's file is for a Feetech bus."""
    assert main(["robot", "check", str(tmp_path / "robot.yaml"), "--port", "PORT"]) == 0
    table = capsys.readouterr().out
    assert "robot.yaml and MJCF agree" in table and "servo 2 (elbow)" in table
    opened.servos[1].present = False
    assert main(["robot", "check", str(tmp_path / "robot.yaml"), "--port", "PORT"]) == 1
    assert main(["robot", "check", str(tmp_path / "robot.yaml"), "--port", "PORT", "--by-hand"]) == EXIT_ERROR
    assert "run it in a terminal" in capsys.readouterr().err
    motor = {"id": 1, "drive_mode": 0, "homing_offset": 5, "range_min": 0, "range_max": 4095}
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps({"shoulder": motor}), encoding="utf-8")
    line = ["robot", "check", str(tmp_path / "robot.yaml"), "--port", "PORT", "--lerobot", str(file)]
    assert main(line) == (EXIT_ERROR if bus == "dynamixel" else 1)
    printed = capsys.readouterr()
    assert "homing offset 0, LeRobot's calibration says 5" in printed.out or "Feetech" in printed.err


# The terminal, and the emulated arm.


def test_a_terminal_asks_and_takes_enter(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Keys that were pressed before a prompt do not count; nothing but Enter is the last answer."""
    person, program = pty.openpty()
    with open(program, encoding="utf-8") as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        terminal = dialogues.TerminalDialogue("robot new --bus")
        os.write(person, b"\nx\n\n")
        assert terminal.ask("Off?", ("y", "n")) == "n"
        assert terminal.ask("Off?", ("y", "n")) == "n"
        os.write(person, b"Y\n")
        assert terminal.ask("Off?", ("y", "n")) == "y"
        os.write(person, b"\n")
        terminal.begin("Turn it.")
        assert not terminal.done()
        os.write(person, b"\n")
        assert terminal.done() and not terminal.done()
    os.close(person)
    assert "Turn it. Then press Enter." in capsys.readouterr().out


def test_a_hand_holds_a_joint_without_torque_only(rig: Rig) -> None:
    """Let go, it falls; with torque nobody turns it."""
    rig.robot.connect()
    rig.device.turn("shoulder", 0.8)
    rig.advance(0.5)
    assert rig.true_position()[0] == pytest.approx(0.8)
    rig.device.turn("shoulder", None)
    rig.advance(0.2)
    assert rig.true_position()[0] != pytest.approx(0.8, abs=1e-3)
    rig.armed()
    with pytest.raises(ValueError, match="shoulder has torque"):
        rig.device.turn("shoulder", 0.5)
    assert np.abs(rig.true_position()).max() < 0.2
