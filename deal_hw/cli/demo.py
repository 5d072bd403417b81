"""``deal-hw demo``: all five jobs on an emulated robot with hidden physics.

The part of each robot is in :mod:`deal_hw.cli.demo_cartpole`, :mod:`deal_hw.cli.demo_go2` and
:mod:`deal_hw.cli.demo_so101`. This module has stages, summary and tables.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, cast

import numpy as np
from rich.markup import escape

from deal_hw.calibration import CalibrationResult, percent
from deal_hw.data.run_folder import RunFolder
from deal_hw.errors import ConfigurationError, DealHwError, MissingExtraError
from deal_hw.ranges import Checked, Range
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.run import CalibrateReport
from deal_hw.workflows.kinds import InputKind, Kinds
from deal_hw.workflows.options import Seed, given, refuse
from deal_hw.workflows.running.report import RunReport

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

PLATFORM_M = 0.1
"""Height of the platform that a Go2 climbs in the demo [m]."""
END_WIDTH = 110
"""Width of the demo's final output [columns]."""


@dataclass(frozen=True, kw_only=True)
class Demo(Checked):
    """Record, calibrate, retrain, deploy and compare on an emulated robot."""

    robot: str = field(default="cartpole", kw_only=False)
    """cartpole balances its pole, go2 walks, so101 reaches poses."""

    out: Path | None = None
    """Run folder, by default runs/demo (others: runs/demo_go2, demo_canter, demo_climb, demo_so101). A former
    demo in it is deleted."""

    profile: Literal["ideal", "sensor", "realistic"] = "realistic"
    """Sensor effects of the emulated robot, as for `deal-hw emulate`."""

    seed: Seed = 0
    """Seed of the hidden truth, the motion, the search and the training."""

    episodes: Annotated[int | None, Range(1, 1000)] = None
    """Deployments of each policy. Cart-pole: 3 of 10 s. Go2: 1 walk of 17 s, or 3 climbs of 6 s. SO-101: 1 of
    16 s."""

    steps: Annotated[int | None, Range(1, 10**9)] = None
    """Training steps. Cart-pole: by default as many as for the shipped UDR policy. Go2: 300,000, starting
    from the shipped policy. SO-101: 600,000."""

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.out or Path("runs") / ("demo" if self.robot == "cartpole" else f"demo_{self.robot}")


@dataclass(frozen=True, kw_only=True)
class DemoCartpole(Demo):
    """Record, calibrate, retrain, deploy and compare on an emulated cart-pole, which balances its pole."""

    transport: Literal["serial", "can", "odrive", "dynamixel"] = "serial"
    """The wire."""

    firmware: Literal["auto", "host", "python", "avr"] = "auto"
    """How the firmware of the cart-pole runs, as for `deal-hw emulate cartpole`."""


