"""Settings of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from deal_hw.calib.pipeline.methods import (
    CLOSED_LOOP_METHODS,
    DEFAULT_SEARCH,
    SEARCHES,
    SEARCHING,
    check_method,
    search_of,
    usual_budget,
    with_search,
)
from deal_hw.calibration import LATENCY_RANGE_S, Budget
from deal_hw.data.checks.spikes import DEFAULT_SPIKES, SpikeSettings
from deal_hw.data.files import dataset_of
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import LONGEST_LATENCY_S, ParameterSpace
from deal_hw.ranges import Checked, Range
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.policy import check_policy
from deal_hw.workflows.calibration.recordings import Recorded
from deal_hw.workflows.calibration.source import Division
from deal_hw.workflows.options import File, Ratio, Seed, Threads, given, refuse
from deal_hw.workflows.robot import carries_robot

if TYPE_CHECKING:
    from deal_hw.sim.engine.model import RobotModel

HELDOUT_PART = 0.25
HELDOUT_WINDOW_S = 0.2
"""The same as in :mod:`deal_hw.calib.validation.metrics`, which is loaded on need."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recordings(Checked):
    """Any robot: its MuJoCo model and its recordings (docs/tutorials/your-robot.md)."""

    model: Path | None = None
    """The robot's MJCF. Its position actuators (or motors) take the recorded commands."""

    data: tuple[Path, ...] = ()
    """Recordings to fit: CSV, NPZ or MCAP files, or LeRobot folders."""

    columns: Path | None = None
    """Column map (YAML; docs/how-to/import.md). Without one, the meaning of the
    channels is guessed from their names."""

    parameters: Path | None = None
    """What to search (YAML; --write-parameters writes an example). By default friction, damping and armature
    of every joint and gain of every actuator of the model. With a dataset of a robot with a driver: what to
    search beside its set."""

    write_parameters: Path | None = None
    """Write a --parameters file for --model, to edit, and end."""

    feet: tuple[str, ...] = ()
    """Sphere geoms of the feet of a floating robot. The standing feet give the base's height and velocity;
    recordings must contain the base's orientation and gyro."""

    holdout_part: Annotated[float | None, Range(0, 0.95)] = None
    """Share of each recording, its last part, that is held out to test the result, without --holdout; 0.25 by
    default, 0 for none."""

    leave_out: Annotated[tuple[tuple[str, float, float], ...], Range(0, 1e6, "s")] = ()
    """Parts of recordings that the model cannot explain, such as contacts: FILE FROM TO [s from start]."""

    fit_seconds: Annotated[float, Range(0.1, 1e5, "s")] = 60.0
    """Fit this many seconds, in parts that lie evenly over the recordings; more is slower."""

    window: Annotated[float, Range(1e-3, 60, "s")] = 0.4
    """Length of the longest prediction windows of the search [s]; the search begins with a quarter of it.
    Longer windows show slow effects (weight, static friction); their memory grows with the square of their
    samples."""

    physics_step: Annotated[float | None, Range(1e-6, 0.1, "s")] = None
    """Requested physics step [s]; by default the MJCF's timestep. It is adjusted to a whole number of steps
    per sampling period."""

    force: bool = False
    """Use recordings although a check of them failed."""


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

    method: str = ""
    """The pipeline. default: a local fit; where it does not explain the recordings a search, then refinement
    to the sensor noise. output-error: fits of predictions, and a search; the best predictor is chosen. local:
    those fits without a search. gait: short fits for a walk. nominal: no fit. By default gait for a walk,
    unless --search is given; output-error with --model for servos on a fixed base; but default with
    --residual-std or --no-refine, and for all else. Baselines to compare with: easi, easi-log, bo, bo-critic,
    cma, gauss-newton, least-squares, least-squares-random, least-squares-multistart, ekf, ekf-one-pass,
    mujoco-sysid, random, midpoint, midpoint-linear, and variants of the DEAL paper's Algorithm 1:
    deal-paper-literal, deal-paper-literal-fn, deal-paper-literal-pn, deal-paper-literal-flat, deal-paper-fn,
    deal-paper-pn, deal-paper-flat, deal-paper-replay, deal-paper-energy, deal-paper-mmd; parts of deal:
    deal-critic, deal-untrained, deal-no-critic; and searches that compare distributions of transitions in
    closed loop: deal-unaligned, mmd-unaligned, moments-unaligned."""

    search: Literal["deal", "eki", "deal-paper"] | None = None
    """The search of default and output-error, by default deal. deal: a critic tells recording and simulators
    apart, and the population moves to where it cannot. eki: an ensemble Kalman search, without a critic.
    deal-paper: the DEAL paper's Algorithm 1. With --no-refine the search alone."""

    policy: File | None = None
    """The policy (.onnx) that moved the robot. With --model it gives the commands of recordings without any,
    and checks the clock of recorded ones. With a dataset: for deal-paper and other methods that run it in
    every simulator; by default the copy in the dataset."""

    space: str = ""
    """Named parameter set of a robot with a driver, such as k9 or k11; by default the first.
    docs/reference/parameters.md lists them."""

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

    checks: Literal["usual", "all"] = "usual"
    """Checks of recordings that the model does not explain: usual ends them where they take more physics
    steps than the fits; all runs them to their end."""

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

    def check(self, data: Sequence[Recorded] = ()) -> None:
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
        if self.method in SEARCHES:
            raise ConfigurationError(
                f"--method {self.method}: that is a search; --search {self.method} runs it where the local "
                f"fit does not explain the recordings, --search {self.method} --no-refine runs it alone"
            )
        check_method(self.named())
        if self.method and self.method not in SEARCHING:
            refuse(
                given(self, CalibrateSettings(), ("search",)), f"--method {self.method} has no search inside"
            )
        own = self.recordings.model is not None or carries_robot(self.dataset)
        files = self.recordings.model is not None
        check_policy(self.named(), given=self.policy is not None, model=own, files=files)

    def named(self, pipeline: str = "") -> str:
        """Return the name of a pipeline, by default the one that is asked for, with its search."""
        return with_search(pipeline or self.method or "default", self.search or DEFAULT_SEARCH)

    @property
    def in_closed_loop(self) -> bool:
        """Whether the method runs the policy that moved the robot in every simulator."""
        return search_of(self.named()) in CLOSED_LOOP_METHODS

    @property
    def budget(self) -> Budget:
        """Budget of the method."""
        return usual_budget(self.named(), self.population, self.generations, refine=self.refine)

    def division(self, holdout: Sequence[object]) -> Division:
        """Return how recordings become parts to fit and parts that judge.

        Args:
            holdout: Recordings that only judge.

        Raises:
            ConfigurationError: A share of each recording is to be held out as well.
        """
        config = self.recordings
        if holdout and config.holdout_part:
            raise ConfigurationError("give --holdout or --holdout-part, not both")
        share = HELDOUT_PART if config.holdout_part is None else config.holdout_part
        return Division(
            share=0.0 if holdout else share, fit_seconds=config.fit_seconds, window_s=config.window
        )

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
    def spikes(self) -> SpikeSettings:
        """Definition of a spike."""
        return SpikeSettings(ratio=self.spike_ratio)

    def searched(self, space: ParameterSpace) -> ParameterSpace:
        """Return a parameter set with the changes of the settings.

        Raises:
            UnknownNameError: A name is not known; the message lists the names.
            ConfigurationError: A range is empty, reversed, or excludes the nominal value; or no parameter is
                left.
        """
        if self.free:
            space = space.with_free(self.free)
        if self.range_ratio is not None:
            space = space.with_ratio(self.range_ratio)
        space = space.with_known(dict(self.known))
        for parameter, low, high in self.range:
            space = space.with_range(parameter, low, high)
        if not len(space):
            raise ConfigurationError(
                "every parameter is known, so there is nothing to search; remove one from --known"
            )
        return space


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


