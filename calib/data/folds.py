"""Cross-validation: candidate fits are compared by their predictions of data that they left out.

The folds are parts of the fitted recordings; held-out recordings stay unseen.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.independent import in_order
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.errors import CalibrationError, InsufficientDataError
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray, IntArray

BLOCKS = 2
"""Stretches of each recording that a fold leaves out."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Result of cross-validation.

    Attributes:
        chosen: Name of the candidate.
        errors: Error of each candidate in each fold: root mean squared prediction error in units of the
            sensor's noise.
        window_s: Length of the predictions [s].
        steps: Physics steps used.
        note: Why nothing was compared.
    """

    chosen: str
    errors: Mapping[str, tuple[float, ...]]
    window_s: float
    steps: int = 0
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        if self.note:
            return {"chosen": self.chosen, "note": self.note}
        return {
            "chosen": self.chosen,
            "errors": {name: list(values) for name, values in self.errors.items()},
            "window_s": self.window_s,
            "steps": self.steps,
        }


def on_folds(
    problem: Problem,
    masks: Sequence[Sequence[npt.NDArray[np.bool_]]],
    fits: Callable[[Problem, int], Mapping[str, Member]],
    errors: Callable[[Problem, Sequence[Member]], FloatArray],
    usual: str,
    window_s: float,
    say: Callable[[int], None] = lambda fold: None,
) -> Choice:
    """Fit every candidate without each fold and compare the predictions of that fold.

    For each fold, ``masks`` hold the samples of each recording that it leaves out, (T,) each. ``fits`` makes
    all candidates from a fold's data and its number, ``errors`` returns each one's prediction error on a
    part, (N,); both are sent to workers where the problem has some. ``usual`` is taken where nothing is
    better or no fold can be fitted. ``say`` is called with the number of each fold that is waited for.
    """
    found: dict[str, list[float]] = {}
    folds = in_order(problem, partial(_on_fold, fits=fits, errors=errors), list(enumerate(masks)))
    with contextlib.closing(folds):
        for fold in range(len(masks)):
            say(fold)
            each = next(folds)
            if isinstance(each, str):
                return Choice(usual, {}, window_s, note=f"a fold's data cannot be fitted: {each}")
            for name, value in each.items():
                found.setdefault(name, []).append(value)
    means = {name: float(np.mean(np.log(values))) for name, values in found.items()}
    chosen = min(means, key=lambda name: (means[name], name != usual))
    return Choice(chosen, {n: tuple(v) for n, v in found.items()}, window_s)


def _on_fold(
    problem: Problem,
    fold: tuple[int, Sequence[npt.NDArray[np.bool_]]],
    fits: Callable[[Problem, int], Mapping[str, Member]],
    errors: Callable[[Problem, Sequence[Member]], FloatArray],
) -> dict[str, float] | str:
    """Return each candidate's error in a fold, or why the fold's data cannot be fitted."""
    number, left_out = fold
    try:
        members = fits(problem.part([~mask for mask in left_out]), number)
        each = errors(problem.part(left_out), list(members.values()))
    except (InsufficientDataError, CalibrationError) as err:
        return str(err)
    return dict(zip(members, map(float, each), strict=True))


def fold_numbers(count: int, folds: int, rounds: int) -> IntArray:
    """Return the fold that leaves out each of ``count`` items in a row, (count,).

    Each fold leaves out ``rounds`` stretches of items that follow each other; one where items are too few.
    """
    rounds = rounds if count >= rounds * folds else 1
    return np.asarray(np.arange(count) * folds * rounds // max(count, 1) % folds)


def fold_masks(problem: Problem, count: int) -> list[list[npt.NDArray[np.bool_]]]:
    """Return for each of ``count`` folds the samples of each recording that it leaves out, (T,) each.

    With enough motions, whole motions are left out in turn: a calibration must predict other motion. The
    stretches of a single motion are left out likewise. A single recording is divided into blocks, so that all
    phases of the motion are on both sides.
    """
    episodes = problem.episodes
    unit = motion_numbers(episodes)
    if unit[-1] + 1 < count:
        unit = list(range(len(episodes)))
    left_out = [
        fold_numbers(len(e.sample), count, BLOCKS)
        if len(episodes) < count
        else np.full(len(e.sample), number % count)
        for number, e in zip(unit, episodes, strict=True)
    ]
    return [[of_episode == fold for of_episode in left_out] for fold in range(count)]


def time_masks(problem: Problem, count: int) -> list[list[npt.NDArray[np.bool_]]]:
    """Return for each of ``count`` folds the samples that it leaves out, (T,) each: one stretch of time.

    Alternating blocks share any drift (a gear that warms up), so a fit that follows the drift predicts them
    well. The use of a calibration comes later in time.
    """
    lengths = [len(episode.sample) for episode in problem.episodes]
    parts = np.split(fold_numbers(sum(lengths), count, 1), np.cumsum(lengths)[:-1])
    return [[part == fold for part in parts] for fold in range(count)]


def motion_numbers(episodes: Sequence[SampledEpisode]) -> list[int]:
    """Return the number of each episode's motion, from 0; stretches of one motion follow each other."""
    number, found = -1, []
    last: tuple[int, int] | None = None
    for episode in episodes:
        at = episode.first_row, episode.origin
        if last is None or at <= last:
            number += 1
        found.append(number)
        last = at
    return found
