"""Settings of the benches: a class for each bench, with the options that it has and their defaults.

Options that several benches have come from the small classes at the top. This module loads no bench and no
simulator, so that the command line can explain all benches quickly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, ClassVar, Final, Literal

from deal_hw.calibration import Budget
from deal_hw.errors import ConfigurationError
from deal_hw.ranges import Checked, Range
from deal_hw.scale.tasks import task_map
from deal_hw.scale.where import check_device
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.task_map import TaskMap
from deal_hw.workflows.calibration.settings import Recordings
from deal_hw.workflows.options import OneWord, Ratio, RayPlace, Seeds, Threads


def parse_ratios(text: str) -> tuple[float, ...]:
    """Return the ratios of a text such as ``"3,5,10"``.

    Raises:
        ConfigurationError: It is not such a text.
    """
    try:
        ratios = tuple(float(part) for part in text.split(","))
    except ValueError as err:
        raise ConfigurationError(
            f"--range-ratio {text!r}: give numbers above 1, such as 5 or 3,5,10,20"
        ) from err
    Ratio.check("--range-ratio", ratios)
    return ratios


def parse_names(text: str, option: str) -> tuple[str, ...]:
    """Return the names of a text such as ``"eki,deal"``.

    Raises:
        ConfigurationError: There is none; the message begins with the option.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise ConfigurationError(f"{option} {text!r} has no name; give names, separated by commas")
    return names


Ratios = Annotated[tuple[float, ...], Ratio, OneWord(parse_ratios, "RATIOS")]
Names = tuple[str, ...]
Tasks = Annotated[Names, OneWord(partial(parse_names, option="--task"), "TASKS")]
Methods = Annotated[Names, OneWord(partial(parse_names, option="--methods"), "METHODS")]
Problems = Annotated[Names, OneWord(partial(parse_names, option="--problems"), "PROBLEMS")]
Faults = Annotated[Names, OneWord(partial(parse_names, option="--faults"), "FAULTS")]
Profile = Literal["ideal", "sensor", "realistic"]


@dataclass(frozen=True, kw_only=True)
class Bench(Checked):
    """What every bench takes."""

    name: ClassVar[str]
    """Word of the command line, and `bench` of the rows."""
    work: ClassVar[str]
    """MODULE:FUNCTION that takes these settings. It returns the bench's table, or does all by itself and
    returns the exit code."""
    example: ClassVar[str] = ""
    """Options in the example of its help."""

    out: Path | None = None
    """File of the rows, by default BENCH.json; the CSV and the figure lie beside it."""

    json: bool = False
    """Print one JSON document: the contents of the file of rows. Everything else that is printed goes to the
    error output."""

    quiet: bool = False
    """Print nothing but errors."""

    @property
    def file(self) -> Path:
        """File of the rows."""
        return self.out or Path(f"{self.name}.json")

    def beside(self, name: str) -> Path:
        """Return a folder beside the file of rows, for what the bench keeps."""
        return self.file.parent / f"{self.file.stem}_{name}"


@dataclass(frozen=True, kw_only=True)
class SeededBench(Bench):
    """A bench with rows for each seed."""

    seeds: Seeds = (0, 1)
    """Seeds, comma separated; ranges as 1000-1009. 0-99 are for tuning, 1000 and up for reporting."""

    threads: Threads = None
    """Simulation threads; by default all CPUs."""


@dataclass(frozen=True, kw_only=True)
class SpreadBench(SeededBench):
    """A bench whose cells can run in workers: they share nothing, and none is there to be timed."""

    ray: RayPlace = None
    """Run cells in workers of Ray: local (as many as the processors allow), local:N, the HOST:PORT of a
    cluster of which this machine is a node, or auto for the one that runs here (docs/how-to/cluster.md). The
    rows are the same, but for times. Each cell then takes one processor, or --threads of them."""

    @property
    def cell_threads(self) -> int | None:
        """Simulation threads of a cell; None for all CPUs."""
        return 1 if self.ray is not None and self.threads is None else self.threads

    def tasks(self) -> TaskMap:
        """Return what runs the cells.

        Raises:
            ConfigurationError: --ray names no place.
            MissingExtraError: Ray is not installed.
        """
        return task_map(self.ray, self.cell_threads)


