"""Prepare a dataset of deal-hw for a calibration: fitted and held-out episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calib.pipeline.methods import CLOSED_LOOP_METHODS, search_of
from deal_hw.calibration import listed
from deal_hw.data.recording.episode_info import motion_of
from deal_hw.data.recording.spikes import SpikeSettings
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError, MissingExtraError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.robots import parameter_spaces
from deal_hw.types import Trajectory
from deal_hw.workflows.calibration.policy import recorded_policy
from deal_hw.workflows.calibration.run import CalibrationInputs
from deal_hw.workflows.calibration.settings import CalibrateSettings
from deal_hw.workflows.calibration.walking import all_walk, weighed, while_walking
from deal_hw.workflows.robot import recorded_robot
from deal_hw.workflows.say import Say, silent
from deal_hw.workflows.shipped import shipped_balancer

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode

HELDOUT_MOTION = "chirp"
SAMPLES_A_PERIOD = 4
"""Fitted states per control period."""


def prepare_dataset(settings: CalibrateSettings, holdout: Sequence[int], say: Say) -> CalibrationInputs:
    """Read a dataset of a robot of deal-hw.

    Args:
        settings: The settings; they name a dataset.
        holdout: Held-out episodes; empty: those of the motion `chirp`.
        say: Called with sentences on findings in the recordings.

    Raises:
        DealHwError: A setting or a recording is unusable.
    """
    from deal_hw.data.recording.dataset import Dataset

    folder = Path(str(settings.dataset))
    dataset = Dataset.open(folder)
    robot_name = dataset.description["name"]
    description = recorded_robot(dataset.description, folder)
    fit, holdout = choose_episodes(dataset, settings.episodes, holdout, say)
    robot = _model(description)
    space = named_space(robot_name, settings.space)
    if settings.recordings.parameters is not None:
        space = _extended(space, settings.recordings.parameters, robot)
    space = settings.searched(space)
    episodes_read = {i: dataset.read(i) for i in (*fit, *holdout)}
    policy = None
    if search_of(settings.named()) in CLOSED_LOOP_METHODS:
        runs = {i: episodes_read[i].metadata for i in fit}
        given = None if settings.policy is None else Path(settings.policy)
        policy = recorded_policy(dataset, runs, description, given)
    recordings, telemetry = sound_recordings(
        {i: episode.trajectory for i, episode in episodes_read.items()}, folder, settings.spikes, say
    )
    space = without_speed_limits(space, description, recordings.values(), say)
    names = {i: dataset.path(i).name for i in recordings}
    episodes = _simulation(robot, recordings, names, settings.sample_hz)
    walks = all_walk(robot, recordings.values())
    if walks:
        space = weighed(space, robot, recordings[fit[0]], say)
    return CalibrationInputs(
        robot=robot,
        space=space,
        episodes=[episodes[i] for i in fit],
        holdout=[episodes[i] for i in holdout],
        shown=recordings[fit[0]],
        telemetry=telemetry,
        provenance={
            "dataset": str(folder),
            "description_digest": dataset.digest,
            "episodes": list(fit),
            "holdout": list(holdout),
        },
        advice=f"add one: deal-hw collect {robot_name} --port PORT --motion chirp --dataset {folder}",
        balance=shipped_balancer(robot.description),
        name="" if robot.base is not None else robot.description.name,
        policy=policy,
        walks=walks,
    )


def without_speed_limits(
    space: ParameterSpace, description: RobotDescription, trajectories: Iterable[Trajectory], say: Say
) -> ParameterSpace:
    """Return the space without the speed limits of servos whose set-points the host moves (ODrive).

    The commands to such a drive carry its own limit, which is above the range of a servo's. Its set-point
    jumps with each command. The known value is so high that the model's does, too.
    """
    every = list(trajectories)
    numbers = {joint: number for number, joint in enumerate(description.actuated)}
    known = {}
    for p in space:
        if p.kind != "servo_speed_limit":
            continue
        columns = [numbers[joint] for joint in p.elements]
        sent = np.concatenate([t.speed_limit[:, columns].ravel() for t in every])
        if sent.size and np.nanmin(sent) > p.high:
            steps = [np.abs(np.diff(t.position_target[:, columns], axis=0)).max(initial=0.0) for t in every]
            known[p.name] = max(float(np.nanmin(sent)), description.device_rate_hz * float(np.nanmax(steps)))
    if known:
        say(f"{listed(list(known))}: not searched, because the host limits the speed of these set-points")
    return space.with_known(known)


def sound_recordings(
    trajectories: Mapping[int, Trajectory], folder: Path, spikes: SpikeSettings, say: Say
) -> tuple[dict[int, Trajectory], list[str]]:
    """Check episodes of a dataset and leave out their spikes.

    Args:
        trajectories: By number.
        folder: The dataset, for messages.
        spikes: Definition of a spike.
        say: Called with a sentence on each spike.

    Returns:
        The episodes without spikes, by number, and the checks' findings in words.

    Raises:
        InsufficientDataError: An episode cannot be used.
    """
    from deal_hw.data.recording.spikes import without_spikes
    from deal_hw.data.recording.telemetry_checks import check
    from deal_hw.findings import Severity

    verdicts = {index: check(trajectory, spikes) for index, trajectory in trajectories.items()}
    for index, found in verdicts.items():
        failed = [v.message for v in found if v.severity is Severity.FAIL]
        if failed:
            raise InsufficientDataError(
                f"episode {index} of {folder} cannot be used: {'; '.join(failed)}; "
                "record again with `deal-hw collect`"
            )
        for jump in [v.message for v in found if v.code == "spikes" and v.severity is Severity.WARN][:1]:
            say(f"episode {index}: {jump}")
    told = [f"episode {i}: {v.severity}: {v.message}" for i, found in verdicts.items() for v in found]
    return {i: without_spikes(trajectory, spikes) for i, trajectory in trajectories.items()}, told


def named_space(robot: str, name: str = "") -> ParameterSpace:
    """Return a parameter set of a robot; "": its first.

    Raises:
        UnknownNameError: There is no such set; the message lists them.
    """
    table = parameter_spaces(robot)
    name = name or next(iter(table))
    if name not in table:
        raise UnknownNameError("parameter set", name, table)
    return table[name]()


def choose_episodes(
    dataset: Dataset, episodes: Sequence[int], holdout: Sequence[int], say: Say = silent
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the fitted and the held-out episodes.

    Raises:
        ConfigurationError: No episode is left to fit, or one is in both lists.
    """
    every = range(len(dataset.episodes))
    metadata = [dataset.read(i).metadata for i in every]
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


