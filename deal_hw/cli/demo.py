"""``deal-hw demo``: all five jobs on an emulated cart-pole whose physics the calibrator cannot see."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from deal_hw.calibration import CalibrationResult
from deal_hw.cli.calibrate import Calibrate, CalibrateReport, calibrate
from deal_hw.cli.collect import Collect, collect
from deal_hw.cli.deploy import Deploy, deploy
from deal_hw.cli.emulator_process import EmulatorProcess
from deal_hw.cli.episode_report import RunReport
from deal_hw.cli.link import LinkOptions
from deal_hw.cli.options import Checked, Range, Seed
from deal_hw.cli.run_plan import shipped_policy
from deal_hw.control.cadence import CadenceReport
from deal_hw.data.run_folder import RunFolder
from deal_hw.errors import ConfigurationError, DealHwError, MissingExtraError
from deal_hw.types import FloatArray


@dataclass(frozen=True, kw_only=True)
class Demo(Checked):
    """Record, calibrate, retrain, deploy and compare on an emulated cart-pole over its wire."""

    out: Path = Path("runs/demo")
    """Run folder; a former demo in it is replaced."""

    transport: str = "serial"
    """The wire: serial, can, odrive or dynamixel."""

    profile: Literal["ideal", "sensor", "realistic"] = "realistic"
    """What stands between the emulated mechanics and the wire."""

    seed: Seed = 0
    """Draws the hidden truth, the demonstration, the search and the training."""

    episodes: Annotated[int, Range(1, 1000)] = 3
    """Deployments of each policy, 10 s each."""

    firmware: Literal["python", "host", "avr"] = "python"
    """What runs the firmware of the emulated cart-pole; see emulate --firmware."""

    steps: Annotated[int | None, Range(1, 10**9)] = None
    """Training steps; by default those of the shipped UDR policy."""


@dataclass(frozen=True, kw_only=True)
class DemoReport:
    """What the demo found.

    Attributes:
        summary: What ``summary.json`` holds.
        folder: The run folder.
    """

    summary: dict[str, Any]
    folder: Path


class _Stages:
    """Announces stages and keeps their times."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, words: str) -> Iterator[None]:
        print(f"\n== {name}: {words}", flush=True)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = round(time.perf_counter() - start, 2)


def demo(config: Demo) -> DemoReport:
    """Run the whole loop and print what came of it.

    Raises:
        DealHwError: A stage failed; the robot is passive, and what was recorded is whole.
    """
    try:
        from deal_hw.cli.inspect_ import Inspect, inspect
        from deal_hw.cli.train import Train, train
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "all") from err
    udr = shipped_policy("cartpole")
    if udr is None:
        raise ConfigurationError(
            "no UDR policy is shipped for the cart-pole; tools/train_udr_policy.py makes it"
        )
    _clear(config.out)
    folder = RunFolder(config.out)
    stages = _Stages()
    truth_file = config.out / "truth.json"
    with folder:
        folder.start(
            {
                "kind": "demo",
                "transport": config.transport,
                "profile": config.profile,
                "episodes": config.episodes,
                "steps": config.steps,
            },
            {"demo": config.seed},
        )
        options = (
            "--transport", config.transport, "--profile", config.profile, "--seed", str(config.seed),
            "--firmware", config.firmware, "--reveal-to", str(truth_file),
        )  # fmt: skip
        link = LinkOptions(transport=config.transport)
        with EmulatorProcess("cartpole", *options) as emulator:
            port = emulator.port
            print(f"an emulated cart-pole ({config.profile}) with hidden physics is on {port}")
            with stages.stage("collect", "4 s that tell much, and 4 s of other motion to judge by"):
                for kind in ("rich", "chirp"):
                    collect(
                        Collect(
                            robot="cartpole", port=port, link=link, out=config.out, profile=kind,
                            seed=config.seed,
                        )
                    )  # fmt: skip
            with stages.stage("calibrate", "search, refinement, latency, intervals"):
                found = calibrate(Calibrate(dataset=folder.dataset, out=config.out, seed=config.seed))
            with stages.stage("calibrate deal", "the adversarial search alone, to compare with"):
                beside = calibrate(
                    Calibrate(
                        dataset=folder.dataset, out=config.out / "deal", method="deal", refine=False,
                        seed=config.seed, quiet=True,
                    )
                )  # fmt: skip
            policy = folder.policies / "calibrated.onnx"
            with stages.stage("train", "a policy under what is now known of the robot"):
                train(
                    Train(
                        robot="cartpole", distribution=found.files["distribution.json"], out=policy,
                        steps=config.steps, seed=config.seed,
                    )
                )  # fmt: skip
            runs: dict[str, RunReport] = {}
            for name, file in (("udr", udr), ("retrained", policy)):
                with stages.stage(f"deploy {name}", f"{config.episodes} times 10 s over the port"):
                    runs[name] = deploy(
                        Deploy(
                            robot="cartpole", port=port, link=link, policy=file,
                            dataset=config.out / f"deploy_{name}", episodes=config.episodes, task="balance",
                        )
                    )  # fmt: skip
        with stages.stage("inspect", "real, nominal and calibrated on one screen"):
            rrd = config.out / "inspect.rrd"
            inspect(
                Inspect(
                    episode=folder.dataset / "episodes" / "000000.mcap",
                    calibration=folder.calibration,
                    save=rrd,
                )
            )
        truth = json.loads(truth_file.read_text(encoding="utf-8"))
        scores = {name: task_scores(config.out / f"deploy_{name}", config.episodes) for name in runs}
        paths = {"rrd": str(rrd), "mjcf": str(found.files["calibrated.xml"]), "policy": str(policy)}
        summary = _summary(found, beside.result, truth, scores, runs, stages.seconds, paths)
        folder.write("summary.json", summary)
        folder.finish(seconds=stages.seconds)
    _print(summary, found.result, config.out)
    return DemoReport(summary=summary, folder=config.out)


