"""Puts a recording on a uniform time grid and makes trajectories from it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.data.importing.stamps import even_counts
from deal_hw.data.table import Table
from deal_hw.errors import DatasetError
from deal_hw.types import BaseTrajectory, BodyTrajectory, FloatArray, IntArray, Status, Trajectory

EVEN = 0.02
"""Steps between samples count as even if they differ from whole periods by at most this share."""
CLOCKS = 1e-3
"""Rates of one rig differ by at most this share: its clocks are good to some hundred parts per million."""
GAP_PERIODS = 3.0
"""A longer pause between samples splits a recording; it is not interpolated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """Settings of the robot's own servos, in the order of the actuated joints (A); NaN if unknown.

    Attributes:
        stiffness: kp.
        damping: kd.
        effort_limit: [N or N·m].
        speed_limit: Of the set-point; infinite where it is not limited.
    """

    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    effort_limit: tuple[float, ...]
    speed_limit: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A part of a recording without pauses, on a uniform grid.

    Attributes:
        trajectory: The data for calibration; ``metadata["import"]`` has its origin. Its body contains the
            base's orientation and angular velocity, if the recording has one of them.
    """

    trajectory: Trajectory

    @property
    def orientation(self) -> FloatArray | None:
        """Base orientation at its samples, quaternion w x y z, (T, 4), or None."""
        body = self.trajectory.body
        return None if body is None or np.isnan(body.orientation).all() else body.orientation

    @property
    def gyro(self) -> FloatArray | None:
        """Angular velocity of the base in its own frame at its samples, (T, 3) [rad/s]; None: none."""
        body = self.trajectory.body
        return None if body is None or np.isnan(body.angular_velocity).all() else body.angular_velocity


def period_of(table: Table) -> float:
    """Return the sampling period of a recording [s]: its own, not rounded.

    It is the total time divided by the number of periods, without gaps. With the median step, stamps would
    drift against the grid.

    Raises:
        DatasetError: There are fewer than three samples, or the clock stands still.
    """
    clock = _clock(table)[0]
    if clock.size < 3:
        raise DatasetError(
            f"{table.name}: only {max(clock.size, 1)} samples at different times; check the time channel"
        )
    return even_counts(clock)[1]


def common_period(tables: Sequence[Table]) -> float:
    """Return one period for several recordings of a robot [s], for software that knows one rate.

    Raises:
        DatasetError: They were recorded at rates that differ by more than 2 %.
    """
    periods = np.array([period_of(table) for table in tables])
    middle = float(np.median(periods))
    if np.any(np.abs(periods / middle - 1) > EVEN):
        rates = ", ".join(f"{table.name}: {1 / p:.4g} Hz" for table, p in zip(tables, periods, strict=True))
        raise DatasetError(
            f"these recordings have different rates ({rates}), and one is needed here; use recordings of one "
            "rate at a time"
        )
    return middle


def grid_periods(tables: Sequence[Table]) -> list[float]:
    """Return the period of each recording's grid [s]; recordings of one rate share the median of theirs.

    They have one rate if their clocks agree, or if no stamp moves by more than half a period.
    """
    periods = np.array([period_of(table) for table in tables])
    lasts_s = np.array([np.ptp(_clock(table)[0]) for table in tables])
    found = periods.copy()
    groups = [np.argsort(periods, kind="stable")]
    while groups:
        rows = groups.pop()
        shared = float(np.median(periods[rows]))
        off = np.abs(periods[rows] / shared - 1)
        one = (off <= CLOCKS) | ((off <= EVEN) & (off * lasts_s[rows] <= shared / 2))
        if one.all():
            found[rows] = shared
        else:
            apart = int(np.argmax(np.diff(np.log(periods[rows])))) + 1
            groups += [rows[:apart], rows[apart:]]
    return [float(period) for period in found]


def unevenness_s(table: Table) -> float:
    """Return how far the stamps of a recording lie beside those of an even clock at most [s].

    Each part between pauses has a clock of its own: its rate and its zero are fitted.
    """
    clock, period = _clock(table)[0], period_of(table)
    worst = 0.0
    for part in np.split(clock, np.flatnonzero(np.diff(clock) > GAP_PERIODS * period) + 1):
        if part.size > 2:
            index = np.concatenate(([0.0], np.round(np.diff(part) / period).clip(1).cumsum()))
            even = np.polynomial.Polynomial.fit(index, part, 1)(index)
            worst = max(worst, float(np.max(np.abs(part - even))))
    return worst


def to_trajectories(
    table: Table,
    gains: Gains | None = None,
    period_s: float | None = None,
    gap_periods: float = GAP_PERIODS,
) -> list[Recording]:
    """Put a recording on a uniform grid; gaps split it.

    Where the stamps are even (each step within 2 % of whole periods) every sample keeps its values and only
    its stamp moves to the grid, together with the commands' stamps. Smoothing a measurement would add a
    larger error than a stamp that is 2 % off. Otherwise positions are interpolated linearly at the grid's
    times, and commands keep their own. A command is active from its time on. Lost samples within a part of
    even stamps stay absent.

    Args:
        table: The recording.
        gains: Settings of the servos; None: unknown.
        period_s: The grid's period [s]; None: the recording's own.
        gap_periods: A pause of more periods splits the recording. Infinite: no pause does, and its samples
        are absent.

    Returns:
        The parts of at least two samples, in order.

    Raises:
        DatasetError: The clock goes backwards, or there are too few samples or no commands.
    """
    if not table.command_s.size:
        raise DatasetError(
            f"{table.name}: no commands; name the commanded positions as `target` in the column map, or "
            "give the policy that moved the robot (--policy FILE.onnx)"
        )
    clock, rows = _clock(table)
    period = period_of(table) if period_s is None else period_s
    limit = gap_periods * period
    cuts = np.flatnonzero(np.diff(clock) > limit) + 1
    stretches = [part for part in np.split(np.arange(clock.size), cuts) if part.size >= 2]
    if not stretches:
        raise DatasetError(
            f"{table.name}: the pauses between all samples are longer than {limit:.3g} s; "
            "check the unit of time"
        )
    recordings = []
    for number, part in enumerate(stretches):
        facts = {
            **table.source,
            "stretch": number,
            "stretches": len(stretches),
            "rows_left_out": int(table.time_s.size - clock.size),
            "period_s": period,
        }
        recordings.append(_recording(table, rows[part], clock[part], period, gains, facts))
    return [recording for recording in recordings if recording is not None]


def with_earlier_commands(trajectory: Trajectory, by_s: float) -> Trajectory:
    """Return an imported recording whose commands were sent so much earlier [s]; its states stay."""
    sent_s, device_s = trajectory.sent_s - by_s, trajectory.device_s
    in_force = np.searchsorted(sent_s, device_s + 1e-9, side="right") - 1
    known, at = in_force >= 0, np.maximum(in_force, 0)
    return dataclasses.replace(
        trajectory,
        sent_s=sent_s,
        command_sequence=np.where(known, trajectory.sent_sequence[at], -1),
        command_age_s=np.where(known, np.maximum(device_s - sent_s[at], 0.0), np.nan),
    )


def _clock(table: Table) -> tuple[FloatArray, IntArray]:
    """Return stamps and rows of the samples that can be used: finite positions, one sample a stamp."""
    sound = np.isfinite(table.time_s) & np.isfinite(table.position).all(axis=1)
    if table.base_position is not None:
        sound &= np.isfinite(table.base_position).all(axis=1)
    rows = np.flatnonzero(sound)
    clock = table.time_s[rows]
    back = np.flatnonzero(np.diff(clock) < 0)
    if back.size:
        raise DatasetError(
            f"{table.name}: the clock goes backwards {back.size} times, first after {clock[back[0]]:.6g} s; "
            "cut the file there, or sort it if its rows were only mixed up"
        )
    first = np.concatenate(([True], np.diff(clock) > 0)) if clock.size else np.empty(0, dtype=bool)
    return clock[first], rows[first]


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """Samples and commands of a part on the grid.

    Attributes:
        index: Grid index of each sample, (T,).
        values: By name, (T, K).
        sent_s: Commands since the first sample, all of the table, (C,) [s].
        method: "kept" or "interpolated".
        shift_s: Largest distance of a sample of the grid to the nearest stamp [s].
    """

    index: IntArray
    values: dict[str, FloatArray]
    sent_s: FloatArray
    method: str
    shift_s: float


def _recording(
    table: Table,
    rows: IntArray,
    clock: FloatArray,
    period: float,
    gains: Gains | None,
    facts: dict[str, Any],
) -> Recording | None:
    """Return a part on the grid; None where fewer than two points of the grid lie in it."""
    values = {"position": table.position[rows], "velocity": _velocity(table, rows, clock)}
    values["effort"] = (
        np.full(values["position"].shape, np.nan) if table.effort is None else table.effort[rows]
    )
    if table.orientation is not None:
        values["orientation"] = _one_hemisphere(table.orientation[rows])
    for name in ("gyro", "base_position", "base_velocity"):
        if (found := getattr(table, name)) is not None:
            values[name] = found[rows]
    index = np.round(np.diff(clock) / period).clip(1).cumsum().astype(np.int64)
    index = np.concatenate(([0], index))
    # A few ppm between this recording's clock and the grid's accumulate, so evenness is judged step by step.
    # Over a pause they accumulate more.
    steps = np.diff(clock)
    uneven = (np.abs(steps - np.diff(index) * period) > EVEN * period) & (steps <= GAP_PERIODS * period)
    even = not uneven.any()
    put = _keep if even else _interpolate
    placed = put(clock, index, period, values, table.command_s)
    if placed is None:
        return None
    metadata = {
        "purpose": "import",
        "import": {**facts, "method": placed.method, "largest_shift_s": placed.shift_s},
    }
    device_s = np.asarray(placed.index * period, dtype=np.float64)
    trajectory = _trajectory(table, device_s, placed.sent_s, placed.values, gains, metadata)
    return Recording(trajectory=trajectory)


def _keep(
    clock: FloatArray, index: IntArray, period: float, values: dict[str, FloatArray], command_s: FloatArray
) -> _Placed:
    """Move the stamps to the grid and the commands' stamps along with them."""
    grid_s = index * period
    sent_s = np.interp(command_s, clock, grid_s)
    sent_s = np.where(command_s < clock[0], command_s - clock[0], sent_s)
    sent_s = np.where(command_s > clock[-1], command_s - clock[-1] + grid_s[-1], sent_s)
    off = clock - clock[0] - grid_s
    # Only differences of time matter, so the grid is placed where it fits best.
    shift_s = float(np.max(off) - np.min(off)) / 2
    return _Placed(index, dict(values), sent_s, "kept", shift_s)