def _model(description: RobotDescription) -> RobotModel:
    try:
        from deal_hw.sim.engine.model import load_model
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err

    return load_model(description)


def _extended(space: ParameterSpace, file: Path, robot: RobotModel) -> ParameterSpace:
    from deal_hw.sim.parameters import check_space
    from deal_hw.sim.parameters.yaml_space import read_space

    found = ParameterSpace([*space.parameters, *read_space(file, robot.model).parameters])
    check_space(robot.model, found)
    return found


def _repeats(one: Mapping[str, Any], former: Mapping[str, Any]) -> bool:
    """Return whether a recording repeats the one before with a stronger motion, by their metadata."""
    same = all(one.get(key) == former.get(key) for key in ("seed", "seconds"))
    same = same and motion_of(one) == motion_of(former)
    return same and one.get("attempt", 0) == former.get("attempt", 0) + 1


def _simulation(
    robot: RobotModel, recordings: Mapping[int, Trajectory], names: Mapping[int, str], sample_hz: float | None
) -> dict[int, SampledEpisode]:
    from deal_hw.sim.recordings.episode import align, thin
    from deal_hw.sim.recordings.standing import with_sensed_base

    episodes = {}
    for i, trajectory in recordings.items():
        episodes[i] = align(trajectory, robot.description, names[i])
        if robot.base is not None and trajectory.body is not None:
            episodes[i] = while_walking(with_sensed_base(episodes[i], robot, trajectory), trajectory)
        episodes[i] = thin(episodes[i], sample_hz or SAMPLES_A_PERIOD * robot.description.control_rate_hz)
    return episodes
