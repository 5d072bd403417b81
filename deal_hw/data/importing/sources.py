"""Refuses a recording in which two programs wrote in turn, such as two publishers on one topic."""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.data.table import Table
from deal_hw.errors import DatasetError
from deal_hw.types import FloatArray

APART: Final = 5.0
"""Steps between samples, over those within each of two sources, from which on two are said [-]. One smooth
motion, however it is divided, stays below 1.5; white noise below 3."""
LEAST: Final = 0.05
"""Least share of the samples that the second source has [-]. Single samples that jump are spikes."""
LONGEST: Final = 2.5
"""Mean number of samples that the rarer source has in a row, up to which the two are said to be interleaved
[-]. A joint that jumps between two places stays there for longer."""
LOOKED_AT: Final = 20_000
"""Most samples that are divided."""
FEWEST: Final = 20
"""Fewer samples show no second source."""


def check_one_source(table: Table) -> None:
    """Check that the positions are of one source.

    Samples are divided into two tracks, each going to the track whose last one is nearer. Two sources leave
    two tracks that move in small steps, in turn.

    Raises:
        DatasetError: They are of two.
    """
    position = table.position[np.isfinite(table.position).all(axis=1)][:LOOKED_AT]
    span = np.ptp(position, axis=0) if len(position) else np.zeros(1)
    if len(position) < FEWEST or not span.any():
        return
    scaled = position[:, span > 0] / span[span > 0]
    steps = np.linalg.norm(np.diff(scaled, axis=0), axis=1)
    second = _second(scaled, int(np.argmax(steps)) + 1)
    share = float(np.mean(second))
    if not LEAST <= share <= 1 - LEAST:
        return
    tracks = [scaled[second], scaled[~second]]
    within = np.concatenate([np.linalg.norm(np.diff(track, axis=0), axis=1) for track in tracks])
    if np.mean(steps) < APART * np.mean(within):
        return
    share = min(share, 1 - share)
    changes = int(np.sum(second[1:] != second[:-1]))
    if changes * LONGEST < 2 * share * len(second):
        return
    raise DatasetError(
        f"{table.name}: two sources are interleaved: {share:.0%} of the samples are of a second one, and the "
        f"reading jumps {changes} times between the two. Two programs publish the same joints on one topic "
        "(such as a joint_state_publisher beside the driver), or a sensor drops out. Stop one program and "
        "record again, or keep the messages of one"
    )


def _second(scaled: FloatArray, jump: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which samples, (T, J), go to the second track, (T,); that begins with the one after the jump."""
    second = np.zeros(len(scaled), dtype=bool)
    for rows in (range(jump + 1, len(scaled)), range(jump - 2, -1, -1)):
        first_last, second_last = scaled[jump - 1], scaled[jump]
        for row in rows:
            here = scaled[row]
            to_first, to_second = here - first_last, here - second_last
            second[row] = to_second @ to_second < to_first @ to_first
            if second[row]:
                second_last = here
            else:
                first_last = here
    second[jump] = True
    return second
