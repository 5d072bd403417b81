"""Settings of a calibration, and the functions that read and check their inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from deal_hw.calib.pipeline.methods import check_method, usual_budget
from deal_hw.calibration import LATENCY_RANGE_S, Budget, CalibrationResult, ProgressCallback
from deal_hw.data.files import dataset_of
from deal_hw.data.recording.spikes import DEFAULT_SPIKES, SpikeSettings
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import LONGEST_LATENCY_S
from deal_hw.ranges import Checked, Range
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.carried import prepare_carried
from deal_hw.workflows.calibration.dataset import DatasetRecordings, prepare_dataset
from deal_hw.workflows.calibration.model import DEFAULT, Recordings, method_for, prepare_model
from deal_hw.workflows.calibration.policy import check_policy
from deal_hw.workflows.calibration.recordings import Source
from deal_hw.workflows.calibration.run import (
    HELDOUT_WINDOW_S,
    CalibrationInputs,
    SpaceOverrides,
    calibrate_episodes,
    residual_std,
)
from deal_hw.workflows.calibration.walking import WALK_TELLS
from deal_hw.workflows.options import File, Ratio, Seed, Threads, given, refuse
from deal_hw.workflows.robot import carries_robot
from deal_hw.workflows.say import Say, silent

if TYPE_CHECKING:
    from deal_hw.sim.engine.model import RobotModel

OF_DATASETS = ("episodes", "space", "sample_hz")
"""Settings for datasets only."""
OF_OWN_ROBOTS = tuple(f.name for f in fields(Recordings) if f.name != "parameters")
"""Settings without effect for datasets of robots with a driver."""
FROM_FILES = ("data", "columns", "feet", "leave_out", "force")
"""Settings on reading files, which have no effect for a dataset with its own robot.yaml."""


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(Checked):
    """Settings of ``deal-hw calibrate`` and :func:`deal_hw.calibrate`, with the same checks in both."""

    dataset: File | None = None
    """Dataset folder, such as runs/first/dataset; left out with --model."""

    recordings: Recordings = field(default_factory=Recordings)

    episodes: Annotated[tuple[int, ...], Range(0, 1_000_000)] = ()
    """Numbers of the episodes of the dataset to fit (the first is 0); by default all but the held-out
    ones."""

    holdout: Annotated[tuple[int | Path, ...], Range(0, 1_000_000)] = ()
    """Held-out data, which only test the result: numbers of episodes of the dataset (the first is 0), or with
    --model recordings. By default the episodes collected with --motion chirp; if there is none and the robot
    is your own, the last part of each recording (--holdout-part)."""

    heldout_window: Annotated[float, Range(1e-3, 600, "s")] = HELDOUT_WINDOW_S
    """Held-out predictions restart from the measured state after this time [s]."""

    method: str = DEFAULT
    """Search method: default, output-error, eki, deal, deal-paper, ... (an unknown name lists all). The
    default is eki with refinement. For a walk it is gait. With --model, for servos on a fixed base, it is
    output-error, unless --residual-std or --no-refine is given."""

    policy: File | None = None
    """The policy (.onnx) that moved the robot, for deal-paper and other methods that run it in every
    simulator; by default the copy in the dataset."""

    space: str = ""
    """Named parameter set of a robot with a driver, such as k9 or k11; by default the first. Page
    'Parameters' of the documentation lists them."""

    free: tuple[str, ...] = ()
    """Search exactly these parameters; all others keep their nominal values."""

    known: Annotated[tuple[tuple[str, float], ...], Range(-1e12, 1e12)] = ()
    """Values that were measured by other means, as NAME VALUE pairs (SI)."""

    range: Annotated[tuple[tuple[str, float, float], ...], Range(-1e12, 1e12)] = ()
    """Other search ranges, as NAME LOW HIGH (SI)."""

    range_ratio: Annotated[float | None, Ratio] = None
    """Search each parameter within a factor RANGE-RATIO to either side of its nominal value. By default as
    its parameter set says, mostly 5; with --model 20 for dry friction; with --parameters the ranges of that
    file."""

    latency: Annotated[float | None, Range(0, LONGEST_LATENCY_S, "s")] = None
    """Total latency [s] if it is known; by default it is searched."""

    latency_range: Annotated[tuple[float, float], Range(0, LONGEST_LATENCY_S, "s")] = LATENCY_RANGE_S
    """Range of the latency search, LOW HIGH [s]. Widen it if an alarm reports an estimate at its end."""

    spike_ratio: Annotated[float, Range(1, 1e6)] = DEFAULT_SPIKES.ratio
    """Leave out up to three successive samples that jump away and come back, if they jump more than this many
    times as far as the joint's fastest motion would reach. A larger number leaves out fewer samples."""

    residual_std: float | Mapping[str, float] | tuple[str, ...] | None = ()
    """Expected standard deviation of the prediction error [rad, m]: sensor noise and model error. One number,
    or NAME VALUE pairs of joints; by default the sensor noise, estimated from the recordings. For real robots
    a few milliradians are often better."""

    sample_hz: Annotated[float | None, Range(1, 1e5, "Hz")] = None
    """Rate of the fitted and held-out states of a dataset, approximately [Hz]; by default four per control
    period."""

    population: Annotated[int | None, Range(2, 100_000)] = None
    """Population size of the search; by default 100, for methods of the paper 200."""

    generations: Annotated[int, Range(1, 100_000)] = 50
    """Most generations of the search."""

    refine: bool = True
    """After the search, refine by multiple shooting on the prediction error."""

    seed: Seed = 0
    """Seed of all random numbers."""

    threads: Threads = None
    """Simulation threads; by default all CPUs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.latency_range
        if not low < high:
            raise ConfigurationError(f"--latency-range {low:g} {high:g}: give the lower one first")

    def check(self, data: Sequence[Source] = ()) -> None:
        """Check the combination of settings before anything is read.

        Args:
            data: Recordings to fit that are not among the settings.

        Raises:
            ConfigurationError: A setting would have no effect, or is missing.
            UnknownNameError: There is no such method.
        """
        check_source(
            dataset=self.dataset,
            model=self.recordings.model is not None,
            data=bool(data or self.recordings.data),
        )
        if self.dataset is not None:
            object.__setattr__(self, "dataset", dataset_of(self.dataset))
        if self.recordings.model is None:
            carries = carries_robot(self.dataset)
            foreign = given(self.recordings, Recordings(), FROM_FILES if carries else OF_OWN_ROBOTS)
            if carries:
                refuse(
                    given(self, CalibrateSettings(), ("space",)), "this robot has one set; use --parameters"
                )
            foreign += ["--data"] if data and "--data" not in foreign else []
            refuse(foreign, "a dataset defines it; use that option with --model and --data")
        else:
            refuse(
                given(self, CalibrateSettings(), OF_DATASETS),
                "only datasets take that; with --model use --data and --parameters",
            )
        if self.latency is not None:
            refuse(given(self, CalibrateSettings(), ("latency_range",)), "--latency gives the latency")
        check_method(self.method)
        own = self.recordings.model is not None or carries_robot(self.dataset)
        check_policy(self.method, given=self.policy is not None, model=own)

    @property
    def budget(self) -> Budget:
        """Budget of the method."""
        return usual_budget(self.method, self.population, self.generations, refine=self.refine)

    def known_std(self, robot: RobotModel) -> FloatArray | None:
        """Return the expected prediction error (std), positions then velocities, (2 C,), or None.

        Raises:
            ConfigurationError: A number is missing, or is not above 0.
            UnknownNameError: A joint is not known.
        """
        return residual_std(self.residual_std, robot)

    @property
    def provenance(self) -> dict[str, Any]:
        """The settings in the result's provenance: plain JSON values."""
        std = self.residual_std
        noted = {
            "seed": self.seed,
            "range_ratio": self.range_ratio,
            "heldout_window_s": self.heldout_window,
            "latency_range_s": None if self.latency is not None else list(self.latency_range),
        }
        if std in ((), None):
            return noted
        given = list(std) if isinstance(std, tuple) else dict(std) if isinstance(std, Mapping) else std
        return {**noted, "residual_std": given}

    @property
    def overrides(self) -> SpaceOverrides:
        """Changes of the parameters."""
        return SpaceOverrides(
            free=self.free, known=dict(self.known), ranges=self.range, range_ratio=self.range_ratio
        )


