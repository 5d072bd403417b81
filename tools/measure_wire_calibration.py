#!/usr/bin/env python3
"""Parameter errors of the cart-pole behind each of its wires: the demo's demonstration and calibration.

python tools/measure_wire_calibration.py --transports serial can odrive dynamixel --seeds 1,2,3 --out r.json
python tools/measure_wire_calibration.py --virtual --profile realistic --seeds 1000-1009 --out r.json
python tools/measure_wire_calibration.py --table r.json

Each row is an emulator with hidden physics in a process of its own. 4 s of motion `rich` are fitted by
default settings, and 4 s of `chirp` judge. Two runs over one wire differ, too: they are in real time, and a
balancing pole is chaotic, so each demonstration shows different parameters. So a seed is run several times
(--repeats), and the interval beside each error shows what its recording determines. Parameters that a wire's
device does not have are left out: an ODrive's set-point is moved by the host. The wire `firmware` is serial,
with the firmware of the ATmega328P in simavr at its end.

With --virtual everything runs in virtual time: the machine's load changes nothing, and a seed gives one row.
Rows that --out holds already are not run again. The second table has, for each wire and value, how many 90 %
intervals hold the truth. The true latency is the device's own mean delay. ODrive and Dynamixel do not report
when a command arrived, so there the calibrated latency also contains the wire's, up to 1 ms. In virtual time
an ODrive's is always 1 ms, which is added to the truth.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Rows, add_seeds, parser, read_rows

from deal_hw.calibration import CalibrationResult
from deal_hw.cli.calibrate import CalibrateDataset, calibrate
from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.drivers.cartpole.chips.avr_device import AvrDevice
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.dynamixel.device import DynamixelDevice
from deal_hw.drivers.cartpole.dynamixel.robot import DynamixelCartpole
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.emulator.can_emulator import can_device
from deal_hw.drivers.cartpole.emulator.odrive_emulator import odrive_device
from deal_hw.drivers.cartpole.emulator.odrive_endpoints import ENABLE_WATCHDOG, WATCHDOG_TIMEOUT
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.robots.odrive_robot import OdriveRobot
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire.can_link import CanLink
from deal_hw.drivers.cartpole.wire.odrive_link import OdriveSettings
from deal_hw.errors import DealHwError, InsufficientDataError, UnknownNameError
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align, fill_gaps
from deal_hw.workflows.calibration.intake import CalibrationInput
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import CalibrateSettings
from deal_hw.workflows.calibration.space import without_speed_limits
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.settings import CARTPOLE_RANGE_RATIO
from deal_hw.workflows.emulation.virtual import VirtualCartpole, demonstrate
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.settings import LinkOptions
from deal_hw.workflows.say import silent
from deal_hw.workflows.shipped import required_policy

FIRMWARE = "firmware"
WIRES = ("serial", "can", "odrive", "dynamixel", FIRMWARE)
TRIES = 3
"""A recording is made again where a pause of this computer made the safety filter end it too early."""
NOT_THERE = {"odrive": ("servo.speed_limit",)}
"""Parameters that a wire's device does not have."""
VIRTUAL_WIRE_S = {"odrive": 1e-3}
"""From a command's stamp to its arrival in virtual time, on wires that do not report the arrival [s]."""


def measure(transport: str, profile: str, seed: int) -> dict[str, Any]:
    """Run one row and keep its errors."""
    row: dict[str, Any] = {"transport": transport, "profile": profile, "seed": seed, "error": ""}
    for tries in range(1, TRIES + 1):
        row["tries"] = tries
        with tempfile.TemporaryDirectory() as place:
            try:
                return row | _calibrated(Path(place), transport, profile, seed) | {"error": ""}
            except InsufficientDataError as error:
                row["error"] = f"{type(error).__name__}: {error}"
            except DealHwError as error:
                return row | {"error": f"{type(error).__name__}: {error}"}
    return row


