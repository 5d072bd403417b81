"""Settings of a calibration: what all have, and what each kind of recordings has beside.

A dataset of a robot with a driver, a dataset with its own robot.yaml, and a model with files each have a type
with the options that apply to them. :func:`kind_of` chooses one from what was named.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, cast

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
from deal_hw.calibration import LATENCY_RANGE_S, Budget, listed
from deal_hw.data.checks.spikes import DEFAULT_SPIKES, SpikeSettings
from deal_hw.data.files import dataset_of
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import LONGEST_LATENCY_S, ParameterSpace
from deal_hw.ranges import Checked, Range, option
from deal_hw.sim.engine.gpu import WantedEngine
from deal_hw.workflows.calibration.source import Division
from deal_hw.workflows.kinds import InputKind, Kinds, fitting
from deal_hw.workflows.options import File, Ratio, RayPlace, Seed, Threads
from deal_hw.workflows.robot import carries_robot

HELDOUT_PART = 0.25
HELDOUT_WINDOW_S = 0.2
"""The same as in :mod:`deal_hw.calib.validation.metrics`, which is loaded on need."""

Pairs: TypeAlias = tuple[tuple[str, float], ...]
Triples: TypeAlias = tuple[tuple[str, float, float], ...]


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(Checked):
    """Settings that every calibration has."""

    setups: File | None = None
    """Which recordings were made with a payload, other gains or another MJCF (YAML;
    docs/reference/setups.md): all are fitted together. A dataset's own setups.yaml is used by default."""

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
    deal-critic, deal-untrained, deal-no-critic; output-error-no-laws; and searches that compare distributions
    of transitions in closed loop: deal-unaligned, mmd-unaligned, moments-unaligned."""

    search: Literal["deal", "eki", "deal-paper"] | None = None
    """The search of default and output-error, by default deal. deal: a critic tells recording and simulators
    apart, and the population moves to where it cannot. eki: an ensemble Kalman search, without a critic.
    deal-paper: the DEAL paper's Algorithm 1. With --no-refine the search alone."""

    free: str | tuple[str, ...] = ()
    """Search exactly these parameters; all others keep their nominal values."""

    known: Annotated[Mapping[str, float] | Pairs, Range(-1e12, 1e12)] = ()
    """Values that were measured by other means, as NAME VALUE pairs (SI); from Python by name."""

    range: Annotated[Mapping[str, tuple[float, float]] | Triples, Range(-1e12, 1e12)] = ()
    """Other search ranges, as NAME LOW HIGH (SI); from Python low and high by name."""

    range_ratio: Annotated[float | None, Ratio] = None
    """Search each parameter within a factor RANGE-RATIO to either side of its nominal value. By default as
    its parameter set says, mostly 5; with --model 20 for dry friction; with --parameters the ranges of that
    file."""

    latency: Annotated[float | None, Range(0, LONGEST_LATENCY_S, "s")] = None
    """Total latency [s] if it is known; by default it is searched."""

    latency_range: Annotated[tuple[float, float], Range(0, LONGEST_LATENCY_S, "s")] = LATENCY_RANGE_S
    """Range of the latency search, LOW HIGH [s]. The default goes on, up to 0.16 s, where the recordings ask
    for it."""

    spike_ratio: Annotated[float, Range(1, 1e6)] = DEFAULT_SPIKES.ratio
    """Leave out up to three successive samples that jump away and come back, if they jump more than this many
    times as far as the joint's fastest motion would reach. A larger number leaves out fewer samples."""

    residual_std: float | Mapping[str, float] | tuple[str, ...] | None = ()
    """Expected standard deviation of the prediction error [rad, m]: sensor noise and model error. One number,
    or NAME VALUE pairs of joints; by default the sensor noise, estimated from the recordings. For real robots
    a few milliradians are often better."""

    population: Annotated[int | None, Range(2, 100_000)] = None
    """Population size of the search; by default 100, for methods of the paper 200."""

    generations: Annotated[int, Range(1, 100_000)] = 50
    """Most generations of the search."""

    starts: Literal["recorded", "drawn"] | None = None
    """Start states of methods that run the recordings' policy in every simulator. recorded: the first state
    of each recording. drawn: states drawn from the whole recordings, each moved by its uncertainty, with
    rollouts of half a second or so. By default drawn where the first state is not known well."""

    start_std: Annotated[Mapping[str, float] | Pairs, Range(0, 1e3)] = ()
    """Uncertainty (standard deviation) of entries of drawn start states that the recordings do not show, as
    NAME VALUE pairs [rad, m, rad/s, m/s], such as pole.velocity 0.5; by default that of the recordings."""

    checks: Literal["usual", "all"] = "usual"
    """Checks of recordings that the model does not explain: usual ends them where they take more physics
    steps than the fits; all runs them to their end."""

    laws: bool = True
    """Where a law that MuJoCo lacks, such as friction that falls with speed, predicts the robot better, take
    it into the result. Your own simulator needs it then: deal_hw.sim.actuators applies it in a MuJoCo loop.
    --no-laws keeps to what an MJCF can say; the law is still named."""

    refine: bool = True
    """After the search, refine by multiple shooting on the prediction error."""

    seed: Seed = 0
    """Seed of all random numbers."""

    threads: Threads = None
    """Simulation threads; by default all CPUs."""

    engine: WantedEngine = "mujoco"
    """What simulates the population of a search (deal, eki, deal-paper); every fit is by mujoco, in float64.
    mujoco: all CPUs. warp: MuJoCo Warp on an NVIDIA GPU, in float32, for populations of hundreds and more
    (extra gpu). auto: warp where there is a GPU, the model can run there and the population is large enough,
    else mujoco. warp-cpu: MuJoCo Warp without a GPU, far slower than mujoco, to try it
    (docs/how-to/gpu.md)."""

    ray: RayPlace = None
    """Do fits that do not depend on each other in workers of Ray: drawn starts, folds of a cross-validation.
    local (as many as there are processors), local:N, the HOST:PORT of a cluster of which this machine is a
    node, or auto for the one that runs here (docs/how-to/cluster.md). Results are the same."""

    def __post_init__(self) -> None:
        self._keep(free=_words(self.free), known=_pairs(self.known), range=_triples(self.range))
        self._keep(start_std=_pairs(self.start_std))
        for name in ("known", "range", "start_std"):
            named = [row[0] for row in getattr(self, name)]
            if twice := [one for one in dict.fromkeys(named) if named.count(one) > 1]:
                raise ConfigurationError(f"{option(name)} names {listed(twice)} twice; give one of them")
        super().__post_init__()
        low, high = self.latency_range
        if not low < high:
            raise ConfigurationError(f"--latency-range {low:g} {high:g}: give the lower one first")

    def _keep(self, **values: Any) -> None:
        """Set fields to what was given in another form."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def check(self) -> None:
        """Check the combination of settings before anything is read.

        Raises:
            ConfigurationError: A setting would have no effect.
            UnknownNameError: There is no such method.
        """
        if self.latency is not None and self.latency_range != LATENCY_RANGE_S:
            raise ConfigurationError("--latency-range would have no effect: --latency gives the latency")
        if self.method in SEARCHES:
            raise ConfigurationError(
                f"--method {self.method}: that is a search; --search {self.method} runs it where the local "
                f"fit does not explain the recordings, --search {self.method} --no-refine runs it alone"
            )
        check_method(self.named())
        for flag, there in (("--starts", self.starts is not None), ("--start-std", bool(self.start_std))):
            if there and not self.in_closed_loop:
                raise ConfigurationError(
                    f"{flag} would have no effect: {search_of(self.named())} runs no policy"
                )
        if self.starts == "recorded" and self.start_std:
            raise ConfigurationError("--start-std would have no effect: --starts recorded moves no state")
        if self.search is not None and self.method and self.method not in SEARCHING:
            raise ConfigurationError(
                f"--search would have no effect: --method {self.method} has no search inside"
            )

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
        for parameter, low, high in cast(Triples, self.range):
            space = space.with_range(parameter, low, high)
        # An unknown payload of a set-up is one more parameter.
        if not len(space) and self.setups is None:
            raise ConfigurationError(
                "every parameter is known, so there is nothing to search; remove one from --known"
            )
        return space


@dataclass(frozen=True, kw_only=True)
class DatasetSettings(CalibrateSettings):
    """Settings of a calibration from a dataset."""

    dataset: File
    """Dataset folder, such as runs/first/dataset."""

    episodes: Annotated[tuple[int, ...], Range(0, 1_000_000)] = ()
    """Numbers of the episodes of the dataset to fit (the first is 0); by default all but the held-out ones,
    and those whose run tripped or failed (`deal-hw data info` shows them, `deal-hw data keep` uses them)."""

    holdout: Annotated[tuple[int, ...], Range(0, 1_000_000)] = ()
    """Held-out episodes, which only test the result, by number (the first is 0). By default those collected
    with --motion chirp whose run did not trip or fail."""

    sample_hz: Annotated[float | None, Range(1, 1e5, "Hz")] = None
    """Rate of the fitted and held-out states of a dataset, approximately [Hz]; by default four per control
    period."""

    def __post_init__(self) -> None:
        judges: tuple[Any, ...] = _listed(self.holdout)
        self._keep(dataset=dataset_of(self.dataset), episodes=_listed(self.episodes), holdout=judges)
        wrong = [str(one) for one in judges if not isinstance(one, int)]
        if wrong:
            raise ConfigurationError(
                f"--holdout {' '.join(wrong)}: with a dataset give episode numbers; files go with --model"
            )
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class DriverDatasetSettings(DatasetSettings):
    """Settings of a calibration from a dataset of a robot with a driver."""

    space: str = ""
    """Named parameter set of the robot, such as k9 or k11; by default the first.
    docs/reference/parameters.md lists them."""

    parameters: File | None = None
    """What to search beside the robot's set (YAML), such as an encoder's zero."""

    policy: File | None = None
    """The policy (.onnx) that moved the robot, for deal-paper and other methods that run it in every
    simulator; by default the copy in the dataset."""

    def check(self) -> None:
        """Check the combination of settings; errors as :meth:`CalibrateSettings.check`."""
        super().check()
        if self.policy is not None and not self.in_closed_loop:
            raise ConfigurationError(
                f"--policy would have no effect: {search_of(self.named())} runs no policy"
            )


@dataclass(frozen=True, kw_only=True)
class Divided(Checked):
    """What to search of a user's robot, and which parts of its recordings to use."""

    parameters: File | None = None
    """What to search (YAML; --write-parameters writes an example). By default friction, damping, armature and
    zero of every joint, gains of every actuator, and every mass."""

    holdout_part: Annotated[float | None, Range(0, 0.95)] = None
    """Share of each recording, its last part, that is held out to test the result, without --holdout; 0.25 by
    default, 0 for none."""

    fit_seconds: Annotated[float, Range(0.1, 1e5, "s")] = 60.0
    """Fit this many seconds, in parts that lie evenly over the recordings; more is slower."""

    window: Annotated[float, Range(1e-3, 60, "s")] = 0.4
    """Length of the longest prediction windows of the search [s]; the search begins with a quarter of it.
    Longer windows show slow effects (weight, static friction); their memory grows with the square of their
    samples."""

    physics_step: Annotated[float | None, Range(1e-6, 0.1, "s")] = None
    """Requested physics step [s]; by default the MJCF's timestep. It is adjusted to a whole number of steps
    per sampling period."""

    def division(self, *, judged: bool) -> Division:
        """Return how recordings become parts to fit and parts that judge.

        Args:
            judged: Whether recordings were named that only judge.

        Raises:
            ConfigurationError: A share of each recording is to be held out as well.
        """
        if judged and self.holdout_part:
            raise ConfigurationError("give --holdout or --holdout-part, not both")
        share = HELDOUT_PART if self.holdout_part is None else self.holdout_part
        return Division(share=0.0 if judged else share, fit_seconds=self.fit_seconds, window_s=self.window)


