"""Reads datasets for a calibration: of a robot with a driver, and with its own robot.yaml."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.data.checks.spikes import SpikeSettings
from deal_hw.description import RobotDescription
from deal_hw.errors import InsufficientDataError
from deal_hw.types import Trajectory
from deal_hw.workflows.calibration.episodes import choose_episodes, remaining
from deal_hw.workflows.calibration.recordings import one_rate, say_rates
from deal_hw.workflows.calibration.settings import (
    DatasetSettings,
    DriverDatasetSettings,
    OwnDatasetSettings,
)
from deal_hw.workflows.calibration.source import Named, Source
from deal_hw.workflows.calibration.space import (
    extended,
    named_space,
    searched_space,
    without_speed_limits,
)
from deal_hw.workflows.robot import recorded_robot
from deal_hw.workflows.say import Say
from deal_hw.workflows.shipped import shipped_balancer

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset

_REPORTED = ("spikes", "blind", "following")
"""Checks whose warnings say that samples are left out."""
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
    trajectories, telemetry = sound_recordings(
        {i: episode.trajectory for i, episode in episodes.items()},
        dataset.folder,
        settings.spikes,
        say,
        (*settings.episodes, *settings.holdout),
    )
    fit, held = remaining(dataset, fit, held, trajectories)
    policy = None
    if settings.in_closed_loop:
        from deal_hw.workflows.calibration.policy import recorded_policy, say_other_range

        given = None if settings.policy is None else Path(settings.policy)
        policy = recorded_policy(dataset, {i: episodes[i].metadata for i in fit}, description, given)
        say_other_range(policy, robot_name, space, say)
    return Source(
        robot=robot,
        space=without_speed_limits(space, description, trajectories.values(), say),
        fitted=[Named(dataset.path(i).name, trajectories[i]) for i in fit],
        held=[Named(dataset.path(i).name, trajectories[i]) for i in held],
        division=None,
        sample_hz=settings.sample_hz or SAMPLES_A_PERIOD * description.control_rate_hz,
        feet=description.feet,
        telemetry=[*_left_out(dataset, fit, held), *telemetry],
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
    from deal_hw.data.checks.suite import nominal_period_s
    from deal_hw.sim.engine.compiling import compile_mjcf
    from deal_hw.sim.engine.model import load_model
    from deal_hw.sim.mjcf.describe import at_rates, sampling, slowest, with_speed_limits

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
    named = (*settings.episodes, *settings.holdout)
    trajectories, telemetry = sound_recordings(trajectories, dataset.folder, settings.spikes, say, named)
    fit, held = remaining(dataset, fit, held, trajectories)
    space = searched_space(settings, model, say)
    timestep = float(model.opt.timestep) if settings.physics_step is None else settings.physics_step
    usual_s = 1.0 / description.state_rate_hz
    every = {
        i: sampling(nominal_period_s(trajectory) or usual_s, timestep, settings.window)
        for i, trajectory in trajectories.items()
    }
    say_rates([dataset.path(i).name for i in every], [*every.values()], say)
    rates = slowest([*every.values()])
    in_loop = None
    if policy is not None and settings.in_closed_loop:
        from deal_hw.workflows.calibration.policy import policy_of_files
        from deal_hw.workflows.calibration.policy_commands import at_policy_rate

        rates = at_policy_rate(one_rate([*every.values()]), policy)
        every = dict.fromkeys(every, rates)
        in_loop = functools.partial(policy_of_files, policy)
    description = at_rates(description, rates)
    return Source(
        robot=load_model(with_speed_limits(description, model, space), rates.step_s),
        space=space,
        fitted=[Named(dataset.path(i).name, trajectories[i], every[i]) for i in fit],
        held=[Named(dataset.path(i).name, trajectories[i], every[i]) for i in held],
        division=division,
        sample_hz=settings.sample_hz,
        feet=description.feet,
        telemetry=[*_left_out(dataset, fit, held), *telemetry],
        provenance={
            **_provenance(dataset, fit),
            "holdout": list(held) or f"last {division.share:.0%} of each recording",
            "sampling": dataclasses.asdict(rates),
            "rates_hz": sorted({1.0 / each.period_s for each in every.values()}),
        },
        advice="import recordings of other motion, and name their episodes with --holdout",
        policy=None if in_loop is None else in_loop(description, space, settings.latency_range, say),
        rates=rates,
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


def _left_out(dataset: Dataset, fit: Sequence[int], held: Sequence[int]) -> list[str]:
    """Return a line for each episode that is neither fitted nor held out because its run failed."""
    return [
        f"episode {info.number}: left out: {info.left_out}"
        for info in dataset.episodes
        if info.left_out and info.number not in (*fit, *held)
    ]


def sound_recordings(
    trajectories: Mapping[int, Trajectory],
    folder: Path,
    spikes: SpikeSettings,
    say: Say,
    named: Collection[int] = (),
) -> tuple[dict[int, Trajectory], list[str]]:
    """Check episodes of a dataset, and leave out the samples that must not be fitted.

    These are spikes, values that a sensor holds where it is blind, and all after joints no longer followed
    their commands.

    Args:
        trajectories: By number.
        folder: The dataset, for messages.
        spikes: Definition of a spike.
        say: Called with a sentence on each spike, each blind range, each end of following and each episode
            that cannot be used.
        named: The episodes that the user named: one of them that cannot be used is an error.

    Returns:
        The usable episodes without these samples, by number, and the checks' findings in words.

    Raises:
        InsufficientDataError: A named episode cannot be used.
    """
    from deal_hw.data.checks.blind import find_blind, seen
    from deal_hw.data.checks.following import followed_part
    from deal_hw.data.checks.spikes import with_samples, without_spikes
    from deal_hw.data.checks.suite import check
    from deal_hw.data.table import table_of
    from deal_hw.findings import Severity

    smooth = {index: without_spikes(followed_part(one), spikes) for index, one in trajectories.items()}
    tables = {index: table_of(trajectory) for index, trajectory in smooth.items()}
    blind = find_blind(tables.values(), spikes)
    verdicts = {index: check(trajectory, spikes, blind) for index, trajectory in trajectories.items()}
    for index, found in verdicts.items():
        for one in [v for v in found if v.code in _REPORTED and v.severity is Severity.WARN]:
            say(f"episode {index}: {one.message}")
        if failed := "; ".join(v.message for v in found if v.severity is Severity.FAIL):
            del smooth[index]
            if index in named:
                raise InsufficientDataError(
                    f"episode {index} of {folder} cannot be used: {failed}; name others (--episodes, "
                    "--holdout), or record again with `deal-hw collect`"
                )
            say(f"episode {index} is left out: {failed}")
    lines = [f"episode {i}: {v.severity}: {v.message}" for i, found in verdicts.items() for v in found]
    return {i: with_samples(trajectory, seen(tables[i], blind)) for i, trajectory in smooth.items()}, lines