def _clear(folder: Path) -> None:
    """Remove a former demo; refuse to touch anything else."""
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


def task_scores(dataset: Path, episodes: int) -> FloatArray:
    """Return mean |pole angle| [rad] and mean |cart speed| [m/s] of each deployment, (E, 2).

    What is missing of a run that the safety filter ended early counts as fallen: pi rad, and a cart at rest.
    """
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.policies.evaluate import TASK_SECONDS, balance_result

    store = Dataset.open(dataset)
    scores = []
    for index in range(len(store.episodes)):
        recorded = store.read(index).trajectory
        period_s = float(np.median(np.diff(recorded.device_s)))
        result = balance_result(recorded.position, recorded.velocity, period_s, TASK_SECONDS)
        scores.append((result.angle_error_rad, result.cart_speed_m_s))
    # Episodes that were not run any more, because an earlier one was tripped, count like that one's worst.
    scores += [(np.pi, 0.0)] * (episodes - len(scores))
    return np.array(scores)


def _summary(
    found: CalibrateReport,
    deal: CalibrationResult,
    truth: dict[str, Any],
    scores: dict[str, FloatArray],
    runs: dict[str, RunReport],
    seconds: dict[str, float],
    paths: dict[str, str],
) -> dict[str, Any]:
    result = found.result
    cadence = runs["retrained"].episodes[-1].cadence
    return {
        "parameters": {
            p.name: {
                "estimate": float(result.estimate[k]),
                "low": float(result.interval[k, 0]),
                "high": float(result.interval[k, 1]),
                "truth": truth["parameters"][p.name],
                "nominal": p.nominal,
                "unit": p.unit,
                "deal": float(deal.estimate[k]),
            }
            for k, p in enumerate(result.space)
        },
        "heldout_nrmse": dict(result.heldout_nrmse),
        "latency_s": {"true": truth["latency_s"], "found": result.latency_s},
        "angle_error_rad": {name: float(score[:, 0].mean()) for name, score in scores.items()},
        "angle_error_std_rad": {name: float(score[:, 0].std()) for name, score in scores.items()},
        "cart_speed_m_s": {name: float(score[:, 1].mean()) for name, score in scores.items()},
        "cart_speed_std_m_s": {name: float(score[:, 1].std()) for name, score in scores.items()},
        "cadence": _cadence(cadence),
        "alarms": [str(alarm) for alarm in result.alarms],
        "seconds": seconds,
        "paths": paths,
    }


def _cadence(cadence: CadenceReport | None) -> dict[str, Any]:
    if cadence is None:
        return {}
    values = cadence.to_json()
    return {f"period_{key}": values["period"][f"{key}_s"] for key in ("p50", "p99", "max")} | values


def _print(summary: dict[str, Any], result: CalibrationResult, folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(width=110)
    table = Table(title="what the calibrator found of a robot it could not look inside")
    for name in ("parameter", "unit", "nominal", "deal alone", "estimate", "90 % interval", "truth"):
        table.add_column(name, justify="left" if name in ("parameter", "unit") else "right")
    for name, row in summary["parameters"].items():
        inside = row["low"] <= row["truth"] <= row["high"]
        table.add_row(
            name, row["unit"], f"{row['nominal']:.4g}", f"{row['deal']:.4g}", f"{row['estimate']:.4g}",
            f"{row['low']:.4g} .. {row['high']:.4g}",
            f"{row['truth']:.4g}" + ("" if inside else " (outside)"),
        )  # fmt: skip
    latency = summary["latency_s"]
    table.add_row(
        "latency", "ms", "0", "", f"{1e3 * latency['found']:.1f}", "", f"{1e3 * latency['true']:.1f}"
    )
    console.print(table)
    for alarm in result.alarms:
        console.print(f"alarm: {alarm}")

    table = Table(title="policies on the robot, mean ± std over deployments (the paper's Table 2)")
    for name in ("policy", "pole-angle error [rad]", "cart speed [m/s]"):
        table.add_column(name, justify="left" if name == "policy" else "right")
    for name in ("udr", "retrained"):
        cells = (
            f"{summary[key][name]:.4f} ± {summary[std][name]:.4f}"
            for key, std in (
                ("angle_error_rad", "angle_error_std_rad"),
                ("cart_speed_m_s", "cart_speed_std_m_s"),
            )
        )
        table.add_row(name, *cells)
    console.print(table)
    errors = summary["heldout_nrmse"]
    console.print(f"held-out error: nominal {errors['nominal']:.4f}, calibrated {errors['calibrated']:.4f}")
    console.print(
        "seconds: " + ", ".join(f"{name} {value:.0f}" for name, value in summary["seconds"].items())
    )
    for name, path in summary["paths"].items():
        console.print(f"{name}: {path}", soft_wrap=True)
    console.print(
        f"summary: {folder / 'summary.json'}; look at it with: deal-hw inspect --help", soft_wrap=True
    )
