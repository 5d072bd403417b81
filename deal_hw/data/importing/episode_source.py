"""Reads our own episode as channels, so that joints can be renamed and selected as in any other file."""

from __future__ import annotations

from pathlib import Path

from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.table import table_of


def read_own(path: Path) -> Channels:
    """Read an episode: samples on device time, commands at the device time of their start.

    Raises:
        TornRecordingError: It has no footer or is damaged.
        DatasetError: It cannot be read.
    """
    table = table_of(read_trajectory(path), path.name)
    arrays = {
        "time_s": table.time_s,
        "position": table.position,
        "command_time_s": table.command_s,
        "target": table.target,
    }
    for name, values in (("velocity", table.velocity), ("effort", table.effort)):
        if values is not None:
            arrays[name] = values
    measured = dict.fromkeys(("position", "velocity", "effort"), table.joint_names)
    return Channels(
        path=path,
        kind="deal-hw",
        digest=digest_of_file(path),
        arrays=arrays,
        labels={name: joints for name, joints in measured.items() if name in arrays}
        | {"target": table.actuated},
        units={"position": table.units},
    )
