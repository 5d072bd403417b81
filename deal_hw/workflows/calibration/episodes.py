"""Which episodes of a dataset are fitted and which are held out, and why the others are neither.

`collect` asks, too, before it names the next step. So nothing here loads the packages of a calibration.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.episode_info import EpisodeInfo, motion_of
from deal_hw.data.recording.excitation import FEWEST_CHANGES, LEAST_MOTION
from deal_hw.data.recording.reader import read_metadata
from deal_hw.description import SensorModel
from deal_hw.errors import ConfigurationError, DealHwError, InsufficientDataError
from deal_hw.workflows.robot import carries_robot
from deal_hw.workflows.say import Say, silent

HELDOUT_MOTION = "chirp"


def choose_episodes(
    dataset: Dataset, episodes: Sequence[int], holdout: Sequence[int], say: Say = silent
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the fitted and the held-out episodes.

    Args:
        dataset: The dataset.
        episodes: The episodes to fit; empty: all that are not held out. Those whose run failed and that the
            user did not keep are left out; so are recordings that hardly moved and were made again.
        holdout: The held-out episodes; empty: those of the motion `chirp`, failed runs left out.
        say: Called with a sentence on what is left out.

    Raises:
        ConfigurationError: No episode is left to fit, or one is in both lists.
    """
    # An episode that is named twice must not count twice.
    episodes, holdout = tuple(dict.fromkeys(episodes)), tuple(dict.fromkeys(holdout))
    used = [info.number for info in dataset.episodes if not info.left_out]
    metadata = {number: read_metadata(dataset.path(number)) for number in used}
    judges = (n for n in used if motion_of(metadata[n]) == HELDOUT_MOTION and n not in episodes)
    held = holdout or tuple(judges)
    for info in dataset.episodes:
        judge = motion_of(info.facts) == HELDOUT_MOTION
        if info.left_out and not (holdout if judge else episodes):
            say(dataset.why_left_out(info))
    pairs = [] if episodes else itertools.pairwise(used)
    repeated = [one for one, again in pairs if _repeats(metadata[again], metadata[one])]
    if repeated:
        say(
            f"episodes {repeated} hardly moved and were recorded again, so they are not fitted (--episodes "
            "overrides this)"
        )
    fit = episodes or tuple(n for n in used if n not in held and n not in repeated)
    both = sorted(set(fit) & set(held))
    if both:
        raise ConfigurationError(
            f"episodes {both} are both fitted and held out; a held-out episode must not be fitted: remove "
            "it from --episodes or --holdout"
        )
    if not fit:
        raise ConfigurationError(nothing_to_fit(dataset, held))
    return fit, held


def remaining(
    dataset: Dataset, fit: Sequence[int], held: Sequence[int], kept: Collection[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the fitted and the held-out episodes that are among the kept ones.

    Raises:
        InsufficientDataError: None is left to fit.
    """
    left = tuple(number for number in fit if number in kept)
    if not left:
        raise InsufficientDataError(nothing_to_fit(dataset, held, {*fit, *held} - set(kept)))
    return left, tuple(number for number in held if number in kept)


def nothing_to_fit(dataset: Dataset, held: Collection[int], failed: Collection[int] = ()) -> str:
    """Return why no episode of a dataset can be fitted, and a command that works, as text.

    Args:
        dataset: The dataset.
        held: The held-out episodes.
        failed: Episodes whose samples cannot be used although the index does not say so.
    """
    reasons, usable = [], []
    for info in dataset.episodes:
        why = [info.left_out, *info.failed_checks]
        why += ["it is held out"] if info.number in held else []
        why += ["a check of its samples failed"] if info.number in failed and not info.failed_checks else []
        reason = "; ".join(filter(None, why)) or "it hardly moved and was recorded again"
        reasons.append(f"episode {info.number}: {reason}")
        if info.states and not info.failed_checks and info.number not in failed:
            usable.append(info)
    text = f"nothing to fit: {dataset.folder} has {len(reasons)} episodes. {'. '.join(reasons)}"
    text += f". {_record_one(dataset)}"
    if usable and not too_little(dataset, usable):
        numbers = " ".join(str(info.number) for info in usable)
        text += f". To fit what is there: deal-hw calibrate {dataset.folder} --episodes {numbers}"
    return text


def refusal(dataset: Dataset) -> str:
    """Return why a calibration of the whole dataset would be refused, as text; "" if it would not.

    This is judged by the index, in a moment. A calibration checks the samples once more.
    """
    try:
        fit, held = choose_episodes(dataset, (), ())
        sound = {info.number for info in dataset.episodes if not info.failed_checks}
        fit, _ = remaining(dataset, fit, held, sound)
    except DealHwError as error:
        return str(error)
    little = too_little(dataset, [dataset.info(number) for number in fit])
    return f"{little}. {_record_one(dataset)}" if little else ""


def too_little(dataset: Dataset, episodes: Sequence[EpisodeInfo]) -> str:
    """Return why the motion of episodes is too little for a calibration, by the index; "" if it is enough."""
    facts, motions = dataset.description, [info.excitation for info in episodes if info.excitation]
    changes = sum(max(motion["target_changes"], default=0) for motion in motions)
    if not motions or (not changes and facts.get("actuation") == "motor"):
        return ""  # Nothing is known, or the joints swing freely.
    if changes < FEWEST_CHANGES:
        return f"the position target changed {changes} times, at least {FEWEST_CHANGES} are needed"
    spans = np.max([motion["position_range"] for motion in motions], axis=0)
    least = LEAST_MOTION * SensorModel(**facts["sensor"]).position_std
    still = [
        f"{name} moved {span:.2g}, at least {most:.2g} are needed"
        for name, span, most in zip(facts["joint_names"], spans, least, strict=True)
        if span < most
    ]
    return f"the recording hardly moves: {'; '.join(still)}" if still else ""


def _record_one(dataset: Dataset) -> str:
    if carries_robot(dataset.folder):
        return "Record another motion with `deal-hw collect`, or import one with `deal-hw data import`"
    name = dataset.description["name"]
    return f"Record one: deal-hw collect {name} --port PORT --motion rich --dataset {dataset.folder}"


def _repeats(one: Mapping[str, Any], former: Mapping[str, Any]) -> bool:
    """Return whether a recording repeats the one before with a stronger motion, by their metadata."""
    same = all(one.get(key) == former.get(key) for key in ("seed", "seconds"))
    same = same and motion_of(one) == motion_of(former)
    return same and one.get("attempt", 0) == former.get("attempt", 0) + 1
