"""The work of ``deal-hw data import`` and ``data export``: convert recordings to and from our files."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from deal_hw.data.files import INDEX_NAME, dataset_of
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.ranges import Checked, Range
from deal_hw.reading import number, read_json, reading
from deal_hw.workflows.calibration.checks import examine_recording
from deal_hw.workflows.calibration.recordings import at_rest_without_commands, kinds_of, on_grid
from deal_hw.workflows.options import given, refuse
from deal_hw.workflows.robot import is_ours, load_robot, recorded_robot
from deal_hw.workflows.robot_recordings import at_recorded_rates, derived_robot
from deal_hw.workflows.say import Say, silent

if TYPE_CHECKING:
    from deal_hw.data.importing.grid import Recording
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.data.recording.reader import Episode
    from deal_hw.sim.mjcf.joint_facts import JointFacts
    from deal_hw.types import Trajectory


@dataclass(frozen=True, kw_only=True)
class ImportSettings(Checked):
    """Settings of :func:`import_recordings`."""

    paths: tuple[Path, ...]
    """Recordings of one robot: CSV, NPZ, JSON, Parquet, HDF5 or MAT files, bags of ROS 1 and 2, folders of
    LeRobot datasets, episodes and datasets of deal-hw."""
    out: Path
    """The dataset to make, or to add to."""
    columns: Path | None = None
    """A column map (YAML). Without it the channels' meaning is guessed from their names, and printed."""
    lerobot: Path | None = None
    """LeRobot's calibration of a servo arm (JSON of lerobot-calibrate): it turns the -100..100 or the degrees
    of its datasets into radians. Needs --model or --robot."""
    model: Path | None = None
    """The robot's MJCF, which gives joint names, order and limits. The dataset keeps a copy."""
    robot: Path | None = None
    """A robot.yaml (`deal-hw robot new`) instead of --model. The dataset keeps a copy with its MJCF, so later
    verbs know the robot."""
    description: Path | None = None
    """A robot description (JSON, as in dataset.json) to use instead of a minimal one."""
    name: str = ""
    """The robot's name; by default the file name of the model, or of the first recording."""
    device_periods: Annotated[int, Range(1, 100_000)] = 1
    """Periods of the robot's own control loop between two samples: its rate divided by the recording's."""
    policy: Path | None = None
    """The policy (.onnx) that moved the robot: it gives the commands of recordings without any, and checks
    the clock of recorded ones. The dataset keeps a copy, for methods that run it in every simulator."""
    force: bool = False
    """Import recordings although a check failed; the failed checks are noted in the dataset."""
    dry_run: bool = False
    """Check and print the findings, but write nothing."""


@dataclass(frozen=True, kw_only=True)
class ExportSettings(Checked):
    """Settings of :func:`export_recordings`."""

    path: Path
    """A dataset (DIR), or an episode (DIR/episodes/000000.mcap)."""
    out: Path
    """The folder to write."""
    format: Literal["lerobot", "foxglove"] = "lerobot"
    """The layout: LeRobot v3.0 (Parquet; needs the extra lerobot), or episodes (MCAP) with the robot in 3D
    for Foxglove (needs the extra sim)."""
    task: str = "deal-hw"
    """Description of the robot's task, for LeRobot."""


