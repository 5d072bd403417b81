"""``deal-hw calibrate --model``: any robot, from its MJCF and recordings of positions and commands."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.errors import ConfigurationError, MissingExtraError, short
from deal_hw.parameters import ParameterSpace
from deal_hw.workflows.calibration.checks import (
    examine_recording,
    require_base,
    sensitive_parameters,
    warn_of_gravity,
)
from deal_hw.workflows.calibration.policy_commands import with_policy_commands
from deal_hw.workflows.calibration.recordings import (
    Source,
    aligned,
    at_rest_without_commands,
    common_rates,
    divide,
    named_on_grid,
    read_tables,
    refuse_copies,
    seconds_of,
    without,
    without_scraps,
)
from deal_hw.workflows.calibration.run import CalibrationInputs
from deal_hw.workflows.calibration.settings import CalibrateSettings, Recordings
from deal_hw.workflows.options import File
from deal_hw.workflows.robot import carries_robot, recorded_robot
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode

HELDOUT_PART = 0.25


def write_parameters(config: Recordings, dataset: File | None = None) -> Path:
    """Write a commented parameter file for a model and return its path.

    Args:
        config: Names the file, and the model.
        dataset: Contains the robot if no model is named.

    Raises:
        ConfigurationError: There is no model, or the file exists.
    """
    path, model = config.write_parameters, config.model
    if model is None and carries_robot(dataset):
        from deal_hw.data.recording.dataset import Dataset

        model = recorded_robot(Dataset.open(Path(str(dataset))).description, Path(str(dataset))).mjcf
    if model is None or path is None:
        raise ConfigurationError(
            "--write-parameters needs --model robot.xml, or a dataset with its own robot.yaml"
        )
    if path.exists():
        raise ConfigurationError(f"{path} exists; name another file, or remove it")
    from deal_hw.sim.engine.compiling import compile_mjcf
    from deal_hw.sim.parameters.template import template

    text = template(compile_mjcf(model), model.name)
    path.write_text(text, encoding="utf-8")
    return path


def prepare_model(
    settings: CalibrateSettings, holdout: Sequence[Source], data: Sequence[Source], say: Say
) -> CalibrationInputs:
    """Read and check everything that a calibration of any robot needs, in a short time.

    Args:
        settings: The settings; they name a model.
        holdout: Recordings that only judge the result.
        data: More recordings to fit, also from memory.
        say: Called with sentences on guesses and doubts.

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

    config, spikes = settings.recordings, settings.spikes
    share = heldout_share(config, holdout)
    data = (*config.data, *data)
    if config.model is None or not data:
        raise ConfigurationError("--model needs recordings to fit: --data rec.csv [more ...]")
    files, judges = (
        {Path(s).resolve() for s in some if isinstance(s, str | Path)} for some in (data, holdout)
    )
    if both := sorted(files & judges):
        raise ConfigurationError(
            f"{both[0]} is both fitted and held out; a held-out recording must not be fitted: remove it "
            "from --data or --holdout"
        )

    model = compile_mjcf(config.model)
    space = searched_space(settings, model, say)
    facts = joint_facts(config.model, model)
    columns = None if config.columns is None else read_column_map(config.columns)
    said: dict[str, str] = {}
    fitted, held = (
        read_tables(sources, columns, facts, say, name, said)
        for name, sources in (("data", data), ("holdout", holdout))
    )
    if settings.policy is not None:
        policy = Path(settings.policy)
        fitted, held = (with_policy_commands(tables, policy, facts, say) for tables in (fitted, held))
    fitted, held = (at_rest_without_commands(tables, facts, say) for tables in (fitted, held))
    refuse_copies([*fitted, *held])
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
    space, episodes, judge = parts_to_calibrate(settings, robot, space, episodes, judge, share, say)
    return CalibrationInputs(
        robot=robot,
        space=space,
        episodes=episodes,
        holdout=judge,
        shown=fit_recordings[0][1].trajectory,
        telemetry=[
            f"{name}: {verdict.severity} {verdict.code}: {verdict.message}"
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


def method_for(work: CalibrationInputs, *, fit_given: bool, searches: bool, real: bool) -> str:
    """Return the method that suits recordings of a robot.

    Args:
        work: Robot and recordings.
        fit_given: Whether the user gave --residual-std or --no-refine.
        searches: Whether the user named a search.
        real: Whether the robot is described by the user's own MJCF.
    """
    facts = work.robot.description
    held = set(facts.actuated) == set(facts.joint_names) and all(kp > 0 for kp in facts.stiffness)
    if fit_given:
        return "default"
    if work.walks and not searches:
        return "gait"
    # Output-error compares predictions over seconds, which are useless for a robot that falls.
    return "output-error" if real and work.robot.base is None and held else "default"


def parts_to_calibrate(
    settings: CalibrateSettings,
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[SampledEpisode],
    judge: Sequence[SampledEpisode],
    share: float,
    say: Say,
) -> tuple[ParameterSpace, list[SampledEpisode], list[SampledEpisode]]:
    """Return the parameters that recordings show, the fitted and the held-out recordings.

    Args:
        settings: How recordings are used.
        robot: The nominal model.
        space: The parameters.
        episodes: Recordings to fit.
        judge: Held-out recordings.
        share: Share of each fitted recording, its last part, that is held out as well.
        say: Called with sentences on doubts.

    Raises:
        InsufficientDataError: The recordings are too short, do not move, or do not depend on a parameter.
    """
    config, std = settings.recordings, settings.known_std(robot)
    parts, judge = divide(episodes, judge, share, config.fit_seconds, config.window, say)
    parts, judge = without_scraps(parts, say), without_scraps(judge, say)
    warn_of_gravity(robot, space, parts, say)
    space = sensitive_parameters(robot, space, parts, std, config.window, settings.threads, say)
    return space, parts, judge


def heldout_share(config: Recordings, holdout: Sequence[object]) -> float:
    """Return the share of each recording, its last part, that is held out.

    Raises:
        ConfigurationError: Held-out recordings are named as well.
    """
    if holdout and config.holdout_part:
        raise ConfigurationError("give --holdout or --holdout-part, not both")
    if holdout:
        return 0.0
    return HELDOUT_PART if config.holdout_part is None else config.holdout_part


def searched_space(settings: CalibrateSettings, model: Any, say: Say) -> ParameterSpace:
    """Return the parameters to search of a user's model; report what is not searched as it is 0 there.

    Raises:
        ConfigurationError: The parameter file, or a change of the parameters, cannot be used.
    """
    from deal_hw.sim.parameters import check_space
    from deal_hw.sim.parameters.template import left_at_zero, template
    from deal_hw.sim.parameters.yaml_space import parse_space, read_space

    if settings.recordings.parameters is None:
        zero = [f"{kind} of {short(', '.join(names))}" for kind, names in left_at_zero(model).items()]
        if zero:
            say(
                f"not searched, because they are 0 in the model: {'; '.join(zero)}. If the robot has them, "
                "write values above 0 into the MJCF"
            )
        space = parse_space(template(model), model, "the default parameters (see --write-parameters)")
    else:
        space = read_space(settings.recordings.parameters, model)
    space = settings.searched(space)
    check_space(model, space)
    return space