def _interpolate(
    clock: FloatArray, index: IntArray, period: float, values: dict[str, FloatArray], command_s: FloatArray
) -> _Placed | None:
    """Interpolate the measurements linearly at the grid's times; commands keep their own times."""
    origin = clock[0] + float(np.median(clock - clock[0] - index * period))
    first = np.ceil((clock[0] - origin) / period - EVEN)
    number = np.arange(first, (clock[-1] - origin) / period + EVEN)
    times = origin + number * period
    after = np.clip(np.searchsorted(clock, times), 1, clock.size - 1)
    known = clock[after] - clock[after - 1] <= GAP_PERIODS * period
    if np.count_nonzero(known) < 2:
        return None
    number, times, after = number[known], times[known], after[known]
    nearest = np.minimum(np.abs(clock[after] - times), np.abs(clock[after - 1] - times))
    read = {
        name: np.stack([np.interp(times, clock, column) for column in array.T], axis=1)
        for name, array in values.items()
    }
    if "orientation" in read:
        read["orientation"] /= np.linalg.norm(read["orientation"], axis=1, keepdims=True)
    begin = (number - number[0]).astype(np.int64)
    return _Placed(begin, read, command_s - times[0], "interpolated", float(np.max(nearest)))


def _one_hemisphere(quaternion: FloatArray) -> FloatArray:
    """Return quaternions, each with the sign nearer to its predecessor; q and -q are one orientation."""
    turn = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    sign = np.where(np.cumsum(np.concatenate(([False], turn))) % 2 == 1, -1.0, 1.0)
    return quaternion * sign[:, None]


