"""Start states of rollouts: how well a recording shows its first state, and the spread of drawn ones.

A search that compares distributions of motion rolls a policy out from the recording's first state. Where the
recording does not show that state well, its rollouts begin in states drawn from the whole recording instead,
each moved by what is not known of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.errors import UnknownNameError
from deal_hw.types import FloatArray

KNOWN_SHARE = 0.25
"""Largest uncertainty of an entry of a known first state, as a share of its spread in the recording."""

MOVES = 1.5
"""Least spread of an entry that moves, as a multiple of its typical uncertainty: of one at rest, every state
of the recording is as uncertain as the first."""


def state_names(problem: Problem) -> tuple[str, ...]:
    """Return the names of the entries of (position, velocity), (2 C,)."""
    names = problem.robot.coordinates
    return (*names, *(f"{name}.velocity" for name in names))


def own_std(problem: Problem, index: int) -> FloatArray:
    """Return the uncertainty of an episode's states, (T, 2 C); 0 where nothing is known of it.

    Smoothed states count with twice their noise, for kinks that are no polynomials; here it is once.
    """
    std = 0.5 * problem.starts[index].std
    return np.where(np.isfinite(std), std, 0.0)


def uncertain_entries(problem: Problem, first: Sequence[int]) -> dict[str, float]:
    """Return which entries of the first states the recordings do not show well.

    Args:
        problem: The recordings.
        first: Sample of each episode at which its rollout begins.

    Returns:
        Name of an entry, and its uncertainty as a share of its spread in the recording; the largest of all
        episodes.
    """
    found: dict[str, float] = {}
    for index, row in enumerate(first):
        states, std = problem.starts[index], own_std(problem, index)
        spread = np.concatenate([states.position.std(axis=0), states.velocity.std(axis=0)])
        moves = spread > MOVES * np.median(std, axis=0)
        share = std[row] / np.maximum(spread, 1e-12)
        for c in np.flatnonzero(moves & (share > KNOWN_SHARE)):
            name = state_names(problem)[c]
            found[name] = max(found.get(name, 0.0), float(share[c]))
    return found


def drawn_start(problem: Problem, index: int, row: int, given: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where the true state lies, from a recorded one: mean and standard deviation, (2 C,) each.

    A recorded entry x has the spread S in the recording, of which its uncertainty e is a part. So the true
    entry is normal around x - (e / S)^2 (x - mean), with variance e^2 (1 - (e / S)^2): states drawn in this
    way have the true spread, those drawn around x would have more than the recorded one.

    Args:
        problem: The recordings.
        index: Number of an episode.
        row: The recorded state.
        given: Standard deviation of entries that the recording does not show, which are drawn around x; NaN:
            of the others.
    """
    states, std = problem.starts[index], own_std(problem, index)[row]
    every = np.concatenate([states.position, states.velocity], axis=1)
    share = np.minimum((std / np.maximum(every.std(axis=0), 1e-12)) ** 2, 1.0)
    shown = np.isnan(given)
    middle = np.where(shown, -share * (every[row] - every.mean(axis=0)), 0.0)
    return middle, np.where(shown, std * np.sqrt(1.0 - share), given)


def given_std(problem: Problem, given: Mapping[str, float]) -> FloatArray:
    """Return the spread of drawn start states, (2 C,): the given entries, NaN for the recording's own.

    Raises:
        UnknownNameError: A name is no entry of the state.
    """
    names = state_names(problem)
    found = np.full(len(names), np.nan)
    for name, std in given.items():
        if name not in names:
            raise UnknownNameError("entry of the start state", name, names)
        found[names.index(name)] = std
    return found
