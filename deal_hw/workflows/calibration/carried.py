"""Calibration of a dataset with its own robot.yaml."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw.errors import MissingExtraError
from deal_hw.workflows.calibration.checks import require_base
from deal_hw.workflows.calibration.dataset import choose_episodes, sound_recordings
from deal_hw.workflows.calibration.model import heldout_share, parts_to_calibrate, searched_space
from deal_hw.workflows.calibration.recordings import aligned
from deal_hw.workflows.calibration.run import CalibrationInputs
from deal_hw.workflows.calibration.settings import CalibrateSettings
from deal_hw.workflows.robot import recorded_robot
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    pass


def prepare_carried(settings: CalibrateSettings, holdout: Sequence[int], say: Say) -> CalibrationInputs:
    """Read a dataset with its own robot.yaml; its recordings are used like those of any user's robot.

    Args:
        settings: The settings; they name a dataset.
        holdout: Held-out episodes; empty: those of the motion `chirp`.
        say: Called with sentences on findings.

    Raises:
        DealHwError: A setting, the robot or a recording is unusable.
    """
    try:
        from deal_hw.data.importing.grid import Recording
        from deal_hw.data.recording.dataset import Dataset
        from deal_hw.sim.engine.compiling import compile_mjcf
        from deal_hw.sim.engine.model import load_model
        from deal_hw.sim.mjcf.describe import sampling, with_speed_limits
        from deal_hw.sim.recordings.episode import thin
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err

    config, folder = settings.recordings, Path(str(settings.dataset))
    share = heldout_share(config, holdout)
    dataset = Dataset.open(folder)
    description = recorded_robot(dataset.description, folder)
    fit, held = choose_episodes(dataset, settings.episodes, holdout, say)
    if held and config.holdout_part is None:
        share = 0.0
    trajectories, telemetry = sound_recordings(
        {i: dataset.read(i).trajectory for i in (*fit, *held)}, folder, settings.spikes, say
    )
    model = compile_mjcf(description.mjcf)
    space = searched_space(settings, model, say)
    timestep = float(model.opt.timestep) if config.physics_step is None else config.physics_step
    rates = sampling(1.0 / description.state_rate_hz, timestep, config.window)
    description = dataclasses.replace(
        description,
        device_rate_hz=1.0 / rates.step_s,
        control_rate_hz=1.0 / (rates.period_s * rates.samples_per_tick),
    )
    robot = load_model(with_speed_limits(description, model, space), rates.step_s)
    recordings = {i: Recording(trajectory) for i, trajectory in trajectories.items()}
    feet = config.feet or description.feet
    require_base(robot, feet, list(recordings.values()))
    episodes = {
        i: aligned(recording, robot, feet, dataset.path(i).name) for i, recording in recordings.items()
    }
    if settings.sample_hz is not None:
        episodes = {i: thin(episode, settings.sample_hz) for i, episode in episodes.items()}
    space, parts, judge = parts_to_calibrate(
        settings, robot, space, [episodes[i] for i in fit], [episodes[i] for i in held], share, say
    )
    return CalibrationInputs(
        robot=robot,
        space=space,
        episodes=parts,
        holdout=judge,
        shown=trajectories[fit[0]],
        telemetry=telemetry,
        provenance={
            "dataset": str(folder),
            "description_digest": dataset.digest,
            "episodes": list(fit),
            "holdout": list(held) or f"last {share:.0%} of each recording",
            "sampling": dataclasses.asdict(rates),
        },
        advice="import recordings of other motion, and name their episodes with --holdout",
    )