@dataclass(frozen=True, kw_only=True)
class Recordings(Divided):
    """Any robot: its MuJoCo model and its recordings (docs/tutorials/your-robot.md)."""

    model: Path | None = None
    """The robot's MJCF. Its position actuators (or motors) take the recorded commands."""

    data: tuple[Path, ...] = ()
    """Recordings to fit: files that `data import` reads, or LeRobot folders."""

    columns: File | None = None
    """Column map (YAML; docs/how-to/import.md). Without one, the meaning of the
    channels is guessed from their names."""

    feet: tuple[str, ...] = ()
    """Sphere geoms of the feet of a floating robot. The standing feet give the base's height and velocity;
    recordings must contain the base's orientation and gyro. Not with base_position in the column map."""

    leave_out: Annotated[tuple[tuple[str, float, float], ...], Range(0, 1e6, "s")] = ()
    """Parts of recordings that the model cannot explain, such as contacts: FILE FROM TO [s from start]."""

    force: bool = False
    """Use recordings although a check of them failed."""


@dataclass(frozen=True, kw_only=True)
class UserRobotSettings(Divided, CalibrateSettings):
    """Settings of a calibration of a user's robot."""

    def refuse_unknown_policy(self) -> None:
        """Refuse a method that runs the policy that moved the robot, where nobody knows that policy.

        Raises:
            ConfigurationError: The method does.
        """
        if self.in_closed_loop:
            raise ConfigurationError(
                f"{search_of(self.named())} runs the policy that moved the robot, which is unknown for "
                "--model without --policy FILE.onnx, and for a dataset with its own robot.yaml that was "
                "imported without it; name it, or use eki, deal or deal-paper-replay"
            )


