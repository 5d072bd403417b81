#!/usr/bin/env python3
"""Calibration of the emulated Go2 on a stand over its wire, compared with its hidden truth.

For each seed an emulator, `deal-hw collect` and `deal-hw calibrate` run as separate processes, over a real
wire. `collect` records a multisine to fit, and a motion of another family to judge. The emulator writes its
truth when it ends; it is read after the calibration has written its result.

    python tools/measure_go2_calibration.py --transport zenoh --seeds 1000-1004 --out FILE.json

The true stiffness is the drive's factor times the kp that is sent. The true damping is the drive's factor
times the kd that is sent, plus the joint's viscous friction. The others have their own value. The latency of
a recording is the emulator's own plus the transit over the wire and back, rounded up to the drives' next
millisecond.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import add_seeds, head, parser, write_document

from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.workflows.emulation.process import EmulatorProcess

PORTS = {"zenoh": "tcp/127.0.0.1:0", "dds": "lo"}
PATIENCE_S = 1800.0
ATTEMPTS = 3
GAINS = ("stiffness", "damping")


def main() -> int:
    """Measure each seed and write the rows."""
    options = _options()
    result: dict[str, Any] = {**head(__file__, dated=True), "rows": []}
    for seed in options.seeds:
        row = measure(options, seed)
        result["rows"].append(row)
        print(json.dumps({k: v for k, v in row.items() if k != "parameters"}), flush=True)
        result["summary"] = summary(result["rows"])
        write_document(options.out, result)
    print(json.dumps(result["summary"], indent=1))
    return 0 if all("error" not in row for row in result["rows"]) else 1


def measure(options: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Return the row of one seed, with its failures."""
    row: dict[str, Any] = {"seed": seed, "profile": options.profile, "transport": options.transport}
    with tempfile.TemporaryDirectory(dir=options.keep) as folder:
        try:
            began = time.monotonic()
            run, row["collect"], row["failed_recordings"] = recorded(options, seed, Path(folder))
            row["collect_s"] = round(time.monotonic() - began, 1)
            # The first episode is fitted, the second only judges.
            words = f"--holdout 1 --no-report --no-advise {options.calibrate}".split()
            verb("calibrate", str(run / "dataset"), "--out", str(run), *words)
            result = json.loads((run / "calibration" / "result.json").read_text(encoding="utf-8"))
            truth = Go2Truth.from_json(json.loads((run / "truth.json").read_text(encoding="utf-8")))
            row |= judge(result, truth)
        except RuntimeError as error:
            row["error"] = str(error)
    return row


def recorded(options: argparse.Namespace, seed: int, folder: Path) -> tuple[Path, list[str], list[str]]:
    """Record both episodes, again if a run ended early: on a busy machine states may be late.

    Returns:
        The run folder, the output of `collect` for both, and its output for recordings that ended early.

    Raises:
        RuntimeError: Each attempt ended early.
    """
    failed: list[str] = []
    for attempt in range(ATTEMPTS):
        run = folder / str(attempt)
        run.mkdir()
        try:
            return run, record(options, seed, run), failed
        except RuntimeError as error:
            failed.append(str(error).replace(str(run), "RUN"))
    raise RuntimeError(f"{ATTEMPTS} recordings ended early: {'; '.join(failed)}")


def record(options: argparse.Namespace, seed: int, run: Path) -> list[str]:
    """Record both episodes from a new emulator; return the output of `collect`."""
    wire = (
        "--transport",
        options.transport,
        *(("--domain", str(options.domain)) * (options.transport == "dds")),
    )
    printed = []
    robot = f"--port {PORTS[options.transport]} --on-stand --profile {options.profile} --seed {seed}".split()
    with EmulatorProcess("go2", *wire, *robot, "--reveal-to", str(run / "truth.json")) as emulator:
        for excite, seconds in (("multisine", options.seconds), (options.heldout, options.heldout_seconds)):
            plan = excite
            if excite not in ("multisine", "chirp"):
                plan = str(run / "heldout.json")
                design = f"design-excitation {DESCRIPTION.name} --family {excite} --seconds {seconds}"
                verb(*design.split(), "--seed", str(seed), "--out", plan)
            words = ("--excite", plan, "--seconds", str(seconds), "--seed", str(seed), "--out", str(run))
            report = verb("collect", DESCRIPTION.name, *wire, "--port", emulator.port, *words)
            printed.append(report.replace(str(run), "RUN"))
    return printed


