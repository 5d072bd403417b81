"""Parts of an episode: stretches short enough for many members, and a last part for evaluation."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from deal_hw.parameters import LONGEST_LATENCY_S
from deal_hw.sim.recordings.episode import SAMPLED, SENT, SampledEpisode

LEAD_S = LONGEST_LATENCY_S
"""Length of commands kept before a part's first sample [s]: the longest latency."""


def part(episode: SampledEpisode, first: int, last: int) -> SampledEpisode:
    """Return the samples first .. last - 1 of an episode, with the commands that act on them.

    Set-points without a speed limit depend on nothing older than the latency. With a limit, the set-point at
    the part's beginning is assumed to have reached its target.
    """
    lead = round(LEAD_S / episode.step_s)
    origin = max(int(episode.sample[first]) - lead, 0)
    until = max(int(episode.sample[last - 1]), origin + 1)
    start = episode.start_setpoint if origin == 0 else episode.target[origin - 1]
    return dataclasses.replace(
        episode.cut(slice(first, last), slice(origin, until)),
        sample=episode.sample[first:last] - origin,
        start_setpoint=start,
        first_row=episode.first_row + first,
        origin=episode.origin + origin,
    )


def stretches(episode: SampledEpisode, seconds: float) -> list[SampledEpisode]:
    """Cut an episode into parts of equal length, none longer than ``seconds``; they share end samples."""
    T = len(episode.sample)
    count = max(int(np.ceil((T - 1) * episode.period_s / seconds)), 1)
    edges = np.linspace(0, T - 1, count + 1).round().astype(int)
    return [part(episode, int(a), int(b) + 1) for a, b in itertools.pairwise(edges) if b > a]


def joined(parts: Sequence[SampledEpisode]) -> list[SampledEpisode]:
    """Return parts with consecutive ones joined: the inverse of `stretches`."""
    found: list[SampledEpisode] = []
    for after in parts:
        if found and _follows(found[-1], after):
            found[-1] = _joined(found[-1], after)
        else:
            found.append(after)
    return found


def _follows(before: SampledEpisode, after: SampledEpisode) -> bool:
    """Return whether a part begins with the last sample of another."""
    return (
        after.first_row == before.first_row + len(before.sample) - 1
        and after.origin + int(after.sample[0]) == before.origin + int(before.sample[-1])
        and 0 <= after.origin - before.origin <= before.steps
        and np.array_equal(after.position[0], before.position[-1])
    )


def _joined(before: SampledEpisode, after: SampledEpisode) -> SampledEpisode:
    shift = after.origin - before.origin
    samples: dict[str, Any] = {
        name: np.concatenate([getattr(before, name)[:-1], getattr(after, name)])
        for name, axes in SAMPLED.items()
        if np.ndim(getattr(before, name)) == np.ndim(getattr(after, name)) == axes
    }
    samples["sample"] = np.concatenate([before.sample[:-1], after.sample + shift])
    sent: dict[str, Any] = {
        name: np.concatenate([getattr(before, name)[:shift], getattr(after, name)]) for name in SENT
    }
    return dataclasses.replace(before, **samples, **sent)


def split_last(episode: SampledEpisode, share: float) -> tuple[SampledEpisode, SampledEpisode]:
    """Return an episode without its last part, and that part.

    Args:
        episode: The episode.
        share: Share of the samples in the last part, between 0 and 1.
    """
    at = round((1.0 - share) * (len(episode.sample) - 1))
    return part(episode, 0, at + 1), part(episode, at, len(episode.sample))


def spread(parts: Sequence[SampledEpisode], seconds: float) -> list[SampledEpisode]:
    """Return evenly spread parts that add up to about ``seconds``; all if they are shorter."""
    lengths = np.array([(len(p.sample) - 1) * p.period_s for p in parts])
    if lengths.sum() <= seconds:
        return list(parts)
    count = max(int(seconds / lengths.mean()), 1)
    chosen = np.unique(((np.arange(count) + 0.5) * len(parts) / count).astype(int))
    return [parts[i] for i in chosen]