def residual_std(
    given: float | Mapping[str, float] | tuple[str, ...] | None, robot: RobotModel
) -> FloatArray | None:
    """Return the expected prediction error (std), positions then velocities, (2 C,), or None.

    Args:
        given: One number for all joints of a fixed robot, or one for each name [rad or m]; from the command
            line as words; None or no words: none is expected.
        robot: The robot.

    Raises:
        ConfigurationError: A number is missing, or is not above 0.
        UnknownNameError: A joint is not known.
    """
    if given is None or given == ():
        return None
    if isinstance(given, tuple) and len(given) == 1:
        given = _number(given[0])
    elif isinstance(given, tuple):
        # A last word without a number is a joint without a value.
        found = [*map(_number, given[1::2]), *([math.nan] * (len(given) % 2))]
        given = dict(zip(given[::2], found, strict=True))
    names = robot.description.joint_names + (("orientation", "gyro") if robot.base is not None else ())
    one = not isinstance(given, Mapping)
    values = dict.fromkeys(names, given) if isinstance(given, float | int) else dict(given)
    for name in values:
        if name not in names:
            raise UnknownNameError("joint", name, names)
    if (
        set(values) != set(names)
        or any(math.isnan(v) for v in values.values())
        or (one and robot.base is not None)
    ):
        whole = "" if robot.base is not None else "one number, or "
        raise ConfigurationError(
            f"--residual-std: give {whole}a name and a number above 0 for each of {', '.join(names)}"
        )
    for value in values.values():
        Range(1e-9, 1e3, "rad or m").check("--residual-std", float(value))
    C = len(robot.coordinates)
    std = np.ones(2 * C)
    std[:C][robot.joints] = [values[name] for name in robot.description.joint_names]
    if robot.base is not None:
        std[:C][robot.rotation], std[C:][robot.rotation] = values["orientation"], values["gyro"]
    return std


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError as err:
        raise ConfigurationError(f"--residual-std: {word!r} is no number [rad or m]") from err