@dataclass(frozen=True, kw_only=True)
class EngineBench(SpreadBench):
    """A bench whose searches another engine can simulate; `auto` would make rows depend on the machine."""

    engine: EngineName = "mujoco"
    """What simulates the populations of deal, eki and deal-paper, as for `deal-hw calibrate`: warp on an
    NVIDIA GPU (docs/how-to/gpu.md). A row names it. Methods without such a search take mujoco."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_device(self.ray, self.engine, "cells")

    def engine_of(self, method: str) -> EngineName | Literal[""]:
        """Return what simulates a method's populations, for its row; "" for mujoco."""
        from deal_hw.calib.pipeline.methods import takes_engine

        return self.engine if self.engine != "mujoco" and takes_engine(method) else ""


@dataclass(frozen=True, kw_only=True)
class SearchingBench(SeededBench):
    """A bench whose methods have one budget."""

    population: Annotated[int, Range(2, 100_000)] = Budget().population
    """Members of a search."""

    generations: Annotated[int, Range(1, 100_000)] = Budget().generations
    """Most generations of a search."""

    @property
    def budget(self) -> Budget:
        """Limits of a search."""
        return Budget(population=self.population, generations=self.generations)


@dataclass(frozen=True, kw_only=True)
class TaskBench(SeededBench):
    """A bench that compares methods on the robots of the paper."""

    task: Tasks = ("cartpole",)
    """Tasks, comma separated: cartpole, ant, humanoid, go2, allegro."""

    population: Annotated[int | None, Range(2, 100_000)] = None
    """Members of a search; by default 100, for methods of the paper 200."""

    generations: Annotated[int, Range(1, 100_000)] = 50
    """Most generations of a search."""


@dataclass(frozen=True, kw_only=True)
class KnownTruth(TaskBench, EngineBench):
    """A bench that calibrates robots whose truth it knows."""

    work: ClassVar[str] = "deal_hw.bench.calibration:table"

    space: str = ""
    """Parameter set of the task; its default where nothing is named."""

    methods: Methods = ("default",)
    """Methods, comma separated, as for `deal-hw calibrate`. `default` is refined, others with
    --refine-all."""

    range_ratio: Ratios = (5.0,)
    """Ratios of the search range, comma separated."""

    refine_all: bool = False
    """Refine every method; by default only `default` is."""

    demonstration: Literal["excite", "policy"] = "excite"
    """What moves the robots: exciting motions, or their shipped policies, which the methods of the paper
    need."""

    demonstration_seconds: Annotated[float, Range(1, 600, "s")] = 4.0
    """Length of the demonstration [s]."""

    checkpoint: tuple[Path, ...] = ()
    """Policies (.onnx) that demonstrate instead of the shipped one, with --demonstration policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.checkpoint and self.demonstration != "policy":
            raise ConfigurationError("--checkpoint names policies; add --demonstration policy")


@dataclass(frozen=True, kw_only=True)
class FixedRange(KnownTruth):
    """Calibrate robots with drawn truths in a fixed range."""

    name: ClassVar[str] = "fixed-range"
    example: ClassVar[str] = "--task cartpole --methods default,eki"

    profile: Profile = "sensor"
    """Profile of the emulated robots."""


@dataclass(frozen=True, kw_only=True)
class Paper(FixedRange):
    """DEAL's protocol: the robot to find is the nominal model."""

    name: ClassVar[str] = "paper"
    example: ClassVar[str] = "--task cartpole --methods deal-paper"


@dataclass(frozen=True, kw_only=True)
class Mismatch(KnownTruth):
    """Calibrate robots with effects that no simulator here models (profile realistic)."""

    name: ClassVar[str] = "mismatch"
    example: ClassVar[str] = "--task cartpole"
    profile: ClassVar[str] = "realistic"


