"""One recording in SI units, on its own stamps: what checks read and what imports make."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray, IntArray, Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """T measured samples and C commands of one recording.

    Attributes:
        joint_names: The J joints.
        actuated: The A joints that have commands, in the order of the joints.
        units: Unit of each position, "rad" or "m", (J,).
        time_s: Stamps of the samples since the first of them, as recorded, (T,) [s].
        position: (T, J) [rad or m].
        velocity: (T, J) [rad/s or m/s], or None.
        effort: (T, J), in the file's unit, or None.
        command_s: Stamps of the commands on the same clock and zero, (C,) [s].
        target: Commanded positions, (C, A) [rad or m].
        orientation: Base orientation, quaternion w x y z, (T, 4), or None.
        gyro: Angular velocity of the base in its own frame, (T, 3) [rad/s], or None.
        source: Origin and changes: plain JSON values.
        base_position: Place of the base in the world, (T, 3) [m], or None.
        base_velocity: Its velocity in the world, (T, 3) [m/s], or None.
    """

    joint_names: tuple[str, ...]
    actuated: tuple[str, ...]
    units: tuple[str, ...]
    time_s: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray | None
    command_s: FloatArray
    target: FloatArray
    orientation: FloatArray | None
    gyro: FloatArray | None
    source: dict[str, Any]
    base_position: FloatArray | None = None
    base_velocity: FloatArray | None = None

    @property
    def actuated_index(self) -> tuple[int, ...]:
        """Index of each actuated joint among the joints, (A,)."""
        return tuple(self.joint_names.index(name) for name in self.actuated)

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"{self.source['file']} {self.source['part']}".strip()

    def target_at(self, time_s: FloatArray) -> FloatArray:
        """Return the active command at N times, (N, A); before the first command, that one."""
        rows = np.searchsorted(self.command_s, time_s + 1e-9, side="right") - 1
        return np.asarray(self.target[np.maximum(rows, 0)])

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """Return the positions at N times, (N, J), linear between samples whose positions are all finite."""
        sound = np.isfinite(self.position).all(axis=1)
        columns = self.position[sound].T
        return np.stack([np.interp(time_s, self.time_s[sound], column) for column in columns], axis=1)

    def in_order(self, joint_names: Sequence[str], actuated: Sequence[str] | None = None) -> Table:
        """Return the recording with its joints, all of them, in another order.

        Args:
            joint_names: The order.
            actuated: Order of the commands; None: that of the joints.
        """
        order = [self.joint_names.index(name) for name in joint_names]
        arrays = {
            name: values[:, order]
            for name in ("position", "velocity", "effort")
            if (values := getattr(self, name)) is not None
        }
        if actuated is None:
            actuated = [name for name in joint_names if name in self.actuated]
        columns = [self.actuated.index(name) for name in actuated]
        return dataclasses.replace(
            self,
            joint_names=tuple(joint_names),
            units=tuple(self.units[i] for i in order),
            actuated=tuple(actuated),
            target=self.target[:, columns],
            **arrays,
        )

    def commanded(self, names: Collection[str]) -> Table:
        """Return the recording with the commands of these joints only."""
        columns = [a for a, name in enumerate(self.actuated) if name in names]
        return dataclasses.replace(
            self, actuated=tuple(self.actuated[a] for a in columns), target=self.target[:, columns]
        )

    def rows(self, kept: npt.NDArray[np.bool_]) -> Table:
        """Return the recording with these samples only, (T,); commands stay."""
        optional: dict[str, Any] = {
            name: values[kept]
            for name in ("velocity", "effort", "orientation", "gyro", "base_position", "base_velocity")
            if (values := getattr(self, name)) is not None
        }
        return dataclasses.replace(self, time_s=self.time_s[kept], position=self.position[kept], **optional)


def table_of(trajectory: Trajectory, name: str = "episode") -> Table:
    """Return a trajectory as a table, with commands at the device time of their start."""
    rows, command_s = _receptions(trajectory)
    return Table(
        joint_names=trajectory.joint_names,
        actuated=trajectory.actuated,
        units=position_units(trajectory),
        time_s=trajectory.device_s,
        position=trajectory.position,
        velocity=trajectory.velocity,
        effort=trajectory.effort if np.isfinite(trajectory.effort).any() else None,
        command_s=command_s,
        target=trajectory.position_target[rows],
        orientation=None,
        gyro=None,
        source={"file": name, "part": "", "kind": "deal-hw", "sha256": "", "columns": [], "notes": []},
    )


def _receptions(trajectory: Trajectory) -> tuple[IntArray, FloatArray]:
    """Return the commands that came into force, (C,), and the device time of each, (C,) [s].

    A command that no sample reports was lost, unless no sample came while it would have been reported. Then
    it is placed by the clocks' offset, which follows from the reported commands.
    """
    row_of = {int(number): row for row, number in enumerate(trajectory.sent_sequence)}
    numbers, first = np.unique(trajectory.command_sequence, return_index=True)
    received_s = trajectory.device_s[first] - np.nan_to_num(trajectory.command_age_s[first])
    begins = {
        row_of[int(n)]: float(at) for n, at in zip(numbers, received_s, strict=True) if int(n) in row_of
    }
    reported = sorted(begins)
    sent_s = trajectory.sent_s
    offset = float(np.median([begins[row] - sent_s[row] for row in reported])) if reported else 0.0
    for before, after in itertools.pairwise(reported):
        for row in range(before + 1, after):
            begin = float(sent_s[row] + offset)
            until = begins[after] if row + 1 == after else float(sent_s[row + 1] + offset)
            sampled = np.searchsorted(trajectory.device_s, [begin, until])
            if begins[before] < begin < until and sampled[0] == sampled[1]:
                begins[row] = begin
    rows = np.array(sorted(begins), dtype=np.int64)
    return rows, np.array([begins[int(row)] for row in rows])


def position_units(trajectory: Trajectory) -> tuple[str, ...]:
    """Return the unit of each position, "rad" if the recording does not name it, (J,)."""
    units = trajectory.metadata.get("description", {}).get("position_units")
    return tuple(units) if units else ("rad",) * len(trajectory.joint_names)
