"""Poses that a policy is to reach: one, or a script of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, shown
from deal_hw.motions.behaviours import centre
from deal_hw.motions.time_script import read_script
from deal_hw.types import FloatArray


class JointTargets:
    """Poses by time; each is valid until the next one's time.

    Attributes:
        time_s: When each pose begins, (T,) [s], growing.
        poses: The poses, (T, A) [rad or m], of the actuated joints.
    """

    def __init__(self, time_s: FloatArray, poses: FloatArray) -> None:
        self.time_s, self.poses = time_s, poses

    def at(self, time_s: float) -> FloatArray:
        """Return the pose to reach at a time, (A,); before the first one's time it is the first one."""
        row = int(np.searchsorted(self.time_s, time_s + 1e-9, side="right")) - 1
        return np.asarray(self.poses[max(row, 0)])


def make_targets(text: str, description: RobotDescription) -> JointTargets:
    """Return the poses that an option names.

    Args:
        text: Positions of the actuated joints, as ``0.2,-0.5,0.4``; the path of a script (.csv) with time_s
            and these joints; or "" for the default pose.
        description: The robot.

    Raises:
        ConfigurationError: The text or file is wrong, or a position is outside its joint's targets.
    """
    if not text:
        return JointTargets(np.zeros(1), centre(description)[None])
    names = description.actuated
    script = text.endswith(".csv")
    lines = read_script(Path(text), names) if script else [(0, [0.0, *_parsed(text, names)])]
    for number, row in lines:
        for name, value, (low, high) in zip(names, row[1:], description.limits.target, strict=True):
            if not low <= value <= high:
                where = f"{text}: line {number}" if script else f"--target {shown(text)}"
                raise ConfigurationError(f"{where}: {name} is {value!r}, allowed: {low:.4g} to {high:.4g}")
    rows = np.array([row for _, row in lines])
    return JointTargets(rows[:, 0], rows[:, 1:])


def _parsed(text: str, names: tuple[str, ...]) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len(names):
        raise ConfigurationError(
            f"--target {shown(text)}: give the positions of {','.join(names)}, such as "
            f"{','.join('0' for _ in names)}, or a CSV file with the columns time_s,{','.join(names)}"
        )
    return numbers