def import_recordings(config: ImportSettings, say: Say = silent) -> Dataset | None:
    """Make a dataset from recordings of any robot, or add to one; refuse implausible recordings.

    Args:
        config: Settings.
        say: Called with sentences on guesses, findings and resampling.

    Returns:
        The dataset; None with ``dry_run``.

    Raises:
        DatasetError: A recording cannot be read, understood or trusted.
        ConfigurationError: The column map, model or description cannot be used.
    """
    from deal_hw.data.checks.following import followed_part
    from deal_hw.data.importing.channels import digest_of_file
    from deal_hw.data.importing.columns import ColumnMap, read_column_map
    from deal_hw.data.importing.grid import grid_periods, to_trajectories
    from deal_hw.data.importing.load import MapOf, load_tables
    from deal_hw.data.importing.store import minimal_description, write_dataset
    from deal_hw.data.recording.dataset_index import entry_of_episode
    from deal_hw.data.recording.episode_info import verdict_json
    from deal_hw.data.table import table_of
    from deal_hw.workflows.lerobot_columns import columns_of_lerobot
    from deal_hw.workflows.ros2_columns import columns_of_robot

    _refuse_ignored(config)
    columns: ColumnMap | MapOf | None = None
    if config.columns is not None:
        columns = read_column_map(config.columns)
    robot = None if config.robot is None else load_robot(config.robot)
    if columns is None and robot is not None and robot.file.ros2 is not None:
        columns = functools.partial(columns_of_robot, robot.file, robot.file.ros2)
    facts = _joint_facts(config.model if robot is None else robot.mjcf, say)
    columns = columns_of_lerobot(config.lerobot, facts, columns is not None) or columns
    described = None if config.description is None else _description(config.description)
    joints = None if facts is None else facts.names
    if robot is not None:
        joints = robot.joint_names
    elif described is not None:
        joints = described["joint_names"]
    mapped = columns is not None or described is not None or facts is not None
    episodes, foreign = ([], list(config.paths)) if mapped else _as_recorded(config, say)
    printed: dict[str, str] = {}
    kinds = None if facts is None else kinds_of(facts)
    tables = [table for path in foreign for table in load_tables(path, columns, joints, say, printed, kinds)]
    policy = None
    if facts is not None:
        if config.policy is not None:
            from deal_hw.policies.onnx_runtime import OnnxPolicy
            from deal_hw.workflows.calibration.policy_commands import with_commands_of

            policy = OnnxPolicy(config.policy)
            tables = with_commands_of(policy, tables, facts, say)
        tables = at_rest_without_commands(tables, facts, say)
    checked = [*(table_of(followed_part(e.trajectory), e.path.name) for e in episodes), *tables]
    if episodes:
        described = dict(episodes[0].description)
    problems = {
        table.name: [verdict_json(v) for v in examine_recording(table, facts, config.force, say=say)]
        for table in checked
    }
    periods, kept_rates = grid_periods(checked), {} if episodes else _kept_rates(config.out, say)
    if robot is None and described is None and config.model is not None:
        rate_hz = kept_rates.get("control_rate_hz", 1 / max(periods))
        robot = derived_robot(config.model, config.name, tables, rate_hz)
    elif facts is None and described is None and not is_ours(config.name or config.paths[0].stem):
        say(
            "no model is given, so `calibrate` and `inspect` cannot use the dataset: add --model robot.xml "
            "or --robot robot.yaml"
        )
    for name in [table.name for table in tables if table.base_position is not None]:
        say(
            f"{name}: base_position and base_velocity are not kept, as a dataset holds no place of a base. "
            "To use them: deal-hw calibrate --model robot.xml --data FILE --columns columns.yaml"
        )
    if robot is None:
        each = zip(tables, periods[len(episodes) :], strict=True)
        recordings = [part for table, own in each for part in to_trajectories(table, period_s=own)]
    else:
        simulated, rates = at_recorded_rates(robot, tables, config.device_periods)
        pairs = zip(tables, rates, strict=True)
        recordings = [part for table, own in pairs for part in on_grid(table, simulated, own)]
        described = simulated.description.to_json()
    for line in _placed(recordings):
        say(line)
    # The source of each new episode, as it is noted in the dataset.
    sources = [_source(e.path.name, digest_of_file(e.path)) for e in episodes]
    sources += [_source(**part.trajectory.metadata["import"]) for part in recordings]
    _refuse_copies(config.out, sources, say)
    if config.dry_run:
        return None
    values = described or minimal_description(
        recordings,
        config.name or (config.model or config.paths[0]).stem,
        tables[0].units,
        1 / max(periods),
        mjcf=config.model,
        rates_per_sample=config.device_periods,
    )
    values = {**values, **kept_rates}
    if robot is not None:
        from deal_hw.data.recording.dataset import Dataset
        from deal_hw.sim.robots.dataset_robot import store_robot

        with Dataset.create_or_open(config.out, values, say) as dataset:
            store_robot(robot, config.out)
            if policy is not None:
                dataset.keep_policy(policy.path, policy.digest)
    # How the run of an episode ended, and what its user decided, goes with it.
    known = [{} if (entry := entry_of_episode(e.path)) is None else dict(entry.facts) for e in episodes]
    known += [{} for _ in recordings]
    noted = [{**of, "plausibility": problems, "source": s} for of, s in zip(known, sources, strict=True)]
    return write_dataset(config.out, recordings, values, noted, say, [e.path for e in episodes])


