"""Read the inputs of a calibration by its settings, and calibrate from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.calibration import CalibrationResult, ProgressCallback
from deal_hw.errors import ConfigurationError
from deal_hw.workflows.calibration.carried import prepare_carried
from deal_hw.workflows.calibration.dataset import prepare_dataset
from deal_hw.workflows.calibration.model import method_for, prepare_model
from deal_hw.workflows.calibration.recordings import Source
from deal_hw.workflows.calibration.run import CalibrationInputs, calibrate_episodes
from deal_hw.workflows.calibration.settings import CalibrateSettings
from deal_hw.workflows.calibration.walking import WALK_TELLS
from deal_hw.workflows.robot import carries_robot
from deal_hw.workflows.say import Say, silent


def prepare(
    settings: CalibrateSettings,
    *,
    data: Sequence[Source] = (),
    holdout: Sequence[Any] | None = None,
    say: Say = silent,
) -> CalibrationInputs:
    """Read and check the inputs of a calibration.

    Args:
        settings: The settings.
        data: More recordings to fit, also from memory.
        holdout: Held-out recordings, also from memory; by default those of the settings.
        say: Called with sentences on guesses and doubts.

    Raises:
        DealHwError: A setting or a recording is unusable.
    """
    judges = settings.holdout if holdout is None else holdout
    if settings.recordings.model is not None:
        numbers = " ".join(str(one) for one in judges if isinstance(one, int))
        if numbers:
            raise ConfigurationError(
                f"--holdout {numbers}: with --model give recordings; episode numbers go with a dataset"
            )
        return prepare_model(settings, judges, data, say)
    wrong = [str(one) for one in judges if not isinstance(one, int)]
    if wrong:
        raise ConfigurationError(
            f"--holdout {' '.join(wrong)}: with a dataset give episode numbers; files go with --model"
        )
    held = [int(str(one)) for one in judges]
    if settings.dataset is None:
        raise ConfigurationError("no dataset was named")
    if carries_robot(settings.dataset):
        return prepare_carried(settings, held, say)
    return prepare_dataset(settings, held, say)


def usual_method(settings: CalibrateSettings, work: CalibrationInputs, say: Say = silent) -> str:
    """Return the named method, or the one that suits the recordings."""
    if settings.method:
        return settings.named()
    fit_given = settings.residual_std not in ((), None) or not settings.refine
    real = settings.recordings.model is not None or carries_robot(settings.dataset)
    method = method_for(work, fit_given=fit_given, searches=settings.search is not None, real=real)
    if work.walks and method == "gait":
        say(WALK_TELLS)
    if method != "default":
        say(f"method: {method} (alternative: --method default, which refines to the sensor noise)")
    return settings.named(method)


def calibrate_inputs(
    settings: CalibrateSettings,
    work: CalibrationInputs,
    method: str,
    *,
    progress: ProgressCallback | None = None,
    say: Say = silent,
    checkpoint: Path | None = None,
    resume: bool = False,
    keep: Path | None = None,
) -> CalibrationResult:
    """Calibrate from the inputs with the settings; see :func:`calibrate_episodes`."""
    return calibrate_episodes(
        work.robot,
        work.space,
        work.episodes,
        work.holdout,
        method=method,
        budget=settings.budget,
        thorough=settings.checks == "all",
        rng=np.random.default_rng(settings.seed),
        latency_s=settings.latency,
        latency_range_s=settings.latency_range,
        threads=settings.threads,
        progress=progress,
        say=say,
        checkpoint=checkpoint,
        resume=resume,
        keep=keep,
        known_std=settings.known_std(work.robot),
        heldout_window_s=settings.heldout_window,
        policy=work.policy,
        smoothing_s=work.smoothing_s,
    )