def check_source(*, dataset: Path | str | None, model: bool, data: bool) -> None:
    """Check that there is one source of recordings.

    Args:
        dataset: The named dataset.
        model: Whether a model is given.
        data: Whether recordings for a model are given.

    Raises:
        ConfigurationError: There is none, or there are two; or a model is named as a dataset.
    """
    if not model and dataset is not None and Path(dataset).suffix == ".xml":
        recordings = "" if data else " --data rec.csv"
        raise ConfigurationError(
            f"{dataset} is a model, not a dataset; name it by --model {dataset}{recordings}"
        )
    if not model and dataset is None and data:
        raise ConfigurationError("--data needs the robot's model: add --model robot.xml")
    if (dataset is not None) == model:
        how = "not both" if model else "one of the two"
        raise ConfigurationError(
            "name a dataset (deal-hw calibrate runs/first/dataset), or a model and its recordings "
            f"(deal-hw calibrate --model robot.xml --data rec.csv), {how}"
        )


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
    spikes = SpikeSettings(ratio=settings.spike_ratio)
    if settings.recordings.model is not None:
        numbers = " ".join(str(one) for one in judges if isinstance(one, int))
        if numbers:
            raise ConfigurationError(
                f"--holdout {numbers}: with --model give recordings; episode numbers go with a dataset"
            )
        return prepare_model(
            settings.recordings,
            judges,
            settings.overrides,
            std=settings.known_std,
            data=data,
            spikes=spikes,
            threads=settings.threads,
            say=say,
        )
    wrong = [str(one) for one in judges if not isinstance(one, int)]
    if wrong:
        raise ConfigurationError(
            f"--holdout {' '.join(wrong)}: with a dataset give episode numbers; files go with --model"
        )
    if settings.dataset is None:
        raise ConfigurationError("no dataset was named")
    source = DatasetRecordings(
        folder=Path(settings.dataset),
        episodes=settings.episodes,
        holdout=[int(str(one)) for one in judges],
        parameters=settings.recordings.parameters,
        policy=None if settings.policy is None else Path(settings.policy),
        sample_hz=settings.sample_hz,
        spikes=spikes,
    )
    if carries_robot(settings.dataset):
        return prepare_carried(
            source,
            settings.recordings,
            settings.overrides,
            std=settings.known_std,
            threads=settings.threads,
            say=say,
        )
    return prepare_dataset(source, settings.space, settings.overrides, settings.method, say)


def usual_method(settings: CalibrateSettings, work: CalibrationInputs, say: Say = silent) -> str:
    """Return the named method, or the one that suits the recordings."""
    if settings.method != DEFAULT:
        return settings.method
    fit_given = settings.residual_std not in ((), None) or not settings.refine
    real = settings.recordings.model is not None or carries_robot(settings.dataset)
    method = method_for(work, fit_given=fit_given, real=real)
    if work.walks and not fit_given:
        say(WALK_TELLS)
    if method != DEFAULT:
        say(f"method: {method} (alternative: --method eki, which searches and refines to the sensor noise)")
    return method


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