RATES = ("control_rate_hz", "device_rate_hz", "state_rate_hz")
"""Entries of a description that an imported episode need not have: it has a grid of its own."""


def _kept_rates(folder: Path, say: Say) -> dict[str, float]:
    """Return the rates that the description of an existing dataset has; none of a new one."""
    from deal_hw.data.recording.dataset import Dataset

    if not (folder / INDEX_NAME).is_file():
        return {}
    kept = Dataset.open(folder, say).description
    return {name: float(kept[name]) for name in RATES}


def _placed(recordings: Sequence[Recording]) -> Iterator[str]:
    """Yield how each recording was put on its grid, with all of its parts in one line."""
    parts: dict[tuple[str, str], list[Trajectory]] = {}
    for recording in recordings:
        how = recording.trajectory.metadata["import"]
        parts.setdefault((how["file"], how["part"]), []).append(recording.trajectory)
    for (file, part), trajectories in parts.items():
        hows = [t.metadata["import"] for t in trajectories]
        many = f"{len(trajectories)} parts between pauses, " if len(trajectories) > 1 else ""
        seconds, shift_s = sum(t.duration_s for t in trajectories), max(h["largest_shift_s"] for h in hows)
        rate_hz, kept = 1 / hows[0]["period_s"], " and ".join(sorted({h["method"] for h in hows}))
        name = f"{file} {part}".strip()
        yield (
            f"{name}: {many}{seconds:.4g} s at {rate_hz:.6g} Hz, samples {kept}, largest shift "
            f"{shift_s * 1e3:.3f} ms"
        )


def _source(file: str, sha256: str, part: str = "", stretch: int = 0, **_: Any) -> dict[str, Any]:
    return {"file": file, "sha256": sha256, "part": part, "stretch": stretch}


def _refuse_copies(folder: Path, sources: Sequence[Mapping[str, Any]], say: Say) -> None:
    """Refuse to import the same recording twice: a copy could be fitted and held out at the same time.

    Raises:
        DatasetError: A recording is in the dataset already, or is given twice.
    """
    from deal_hw.data.recording.dataset import Dataset

    taken: dict[tuple[Any, ...], str] = {}
    kept = Dataset.open(folder, say).episodes if (folder / INDEX_NAME).is_file() else ()
    for episode in kept:
        taken[_content(episode.facts.get("source", {}))] = f"episode {episode.number} of {folder}"
    for source in sources:
        if _content(source) in taken:
            raise DatasetError(
                f"{source['file']} is a copy of {taken[_content(source)]}; a copy counts twice, and can be "
                "fitted and held out at the same time. Leave it out, or name another folder"
            )
        taken[_content(source)] = source["file"]


def _content(source: Mapping[str, Any]) -> tuple[Any, ...]:
    return source.get("sha256"), source.get("part"), source.get("stretch")


def _as_recorded(config: ImportSettings, say: Say) -> tuple[list[Episode], list[Path]]:
    """Return our own episodes, which are copied unchanged, and the files to interpret."""
    from deal_hw.data.importing.load import own_episodes
    from deal_hw.data.recording.reader import read_episode

    found: list[Episode] = []
    foreign: list[Path] = []
    for path in config.paths:
        episodes = [read_episode(episode) for episode in own_episodes(path, say)]
        found += episodes
        if not episodes:
            foreign.append(path)
    for episode in found:
        if episode.description != found[0].description:
            raise DatasetError(
                f"{episode.path} describes another robot than {found[0].path}; import them into two datasets"
            )
    if found:
        default = ImportSettings(paths=config.paths, out=config.out)
        refuse(
            given(config, default, ("name", "device_periods")), "the episodes contain their own description"
        )
    return found, foreign


def _refuse_ignored(config: ImportSettings) -> None:
    """Refuse options that have no effect beside another one.

    Raises:
        ConfigurationError: There is one.
    """
    default = ImportSettings(paths=config.paths, out=config.out)
    if config.robot is not None:
        names = ("model", "description", "name", "device_periods")
        refuse(given(config, default, names), "--robot says it")
    if config.description is not None:
        refuse(given(config, default, ("name", "device_periods")), "--description says it")
    if config.policy is not None and config.robot is None and config.model is None:
        raise ConfigurationError(
            "--policy needs the robot that it moved: add --robot robot.yaml or --model robot.xml"
        )


