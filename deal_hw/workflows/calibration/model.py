"""``deal-hw calibrate --model``: any robot, from its MJCF and recordings of positions and commands."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from deal_hw.data.recording.spikes import DEFAULT_SPIKES, SpikeSettings
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.checks import (
    examine_recording,
    require_base,
    require_sensitive_parameters,
    warn_of_gravity,
)
from deal_hw.workflows.calibration.recordings import (
    Source,
    aligned,
    common_rates,
    divide,
    named_on_grid,
    read_tables,
    seconds_of,
    without,
)
from deal_hw.workflows.calibration.run import CalibrationInputs, SpaceOverrides
from deal_hw.workflows.options import Checked, File, Range
from deal_hw.workflows.robot import carries_robot, recorded_robot
from deal_hw.workflows.say import Say, silent

if TYPE_CHECKING:
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode

HELDOUT_PART = 0.25
DEFAULT = "default"
"""Name of the method where none is named."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recordings(Checked):
    """Any robot: its MuJoCo model and its recordings (page 'Your own robot' of the documentation)."""

    model: Path | None = None
    """The robot's MJCF. Its position actuators (or motors) take the recorded commands."""

    data: tuple[Path, ...] = ()
    """Recordings to fit: CSV, NPZ or MCAP files, or LeRobot folders."""

    columns: Path | None = None
    """Column map (YAML; page 'Use your recordings' of the documentation). Without one, the meaning of the
    channels is guessed from their names."""

    parameters: Path | None = None
    """What to search (YAML; --write-parameters writes an example). By default friction, damping and armature
    of every joint and gain of every actuator of the model."""

    write_parameters: Path | None = None
    """Write such a file for --model, to edit, and do nothing else."""

    feet: tuple[str, ...] = ()
    """Of a floating robot: its feet's sphere geoms. Base height and velocity are estimated from those that
    stand; recordings must hold the base's orientation and gyro."""

    holdout_part: Annotated[float | None, Range(0, 0.95)] = None
    """Without --holdout this last share of each recording only judges the result; 0.25 by default, 0 for
    none."""

    leave_out: Annotated[tuple[tuple[str, float, float], ...], Range(0, 1e6, "s")] = ()
    """Stretches that the model has no part for, such as a contact: FILE FROM TO [s from its start]."""

    fit_seconds: Annotated[float, Range(0.1, 1e5, "s")] = 60.0
    """Fit stretches that lie evenly over the recordings and add up to so many seconds; more is slower."""

    window: Annotated[float, Range(1e-3, 60, "s")] = 0.4
    """Length of the search's longest windows of prediction [s]; the first ones are a quarter of it. Longer
    ones see slow things (weight, friction that holds) and cost memory with the square of their samples."""

    physics_step: Annotated[float | None, Range(1e-6, 0.1, "s")] = None
    """Wanted physics step [s]; by default the MJCF's timestep. A whole number fits into a sampling period."""

    force: bool = False
    """Use recordings although a plausibility check failed."""


def write_parameters(config: Recordings, dataset: File | None = None) -> Path:
    """Write a commented parameter file for a model and return its path.

    Args:
        config: Names the file, and the model.
        dataset: Carries the robot where no model is named.

    Raises:
        ConfigurationError: There is no model, or the file exists.
    """
    path, model = config.write_parameters, config.model
    if model is None and carries_robot(dataset):
        from deal_hw.data.recording.dataset import Dataset

        model = recorded_robot(Dataset.open(Path(str(dataset))).description, Path(str(dataset))).mjcf
    if model is None or path is None:
        raise ConfigurationError(
            "--write-parameters needs --model robot.xml, or a dataset that carries a robot"
        )
    if path.exists():
        raise ConfigurationError(f"{path} exists; name another file, or remove it")
    from deal_hw.sim.engine.compiling import compile_mjcf
    from deal_hw.sim.parameters.template import template

    text = template(compile_mjcf(model), model.name)
    path.write_text(text, encoding="utf-8")
    return path


