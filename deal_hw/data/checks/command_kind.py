"""Are recorded commands what the model's actuators take: positions for servos, efforts for motors?

The two look alike in a file. A joint follows commanded positions; commanded efforts explain its acceleration
instead. If the commands are of one kind and the model's actuators of the other, the check fails, since every
fitted parameter would be meaningless. A slow joint follows a torque, too, as a spring follows a force: where
the column map gives the unit of an effort, efforts are taken as such, with a warning.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from deal_hw.data.checks.meaning import FACTORS, SCALE_TOLERANCE
from deal_hw.data.table import Table
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray

LAG_S: Final = 0.3
"""A joint follows a position within this time."""
FOLLOWS: Final = 0.95
"""Least correlation of a position with the command that it follows ..."""
SLOPE: Final = (0.7, 1.3)
"""... and the least and largest motion for a command of 1."""
PERHAPS: Final = 0.7
PERHAPS_SLOPE: Final = (0.4, 2.0)
"""A joint that follows its command with this correlation may be a poor servo; its commands do not count as
efforts."""
SOFT_SLOPE: Final = 0.2
"""A joint that follows closely, but moves less than commanded, is that of a soft servo under a load. A
Dynamixel XL330 with a P gain of 100 moves a weight of 0.5 N·m by 0.25 to 0.4 of its command."""
SERVO_SHARE: Final = 0.5
"""In a servo's command its own position has weight 1, within this tolerance."""
EXPLAINED: Final = 0.5
"""Position, speed and acceleration explain at least this share of an effort."""
EFFORT_LAG_S: Final = 0.06
SMOOTHED_S: Final = 0.08
"""The acceleration is that of a parabola through this much of the motion."""
MOST: Final = 2 / 3
"""Share of the moving joints that must agree."""
BEYOND: Final = (0.05, 0.5)
"""Commands outside the actuator's range for these shares of the time: a warning, a failure."""
SLACK: Final = 1.02
FEWEST: Final = 50
STILL: Final = {"rad": 0.02, "m": 0.002}
"""A joint or a command with a standard deviation of a quarter of this or less is not checked [rad or m]."""


def command_kind(table: Table, *, servo: bool, limits: FloatArray | None = None) -> Finding:
    """Check that commands are what the actuators of the model take, and that their unit is known.

    Args:
        table: The recording, with valid clock and values.
        servo: Whether the model's actuators take positions; else efforts.
        limits: Lowest and highest command that the actuators take, (A, 2); infinite where free.
    """
    beyond = _beyond(table, limits, servo)
    if beyond is not None and beyond.severity is Severity.FAIL:
        return beyond
    grid, position, command = _on_grid(table)
    joints = []
    for column, index in enumerate(table.actuated_index):
        least = 0.25 * STILL[table.units[index]]
        if len(grid) >= FEWEST and min(np.std(position[:, index]), np.std(command[:, column])) > least:
            joints.append((column, index))
    period = float(grid[1] - grid[0]) if len(grid) > 1 else 1.0
    test = _is_effort if servo else _is_position
    found = [table.actuated[c] for c, i in joints if test(position[:, i], command[:, c], period)]
    if not joints or len(found) < MOST * len(joints):
        if not servo and "unsaid" in table.source:
            return Finding("actuation", Severity.FAIL, table.source["unsaid"])
        return beyond or Finding("actuation", Severity.OK, "the commands fit the model's actuators")
    efforts = table.source.get("efforts", {})
    if not servo and all(name in efforts for name in found):
        units = " and ".join(sorted({efforts[name] for name in found}))
        return beyond or Finding(
            "actuation",
            Severity.WARN,
            f"the joints follow their commands ({', '.join(found)}) as they would follow positions; the "
            f"column map says {units}, so they are taken as efforts",
        )
    return Finding("actuation", Severity.FAIL, _accusation(found, servo=servo))


def _accusation(names: Sequence[str], *, servo: bool) -> str:
    names_text = ", ".join(names)
    if servo:
        return (
            f"commands that look like efforts ({names_text}): no joint follows them as positions, but they "
            "explain its acceleration, and the model's actuators take positions. If they are torques "
            "(N·m) or forces (N), replace <position> by <motor> in a copy of the MJCF; if not, name the "
            "column of commanded positions as `target`"
        )
    return (
        f"commands that look like positions ({names_text}): the joints follow them, but the model has "
        "motors, which would take them as torques. Replace <motor> by <position joint=... kp=... kv=...> in "
        "a copy of the MJCF, with the gains of the drives; or name the column of torques as `target`. If "
        "these are torques (N·m) or forces (N), write `target_unit: Nm` or `N` into the column map"
    )


