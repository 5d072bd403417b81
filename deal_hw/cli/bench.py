"""``deal-hw bench``: measures calibration and the whole loop, as JSON rows, a CSV and a figure."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from deal_hw.calibration import Budget
from deal_hw.cli.json_output import only_document
from deal_hw.cli.piped import PipedProgress
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.ranges import Range, check_ranges
from deal_hw.workflows.calibration.settings import Recordings
from deal_hw.workflows.options import Only, Ratio, Threads, refuse_others

if TYPE_CHECKING:
    from deal_hw.bench.rows import Cells, Row

MOST_SEEDS = 10_000
ROBOTS = Only(("fixed-range", "mismatch", "paper"))
DEMONSTRATED = Only((*ROBOTS.names, "transfer"))
PARAMETER_SETS = Only((*ROBOTS.names, "speed"))
TASKS = Only((*PARAMETER_SETS.names, "transfer"))
RATIOS = Only((*PARAMETER_SETS.names, "loop", "real"))
METHODS = Only((*RATIOS.names, "transfer"))
SEARCHES = Only((*TASKS.names, "real", "verdict", "first-answer"))
ROWS = Only((*SEARCHES.names, "loop", "go2-loop"))
REAL = Only(("real",))
Seeds = Range(0, 2**32 - 1 - MOST_SEEDS)


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure how well calibration and the whole loop work; a stopped bench continues where it stopped."""

    bench: tyro.conf.Positional[
        Literal[
            "loop",
            "go2-loop",
            "transfer",
            "fixed-range",
            "mismatch",
            "paper",
            "real",
            "verdict",
            "first-answer",
            "speed",
            "go2-codec",
        ]
    ]
    """loop: collect, calibrate, train and deploy on emulated cart-poles whose truth only the bench knows.
    go2-loop: the same with emulated Go2 that walk; the shipped policy is fine-tuned. transfer: in drawn
    targets, one policy a task is fine-tuned under the estimate of each method, for equal steps; its return in
    the target is compared, as in DEAL's Figure 4. fixed-range: calibrate
    drawn truths in a fixed range. mismatch: the same on robots with effects that no simulator here
    models. paper: DEAL's protocol, whose target is the nominal model. real: recordings of a real
    robot (--model, --data), compared by errors on held-out motion. verdict: robots in plain MuJoCo with and
    without deliberate faults, to test whether verdicts accept right models and reject wrong ones.
    first-answer: time until a fit is nearly as good as the last one, beside mujoco.sysid with a delay. speed:
    time of a search, beside that of the engine alone and DEAL's Table 3. go2-codec: time to write and read
    the Go2's messages.
    """

    recordings: Annotated[tyro.conf.OmitArgPrefixes[Recordings], REAL] = field(default_factory=Recordings)

    dataset: Annotated[Path | None, REAL] = None
    """A dataset instead of --model and --data; of a robot of ours, or one that carries its robot."""

    holdout: Annotated[tuple[Path, ...], REAL] = ()
    """Held-out recordings, of a dataset episode numbers; by default the last part of each recording."""

    heldout_window: Annotated[float, Range(1e-3, 600, "s"), REAL] = 5.0
    """Held-out predictions restart from the measured state after this time [s]."""

    residual_std: Annotated[tuple[str, ...], REAL] = ()
    """Standard deviation of the prediction error, as for `deal-hw calibrate`; by default the residual of a
    first fit to the fitted recordings."""

    real: Annotated[Path | None, Only(("first-answer",))] = None
    """Folder with so101/ and go2/: the recordings and the columns.yaml of each. docs/results/example-so101.md
    and docs/results/example-go2-suspended.md make them. Without it these two are skipped."""

    problems: Annotated[str, Only(("first-answer", "verdict"))] = ""
    """Robots, comma separated; by default all. first-answer: double-pendulum,
    cart-pole, torque-arm, so101, go2-suspended; verdict: pendulum, double-pendulum, arm, cart-pole, leg."""

    faults: Annotated[str, Only(("verdict",))] = ""
    """Faults, comma separated; by default none, friction, backlash, jitter, mass, sign. Faults of recordings
    that commands and measurements share: mirrored, swapped, fast-clock, slow-clock, degrees, doubled,
    doubled-joint; these calibrations end as soon as they have named the fault."""

    task: Annotated[str, TASKS] = "cartpole"
    """Tasks, comma separated: cartpole, ant, humanoid, go2, allegro."""

    space: Annotated[str, PARAMETER_SETS] = ""
    """Parameter set of the task; its default where nothing is named."""

    profile: Annotated[
        Literal["ideal", "sensor", "realistic"], Only(("loop", "go2-loop", "fixed-range", "paper", "speed"))
    ] = "sensor"
    """Profile of the emulated robots."""

    seeds: Annotated[str, ROWS] = "0,1"
    """Seeds, comma separated; ranges as 1000-1009. 0-99 are for tuning, 1000 and up for reporting."""

    methods: Annotated[str, METHODS] = ""
    """Methods, comma separated, as for `deal-hw calibrate`; by default the default with training, and
    each search without refinement. transfer also takes udr, nominal and oracle, which read no recording; by
    default udr, nominal, easi, bo-critic, deal-paper, deal-paper-literal, default, oracle."""

    range_ratio: Annotated[str, RATIOS] = "5"
    """Ratios of the search range, comma separated; for loop, speed and real one."""

    refine_all: Annotated[bool, Only(("fixed-range", "mismatch", "paper", "real"))] = False
    """Refine every method; by default only `default` is."""

    demonstration: Annotated[Literal["excite", "policy"], ROBOTS] = "excite"
    """What moves the robots: exciting motions, or their shipped policies, which the methods of the paper
    need."""

    demonstration_seconds: Annotated[float, Range(1, 600, "s"), DEMONSTRATED] = 4.0
    """Length of the demonstration [s]."""

    checkpoint: Annotated[tuple[Path, ...], DEMONSTRATED] = ()
    """Policies (.onnx) that demonstrate instead of the shipped one, with --demonstration policy. transfer:
    the base policies, one a task, as `deal-hw train TASK --udr` writes them, the .safetensors beside each.
    For a task without one, the bench takes a shipped policy with its checkpoint, or it trains one under
    uniform randomisation and keeps it."""

    population: Annotated[int | None, Range(2, 100_000), SEARCHES] = None
    """Members of a search; by default 100, for methods of the paper 200."""

    generations: Annotated[int, Range(1, 100_000), SEARCHES] = 50
    """Most generations of a search."""

    train: Annotated[bool, Only(("loop", "go2-loop"))] = True
    """Train and deploy policies with the default method."""

    steps: Annotated[int | None, Range(1, 10**9), Only(("go2-loop", "transfer"))] = None
    """Steps of each fine-tune; by default 300 000 for the Go2, 24 000 for the cart-pole, 60 000 for other
    robots."""

    out: Path | None = None
    """File of the rows, by default BENCH.json; the CSV and the figure lie beside it."""

    threads: Annotated[Threads, ROWS] = None
    """Simulation threads; by default all CPUs."""

    json: bool = False
    """Print one JSON document: the contents of the file of rows. Everything else that is printed goes to the
    error output."""

    quiet: bool = False
    """Print nothing but errors."""

    def __post_init__(self) -> None:
        check_ranges(self)
        parse_seeds(self.seeds)
        parse_ratios(self.range_ratio)
        refuse_others(self, "bench", self.bench)
        if self.checkpoint and self.demonstration != "policy" and self.bench != "transfer":
            raise ConfigurationError("--checkpoint names policies; add --demonstration policy")
        if self.bench in ("loop", "speed", "real") and "," in self.range_ratio:
            raise ConfigurationError(
                f"--range-ratio {self.range_ratio}: `bench {self.bench}` takes one ratio"
            )


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text such as ``"0,3,1000-1009"``.

    Raises:
        ConfigurationError: It is not such a text.
    """
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, dash, last = part.strip().partition("-")
            ends = int(first), int(last if dash else first)
            Seeds.check("--seeds", ends)
            Range(ends[0], ends[0] + MOST_SEEDS).check("--seeds", ends[1])
            seeds += range(ends[0], ends[1] + 1)
    except ConfigurationError:
        raise
    except ValueError as err:
        raise ConfigurationError(
            f"--seeds {text!r}: give numbers and ranges, such as 0,1 or 1000-1009"
        ) from err
    if not seeds:
        raise ConfigurationError(f"--seeds {text!r} names no seed")
    return tuple(seeds)


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


def bench(config: Bench) -> int:
    """Run the cells that are not done yet, writing the files after each; return 1 if any cell failed."""
    out = config.out or Path(f"{config.bench}.json")
    with only_document(config.json) as write:
        code = _run(config, out)
        if config.json:
            write(json.loads(out.read_text(encoding="utf-8")))
    return code


def _run(config: Bench, out: Path) -> int:
    try:
        if config.bench == "go2-codec":
            from deal_hw.bench.go2_codec import bench_codec

            return bench_codec(out if config.json else config.out, quiet=config.quiet)
        from deal_hw.bench.rows import run_cells

        table = _TABLES.get(config.bench, _calibration)(config, out)
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "bench") from err

    def after(place: str, row: Row, rows: list[Row]) -> None:
        table.draw(out, rows)
        piped.at(f"{place} rows done")
        if not config.quiet:
            print(f"{place} {table.line(row)}", flush=True)

    with PipedProgress(f"bench {config.bench}", config.quiet or sys.stderr.isatty()) as piped:
        rows = run_cells(table.cells, out, after)
    if not config.quiet:
        table.summary([row for row in rows if not row["error"]])
        files = (out, out.with_suffix(".csv"), out.with_suffix(".png"))
        print("written: " + ", ".join(str(path) for path in files if path.exists()))
    return 1 if any(row["error"] for row in rows) else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Table:
    """A bench: what it runs and how it is shown.

    Attributes:
        cells: What it runs.
        line: Returns a row as one line of text.
        summary: Prints a summary of the rows without errors.
        draw: Draws all rows beside the file of rows.
    """

    cells: Cells
    line: Callable[[Row], str]
    summary: Callable[[Sequence[Row]], None]
    draw: Callable[[Path, Sequence[Row]], None] = lambda out, rows: None


def _in_words(bench: Any, cells: Cells) -> _Table:
    """Return a bench whose module has the line and the summary, and no figure."""
    return _Table(cells=cells, line=bench.line, summary=lambda rows: print("\n".join(bench.summary(rows))))


def _methods(config: Bench, default: Sequence[str]) -> tuple[str, ...]:
    return _names(config.methods) or tuple(default)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _first_answer(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import first_answer

    cells = first_answer.cells(
        _names(config.problems) or tuple(first_answer.PROBLEMS),
        parse_seeds(config.seeds),
        real=config.real,
        budget=_budget(config),
        threads=config.threads,
    )
    return _in_words(first_answer, cells)


def _budget(config: Bench) -> Budget:
    return Budget(population=config.population or Budget().population, generations=config.generations)


def _draw(out: Path, rows: Sequence[Row]) -> None:
    from deal_hw.bench.figures import draw

    if good := [row for row in rows if not row["error"]]:
        draw(out.with_suffix(".png"), good)


def _loop(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import loop, tables

    (range_ratio,) = parse_ratios(config.range_ratio)
    cells = loop.cells(
        config.profile,
        _methods(config, ("default", *loop.SEARCHES)),
        range_ratio,
        parse_seeds(config.seeds),
        train=config.train,
        folder=out.parent / f"{out.stem}_policies",
        threads=config.threads,
    )
    return _Table(cells=cells, line=tables.line, summary=tables.print_summary, draw=_draw)


def _speed(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import speed

    (range_ratio,) = parse_ratios(config.range_ratio)
    cells = speed.cells(
        _names(config.task),
        _methods(config, speed.METHODS),
        parse_seeds(config.seeds),
        profile=config.profile,
        range_ratio=range_ratio,
        population=config.population,
        generations=config.generations,
        space=config.space,
        threads=config.threads,
    )
    return _in_words(speed, cells)


def _go2_loop(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import go2_loop

    cells = go2_loop.cells(
        config.profile,
        parse_seeds(config.seeds),
        config.steps or go2_loop.STEPS,
        train=config.train,
        folder=out.parent / f"{out.stem}_runs",
        threads=config.threads,
    )
    return _in_words(go2_loop, cells)


def _transfer(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import transfer
    from deal_hw.bench.transfer_figure import draw_transfer

    def say(text: str) -> None:
        if not config.quiet:
            print(text, flush=True)

    def draw(out: Path, rows: Sequence[Row]) -> None:
        if good := [row for row in rows if not row["error"]]:
            draw_transfer(out.with_suffix(".png"), good)

    cells = transfer.cells(
        _names(config.task),
        _methods(config, transfer.METHODS),
        parse_seeds(config.seeds),
        steps=config.steps,
        checkpoints=config.checkpoint,
        folder=out.parent / f"{out.stem}_policies",
        seconds=config.demonstration_seconds,
        population=config.population,
        generations=config.generations,
        threads=config.threads,
        say=say,
    )
    return _Table(cells=cells, line=transfer.line, summary=transfer.print_summary, draw=draw)


def _calibration(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import calibration, tables

    protocol: Any = config.bench
    chosen = calibration.make_cells(
        protocol,
        [task.strip() for task in config.task.split(",")],
        "realistic" if protocol == "mismatch" else config.profile,
        _methods(config, ("default",)),
        parse_ratios(config.range_ratio),
        parse_seeds(config.seeds),
        space=config.space,
        refine_all=config.refine_all,
        demonstration=config.demonstration,
        demonstration_s=config.demonstration_seconds,
        checkpoints=config.checkpoint or (None,),
    )
    cells = calibration.cells(
        chosen, population=config.population, generations=config.generations, threads=config.threads
    )
    return _Table(cells=cells, line=tables.line, summary=tables.print_summary, draw=_draw)


def _real(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import real, tables
    from deal_hw.workflows.calibration.settings import CalibrateSettings

    (range_ratio,) = parse_ratios(config.range_ratio)
    source = CalibrateSettings(
        dataset=config.dataset,
        recordings=config.recordings,
        holdout=tuple(int(str(one)) if str(one).isdigit() else one for one in config.holdout),
        heldout_window=config.heldout_window,
        residual_std=config.residual_std,
        threads=config.threads,
    )
    cells = real.cells(
        source,
        methods=_methods(config, real.METHODS),
        seeds=parse_seeds(config.seeds),
        range_ratio=range_ratio,
        refine_all=config.refine_all,
        budget=_budget(config),
        quiet=config.quiet,
    )
    return _Table(cells=cells, line=tables.line, summary=tables.print_real, draw=_draw)


def _verdict(config: Bench, out: Path) -> _Table:
    from deal_hw.bench import verdict

    cells = verdict.table(
        verdict.cells(parse_seeds(config.seeds), _names(config.problems), _names(config.faults)),
        budget=_budget(config),
        threads=config.threads,
    )
    return _in_words(verdict, cells)


_TABLES: dict[str, Callable[[Bench, Path], _Table]] = {
    "loop": _loop,
    "go2-loop": _go2_loop,
    "transfer": _transfer,
    "speed": _speed,
    "real": _real,
    "verdict": _verdict,
    "first-answer": _first_answer,
}
"""Benches by name; the others calibrate robots whose truth is known."""
