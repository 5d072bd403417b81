"""The column map of LeRobot's recordings of a servo arm, from its calibration.

LeRobot stores no radians: ``-100..100`` of the calibrated travel (the gripper ``0..100``), or degrees from
its middle with ``use_degrees``. The dataset does not say which; the calibration and the values do.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from deal_hw.errors import ConfigurationError, DatasetError, short
from deal_hw.sim.robots.hardware_section import TICKS
from deal_hw.workflows.own_robot.lerobot import read_calibration

if TYPE_CHECKING:
    from deal_hw.data.importing.channels import Channels
    from deal_hw.data.importing.columns import ColumnMap, JointColumns
    from deal_hw.sim.mjcf.joint_facts import JointFacts
    from deal_hw.types import FloatArray

RAD: Final = 2 * np.pi / TICKS
"""One tick [rad]."""
FULL: Final = 100.0
"""LeRobot's value at the end of the travel."""
SLACK: Final = 1.02
"""Values beyond the end by less are rounding, or a joint pressed against its stop [-]."""
GRIPPER: Final = "gripper"
"""The motor whose value is 0 to 100."""


class LeRobotColumns:
    """Returns the column map of each recording; to be used as a map's function.

    Args:
        file: LeRobot's calibration of the arm.
        facts: The joints of the arm's model.

    Raises:
        ConfigurationError: The file cannot be read.
    """

    def __init__(self, file: Path, facts: JointFacts) -> None:
        self._file, self._motors = file, read_calibration(file)
        self._limits = dict(zip(facts.names, np.asarray(facts.limits, dtype=np.float64), strict=True))

    def __call__(self, channels: Channels) -> ColumnMap:
        """Return the map of a recording, with the scale of each joint.

        Raises:
            DatasetError: The joints are not the calibration's, or values do not show their unit.
        """
        from deal_hw.data.importing.guess import guess_columns

        columns = guess_columns(dataclasses.replace(channels, units={}), list(self._limits))
        absent = [joint.name for joint in columns.joints if self._name(joint) not in self._motors]
        if absent:
            raise DatasetError(
                f"{channels.path}: {self._file} has no motor {short(', '.join(absent), 80)}; its motors: "
                f"{short(', '.join(self._motors), 80)}. Name the calibration of this arm"
            )
        degrees = self._in_degrees(channels, columns)
        joints = [self._scaled(joint, degrees) for joint in columns.joints]
        unit = "degrees" if degrees else "-100..100"
        return dataclasses.replace(
            columns, joints=tuple(joints), source=("guessed", f"{unit} by {self._file.name}")
        )

    def _name(self, joint: JointColumns) -> str:
        """Return the motor of a joint."""
        found = joint.column or joint.name
        return found if found in self._motors else joint.name

    def _in_degrees(self, channels: Channels, columns: ColumnMap) -> bool:
        """Return whether values are degrees; else they are shares of the travel."""
        beyond_share, beyond_travel = [], []
        for place, joint in enumerate(columns.joints):
            motor = self._motors[self._name(joint)]
            if self._name(joint) == GRIPPER:
                continue
            reach = _reach(channels, columns, joint, place)
            half = np.degrees((motor.range_max - motor.range_min) * RAD / 2)
            if reach > SLACK * FULL:
                beyond_share.append(f"{joint.name} reaches {reach:.4g}")
            if reach > SLACK * half:
                beyond_travel.append(f"{joint.name} reaches {reach:.4g}, its travel is +-{half:.3g} degrees")
        if beyond_share and beyond_travel:
            raise DatasetError(
                f"{channels.path}: neither -100..100 nor degrees of {self._file}: "
                f"{short('; '.join([*beyond_share, *beyond_travel]), 200)}. It is the calibration of another "
                "arm, or of another day"
            )
        if not beyond_share and not beyond_travel:
            raise DatasetError(
                f"{channels.path}: the values may be -100..100 of the travel, or degrees (use_degrees): all "
                "are within both. Write a column map with `unit: deg`, or with `normalised` for each joint"
            )
        return bool(beyond_share)

    def _scaled(self, joint: JointColumns, degrees: bool) -> JointColumns:
        from deal_hw.data.importing.columns import Normalised

        name = self._name(joint)
        motor, (low, high) = self._motors[name], self._limits[joint.name]
        if not np.isfinite(low + high):
            raise ConfigurationError(
                f"the model gives joint {joint.name!r} no range, so the middle of its travel has no place; "
                "give it one"
            )
        # As in a robot.yaml of this calibration, the middles of travel and of the model's range agree.
        middle, half = (low + high) / 2, (motor.range_max - motor.range_min) * RAD / 2
        if degrees and name != GRIPPER:
            sign = -1.0 if motor.drive_mode else 1.0
            return dataclasses.replace(joint, unit="deg", sign=sign, offset=float(middle))
        begin = 0.0 if name == GRIPPER else -FULL
        scale = Normalised(file=(begin, FULL), robot=(float(middle - half), float(middle + half)))
        return dataclasses.replace(joint, normalised=scale)


def _reach(channels: Channels, columns: ColumnMap, joint: JointColumns, place: int) -> float:
    """Return the largest value of a joint, in the file's unit."""
    from deal_hw.data.importing.table import joint_channel

    plain = dataclasses.replace(joint, unit="rad", sign=1.0, offset=0.0)
    values: FloatArray | None = joint_channel(channels, columns, plain, place, "position")
    return 0.0 if values is None else float(np.nanmax(np.abs(values), initial=0.0))


def columns_of_lerobot(file: Path | None, facts: JointFacts | None, mapped: bool) -> LeRobotColumns | None:
    """Return the maps by a calibration; None without one.

    Args:
        file: LeRobot's calibration, or None.
        facts: The joints of the arm's model, or None.
        mapped: Whether a column map is given besides.

    Raises:
        ConfigurationError: There is no model, or a column map besides.
    """
    if file is None:
        return None
    if facts is None or mapped:
        raise ConfigurationError(
            "--lerobot gives the scale of each joint of a model: add --model or --robot, and leave out "
            "--columns"
        )
    return LeRobotColumns(file, facts)
