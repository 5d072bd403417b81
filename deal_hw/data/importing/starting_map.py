"""Writes a guessed column map as a user would, with places to fill where channels were not guessed."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence

from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.columns import ColumnMap, JointColumns, TimeColumn
from deal_hw.data.importing.guess import channels_of_joints, guess_columns, guess_time
from deal_hw.errors import DatasetError

COLUMN = "COLUMN"
"""Stands for a name that the user writes."""
_QUANTITIES = ("position", "target", "velocity", "effort")


def starting_map(
    channels: Channels, joints: Sequence[str] | None = None, guessed: ColumnMap | None = None
) -> list[str]:
    """Return the lines of a column map (YAML): the guessed entries, and :data:`COLUMN` for the others.

    Args:
        channels: The file's channels.
        joints: Names of the model's joints; None: unknown.
        guessed: The entries that were guessed; None: no complete map was.
    """
    time = guess_time(channels) if guessed is None else guessed.time
    if time is None:
        # The joints may be known although the time is not.
        with contextlib.suppress(DatasetError):
            guessed = guess_columns(channels, joints, TimeColumn(column=COLUMN))
    known = {} if guessed is None else {joint.name: joint for joint in guessed.joints}
    stamps = {"time": time, "command_time": guessed.command_time if guessed else None}
    lines = [
        f"{name}: {{column: {COLUMN if stamp is None else json.dumps(stamp.column)}, "
        f"unit: {'s' if stamp is None else stamp.unit}}}"
        for name, stamp in stamps.items()
        if stamp is not None or name == "time"
    ]
    for name in _QUANTITIES:
        pattern = getattr(guessed, name, None)
        if pattern is not None:
            lines.append(f"{name}: {json.dumps(pattern)}")
    names = joints or tuple(known) or ("JOINT",)
    partly = channels_of_joints(channels, time, joints)
    entries = [_entries(name, known.get(name), partly.get(name, {})) for name in names]
    return [*lines, "joints:", *(f"  - {{{entry}}}" for entry in entries)]


def _entries(name: str, joint: JointColumns | None, partly: Mapping[str, str]) -> str:
    if joint is None:
        position, target = (
            json.dumps(partly[key]) if key in partly else COLUMN for key in ("position", "target")
        )
        return f"name: {json.dumps(name)}, position: {position}, target: {target}, unit: rad"
    values = {
        key: getattr(joint, key) for key in ("name", "column", "index", *_QUANTITIES, "unit", "target_unit")
    }
    return ", ".join(
        f"{key}: {json.dumps(value)}" for key, value in values.items() if value not in (None, "")
    )