@dataclass(frozen=True, kw_only=True)
class OwnDatasetSettings(UserRobotSettings, DatasetSettings):
    """Settings of a calibration from a dataset with its own robot.yaml."""

    policy: File | None = None
    """The policy (.onnx) that moved the robot: it checks the clock of recorded commands. Methods that run it
    in every simulator need it, such as deal-unaligned; by default the one of `data import --policy`."""


@dataclass(frozen=True, kw_only=True)
class FilesSettings(UserRobotSettings, Recordings):
    """Settings of a calibration of any robot, from its MuJoCo model and recordings."""

    model: Any = field(kw_only=False)
    """The robot's MJCF. Its position actuators (or motors) take the recorded commands. From Python also a
    ``mujoco.MjSpec``, or the last compiled ``mujoco.MjModel``."""

    data: Any = field(default=(), kw_only=False)
    """Recordings to fit: files that `data import` reads, or LeRobot folders. From Python one or several, also
    mappings of names to arrays and data frames: positions [rad or m] (T, J), commands (T, A), time [s]
    (T,)."""

    holdout: Any = ()
    """Held-out recordings, which only test the result; by default the last part of each recording
    (--holdout-part)."""

    policy: File | None = None
    """The policy (.onnx) that moved the robot: it gives the commands of recordings without any, and checks
    the clock of recorded ones. Methods that run it in every simulator need it, such as deal-unaligned."""

    def check(self) -> None:
        """Check the combination of settings; errors as :meth:`CalibrateSettings.check`."""
        super().check()
        if self.policy is None:
            self.refuse_unknown_policy()

    def __post_init__(self) -> None:
        self._keep(data=_listed(self.data), holdout=_listed(self.holdout), feet=_words(self.feet))
        self._keep(leave_out=_triples(self.leave_out))
        numbers = [str(one) for one in self.holdout if str(one).isdigit()]
        if numbers:
            raise ConfigurationError(
                f"--holdout {' '.join(numbers)}: with --model give recordings; episode numbers go with a "
                "dataset"
            )
        super().__post_init__()