@dataclass(frozen=True, kw_only=True)
class Loop(SpreadBench):
    """Collect, calibrate, train and deploy on emulated cart-poles whose truth only the bench knows."""

    name: ClassVar[str] = "loop"
    work: ClassVar[str] = "deal_hw.bench.loop:table"
    example: ClassVar[str] = "--profile sensor --seeds 0,1"

    profile: Profile = "sensor"
    """Profile of the emulated robots."""

    methods: Methods = ("default", "deal", "eki", "deal-paper-replay", "deal-paper-flat", "midpoint")
    """Methods, comma separated, as for `deal-hw calibrate`; `default` is refined, the others are not."""

    range_ratio: Annotated[float, Ratio] = 5.0
    """Ratio of the search range."""

    train: bool = True
    """Train and deploy policies with the default method."""


@dataclass(frozen=True, kw_only=True)
class Go2Loop(SpreadBench):
    """Record walks of emulated Go2, calibrate, fine-tune the shipped policy, and walk again.

    With --task climb, robots climb platforms of 0.05 to 0.25 m, told and blind; with canter they canter.
    """

    name: ClassVar[str] = "go2-loop"
    work: ClassVar[str] = "deal_hw.bench.go2_loop:table"
    example: ClassVar[str] = "--seeds 0,1"

    task: Literal["walk", "canter", "climb"] = "walk"
    """What the robots do."""

    profile: Profile = "sensor"
    """Profile of the emulated robots."""

    train: bool = True
    """Fine-tune policies and let them walk."""

    steps: Annotated[int, Range(1, 10**9)] = 300_000
    """Steps of each fine-tune."""


@dataclass(frozen=True, kw_only=True)
class Transfer(TaskBench):
    """In drawn targets, fine-tune one policy a task under the estimate of each method, for equal steps.

    Its return in the target is compared, as in DEAL's Figure 4.
    """

    name: ClassVar[str] = "transfer"
    work: ClassVar[str] = "deal_hw.bench.transfer:table"
    example: ClassVar[str] = "--task cartpole"

    methods: Methods = (
        "udr",
        "nominal",
        "easi",
        "bo-critic",
        "deal-paper",
        "deal-paper-literal",
        "default",
        "oracle",
    )
    """Methods, comma separated, as for `deal-hw calibrate`; also udr, nominal and oracle, which read no
    recording. By default those of Figure 4, and ours."""

    demonstration_seconds: Annotated[float, Range(1, 600, "s")] = 4.0
    """Length of the demonstration [s]."""

    checkpoint: tuple[Path, ...] = ()
    """Base policies (.onnx), one a task, as `deal-hw train TASK --udr` writes them, the .safetensors beside
    each. For a task without one, the bench takes a shipped policy with its checkpoint, or it trains one under
    uniform randomisation and keeps it."""

    steps: Annotated[int | None, Range(1, 10**9)] = None
    """Steps of each fine-tune; by default 300 000 for the Go2, 24 000 for the cart-pole, 60 000 for other
    robots."""


@dataclass(frozen=True, kw_only=True)
class Speed(TaskBench):
    """Time a search, beside the engine alone and DEAL's Table 3."""

    name: ClassVar[str] = "speed"
    work: ClassVar[str] = "deal_hw.bench.speed:table"
    example: ClassVar[str] = "--task cartpole,go2"

    space: str = ""
    """Parameter set of the task; its default where nothing is named."""

    profile: Profile = "sensor"
    """Profile of the emulated robots."""

    methods: Methods = ("deal-paper",)
    """Methods, comma separated, as for `deal-hw calibrate`."""

    range_ratio: Annotated[float, Ratio] = 5.0
    """Ratio of the search range."""

    engine: EngineName = "mujoco"
    """What simulates the search's population, as for `deal-hw calibrate`: warp for deal, eki and deal-paper,
    on an NVIDIA GPU (docs/how-to/gpu.md)."""