def export_recordings(config: ExportSettings, say: Say = silent) -> tuple[int, str]:
    """Write the episodes of a dataset for other software.

    Args:
        config: Settings.
        say: Called with sentences on repairs of the dataset, on what is left out, and on filled samples.

    Returns:
        The number of episodes, and the robot's name.

    Raises:
        DatasetError: It cannot be read, or the folder cannot be written.
        MissingExtraError: pyarrow is not installed.
    """
    from deal_hw.data.checks.following import followed_part, what_is_cut
    from deal_hw.data.export.lerobot import export_lerobot
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.data.recording.reader import read_trajectory

    paths = [config.path]
    if config.path.is_dir():
        dataset = Dataset.open(dataset_of(config.path), say)
        # To look at a failed run, too, is what Foxglove is for.
        numbers = dataset.numbers if config.format == "foxglove" else dataset.used(say)
        paths = [dataset.path(number) for number in numbers]
    if config.format == "foxglove":
        refuse(
            given(config, ExportSettings(path=config.path, out=config.out), ("task",)),
            "only --format lerobot stores it",
        )
        return len(paths), _with_scene(paths, config.out, say)
    trajectories = [read_trajectory(path) for path in paths]
    names = [path.name for path in paths]
    for name, trajectory in zip(names, trajectories, strict=True):
        if cut := what_is_cut(trajectory):
            say(f"{name}: {cut}")
    robot = trajectories[0].metadata["description"]["name"] if trajectories else ""
    frames, filled = export_lerobot(
        [followed_part(trajectory) for trajectory in trajectories],
        config.out,
        robot,
        config.task,
        names=names,
    )
    if filled:
        say(f"{filled} of {frames} frames replace lost samples: they are interpolated and marked by `filled`")
    return len(trajectories), robot


def _with_scene(paths: Sequence[Path], folder: Path, say: Say) -> str:
    """Write episodes with the robot in 3D; return its name."""
    import numpy as np

    from deal_hw.data.export.foxglove import export_foxglove
    from deal_hw.data.recording.reader import read_episode
    from deal_hw.sim.engine.model import load_model
    from deal_hw.sim.engine.scene import body_poses, read_scene
    from deal_hw.sim.recordings.standing import sensed_base

    folder.mkdir(parents=True, exist_ok=True)
    if not paths:
        return ""
    # The episodes of a dataset are of one robot.
    description = recorded_robot(read_episode(paths[0]).description, paths[0].resolve().parent.parent)
    robot = load_model(description)
    scene = read_scene(robot)
    for path in paths:
        episode = read_episode(path)
        trajectory = episode.trajectory
        poses = body_poses(robot, trajectory.position, sensed_base(robot, trajectory))
        stamps_ns = episode.start_ns + np.round(trajectory.receive_s * 1e9).astype(np.int64)
        moments = export_foxglove(path, folder / path.name, scene.bodies, stamps_ns, poses, scene.shapes)
        say(f"{folder / path.name}: {len(scene.shapes)} shapes at {moments} moments")
    return description.name


def _joint_facts(model: Path | None, say: Say) -> JointFacts | None:
    if model is None:
        return None
    from deal_hw.sim.mjcf.joint_facts import joint_facts

    facts = joint_facts(model)
    if facts.left_out:
        say(
            f"{model.name}: joints with several coordinates are not read from recordings: "
            f"{', '.join(facts.left_out)}"
        )
    for note in facts.notes:
        say(f"{model.name}: {note}")
    return facts


def _description(path: Path) -> dict[str, Any]:
    from deal_hw.data.recording.reader import check_description

    what, advice = "a robot's description", "see `description` in a dataset.json"
    values = read_json(path, dict[str, Any], what, advice, error=ConfigurationError)
    with reading(path, what, advice, error=ConfigurationError):
        missing = [key for key in ("name", "joint_names", "actuated", "state_rate_hz") if key not in values]
        if missing:
            raise ConfigurationError(f"{', '.join(missing)} missing; {advice}")
        check_description(values)
        number(values["state_rate_hz"], "state_rate_hz", 1e-3, 1e6)
    return values