@dataclass(frozen=True, kw_only=True)
class DemoGo2(Demo):
    """Record, calibrate, retrain, deploy and compare on an emulated Go2, which walks, canters or climbs."""

    transport: Literal["dds", "zenoh"] = "dds"
    """The wire."""

    task: Literal["walk", "canter", "climb"] = "walk"
    """What it does: walk, canter, or climb a platform."""

    platform: Annotated[float, Range(0.02, 0.3, "m")] = PLATFORM_M
    """Height of the platform that it climbs [m]."""

    on_stand: bool = False
    """Calibrate from a recording with the body on a stand instead of from the walk."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.task != "climb":
            refuse(given(self, type(self), ["platform"]), "only --task climb has a platform")

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.out or Path("runs") / f"demo_{self.robot if self.task == 'walk' else self.task}"


@dataclass(frozen=True, kw_only=True)
class DemoSo101(Demo):
    """Record, calibrate, retrain, deploy and compare on an emulated SO-101, which reaches poses."""


_TABLE = {
    "cartpole": InputKind(DemoCartpole, example="cartpole --out runs/demo"),
    "go2": InputKind(DemoGo2, example="go2 --out runs/demo_go2"),
    "so101": InputKind(DemoSo101, example="so101 --out runs/demo_so101"),
}
KINDS = Kinds(
    noun="robot",
    argument="robot",
    table=lambda: _TABLE,
    find=lambda arguments: "cartpole" if arguments.first is None else str(arguments.first),
)


@dataclass(frozen=True, kw_only=True)
class DemoReport:
    """Result of the demo.

    Attributes:
        summary: Contents of ``summary.json``.
        folder: The run folder.
    """

    summary: dict[str, Any]
    folder: Path


@dataclass(frozen=True, kw_only=True, eq=False)
class Measure:
    """A measure of each policy's deployments.

    Attributes:
        name: Key in the summary; ends with the unit.
        unit: As it stands in names.
        values: By policy: one value per deployment, (E,).
    """

    name: str
    values: Mapping[str, FloatArray]
    unit: str = ""

    @property
    def std_name(self) -> str:
        """Key of its standard deviation."""
        quantity = self.name.removesuffix(self.unit)
        return f"{quantity}std_{self.unit}" if self.unit else f"{quantity}_std"


@dataclass(frozen=True, kw_only=True)
class Demonstrated:
    """Result of a robot's part of the demo.

    Attributes:
        found: The calibration.
        truth: True values of its parameters, by name.
        latency_s: The true latency [s].
        measures: Measures that compare the policies.
        sentence: The outcome of the loop, from measurements alone.
        episode: The recording to look at.
        run: The last deployment of the retrained policy.
        paths: Files to look at.
        beside: Estimates of another calibration, by parameter; its name is ``beside_name``.
        beside_name: See there.
    """

    found: CalibrateReport
    truth: Mapping[str, float]
    latency_s: float
    measures: Sequence[Measure]
    sentence: str
    episode: Path
    run: RunReport
    paths: Mapping[str, str]
    beside: CalibrationResult | None = None
    beside_name: str = ""


@dataclass
class Stages:
    """Prints the start of each stage and keeps its wall-clock and CPU time, children included."""

    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str, words: str) -> Iterator[None]:
        """Run a stage."""
        print(f"\n== {name}: {words}", flush=True)
        start, cpu = time.perf_counter(), _cpu_seconds()
        try:
            yield
        finally:
            self.seconds[name] = round(time.perf_counter() - start, 2)
            self.cpu_seconds[name] = round(_cpu_seconds() - cpu, 2)


class Part(Protocol):
    """A robot's part."""

    def check(self, config: Demo) -> None:
        """Check settings and installation, so that no later stage fails by them.

        Raises:
            ConfigurationError: A setting or a package is missing or unusable.
        """
        ...

    def run(self, config: Demo, folder: RunFolder, stages: Stages) -> Demonstrated:
        """Do all five jobs."""
        ...


def demo(config: Demo) -> DemoReport:
    """Run the whole loop and print the outcome.

    Raises:
        DealHwError: A stage failed; the robot is passive, and the recordings are complete.
    """
    try:
        # A missing package is reported now, not after minutes.
        importlib.import_module("deal_hw.cli.inspect_")
        importlib.import_module("deal_hw.policies.trainers")
        part = cast("Part", importlib.import_module(f"deal_hw.cli.demo_{config.robot}"))
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "all") from err
    part.check(config)
    clear(config.folder)
    folder, stages = RunFolder(config.folder), Stages()
    with folder:
        settings = ("robot", "transport", "profile", "episodes", "steps", "on_stand", "task", "platform")
        folder.start(
            {"kind": "demo", **{name: getattr(config, name, False) for name in settings}},
            {"demo": config.seed},
        )
        done = part.run(config, folder, stages)
        summary = _summary(done, stages)
        folder.write("summary.json", summary)
        folder.finish(seconds=stages.seconds)
    from rich.console import Console

    print_end(Console(width=END_WIDTH), summary, done.found.result, config.folder)
    return DemoReport(summary=summary, folder=config.folder)


def clear(folder: Path) -> None:
    """Remove a former demo; refuse to touch anything else.

    Raises:
        ConfigurationError: The folder holds something else.
    """
    if not folder.exists() or not any(folder.iterdir()):
        return
    try:
        former = RunFolder(folder).read()["settings"].get("kind") == "demo"
    except (DealHwError, KeyError, AttributeError):
        former = False
    if not former:
        raise ConfigurationError(
            f"{folder} exists and does not hold a former demo; name another folder with --out"
        )
    shutil.rmtree(folder)


def read_truth(path: Path) -> dict[str, Any]:
    """Return the truth that an emulator wrote at its end."""
    return cast("dict[str, Any]", json.loads(path.read_text(encoding="utf-8")))


def show_episode(folder: RunFolder, episode: Path) -> Path:
    """Write a recording with the predictions of both models; return the file."""
    from deal_hw.cli.inspect_ import Inspect, inspect

    rrd = folder.path / "inspect.rrd"
    inspect(Inspect(episode=episode, calibration=folder.calibration, save=rrd))
    return rrd


