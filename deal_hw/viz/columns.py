"""Columns for rerun on a recording's two clocks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray, Trajectory
from deal_hw.viz.backend import rr

DEVICE_TIMELINE = "device_time"
"""Time on the robot's own clock since the first sample: the clock of motion and simulation."""
HOST_TIMELINE = "host_time"
"""Time on the host's clock since the first sample: of a sample its reception, of a command its sending."""


def nanoseconds(time_s: FloatArray) -> npt.NDArray[np.int64]:
    """Return seconds as whole nanoseconds."""
    return np.round(np.asarray(time_s) * 1e9).astype(np.int64)


def indexes(device_s: FloatArray, host_s: FloatArray) -> list[Any]:
    """Return the two time columns of T rows."""
    clocks = ((DEVICE_TIMELINE, device_s), (HOST_TIMELINE, host_s))
    return [
        rr.TimeColumn(name, duration=nanoseconds(time_s).astype("timedelta64[ns]")) for name, time_s in clocks
    ]


def host_to_device(trajectory: Trajectory, host_s: FloatArray) -> FloatArray:
    """Return host times on the device's clock, by the clocks' offset at the samples around them."""
    if not trajectory.receive_s.size:
        return np.array(host_s, dtype=float)
    offset = trajectory.device_s - trajectory.receive_s
    return np.asarray(host_s + np.interp(host_s, trajectory.receive_s, offset))


def command_device_times(trajectory: Trajectory) -> FloatArray:
    """Return when the device received each command, on its clock, (C,) [s].

    Exact where a sample reports the command in force; by the clocks' offset for commands that none reports.
    """
    times = host_to_device(trajectory, trajectory.sent_s)
    seen, first = np.unique(trajectory.command_sequence, return_index=True)
    received = trajectory.device_s[first] - trajectory.command_age_s[first]
    place = {int(sequence): i for i, sequence in enumerate(trajectory.sent_sequence)}
    for sequence, at in zip(seen, received, strict=True):
        if int(sequence) in place and np.isfinite(at):
            times[place[int(sequence)]] = at
    return times


class Log:
    """Writes columns of scalars, poses and texts of one recording."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def line(
        self, path: str, name: str, color: tuple[int, int, int], *, width: float = 1.5, step: bool = False
    ) -> None:
        """Set the style of an entity's scalars; ``step`` holds each value until the next."""
        mode = rr.components.InterpolationMode.StepAfter if step else rr.components.InterpolationMode.Linear
        style = rr.SeriesLines(colors=[color], widths=[width], names=[name], interpolation_mode=mode)
        self.stream.log(path, style, static=True)

    def scalars(self, path: str, device_s: FloatArray, host_s: FloatArray, values: FloatArray) -> None:
        """Write T scalars; a NaN breaks the line."""
        if len(values):
            self.stream.send_columns(path, indexes(device_s, host_s), rr.Scalars.columns(scalars=values))

    def poses(
        self,
        path: str,
        device_s: FloatArray,
        host_s: FloatArray,
        position: FloatArray,
        quaternion: FloatArray,
    ) -> None:
        """Write T poses, (T, 3) and w x y z (T, 4); those that are not finite are left out."""
        # Rerun draws a shape with a NaN pose at the origin.
        known = np.isfinite(position).all(axis=1) & np.isfinite(quaternion).all(axis=1)
        xyzw = np.roll(quaternion[known], -1, axis=1)
        columns = rr.Transform3D.columns(translation=position[known], quaternion=xyzw)
        self.stream.send_columns(path, indexes(device_s[known], host_s[known]), columns)

    def texts(
        self, path: str, device_s: FloatArray, host_s: FloatArray, texts: Iterable[str], levels: Iterable[str]
    ) -> None:
        """Write T lines of a text log."""
        columns = rr.TextLog.columns(text=list(texts), level=list(levels))
        self.stream.send_columns(path, indexes(device_s, host_s), columns)

    def states(self, path: str, device_s: FloatArray, host_s: FloatArray, states: Iterable[str]) -> None:
        """Write T states of a state timeline."""
        self.stream.send_columns(path, indexes(device_s, host_s), rr.StateChange.columns(state=list(states)))