def _calibrated(folder: Path, transport: str, profile: str, seed: int) -> dict[str, Any]:
    truth_file, run = folder / "truth.json", folder / "run"
    options: tuple[str, ...] = ("--profile", profile, "--seed", str(seed))
    if transport == FIRMWARE:
        transport, options = "serial", (*options, "--firmware", "avr")
    options = ("--transport", transport, *options)
    with EmulatorProcess("cartpole", *options, "--reveal-to", str(truth_file)) as emulator:
        for kind in ("rich", "chirp"):
            collect(
                COLLECT.settings(
                    robot="cartpole",
                    port=emulator.port,
                    link=LinkOptions(transport=transport),
                    out=run,
                    motion=kind,
                    seed=seed,
                )
            )
    truth = json.loads(truth_file.read_text(encoding="utf-8"))
    found = calibrate(
        CalibrateDataset(dataset=run / "dataset", out=run, seed=seed, quiet=True, report=False, advise=False)
    ).result
    return _errors(found, truth["parameters"], truth["latency_s"], transport)


def measure_virtual(transport: str, profile: str, seed: int) -> dict[str, Any]:
    """Run one row in virtual time; the calibration is that of the command line's defaults."""
    truth = draw_truth(profile, seed, range_ratio=CARTPOLE_RANGE_RATIO)
    row: dict[str, Any] = {"transport": transport, "profile": profile, "seed": seed, "virtual": True}
    virtual = virtual_wire(transport, truth)
    try:
        plan = RunPlan(
            robot="cartpole", motion="rich", seconds=4.0, seed=seed, policy=str(required_policy("cartpole"))
        )
        runs = [demonstrate(virtual, replace(plan, motion=motion))[0] for motion in ("rich", "chirp")]
        fitted, held_out = (fill_gaps(align(run.trajectory, DESCRIPTION)) for run in runs)
        space = without_speed_limits(k9_space(), DESCRIPTION, [run.trajectory for run in runs], silent)
        work = CalibrationInput(
            robot=load_model(DESCRIPTION), space=space, episodes=[fitted], holdout=[held_out]
        )
        found = calibrate_or_raise(CalibrateSettings(seed=seed, threads=1), work, "default")
    except DealHwError as error:
        return row | {"error": f"{type(error).__name__}: {error}"}
    latency_s = truth.latency_s + VIRTUAL_WIRE_S.get(transport, 0.0)
    return row | _errors(found, truth.parameters, latency_s, transport) | {"error": ""}


def virtual_wire(transport: str, truth: CartpoleTruth) -> VirtualCartpole:
    """Return an emulated cart-pole behind a wire in virtual time."""
    match transport:
        case "serial":
            return VirtualCartpole(truth)
        case "firmware":
            return VirtualCartpole(truth, AvrDevice(truth))
        case "can":
            return VirtualCartpole(truth, can_device(truth), partial(CartpoleRobot, link=CanLink))
        case "odrive":
            parts = OdriveSettings(enable_watchdog=ENABLE_WATCHDOG, watchdog_timeout=WATCHDOG_TIMEOUT)
            return VirtualCartpole(truth, odrive_device(truth, parts), partial(OdriveRobot, settings=parts))
        case "dynamixel":
            servos = DynamixelSettings()
            return VirtualCartpole(
                truth, DynamixelDevice(truth, servos), partial(DynamixelCartpole, settings=servos)
            )
    raise UnknownNameError("wire", transport, WIRES)


def _errors(
    found: CalibrationResult, truth: Mapping[str, float], latency_s: float, transport: str
) -> dict[str, Any]:
    """Return the part of a row that compares a result with the truth."""
    parameters = {
        p.name: {
            "truth": truth[p.name],
            "estimate": float(found.estimate[k]),
            "low": float(found.interval[k, 0]),
            "high": float(found.interval[k, 1]),
        }
        for k, p in enumerate(found.space)
        # Play that the calibration added has no counterpart in the truth.
        if p.name in truth and p.name not in NOT_THERE.get(transport, ())
    }
    off = [abs(v["estimate"] / v["truth"] - 1) for v in parameters.values()]
    half = [np.log(v["high"] / v["low"]) / 2 for v in parameters.values()]
    held = [_holds(v) for v in parameters.values()]
    low, high = found.latency_interval_s
    return {
        "error_percent": 100 * float(np.mean(off)),
        "median_percent": 100 * float(np.median(off)),
        "interval_percent": 100 * float(np.median(half)),
        "coverage90": float(np.mean(held)),
        "chi2": found.chi2,
        "latency_error_ms": 1e3 * (found.latency_s - latency_s),
        "alarms": [str(alarm) for alarm in found.alarms],
        "parameters": parameters,
        "latency": {
            "truth": 1e3 * latency_s,
            "estimate": 1e3 * found.latency_s,
            "low": 1e3 * low,
            "high": 1e3 * high,
        },
        "added": [name for name in found.space.names if name not in truth],
        "seconds": found.seconds,
    }