RECORDINGS: Mapping[str, InputKind] = {
    "dataset": InputKind(
        DriverDatasetSettings, "a dataset of a robot with a driver", example="runs/first/dataset"
    ),
    "own-robot": InputKind(
        OwnDatasetSettings, "a dataset with its own robot.yaml", example="runs/mine/dataset --holdout 1"
    ),
    "model": InputKind(
        FilesSettings,
        "any robot: its MuJoCo model and its recordings",
        usage="--model robot.xml",
        example="--model robot.xml --data rec.csv --out runs/mine",
    ),
}
"""The kinds of recordings."""


def kind_of(dataset: Any, model: Any, options: Collection[str], table: Mapping[str, InputKind]) -> str:
    """Return the kind of the recordings that were named.

    Args:
        dataset: The named dataset, or the name of a kind.
        model: The given model.
        options: The names of all given options.
        table: The kinds.

    Raises:
        ConfigurationError: There is none, or there are two; or a model is named as a dataset.
    """
    if model is None and dataset is not None and Path(dataset).suffix == ".xml":
        recordings = "" if "data" in options else " --data rec.csv"
        raise ConfigurationError(
            f"{dataset} is a model, not a dataset; name it by --model {dataset}{recordings}"
        )
    if model is None and dataset is None and "data" in options:
        raise ConfigurationError("--data needs the robot's model: add --model robot.xml")
    if (dataset is None) == (model is None):
        how = "one of the two" if model is None else "not both"
        raise ConfigurationError(
            "name a dataset (deal-hw calibrate runs/first/dataset), or a model and its recordings "
            f"(deal-hw calibrate --model robot.xml --data rec.csv), {how}"
        )
    if model is not None:
        return "model"
    if str(dataset) in table and not Path(dataset).exists():
        return str(dataset)
    if doubt_of(dataset):
        # The reader will say that it is not there; until then the options of either kind fit.
        return fitting({name: table[name] for name in ("dataset", "own-robot")}, options) or "dataset"
    return "own-robot" if carries_robot(dataset_of(dataset)) else "dataset"


