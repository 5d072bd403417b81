"""``deal-hw robot``: describe a robot of your own, and check the description."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tyro

from deal_hw.cli.dialogue import TerminalDialogue
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds
from deal_hw.workflows.own_robot.check import (
    CHECK_ROBOT,
    CheckBusSettings,
    CheckRobotSettings,
    RobotCheck,
    check_robot,
)
from deal_hw.workflows.own_robot.lock import LOCK_JOINTS, LockJointsSettings, lock_joints
from deal_hw.workflows.own_robot.new import (
    NEW_ROBOT,
    NewFromBusSettings,
    NewFromLeRobotSettings,
    NewRobotSettings,
    new_robot,
)


@dataclass(frozen=True, kw_only=True)
class Check(CheckRobotSettings):
    """Compare a robot.yaml with its MJCF, list what is missing, and simulate a second of holding."""

    # Settings without options have no argument beside them that shows it to be one.
    robot: tyro.conf.Positional[Path]


_VERBS = {"new": NEW_ROBOT, "check": CHECK_ROBOT, "lock": LOCK_JOINTS}


def _table() -> Mapping[str, InputKind]:
    table = {
        _word(verb, name): kind for verb, kinds in _VERBS.items() for name, kind in kinds.table().items()
    }
    table["check"] = dataclasses.replace(table["check"], settings=Check)
    return table


def _find(arguments: Arguments) -> str:
    verb = "" if arguments.first is None else str(arguments.first)
    if verb in _VERBS:
        return _word(verb, _VERBS[verb].find(arguments))
    # A kind that an option names has no word of its own.
    return "" if verb in _table() else verb


def _word(verb: str, kind: str) -> str:
    # The plain verb is the kind that no option names.
    return f"{verb}-{kind}" if _VERBS[verb].table()[kind].usage else verb


KINDS = Kinds(noun="sub-verb", table=_table, find=_find)


def robot(
    config: NewRobotSettings
    | NewFromLeRobotSettings
    | NewFromBusSettings
    | CheckRobotSettings
    | CheckBusSettings
    | LockJointsSettings,
) -> int | RobotCheck:
    """Run the verb.

    Returns:
        0, or the findings, whose exit code is 1 if a check failed.

    Raises:
        ConfigurationError: A file cannot be used, robot.yaml and MJCF contradict each other, a joint cannot
            be locked, or the servos are not those of the arm.
        DealHwError: The port cannot be opened, or its servos do not answer.
    """
    if isinstance(config, NewFromBusSettings):
        config = dataclasses.replace(config, dialogue=TerminalDialogue("robot new --bus"))
    if isinstance(config, CheckBusSettings) and config.by_hand:
        config = dataclasses.replace(config, dialogue=TerminalDialogue("robot check --by-hand"))
    if isinstance(config, CheckRobotSettings):
        found = check_robot(**vars(config))
        print(found.table())
        return found
    if isinstance(config, LockJointsSettings):
        locked = lock_joints(**vars(config))
        print(f"written: {locked.path}; without the joints {', '.join(config.joints)}")
        if locked.removed:
            print(f"removed with them: {', '.join(locked.removed)}")
        return 0
    path = new_robot(**vars(config))
    check = f"deal-hw robot check {path}"
    if isinstance(config, NewRobotSettings):
        print(f"written: {path}; check its rates and limits, then: {check}")
    elif isinstance(config, NewFromLeRobotSettings):
        print(f"written: {path}; check its rates and limits")
        print(
            "Its zeros hold while the servos keep the homing offsets of this calibration. Compare them, and "
            f"the directions, with the arm: {check} --port PORT --lerobot {config.lerobot} --by-hand"
        )
    else:
        print(f"written: {path}; check its rates and limits, then: {check} --port {config.port}")
    return 0