def _velocity(table: Table, rows: IntArray, clock: FloatArray) -> FloatArray:
    """Return measured velocities, or differences of the positions if the file has none."""
    difference = np.gradient(table.position[rows], clock, axis=0)
    if table.velocity is None:
        return np.asarray(difference)
    return np.where(np.isfinite(table.velocity[rows]), table.velocity[rows], difference)


def _body(measured: dict[str, FloatArray], T: int, J: int) -> BodyTrajectory | None:
    """Return only the base's orientation and angular velocity; None if there is neither."""
    if not {"orientation", "gyro"} & set(measured):
        return None
    nothing = np.full(T, np.nan)
    return BodyTrajectory(
        orientation=measured.get("orientation", np.full((T, 4), np.nan)),
        angular_velocity=measured.get("gyro", np.full((T, 3), np.nan)),
        acceleration=np.full((T, 3), np.nan),
        foot_force=np.empty((T, 0)),
        temperature=np.full((T, J), np.nan),
        lost=np.zeros((T, J)),
        battery=nothing,
        voltage=nothing,
        current=nothing,
        sticks=np.full((T, 4), np.nan),
        buttons=np.full(T, -1),
    )


def _base(measured: dict[str, FloatArray], T: int) -> BaseTrajectory | None:
    """Return the place of a base; None if nothing reports it."""
    if "base_position" not in measured:
        return None
    return BaseTrajectory(measured["base_position"], measured.get("base_velocity", np.full((T, 3), np.nan)))


