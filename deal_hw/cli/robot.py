"""``deal-hw robot``: describe a robot of your own, and check the description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from deal_hw.workflows.kinds import InputKind, sub_verbs
from deal_hw.workflows.robot import CheckRobotSettings, NewRobotSettings, RobotCheck, check_robot, new_robot


@dataclass(frozen=True, kw_only=True)
class New(NewRobotSettings):
    """Write a robot.yaml from an MJCF: joints, units, gains, ranges, effort limits."""

    model: tyro.conf.Positional[Path]


@dataclass(frozen=True, kw_only=True)
class Check(CheckRobotSettings):
    """Compare a robot.yaml with its MJCF, list what is missing, and simulate a second of holding."""

    robot: tyro.conf.Positional[Path]


KINDS = sub_verbs(
    new=InputKind(New, example="new robot.xml"),
    check=InputKind(Check, example="check robot.yaml"),
)


def robot(config: New | Check) -> int | RobotCheck:
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
    return 0
