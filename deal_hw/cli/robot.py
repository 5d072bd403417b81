"""``deal-hw robot``: describe a robot of your own, and check the description."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tyro

from deal_hw.workflows.kinds import Arguments, InputKind, Kinds
from deal_hw.workflows.robot import (
    NEW_ROBOT,
    CheckRobotSettings,
    NewFromLeRobotSettings,
    NewRobotSettings,
    RobotCheck,
    check_robot,
    new_robot,
)


@dataclass(frozen=True, kw_only=True)
class Check(CheckRobotSettings):
    """Compare a robot.yaml with its MJCF, list what is missing, and simulate a second of holding."""

    robot: tyro.conf.Positional[Path]


def _table() -> Mapping[str, InputKind]:
    new = {_word(name): kind for name, kind in NEW_ROBOT.table().items()}
    return {**new, "check": InputKind(Check, example="check robot.yaml")}


def _find(arguments: Arguments) -> str:
    if arguments.first != "new":
        return "" if arguments.first is None else str(arguments.first)
    return _word(NEW_ROBOT.find(arguments))


def _word(source: str) -> str:
    return f"new-{source}" if source else "new"


KINDS = Kinds(noun="sub-verb", table=_table, find=_find)


def robot(config: NewRobotSettings | NewFromLeRobotSettings | Check) -> int | RobotCheck:
    """Run the verb.

    Returns:
        0, or the findings, whose exit code is 1 if a check failed.

    Raises:
        ConfigurationError: A file cannot be used, or robot.yaml and MJCF contradict each other.
    """
    if isinstance(config, Check):
        found = check_robot(config.robot)
        print(found.table())
        return found
    path = new_robot(**vars(config))
    print(f"written: {path}; check its rates and limits, then: deal-hw robot check {path}")
    if isinstance(config, NewFromLeRobotSettings):
        print(
            "Its zeros hold while the servos keep the homing offsets of this calibration; its directions are "
            "LeRobot's: move one joint at a time at first."
        )
    return 0
