"""Reads datasets for a calibration: of a robot with a driver, and with its own robot.yaml."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.data.checks.spikes import SpikeSettings
from deal_hw.data.recording.episode_info import motion_of
from deal_hw.data.recording.reader import read_metadata
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.types import Trajectory
from deal_hw.workflows.calibration.settings import (
    DatasetSettings,
    DriverDatasetSettings,
    OwnDatasetSettings,
)
from deal_hw.workflows.calibration.source import Source
from deal_hw.workflows.calibration.space import (
    extended,
    named_space,
    searched_space,
    without_speed_limits,
)
from deal_hw.workflows.robot import recorded_robot
from deal_hw.workflows.say import Say, silent
from deal_hw.workflows.shipped import shipped_balancer

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset

HELDOUT_MOTION = "chirp"
SAMPLES_A_PERIOD = 4
"""Fitted states per control period."""


def read_driver_dataset(settings: DriverDatasetSettings, say: Say) -> Source:
    """Read a dataset of a robot with a driver.

    Args:
        settings: The settings. Without held-out episodes those of the motion `chirp` are.
        say: Called with sentences on findings in the recordings.

    Raises:
        DealHwError: A setting or a recording is unusable.
    """
    from deal_hw.sim.engine.model import load_model

    dataset, description = _opened(settings)
    robot_name = dataset.description["name"]
    fit, held = choose_episodes(dataset, settings.episodes, settings.holdout, say)
    robot = load_model(description)
    space = named_space(robot_name, settings.space)
    if settings.parameters is not None:
        space = extended(space, Path(settings.parameters), robot)
    space = settings.searched(space)
    episodes = {i: dataset.read(i) for i in (*fit, *held)}
    policy = None
    if settings.in_closed_loop:
        from deal_hw.workflows.calibration.policy import recorded_policy, say_other_range

        given = None if settings.policy is None else Path(settings.policy)
        policy = recorded_policy(dataset, {i: episodes[i].metadata for i in fit}, description, given)
        say_other_range(policy, robot_name, space, say)
    trajectories, telemetry = sound_recordings(
        {i: episode.trajectory for i, episode in episodes.items()}, dataset.folder, settings.spikes, say
    )
    return Source(
        robot=robot,
        space=without_speed_limits(space, description, trajectories.values(), say),
        fitted=[(dataset.path(i).name, trajectories[i]) for i in fit],
        held=[(dataset.path(i).name, trajectories[i]) for i in held],
        division=None,
        sample_hz=settings.sample_hz or SAMPLES_A_PERIOD * description.control_rate_hz,
        feet=description.feet,
        telemetry=telemetry,
        provenance=_provenance(dataset, fit) | {"holdout": list(held)},
        advice=f"add one: deal-hw collect {robot_name} --port PORT --motion chirp --dataset {dataset.folder}",
        balance=shipped_balancer(description),
        name="" if robot.base is not None else description.name,
        policy=policy,
    )


def read_own_dataset(settings: OwnDatasetSettings, say: Say) -> Source:
    """Read a dataset with its own robot.yaml, whose recordings are used like those of files.

    Arguments and errors are those of :func:`read_driver_dataset`.
    """
    from deal_hw.sim.engine.compiling import compile_mjcf
    from deal_hw.sim.engine.model import load_model
    from deal_hw.sim.mjcf.describe import sampling, with_speed_limits

    division = settings.division(judged=bool(settings.holdout))
    dataset, description = _opened(settings)
    fit, held = choose_episodes(dataset, settings.episodes, settings.holdout, say)
    if held and settings.holdout_part is None:
        division = dataclasses.replace(division, share=0.0)
    trajectories = {i: dataset.read(i).trajectory for i in (*fit, *held)}
    policy = None
    if settings.policy is not None or settings.in_closed_loop:
        from deal_hw.workflows.calibration.policy import imported_policy

        given = None if settings.policy is None else Path(settings.policy)
        policy = imported_policy(dataset, {i: t.metadata for i, t in trajectories.items()}, given)
        if policy is None:
            settings.refuse_unknown_policy()
    model = compile_mjcf(description.mjcf)
    if policy is not None and settings.policy is not None:
        from deal_hw.sim.mjcf.joint_facts import joint_facts
        from deal_hw.workflows.calibration.policy_commands import with_policy_clock

        trajectories = with_policy_clock(trajectories, policy, joint_facts(description.mjcf, model), say)
    trajectories, telemetry = sound_recordings(trajectories, dataset.folder, settings.spikes, say)
    space = searched_space(settings, model, say)
    timestep = float(model.opt.timestep) if settings.physics_step is None else settings.physics_step
    rates = sampling(1.0 / description.state_rate_hz, timestep, settings.window)
    in_loop = None
    if policy is not None and settings.in_closed_loop:
        from deal_hw.workflows.calibration.policy import policy_of_files
        from deal_hw.workflows.calibration.policy_commands import at_policy_rate

        rates = at_policy_rate(rates, policy)
        in_loop = functools.partial(policy_of_files, policy)
    description = dataclasses.replace(
        description,
        device_rate_hz=1.0 / rates.step_s,
        control_rate_hz=1.0 / (rates.period_s * rates.samples_per_tick),
    )
    return Source(
        robot=load_model(with_speed_limits(description, model, space), rates.step_s),
        space=space,
        fitted=[(dataset.path(i).name, trajectories[i]) for i in fit],
        held=[(dataset.path(i).name, trajectories[i]) for i in held],
        division=division,
        sample_hz=settings.sample_hz,
        feet=description.feet,
        telemetry=telemetry,
        provenance={
            **_provenance(dataset, fit),
            "holdout": list(held) or f"last {division.share:.0%} of each recording",
            "sampling": dataclasses.asdict(rates),
        },
        advice="import recordings of other motion, and name their episodes with --holdout",
        policy=None if in_loop is None else in_loop(description, space, settings.latency_range, say),
    )


def _opened(settings: DatasetSettings) -> tuple[Dataset, RobotDescription]:
    from deal_hw.data.recording.dataset import Dataset

    dataset = Dataset.open(Path(settings.dataset))
    return dataset, recorded_robot(dataset.description, dataset.folder)


def _provenance(dataset: Dataset, fit: Sequence[int]) -> dict[str, Any]:
    return {
        "dataset": str(dataset.folder),
        "description_digest": dataset.digest,
        "episodes": list(fit),
    }


def sound_recordings(
    trajectories: Mapping[int, Trajectory], folder: Path, spikes: SpikeSettings, say: Say
) -> tuple[dict[int, Trajectory], list[str]]:
    """Check episodes of a dataset; leave out spikes, and values that a sensor holds where it is blind.

    Args:
        trajectories: By number.
        folder: The dataset, for messages.
        spikes: Definition of a spike.
        say: Called with a sentence on each spike and each blind range.

    Returns:
        The episodes without these samples, by number, and the checks' findings in words.

    Raises:
        InsufficientDataError: An episode cannot be used.
    """
    from deal_hw.data.checks.blind import find_blind, seen
    from deal_hw.data.checks.spikes import with_samples, without_spikes
    from deal_hw.data.checks.suite import check
    from deal_hw.data.table import table_of
    from deal_hw.findings import Severity

    smooth = {index: without_spikes(trajectory, spikes) for index, trajectory in trajectories.items()}
    tables = {index: table_of(trajectory) for index, trajectory in smooth.items()}
    blind = find_blind(tables.values(), spikes)
    verdicts = {index: check(trajectory, spikes, blind) for index, trajectory in trajectories.items()}
    for index, found in verdicts.items():
        failed = [v.message for v in found if v.severity is Severity.FAIL]
        if failed:
            raise InsufficientDataError(
                f"episode {index} of {folder} cannot be used: {'; '.join(failed)}; "
                "record again with `deal-hw collect`"
            )
        for jump in [v for v in found if v.code in ("spikes", "blind") and v.severity is Severity.WARN]:
            say(f"episode {index}: {jump.message}")
    lines = [f"episode {i}: {v.severity}: {v.message}" for i, found in verdicts.items() for v in found]
    return {i: with_samples(trajectory, seen(tables[i], blind)) for i, trajectory in smooth.items()}, lines


def choose_episodes(
    dataset: Dataset, episodes: Sequence[int], holdout: Sequence[int], say: Say = silent
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the fitted and the held-out episodes.

    Raises:
        ConfigurationError: No episode is left to fit, or one is in both lists.
    """
    every = range(len(dataset.episodes))
    metadata = [read_metadata(dataset.path(i)) for i in every]
    judges = (i for i in every if motion_of(metadata[i]) == HELDOUT_MOTION and i not in episodes)
    # An episode that is named twice must not count twice.
    episodes, holdout = tuple(dict.fromkeys(episodes)), tuple(dict.fromkeys(holdout))
    held = holdout or tuple(judges)
    repeated = [] if episodes else [i for i in every[:-1] if _repeats(metadata[i + 1], metadata[i])]
    if repeated:
        say(
            f"episodes {repeated} hardly moved and were recorded again, so they are not fitted (--episodes "
            "overrides this)"
        )
    fit = episodes or tuple(i for i in every if i not in held and i not in repeated)
    both = sorted(set(fit) & set(held))
    if both:
        raise ConfigurationError(
            f"episodes {both} are both fitted and held out; a held-out episode must not be fitted: remove "
            "it from --episodes or --holdout"
        )
    if not fit:
        raise ConfigurationError(
            f"nothing to fit: the dataset has {len(every)} episodes, {len(held)} of them held out; record "
            "one with `deal-hw collect --motion rich`"
        )
    return fit, held


def _repeats(one: Mapping[str, Any], former: Mapping[str, Any]) -> bool:
    """Return whether a recording repeats the one before with a stronger motion, by their metadata."""
    same = all(one.get(key) == former.get(key) for key in ("seed", "seconds"))
    same = same and motion_of(one) == motion_of(former)
    return same and one.get("attempt", 0) == former.get("attempt", 0) + 1