def _cpu_seconds() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _summary(done: Demonstrated, stages: Stages) -> dict[str, Any]:
    result, beside = done.found.result, done.beside
    loop_timing = done.run.episodes[-1].loop_timing
    values = loop_timing.to_json() if loop_timing is not None else {}
    periods = {f"period_{key}": values["period"][f"{key}_s"] for key in ("p50", "p99", "max") if values}
    return {
        "sentence": done.sentence,
        "parameters": {
            p.name: {
                "estimate": float(result.estimate[k]),
                "low": float(result.interval[k, 0]),
                "high": float(result.interval[k, 1]),
                "truth": done.truth[p.name],
                "nominal": p.nominal,
                "unit": p.unit,
                **({} if beside is None else {done.beside_name: float(beside.estimate[k])}),
            }
            for k, p in enumerate(result.space)
            if p.name in done.truth
        },
        "known": {
            name: {"value": value, "truth": done.truth[name]}
            for name, value in result.space.known.items()
            if name in done.truth
        },
        "median_error": _median_errors(done),
        "heldout_nrmse": dict(result.heldout_nrmse),
        "latency_s": {"true": done.latency_s, "found": result.latency_s},
        **{m.name: {policy: float(v.mean()) for policy, v in m.values.items()} for m in done.measures},
        **{m.std_name: {policy: float(v.std()) for policy, v in m.values.items()} for m in done.measures},
        "loop_timing": periods | values,
        "alarms": [str(alarm) for alarm in result.alarms],
        "seconds": stages.seconds,
        "cpu_seconds": stages.cpu_seconds,
        "paths": {"episode": str(done.episode), **done.paths},
    }


def _median_errors(done: Demonstrated) -> dict[str, float]:
    """Return the median relative error of the parameters that have a value, by estimate."""
    result, beside = done.found.result, done.beside
    has_value = [v != "not identifiable" for v in result.verdicts]
    # A bias around 0 has no relative error.
    rows = [
        k for k, p in enumerate(result.space) if p.name in done.truth and has_value[k] and p.scale == "log"
    ]
    if not rows:
        return {}
    truth = np.array([done.truth[result.space.names[k]] for k in rows])
    estimates = {"the model as it is": result.space.nominal}
    if beside is not None:
        estimates[f"{done.beside_name} alone"] = beside.estimate
    estimates["the calibration"] = result.estimate
    return {name: float(np.median(np.abs(e[rows] / truth - 1))) for name, e in estimates.items()}


def print_end(console: Console, summary: Mapping[str, Any], result: CalibrationResult, folder: Path) -> None:
    """Print the outcome, the estimates beside the truth, and the commands that show more."""
    from rich.table import Table

    console.print(f"\n{summary['sentence']}", markup=False)
    table = Table(title="estimates of the calibration beside the hidden truth")
    for name in ("parameter", "unit", "nominal", "estimate", "90 % interval", "truth"):
        table.add_column(name, justify="left" if name in ("parameter", "unit") else "right")
    for name, row in summary["parameters"].items():
        found, interval = result.estimate_text(name), (row["low"], row["high"])
        _add(table, name, row["unit"], f"{row['nominal']:.4g}", found, interval, row["truth"])
    for name, row in summary["known"].items():
        unit = escape(result.space[name].unit)
        table.add_row(name, unit, "", f"{row['value']:.4g}", "not fitted", f"{row['truth']:.4g}")
    latency = summary["latency_s"]
    low, high = (1e3 * end for end in result.latency_interval_s)
    _add(table, "latency", "ms", "0", f"{1e3 * latency['found']:.1f}", (low, high), 1e3 * latency["true"])
    console.print(table)
    if errors := summary.get("median_error"):  # Summaries of older runs have none.
        each = ", ".join(f"{name} {percent(value)}" for name, value in errors.items())
        console.print(f"median error of the parameters that have a value: {each}", markup=False)
    for command in (
        f"deal-hw inspect {summary['paths']['episode']} --calibration {folder / 'calibration'}",
        f"python3 -m webbrowser {folder / 'calibration' / 'report.html'}",
    ):
        console.print(command, markup=False, highlight=False, soft_wrap=True)


def _add(
    table: Table, name: str, unit: str, nominal: str, found: str, interval: tuple[float, float], truth: float
) -> None:
    low, high = interval
    mark = "" if low <= truth <= high else " (outside)"
    table.add_row(name, escape(unit), nominal, found, f"{low:.4g} .. {high:.4g}", f"{truth:.4g}{mark}")