def _trajectory(
    table: Table,
    device_s: FloatArray,
    sent_s: FloatArray,
    measured: dict[str, FloatArray],
    gains: Gains | None,
    metadata: dict[str, Any],
) -> Trajectory:
    # A command before the part counts if it is still active at its start; commands after its end have no
    # sample.
    order = np.argsort(sent_s, kind="stable")
    sent_s, target = sent_s[order], table.target[order]
    begin = max(int(np.searchsorted(sent_s, 1e-9, side="right")) - 1, 0)
    end = int(np.searchsorted(sent_s, device_s[-1] + 1e-9, side="right"))
    sent_s, target = sent_s[begin:end], target[begin:end]
    # Stamps that agree to the nanosecond are one time; rounding must not delay a command by a period.
    in_force = np.searchsorted(sent_s, device_s + 1e-9, side="right") - 1
    age = np.full(device_s.size, np.nan)
    known = in_force >= 0
    age[known] = np.maximum(device_s[known] - sent_s[in_force[known]], 0.0)
    C, A = target.shape
    nothing = (math.nan,) * A
    unknown = Gains(stiffness=nothing, damping=nothing, effort_limit=nothing, speed_limit=nothing)

    def each(setting: tuple[float, ...]) -> FloatArray:
        return np.tile(np.array(setting, dtype=np.float64), (C, 1)).reshape(C, A)

    servo = gains or unknown
    return Trajectory(
        joint_names=table.joint_names,
        actuated=table.actuated,
        receive_s=device_s,
        device_s=device_s,
        position=measured["position"],
        velocity=measured["velocity"],
        effort=measured["effort"],
        status=np.full(device_s.size, int(Status.ARMED)),
        command_sequence=in_force.astype(np.int64),
        command_age_s=age,
        sent_s=sent_s,
        sent_sequence=np.arange(C),
        body=_body(measured, device_s.size, len(table.joint_names)),
        base=_base(measured, device_s.size),
        requested_position=target,
        position_target=target,
        stiffness=each(servo.stiffness),
        damping=each(servo.damping),
        effort_limit=each(servo.effort_limit),
        speed_limit=each(servo.speed_limit),
        metadata=metadata,
    )