def _beyond(table: Table, limits: FloatArray | None, servo: bool) -> Finding | None:
    """Return the finding on commands that the actuators would clip; None if there are hardly any."""
    if limits is None:
        return None
    outside = (table.target < limits[:, 0] * SLACK) | (table.target > limits[:, 1] * SLACK)
    share = outside.mean(axis=0)
    named = [
        f"{name} {part:.0%} of the time (up to {np.max(np.abs(table.target[:, a])):.3g}, the actuator takes "
        f"{limits[a, 0]:.3g}..{limits[a, 1]:.3g})"
        for a, (name, part) in enumerate(zip(table.actuated, share, strict=True))
        if part > BEYOND[0]
    ]
    if not named:
        return None
    other = "torques for a position actuator" if servo else "positions for a motor"
    text = (
        f"commands outside the actuators' ctrlrange: {', '.join(named)}; check for {other}, or another unit"
    )
    severe = float(np.max(share)) > BEYOND[1]
    return Finding("actuation", Severity.FAIL if severe else Severity.WARN, text)


def _on_grid(table: Table) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return uniform times, (N,), measured positions, (N, J), and the active commands, (N, A)."""
    time = table.time_s[np.isfinite(table.position).all(axis=1)]
    steps = np.diff(time)
    grid = np.arange(time[0], time[-1], max(float(np.median(steps[steps > 0])), 2e-3))
    return grid, table.position_at(grid), table.target_at(grid)


def _is_position(position: FloatArray, command: FloatArray, period_s: float) -> bool:
    correlation, slope, near = _following(position, command, period_s)
    return correlation > FOLLOWS and SLOPE[0] < slope < SLOPE[1] and near


def _is_effort(position: FloatArray, command: FloatArray, period_s: float) -> bool:
    correlation, slope, near = _following(position, command, period_s)
    if correlation > PERHAPS and PERHAPS_SLOPE[0] < slope < PERHAPS_SLOPE[1] and near:
        return False
    if correlation > FOLLOWS and SOFT_SLOPE < slope < 1:
        return False
    if correlation > FOLLOWS and _in_another_unit(slope):
        # The check of the units names it; efforts would be a second, wrong cause.
        return False
    half = max(round(SMOOTHED_S / period_s / 2), 1)
    times = np.arange(-half, half + 1) * period_s
    fit = np.linalg.pinv(np.stack([np.ones_like(times), times, 0.5 * times**2], axis=1))
    motion = np.stack([np.convolve(position, row[::-1], mode="valid") for row in fit], axis=1)
    size = motion.std(axis=0)
    motion = np.concatenate([motion / size, np.ones((len(motion), 1))], axis=1)
    sent = command[half : len(command) - half]
    for lag in range(round(EFFORT_LAG_S / period_s) + 1):
        u, x = sent[: len(sent) - lag], motion[lag:]
        weights, *_ = np.linalg.lstsq(x, u, rcond=None)
        left = float(np.var(u - x @ weights) / np.var(u))
        if 1 - left > EXPLAINED and weights[2] > 0:
            return bool(abs(weights[0] / size[0] - 1.0) > SERVO_SHARE)
    return False


def _in_another_unit(slope: float) -> bool:
    """Return whether a position moves as much more or less than its command as another unit makes it."""
    return any(
        abs(ratio / factor - 1) < SCALE_TOLERANCE for factor in FACTORS for ratio in (slope, 1 / slope)
    )


def _following(position: FloatArray, command: FloatArray, period_s: float) -> tuple[float, float, bool]:
    """Return how a position follows its command at the best lag: correlation, slope, whether it is near."""
    found = (0, 0.0)
    for lag in range(min(round(LAG_S / period_s), len(position) // 4) + 1):
        c = float(np.corrcoef(position[lag:], command[: len(command) - lag])[0, 1])
        if abs(c) > abs(found[1]):
            found = (lag, c)
    x, u = position[found[0] :], command[: len(command) - found[0]]
    slope = found[1] * float(np.std(x) / np.std(u))
    return found[1], slope, float(np.median(np.abs(x - u))) < 0.5 * float(np.ptp(x))