def verb(*words: str) -> str:
    """Run a verb of deal-hw as a separate process; return its output.

    Raises:
        RuntimeError: It failed; the text has its output.
    """
    done = subprocess.run(
        [sys.executable, "-m", "deal_hw", *words],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    if done.returncode:
        printed = (done.stdout + done.stderr).strip()[-2000:]
        raise RuntimeError(f"{' '.join(words)}: {done.returncode}: {printed}")
    return done.stdout.strip()


def judge(result: dict[str, Any], truth: Go2Truth) -> dict[str, Any]:
    """Return the errors of a calibration's result."""
    true = truth.parameters(DESCRIPTION.stiffness[0], DESCRIPTION.damping[0])
    rows: dict[str, dict[str, Any]] = {}
    for name, found in result["parameters"].items():
        rows[name] = {
            "true": true[name],
            **{key: found[key] for key in ("nominal", "estimate", "low", "high", "verdict")},
            "inside": found["low"] <= true[name] <= found["high"],
        }
    kinds = list(dict.fromkeys(name.partition(".")[2] for name in rows))
    rmse = result["provenance"]["heldout_rmse"]["mean"]
    return {
        "heldout_rmse_nominal": rmse["nominal"],
        "heldout_rmse_calibrated": rmse["calibrated"],
        "heldout_ratio": rmse["calibrated"] / rmse["nominal"],
        "gains_inside": share(rows, GAINS),
        "inside": {kind: share(rows, (kind,)) for kind in kinds},
        "median_error": {kind: error(rows, kind, "estimate") for kind in kinds},
        "median_error_nominal": {kind: error(rows, kind, "nominal") for kind in kinds},
        "latency_true_ms": truth.latency_ms,
        "latency_found_ms": 1e3 * result["latency_s"],
        "latency_interval_ms": [1e3 * v for v in result["latency_interval_s"]],
        "chi2": result["chi2"],
        "alarms": result["alarms"],
        "method": result["method"],
        "calibrate_s": result["seconds"],
        "parameters": rows,
    }


def share(rows: dict[str, dict[str, Any]], kinds: Sequence[str]) -> float:
    """Return the share of parameters of these kinds whose truth lies in its 90 % interval."""
    return float(np.mean([row["inside"] for name, row in rows.items() if name.partition(".")[2] in kinds]))


def error(rows: dict[str, dict[str, Any]], kind: str, which: str) -> float:
    """Return the median distance from the truth: a ratio, for encoder biases rad."""
    chosen = [row for name, row in rows.items() if name.partition(".")[2] == kind]
    if kind == "encoder_bias":
        return float(np.median([abs(row[which] - row["true"]) for row in chosen]))
    return float(np.median([abs(row[which] / row["true"] - 1.0) for row in chosen]))


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return statistics over all seeds."""
    good = [row for row in rows if "error" not in row]
    if not good:
        return {"seeds": len(rows), "failed": len(rows)}
    kinds = list(dict.fromkeys(kind for row in good for kind in row["inside"]))
    late = [row["latency_found_ms"] - row["latency_true_ms"] for row in good]
    return {
        "seeds": len(rows),
        "failed": len(rows) - len(good),
        "heldout_ratio_median": float(np.median([row["heldout_ratio"] for row in good])),
        "heldout_ratio_worst": max(row["heldout_ratio"] for row in good),
        "gains_inside": float(np.mean([row["gains_inside"] for row in good])),
        "inside": {kind: float(np.mean([row["inside"].get(kind, np.nan) for row in good])) for kind in kinds},
        "median_error": {
            kind: float(np.median([row["median_error"].get(kind, np.nan) for row in good])) for kind in kinds
        },
        "latency_beyond_emulator_ms": [min(late), max(late)],
        "calibrate_s_median": float(np.median([row["calibrate_s"] for row in good])),
        "failed_recordings": sum(len(row["failed_recordings"]) for row in good),
        "flagged": sum(bool(row["alarms"]) for row in good),
    }


def _options() -> argparse.Namespace:
    made = parser(__doc__, out=False)
    made.add_argument("--transport", choices=tuple(PORTS), default="zenoh")
    made.add_argument("--domain", type=int, default=77, help="DDS domain")
    add_seeds(made, 1000)
    made.add_argument("--profile", default="sensor", help="profile of the emulator")
    made.add_argument("--seconds", type=float, default=10.0, help="length of the recording to fit")
    made.add_argument("--heldout", default="steps", help="family of the held-out motion")
    made.add_argument("--heldout-seconds", type=float, default=6.0)
    made.add_argument("--calibrate", default="--method local", help="further options of calibrate")
    made.add_argument("--keep", type=Path, default=None, help="folder for the runs' temporary folders")
    made.add_argument("--out", type=Path, required=True)
    return made.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
