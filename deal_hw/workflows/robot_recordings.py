"""The robot and the sampling rates of a user's recordings."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw.errors import ConfigurationError
from deal_hw.workflows.calibration.recordings import recorded_rates
from deal_hw.workflows.robot import is_ours

if TYPE_CHECKING:
    from deal_hw.data.table import Table
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.mjcf.describe import Sampling
    from deal_hw.sim.robots.user_robot import UserRobot


def derived_robot(model: Path, name: str, tables: Sequence[Table], rate_hz: float) -> UserRobot | None:
    """Return the robot that a model describes; None for a robot of deal-hw, which is known by its name.

    Args:
        model: The MJCF.
        name: The robot's name; "": the file's name.
        tables: Its recordings.
        rate_hz: Its commands a second.

    Raises:
        ConfigurationError: `inspect` and `calibrate` could not use it.
    """
    from deal_hw.sim.mjcf.urdf import require_drives
    from deal_hw.sim.robots.user_robot import derive_robot

    if is_ours(name or model.stem):
        return None
    try:
        read = {joint for table in tables for joint in table.joint_names}
        robot = derive_robot(model, name=name, control_rate_hz=rate_hz, several_trees=True, recorded=read)
        for table in tables:
            require_drives(model, robot.model, table.actuated)
            _check_joints(robot, table)
    except ConfigurationError as err:
        err.args = (
            f"{err}. `calibrate` and `inspect` could not use the dataset: correct the model or the column "
            "map, or import without --model",
        )
        raise
    return robot


def _check_joints(robot: UserRobot, table: Table) -> None:
    """Check that a recording has the joints of a robot, and the commands of its driven joints.

    Raises:
        ConfigurationError: A joint or a command is missing.
    """
    driven = tuple(joint.name for joint in robot.file.joints if joint.actuator is not None)
    for what, has, wants in (
        ("positions", table.joint_names, robot.joint_names),
        ("commands", table.actuated, driven),
    ):
        if has != wants:
            needed = f"those of {', '.join(wants)}" if wants else "none"
            else_policy = "" if has else ", or give the policy that moved the robot (--policy FILE.onnx)"
            raise ConfigurationError(
                f"{table.name} has {what} of {', '.join(has) or 'no joint'}, but robot {robot.file.name!r} "
                f"needs {needed}; name the columns in a column map (--columns, in Python "
                f"columns=){else_policy}"
            )


def at_recorded_rates(
    robot: UserRobot, tables: Sequence[Table], device_periods: int = 1
) -> tuple[RobotModel, list[Sampling]]:
    """Return the robot's model at the slowest recordings' rates, and the rates of each.

    Args:
        robot: The robot.
        tables: The recordings.
        device_periods: Physics steps between two samples; 1: as the MJCF's timestep requires.

    Raises:
        ConfigurationError: The recordings have other joints than the robot.
    """
    from deal_hw.sim.engine.model import load_model
    from deal_hw.sim.mjcf.describe import WINDOW_TICKS, slowest

    for table in tables:
        _check_joints(robot, table)
    own = robot.rates
    rates = recorded_rates(tables, robot.model, None, own.period_s * own.samples_per_tick * WINDOW_TICKS)
    if device_periods > 1:
        rates = [dataclasses.replace(each, substeps=device_periods) for each in rates]
    described = slowest(rates)
    return load_model(robot.description(described), described.step_s), rates