@dataclass(frozen=True, kw_only=True)
class Real(SearchingBench, EngineBench):
    """Compare methods on recordings of a real robot (--model, --data) by their errors on held-out motion."""

    name: ClassVar[str] = "real"
    work: ClassVar[str] = "deal_hw.bench.real:table"
    example: ClassVar[str] = "--model robot.xml --data rec.csv --holdout other.csv"

    recordings: Recordings = field(default_factory=Recordings)

    dataset: Path | None = None
    """A dataset instead of --model and --data; of a robot of ours, or one that carries its robot."""

    holdout: tuple[Path, ...] = ()
    """Held-out recordings, of a dataset episode numbers; by default the last part of each recording."""

    heldout_window: Annotated[float, Range(1e-3, 600, "s")] = 5.0
    """Held-out predictions restart from the measured state after this time [s]."""

    residual_std: tuple[str, ...] = ()
    """Standard deviation of the prediction error, as for `deal-hw calibrate`; by default the residual of a
    first fit to the fitted recordings."""

    methods: Methods = ("nominal", "output-error", "eki", "mujoco-sysid", "least-squares-multistart")
    """Methods, comma separated, as for `deal-hw calibrate`."""

    range_ratio: Annotated[float, Ratio] = 5.0
    """Ratio of the search range; a file of --parameters has ranges of its own."""

    refine_all: bool = False
    """Refine every method; by default only `default` is."""


@dataclass(frozen=True, kw_only=True)
class Verdict(SearchingBench, SpreadBench):
    """Calibrate robots in plain MuJoCo with and without deliberate faults.

    Tests whether verdicts accept right models and reject wrong ones.
    """

    name: ClassVar[str] = "verdict"
    work: ClassVar[str] = "deal_hw.bench.verdict:table"
    example: ClassVar[str] = "--problems pendulum --faults none,friction"

    problems: Problems = ()
    """Robots, comma separated; by default all: pendulum, double-pendulum, arm, cart-pole, leg."""

    faults: Faults = ()
    """Faults, comma separated; by default none and all of these: friction, load-friction, friction-rise,
    backlash, motor-play, lag, free-speed, servo-dead-zone, motor-dead-zone, motor-asymmetry, encoder-scale,
    blind-encoder, zeros, jitter, mass, sign. encoders: a right model with encoders. Faults of recordings that
    commands and measurements share: mirrored, swapped, fast-clock, slow-clock, degrees, doubled,
    doubled-joint; these calibrations end as soon as they have named the fault. A robot is left out where a
    fault makes no sense for it."""


@dataclass(frozen=True, kw_only=True)
class FirstAnswer(SearchingBench):
    """Time until a fit is nearly as good as the last one, beside mujoco.sysid with a delay."""

    name: ClassVar[str] = "first-answer"
    work: ClassVar[str] = "deal_hw.bench.first_answer:table"
    example: ClassVar[str] = "--problems double-pendulum"

    problems: Problems = ()
    """Robots, comma separated; by default all: double-pendulum, cart-pole, torque-arm, so101,
    go2-suspended."""

    real: Path | None = None
    """Folder with so101/ and go2/: the recordings and the columns.yaml of each. docs/results/example-so101.md
    and docs/results/example-go2-suspended.md make them. Without it these two are skipped."""


@dataclass(frozen=True, kw_only=True)
class Go2Codec(Bench):
    """Time to write and read the Go2's messages."""

    name: ClassVar[str] = "go2-codec"
    work: ClassVar[str] = "deal_hw.bench.go2_codec:bench_codec"


BENCHES: Final[Mapping[str, type[Bench]]] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            Loop,
            Go2Loop,
            Transfer,
            FixedRange,
            Mismatch,
            Paper,
            Real,
            Verdict,
            FirstAnswer,
            Speed,
            Go2Codec,
        )
    }
)
"""Every bench's settings, by its word on the command line."""