def _holds(value: Mapping[str, float]) -> bool:
    return value["low"] <= value["truth"] <= value["high"]


def coverage_table(rows: list[dict[str, Any]]) -> str:
    """Return, as Markdown, how many 90 % intervals of each value hold the truth, and their median width."""
    whole = [row for row in rows if not row["error"] and "latency" in row]
    names = list(dict.fromkeys(name for row in whole for name in row["parameters"]))
    lines = [
        "| wire | runs | latency [ms] | " + " | ".join(f"{name} [%]" for name in names) + " |",
        "|" + "---|" * (3 + len(names)),
    ]
    for transport in dict.fromkeys(row["transport"] for row in whole):
        mine = [row for row in whole if row["transport"] == transport]
        delays = [row["latency"] for row in mine]
        width = np.median([v["high"] - v["low"] for v in delays]) / 2
        cells = [f"{sum(map(_holds, delays))} (+-{width:.2f})"]
        for name in names:
            found = [row["parameters"][name] for row in mine if name in row["parameters"]]
            half = 50 * np.median([np.log(v["high"] / v["low"]) for v in found]) if found else 0.0
            cells.append(f"{sum(map(_holds, found))} (+-{half:.1f})" if found else "")
        lines.append(f"| {transport} | {len(mine)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as Markdown: medians over runs, and each wire's mean error over the serial one's."""
    lines = [
        "| wire | runs | mean error, median of runs [%] | of serial | median error [%] | half interval [%] | "
        "truths inside |",
        "|---|---|---|---|---|---|---|",
    ]
    whole = [row for row in rows if not row["error"]]
    serial = [row["error_percent"] for row in whole if row["transport"] == "serial"]
    for transport in dict.fromkeys(row["transport"] for row in rows):
        mine = [row for row in whole if row["transport"] == transport]
        failed = sum(row["transport"] == transport for row in rows) - len(mine)
        runs = f"{len(mine)}" + (f", {failed} failed" if failed else "")
        if not mine:
            lines.append(f"| {transport} | {runs} | | | | | |")
            continue
        mean, median, half, inside = (
            float(np.median([row[name] for row in mine]))
            for name in ("error_percent", "median_percent", "interval_percent", "coverage90")
        )
        ratio = f"{mean / np.median(serial):.2f}" if serial else ""
        lines.append(
            f"| {transport} | {runs} | {mean:.2f} | {ratio} | {median:.2f} | {half:.2f} | {inside:.2f} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Measure the rows and print them as a table."""
    options = parser(__doc__, table=True)
    add_seeds(options, 1, 2, 3)
    options.add_argument("--transports", nargs="+", choices=WIRES, default=WIRES, help="all by default")
    options.add_argument("--virtual", action="store_true", help="in virtual time")
    options.add_argument("--profile", default="sensor")
    options.add_argument("--repeats", type=int, default=1)
    given = options.parse_args()
    if given.table is not None:
        kept = read_rows(given.table)
        print(table(kept), coverage_table(kept), sep="\n\n")
        return 0
    # In virtual time a run gives the same row again.
    rows = Rows(__file__, given.out, ("transport", "profile", "seed") if given.virtual else ())
    # Wires take turns, so that other work on the machine affects all of them.
    for seed in tuple(given.seeds) * given.repeats:
        for transport in given.transports:
            if given.virtual and rows.done(transport, given.profile, seed):
                continue
            run = measure_virtual if given.virtual else measure
            row = run(transport, given.profile, seed)
            short = row["error"] or f"{row['error_percent']:.2f} %"
            rows.add(row, f"{transport} seed {seed}: {short}", table=True)
    print(table(rows.rows), coverage_table(rows.rows), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
