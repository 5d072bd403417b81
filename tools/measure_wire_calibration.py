#!/usr/bin/env python3
"""Parameter errors of the cart-pole behind each of its wires: the demo's demonstration and calibration.

python tools/measure_wire_calibration.py --transports serial can odrive dynamixel --seeds 1,2,3 --out r.json
python tools/measure_wire_calibration.py --table r.json

Each row is an emulator with hidden physics in a process of its own. 4 s of motion `rich` are fitted by
default settings, and 4 s of `chirp` judge. Two runs over one wire differ, too: they are in real time, and a
balancing pole is chaotic, so each demonstration shows different parameters. So a seed is run several times
(--repeats), and the interval beside each error shows what its recording determines. Parameters that a wire's
device does not have are left out: an ODrive's set-point is moved by the host. The wire `firmware` is serial,
with the firmware of the ATmega328P in simavr at its end.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.bench.rows import write_rows
from deal_hw.cli.bench import parse_seeds
from deal_hw.cli.calibrate import Calibrate, calibrate
from deal_hw.cli.collect import Collect, collect
from deal_hw.errors import DealHwError, InsufficientDataError
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.settings import LinkOptions

FIRMWARE = "firmware"
TRIES = 3
"""A recording is made again where a pause of this computer made the safety filter end it too early."""
NOT_THERE = {"odrive": ("servo.speed_limit",)}
"""Parameters that a wire's device does not have."""


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
                Collect(
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
        Calibrate(dataset=run / "dataset", out=run, seed=seed, quiet=True, report=False, advise=False)
    ).result
    parameters = {
        p.name: {
            "truth": truth["parameters"][p.name],
            "estimate": float(found.estimate[k]),
            "low": float(found.interval[k, 0]),
            "high": float(found.interval[k, 1]),
        }
        for k, p in enumerate(found.space)
        if p.name not in NOT_THERE.get(transport, ())
    }
    off = [abs(v["estimate"] / v["truth"] - 1) for v in parameters.values()]
    half = [np.log(v["high"] / v["low"]) / 2 for v in parameters.values()]
    held = [v["low"] <= v["truth"] <= v["high"] for v in parameters.values()]
    return {
        "error_percent": 100 * float(np.mean(off)),
        "median_percent": 100 * float(np.median(off)),
        "interval_percent": 100 * float(np.median(half)),
        "coverage90": float(np.mean(held)),
        "chi2": found.chi2,
        "latency_error_ms": 1e3 * (found.latency_s - truth["latency_s"]),
        "alarms": [str(alarm) for alarm in found.alarms],
        "parameters": parameters,
    }


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--transports", nargs="+", default=["serial", "firmware", "can", "odrive", "dynamixel"]
    )
    parser.add_argument("--profile", default="sensor")
    parser.add_argument("--seeds", type=parse_seeds, default=(1, 2, 3), help="such as 1,2,3 or 0-9")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--table", type=Path, default=None, help="print the table of a result")
    given = parser.parse_args()
    if given.table is not None:
        print(table(json.loads(given.table.read_text(encoding="utf-8"))["rows"]))
        return 0
    rows: list[dict[str, Any]] = []
    # Wires take turns, so that other work on the machine affects all of them.
    for seed in tuple(given.seeds) * given.repeats:
        for transport in given.transports:
            rows.append(measure(transport, given.profile, seed))
            short = rows[-1]["error"] or f"{rows[-1]['error_percent']:.2f} %"
            print(f"{transport} seed {seed}: {short}", file=sys.stderr, flush=True)
            if given.out is not None:
                write_rows(given.out, rows, program="tools/measure_wire_calibration.py")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