def prepare_model(
    config: Recordings,
    holdout: Sequence[Source],
    overrides: SpaceOverrides,
    *,
    std: Callable[[RobotModel], FloatArray | None],
    data: Sequence[Source] = (),
    spikes: SpikeSettings = DEFAULT_SPIKES,
    threads: int | None = None,
    say: Say = silent,
) -> CalibrationInputs:
    """Read and check everything that a calibration of any robot needs; nothing here takes long.

    Args:
        config: Model and recordings.
        holdout: Recordings that only judge the result.
        overrides: What the command line changes about the parameters.
        std: What a prediction may be off, as in :class:`deal_hw.calib.data.problem.Problem`.
        data: More recordings to fit, also from memory.
        spikes: What counts as a spike.
        threads: Simulation threads.
        say: Called with sentences on what was guessed and what looks odd.

    Raises:
        ConfigurationError: A setting, the model or a parameter cannot be used.
        DatasetError: A recording cannot be read, understood or trusted.
        InsufficientDataError: The recordings are too short.
    """
    try:
        from deal_hw.data.checks.plausibility import despiked
        from deal_hw.data.importing.columns import read_column_map
        from deal_hw.sim.engine.compiling import compile_mjcf
        from deal_hw.sim.engine.model import load_model
        from deal_hw.sim.mjcf.describe import describe, with_speed_limits
        from deal_hw.sim.mjcf.joint_facts import joint_facts
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err

    share = heldout_share(config, holdout)
    data = (*config.data, *data)
    if config.model is None or not data:
        raise ConfigurationError("--model needs recordings to fit: --data rec.csv [more ...]")
    files, judges = (
        {Path(s).resolve() for s in some if isinstance(s, str | Path)} for some in (data, holdout)
    )
    if both := sorted(files & judges):
        raise ConfigurationError(
            f"{both[0]} is to be fitted and held out; a held-out recording must not be seen"
        )

    model = compile_mjcf(config.model)
    space = searched_space(config, overrides, model)
    facts = joint_facts(config.model, model)
    columns = None if config.columns is None else read_column_map(config.columns)
    fitted, held = (
        read_tables(sources, columns, facts.names, say, name)
        for name, sources in (("data", data), ("holdout", holdout))
    )
    rates = common_rates([*fitted, *held], model, config.physics_step, config.window)
    description = describe(config.model, model, fitted[0].joint_names, fitted[0].actuated, rates)
    description = with_speed_limits(description, model, space)
    parts = without(
        config.leave_out, *([despiked(table, spikes) for table in tables] for tables in (fitted, held))
    )
    servo = description.actuation == "position"
    verdicts = {
        table.name: examine_recording(
            table, facts, config.force, servo=servo, kept=kept, spikes=spikes, say=say
        )
        for table, kept in zip((*fitted, *held), itertools.chain(*parts), strict=True)
    }
    robot = load_model(description, rates.step_s)
    fitted, held = parts
    fit_recordings, held_recordings = (named_on_grid(tables, robot, rates) for tables in (fitted, held))
    require_base(robot, config.feet, [r for _, r in (*fit_recordings, *held_recordings)])
    episodes, judge = (
        [aligned(r, robot, config.feet, name) for name, r in recordings]
        for recordings in (fit_recordings, held_recordings)
    )
    episodes, judge = parts_to_calibrate(
        robot, space, episodes, judge, config, share=share, std=std, threads=threads, say=say
    )
    return CalibrationInputs(
        robot=robot,
        space=space,
        episodes=episodes,
        holdout=judge,
        shown=fit_recordings[0][1].trajectory,
        telemetry=[
            f"{name}: {verdict.severity} {verdict.name}: {verdict.message}"
            for name, found in verdicts.items()
            for verdict in found
        ],
        provenance={
            "model": str(config.model),
            "description_digest": description.digest(),
            "recordings": [dict(table.source) for table in fitted],
            "holdout": [dict(table.source) for table in held] or f"last {share:.0%} of each recording",
            "fitted_s": round(sum(seconds_of(e) for e in episodes), 3),
            "left_out": [list(entry) for entry in config.leave_out],
            "heldout_s": round(sum(seconds_of(e) for e in judge), 3),
            "sampling": dataclasses.asdict(rates),
        },
        advice="name recordings of other motion with --holdout",
    )


def method_for(work: CalibrationInputs, *, told: bool, real: bool) -> str:
    """Return the method that suits recordings of a robot.

    Args:
        work: Robot and recordings.
        told: Whether the user said how to treat what no model explains.
        real: Whether they are of a robot that the user's own MJCF describes.
    """
    facts = work.robot.description
    held = set(facts.actuated) == set(facts.joint_names) and all(kp > 0 for kp in facts.stiffness)
    if told:
        return DEFAULT
    if work.walks:
        return "gait"
    # Predictions of seconds, which output-error compares, mean nothing for a robot that falls.
    return "output-error" if real and work.robot.base is None and held else DEFAULT


def parts_to_calibrate(
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[SampledEpisode],
    judge: Sequence[SampledEpisode],
    config: Recordings,
    *,
    share: float,
    std: Callable[[RobotModel], FloatArray | None],
    threads: int | None,
    say: Say,
) -> tuple[list[SampledEpisode], list[SampledEpisode]]:
    """Return what is fitted and what judges, checked against the parameters.

    Args:
        robot: The nominal model.
        space: The parameters.
        episodes: Recordings to fit.
        judge: Recordings that only judge.
        config: How recordings are used.
        share: Share of each fitted recording, its last part, that judges as well.
        std: What a prediction may be off.
        threads: Simulation threads.
        say: Called with sentences on what looks odd.

    Raises:
        InsufficientDataError: The recordings are too short, do not move, or show a parameter nowhere.
    """
    parts, judge = divide(episodes, judge, share, config.fit_seconds, config.window, say)
    warn_of_gravity(robot, space, parts, say)
    require_sensitive_parameters(robot, space, parts, std(robot), config.window, threads, say)
    return parts, judge


def heldout_share(config: Recordings, holdout: Sequence[object]) -> float:
    """Return which last share of each recording only judges.

    Raises:
        ConfigurationError: Recordings to judge by are named as well.
    """
    if holdout and config.holdout_part:
        raise ConfigurationError("give --holdout or --holdout-part, not both")
    if holdout:
        return 0.0
    share = HELDOUT_PART if config.holdout_part is None else config.holdout_part
    return share


def searched_space(config: Recordings, overrides: SpaceOverrides, model: Any) -> ParameterSpace:
    """Return the parameters to search of a user's model.

    Raises:
        ConfigurationError: The file of parameters, or what is changed about them, cannot be used.
    """
    from deal_hw.sim.parameters import check_space
    from deal_hw.sim.parameters.template import template
    from deal_hw.sim.parameters.yaml_space import parse_space, read_space

    if config.parameters is None:
        space = parse_space(template(model), model, "the default parameters (see --write-parameters)")
    else:
        space = read_space(config.parameters, model)
    space = overrides.apply(space)
    check_space(model, space)
    return space
