"""Makes channels of the decoded messages of a bag: ``/topic.field``, joints merged by name."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from deal_hw.data.importing.channels import Channels, as_floats
from deal_hw.errors import short
from deal_hw.reading import NAMES
from deal_hw.types import FloatArray

Row: TypeAlias = dict[str, Any]
"""The fields of a message by dotted name; with ``log_time`` [ns], and the joints under ``name``."""
STAMP_FIELDS = ("log_time", "header.stamp")
"""Times of each topic [s]: the recorder's time of receipt, and the sender's time."""
NAME_FIELDS = ("name", "joint_names", "dof_names")
"""Fields that name the joints of a message."""


def channels_of_topics(
    path: Path,
    kind: str,
    digest: str,
    topics: Mapping[str, list[Row]],
    types: Mapping[str, str],
    left_out: Mapping[str, str],
) -> Channels:
    """Return the channels of a bag.

    Args:
        path: The bag.
        kind: Its kind, for :class:`~deal_hw.data.importing.channels.Channels`.
        digest: Digest of its bytes.
        topics: The messages of each topic, in any order.
        types: The message type of each topic.
        left_out: Topics that were not decoded, and why; "" for others.
    """
    arrays: dict[str, FloatArray] = {}
    labels: dict[str, tuple[str, ...]] = {}
    notes = [f"{short(topic, 60)} is left out: {why}" for topic, why in left_out.items() if why]
    zero_ns = _first_stamp(topics)
    for topic, rows in topics.items():
        rows.sort(key=lambda row: int(row["log_time"]))
        merged = _Merged(topic, rows)
        notes += merged.notes
        for field in merged.rows[0]:
            if (values := merged.channel(field, zero_ns)) is not None:
                arrays[f"{topic}.{field}"] = values
                if merged.names and values.ndim == 2 and values.shape[1] == len(merged.names):
                    labels[f"{topic}.{field}"] = merged.names
        notes += merged.notes_of_sizes()
    return Channels(
        path=path, kind=kind, digest=digest, arrays=arrays, labels=labels, types=types, notes=tuple(notes)
    )


def is_list(value: Any) -> bool:
    """Return whether a field is a list of numbers or texts."""
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
        return False
    return len(value) == 0 or isinstance(value[0], (int, float, str, np.number))


def named(row: Row) -> tuple[str, ...]:
    """Return the joints that a message names; () if it names none."""
    names = next((row[field] for field in NAME_FIELDS if field in row), ())
    return tuple(names) if is_list(names) and all(isinstance(name, str) for name in names) else ()


def _first_stamp(topics: Mapping[str, list[Row]]) -> int:
    """Return the earliest stamp in the file [ns], the zero of all.

    It is subtracted in integers, since absolute nanoseconds would lose their last digits as floats.
    """
    every = (row for rows in topics.values() for row in rows)
    return min((row[kind] for row in every for kind in STAMP_FIELDS if row.get(kind, 0) > 0), default=0)


class _Merged:
    """The messages of one topic. Where they name different joints, these are merged by name.

    An arm and its gripper often publish on one topic, each its own joints. The joints of most messages set
    the times; the others are interpolated there.

    Attributes:
        names: All joints, in the order in which messages first name them.
        rows: The messages that set the times.
        notes: What was merged.
    """

    def __init__(self, topic: str, rows: list[Row]) -> None:
        self._topic, self._every = topic, rows
        groups = Counter(frozenset(row["name"]) for row in rows)
        most = max(groups, key=lambda group: groups[group])
        self.rows = rows
        self.names: tuple[str, ...] = rows[0]["name"]
        self.notes: list[str] = []
        if len(groups) > 1:
            self.rows = [row for row in rows if frozenset(row["name"]) == most]
            every = dict.fromkeys(itertools.chain.from_iterable(row["name"] for row in rows))
            self.names = tuple(itertools.islice(every, NAMES))
            parts = "; ".join(
                f"{', '.join(sorted(group)) or 'none'}: {count}" for group, count in groups.items()
            )
            self.notes.append(
                f"the messages on {short(topic, 60)} name different joints ({short(parts, 120)} messages): "
                f"they are merged by name, at the times of those with {short(', '.join(sorted(most)), 60)}"
            )
        self._sizes: dict[str, Counter[int]] = {}

    def channel(self, field: str, zero_ns: int) -> FloatArray | None:
        """Return a field, (T,) or (T, K); None if it is not numbers of one length."""
        if field in STAMP_FIELDS:
            return _seconds(self.rows, field, zero_ns)
        if any(row.get(field) is None for row in self.rows):
            return None
        if not is_list(self.rows[0][field]):
            return as_floats([row[field] for row in self.rows])
        if self.rows is not self._every and len(self.rows[0][field]) == len(self.rows[0]["name"]):
            return self._by_name(field, zero_ns)
        sizes = Counter(len(row[field]) for row in self.rows)
        if len(sizes) != 1 or 0 in sizes or any(isinstance(value, str) for value in self.rows[0][field]):
            if len(sizes) > 1 and field not in NAME_FIELDS:
                self._sizes[field] = sizes
            return None
        table = as_floats([row[field] for row in self.rows])
        if self.names and table.shape[1] == len(self.names):
            for number, row in enumerate(self.rows):
                if row["name"] != self.names:
                    table[number] = table[number, [row["name"].index(name) for name in self.names]]
        return table

    def notes_of_sizes(self) -> list[str]:
        """Return a note for each field that is left out since its number of values changes."""
        notes = []
        for field, sizes in self._sizes.items():
            (usual, _), *_, (other, count) = sizes.most_common()
            notes.append(
                f"{short(self._topic, 60)}.{field} is left out: {count} of {len(self.rows)} messages have "
                f"{other} values, others {usual}"
            )
        return notes

    def _by_name(self, field: str, zero_ns: int) -> FloatArray | None:
        """Return a field of all joints at the times of the messages that set them, (T, J); NaN outside."""
        if not all(isinstance(value, (int, float, np.number)) for value in self.rows[0][field]):
            return None
        stamp = "header.stamp" if all(row.get("header.stamp", 0) > 0 for row in self._every) else "log_time"
        times = _seconds(self.rows, stamp, zero_ns)
        each: dict[str, list[tuple[int, float]]] = {name: [] for name in self.names}
        for row in self._every:
            values = row.get(field, ())
            if len(values) == len(row["name"]):
                for name, value in zip(row["name"], values, strict=True):
                    if name in each:
                        each[name].append((row[stamp], float(value)))
        table = np.full((len(times), len(self.names)), np.nan)
        for column, found in enumerate(each.values()):
            if not found:
                continue
            stamps, values = zip(*sorted(found), strict=True)
            own = (np.array(stamps, dtype=np.int64) - zero_ns) * 1e-9
            # A message may come just after the last time, which is no reason to lose that sample.
            slack = float(np.median(np.diff(own))) if len(own) > 1 else 0.0
            outside = np.maximum(own[0] - times, times - own[-1])
            table[:, column] = np.where(outside <= slack, np.interp(times, own, values), np.nan)
        return table


def _seconds(rows: Sequence[Row], field: str, zero_ns: int) -> FloatArray:
    stamps = np.array([row[field] for row in rows], dtype=np.int64) - zero_ns
    return np.asarray(stamps.astype(np.float64) * 1e-9)