def doubt_of(dataset: Any) -> str:
    """Return why the kind of a named dataset is not known; empty if it is, or none is named."""
    if dataset is None or str(dataset) in RECORDINGS or Path(dataset).exists():
        return ""
    return f"{dataset} does not exist"


def python_kinds() -> Kinds:
    """Return the kinds as Python names them: model and data, or a dataset."""
    return Kinds(
        noun="recordings",
        table=lambda: RECORDINGS,
        find=lambda given: kind_of(
            given.options.get("dataset"),
            given.options.get("model") if given.first is None else given.first,
            given.options,
            RECORDINGS,
        ),
        doubt=lambda given: doubt_of(given.options.get("dataset")),
    )


_SHAPES = (
    'write known={"cart.mass": 0.41}, range={"cart.mass": (0.1, 1.0)} and '
    'leave_out=[("rec.csv", 1.5, 2.0)] like this; one of them is different'
)


def _pairs(given: Any) -> Pairs:
    try:
        items = given.items() if isinstance(given, Mapping) else given
        return tuple((str(name), float(value)) for name, value in items)
    except (AttributeError, TypeError, ValueError) as err:
        raise ConfigurationError(f"{_SHAPES} ({err})") from err


def _triples(given: Any) -> Triples:
    try:
        rows = [(name, *both) for name, both in given.items()] if isinstance(given, Mapping) else given
        return tuple((str(name), float(low), float(high)) for name, low, high in rows)
    except (AttributeError, TypeError, ValueError) as err:
        raise ConfigurationError(f"{_SHAPES} ({err})") from err


def _words(given: str | tuple[str, ...]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)


def _listed(given: Any) -> tuple[Any, ...]:
    """Return one recording or episode, or several, as a tuple."""
    alone = isinstance(given, str | Path | int | Mapping) or hasattr(given, "columns")
    return (given,) if alone else tuple(given)
