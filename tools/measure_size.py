"""Measure time and memory of a calibration against the size of the robot: arms of 7 and 14 servo joints.

    python tools/measure_size.py --joints 7 --limit 600 --out size.json
    python tools/measure_size.py --joints 14 --lacking --out lacking.json
    python tools/measure_size.py --joints 7 --profile size.prof      # where the time goes, by cProfile

An arm has hidden true values: stiffness, damping, dry friction, armature and encoder bias of every joint, and
masses of all links but the second. The second is known, because no motion shows the common scale of all
masses and forces. The base is tilted, so that the first joint carries weight, too. 14 joints are two arms.

With --lacking the model is that of most people: it has no dry friction, and nobody says what to search. So
masses and encoder biases stay wrong.

The arm is recorded in plain MuJoCo, with late commands and noise. `deal-hw calibrate --model` calibrates it
in a process of its own with default settings. A row has seconds, peak memory, held-out error, the printed
fits, and the errors of the estimates. After --limit seconds the calibration is stopped as by Ctrl-C, and the
row has the best fit until then.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import pstats
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Rows, hear_signals, parser

from deal_hw.testing.plain_robots import RATE_HZ, PlainRobot, record

STEP_S = 0.0025
AXES = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
TILT = 0.5
"""Tilt of an arm's base about its x axis [rad]."""
BENDS = (0.0, -0.7, 0.0, 1.1, 0.0, 0.6, 0.0)
"""Angle of each link about its y axis at zero joint positions [rad]; it makes weight and biases visible."""
WEIGHED = 1
"""The link whose mass is known."""
LENGTHS = (0.05, 0.18, 0.14, 0.14, 0.12, 0.10, 0.08)
MASSES = (1.5, 1.2, 0.9, 0.7, 0.5, 0.35, 0.25)
STIFFNESS = (120.0, 150.0, 80.0, 80.0, 40.0, 30.0, 15.0)
SHARES = {"damping": 0.05, "frictionloss": 0.008, "armature": 0.0012}
"""Of the stiffness: damping [s], dry friction [rad], armature [s^2]."""
FACTORS = {"stiffness": 1.5, "damping": 2.0, "frictionloss": 2.0, "armature": 2.0, "mass": 1.3}
"""Truths lie within these factors of the model's values."""
UNUSUAL = (".mass", ".encoder_bias")
"""Ends of the names of parameters that are searched only where somebody asks for them."""
BIAS_RAD = 0.02
MOST_LATE_STEPS = 8
LEAST_HELD_OUT_S = 4.0
SHOWN_FUNCTIONS = 25


def make_arm(joints: int, seed: int, *, lacking: bool = False) -> tuple[PlainRobot, str]:
    """Return arms of seven joints each with a hidden truth, and the searched parameters (YAML).

    Args:
        joints: Joints altogether, a multiple of seven; fewer than seven are the first of an arm.
        seed: Of the truth.
        lacking: The model has no dry friction, and the usual parameters are searched; the text is empty.
    """
    rng = np.random.default_rng([seed, joints, 40])
    truth: dict[str, float] = {}
    models: dict[bool, list[str]] = {False: [], True: []}
    servos: dict[bool, list[str]] = {False: [], True: []}
    for arm in range(math.ceil(joints / len(AXES))):
        side, count = "lr"[arm], min(joints - arm * len(AXES), len(AXES))
        values = [_draw(rng, side, k) for k in range(count)]
        for own in values:
            truth |= own["truth"]
        for hidden in (False, True):
            bodies, actuators = _chain(side, values, "truth" if hidden else "model")
            models[hidden].append(
                f'<body pos="0 {0.3 - 0.6 * arm:g} 1" euler="{TILT - 2 * TILT * arm:g} 0 0">{bodies}</body>'
            )
            servos[hidden].append(actuators)
    texts = {
        hidden: f'<mujoco model="arm{joints}"><compiler angle="radian"/><option timestep="{STEP_S:g}" '
        'integrator="implicitfast"><flag contact="disable"/></option><worldbody>'
        f"{''.join(models[hidden])}</worldbody><actuator>{''.join(servos[hidden])}</actuator></mujoco>\n"
        for hidden in (False, True)
    }
    robot = PlainRobot(
        kind=f"arm-{joints}",
        model=texts[False],
        robot=texts[True],
        truth=truth,
        delay_s=STEP_S * int(rng.integers(1, MOST_LATE_STEPS)),
        fault=None,
        seed=seed,
    )
    if not lacking:
        return robot, _parameters(list(truth))
    usual = {name: value for name, value in truth.items() if not name.endswith(UNUSUAL)}
    bare = re.sub(r'frictionloss="[^"]*"', 'frictionloss="0"', robot.model)
    return dataclasses.replace(robot, model=bare, truth=usual), ""


def _draw(rng: np.random.Generator, side: str, k: int) -> dict[str, dict[str, float]]:
    """Return a joint's and its link's values, of the model and of the robot, by parameter name."""
    joint, link = f"{side}{k + 1}", f"{side}{k + 1}_link"
    model = {f"{joint}.servo_stiffness": STIFFNESS[k]}
    model |= {f"{joint}.{name}": share * STIFFNESS[k] for name, share in SHARES.items()}
    model[f"{joint}.encoder_bias"] = 0.0
    if k != WEIGHED:
        model[f"{link}.mass"] = MASSES[k]
    truth = {}
    for name, value in model.items():
        quantity = name.partition(".")[2].removeprefix("servo_")
        if quantity == "encoder_bias":
            truth[name] = float(rng.uniform(-BIAS_RAD, BIAS_RAD))
        else:
            truth[name] = value * float(np.exp(rng.uniform(-1, 1) * np.log(FACTORS[quantity])))
    return {"model": model, "truth": truth}


def _chain(side: str, values: Sequence[dict[str, dict[str, float]]], which: str) -> tuple[str, str]:
    """Return the bodies of an arm, one inside the other, and its servos."""
    bodies, actuators = "", ""
    for k in reversed(range(len(values))):
        own, joint, link = values[k][which], f"{side}{k + 1}", f"{side}{k + 1}_link"
        dynamics = " ".join(f'{name}="{own[f"{joint}.{name}"]:.9g}"' for name in SHARES)
        # An encoder's bias shifts the joint's zero, because the servo closes its loop on its reading.
        bias = own.get(f"{joint}.encoder_bias", 0.0)
        mass = own.get(f"{link}.mass", MASSES[k])
        bodies = (
            f'<body name="{link}" pos="{LENGTHS[k - 1] if k else 0:g} 0 0" euler="0 {BENDS[k]:g} 0">'
            f'<joint name="{joint}" axis="{AXES[k]}" ref="{bias:.9g}" {dynamics}/>'
            f'<geom type="capsule" fromto="0 0 0 {LENGTHS[k]:g} 0 0" size="0.03" mass="{0.8 * mass:.9g}"/>'
            # Beside the axis, so that links that roll carry weight.
            f'<geom type="sphere" pos="{LENGTHS[k] / 2:g} 0.04 0.02" size="0.02" mass="{0.2 * mass:.9g}"/>'
            f"{bodies}</body>"
        )
        stiffness = own[f"{joint}.servo_stiffness"]
        actuators = f'<position name="{joint}" joint="{joint}" kp="{stiffness:.9g}"/>' + actuators
    return bodies, actuators


def _parameters(names: Sequence[str]) -> str:
    masses, biases = (
        [name.partition(".")[0] for name in names if name.endswith(end)] for end in (".mass", ".encoder_bias")
    )
    kinds = ("servo_stiffness", "dof_damping", "dof_frictionloss", "dof_armature")
    lines = [f'  - {{kind: {kind}, elements: "*"}}' for kind in kinds]
    lines.append(f"  - {{kind: body_mass, elements: [{', '.join(masses)}], ratio: 2}}")
    lines.append(f"  - {{kind: encoder_bias, elements: [{', '.join(biases)}], range: [-0.05, 0.05]}}")
    return "\n".join(["parameters:", *lines]) + "\n"


def write_arm(
    folder: Path, joints: int, seed: int, seconds: float, *, lacking: bool = False
) -> tuple[PlainRobot, list[str]]:
    """Write model, parameters and recordings; return the robot and the arguments of ``deal-hw calibrate``.

    Args:
        folder: Folder for the files.
        joints: Joints of the robot.
        seed: Of truth, motions and noise.
        seconds: Length of what is fitted, in two recordings; a third recording only judges [s].
        lacking: As for :func:`make_arm`.
    """
    robot, parameters = make_arm(joints, seed, lacking=lacking)
    (folder / "robot.xml").write_text(robot.model, encoding="utf-8")
    searched = []
    if parameters:
        (folder / "params.yaml").write_text(parameters, encoding="utf-8")
        searched = ["--parameters", "params.yaml"]
    lengths = {"fit1": seconds / 2, "fit2": seconds / 2, "held-out": max(seconds / 6, LEAST_HELD_OUT_S)}
    for number, (name, length_s) in enumerate(lengths.items()):
        text = record(robot, number, round(length_s * RATE_HZ) / RATE_HZ)
        (folder / f"{name}.csv").write_text(text, encoding="utf-8")
    files = "--model robot.xml --data fit1.csv fit2.csv --holdout held-out.csv"
    return robot, ["calibrate", *files.split(), *searched, "--heldout-window", "2", "--out", "out"]


def measure(
    joints: int,
    seed: int,
    seconds: float,
    limit_s: float,
    more: Sequence[str],
    profile: Path | None,
    *,
    lacking: bool = False,
) -> dict[str, Any]:
    """Make an arm, calibrate it and return the row.

    Args:
        joints: Of the robot.
        seed: Of the truth.
        seconds: Length of what is fitted [s].
        limit_s: The calibration is stopped then, as by Ctrl-C [s].
        more: More options of `deal-hw calibrate`.
        profile: File for cProfile's figures; None: no profiling.
        lacking: As for :func:`make_arm`.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot, arguments = write_arm(folder, joints, seed, seconds, lacking=lacking)
        row: dict[str, Any] = {
            "bench": "size",
            "joints": joints,
            "parameters": len(robot.truth),
            "lacking": lacking,
            "seed": seed,
            "fitted_s": seconds,
            "limit_s": limit_s,
            "options": list(more),
            "error": "",
            "load_before": os.getloadavg()[0],
        }
        program = ["-m", "deal_hw"]
        if profile is not None:
            program = ["-m", "cProfile", "-o", str(profile.resolve()), *program]
        row |= _run([sys.executable, *program, *arguments, *more], folder, limit_s)
        if row["exit_code"] not in (0, 130):
            row["error"] = f"deal-hw calibrate ended with {row['exit_code']}: {row['printed'][-1:]}"
        found = folder / "out/calibration/result.json"
        row["stopped"] = not row["error"] and not found.exists()
        if row["stopped"]:
            found = folder / "out/calibration/so_far/result.json"
        if found.exists():
            row |= against_truth(robot, json.loads(found.read_text(encoding="utf-8")))
    row["load_after"] = os.getloadavg()[0]
    return row


def _run(command: Sequence[str], folder: Path, limit_s: float) -> dict[str, Any]:
    """Run a calibration; return seconds, memory, and its output with times."""
    began, printed = time.monotonic(), []
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with subprocess.Popen(
        command,
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as process:
        limit = threading.Timer(limit_s, process.send_signal, [signal.SIGINT])
        limit.start()
        try:
            for line in process.stderr or ():
                printed.append(f"{time.monotonic() - began:.1f} s: {line.rstrip()}")
        finally:
            limit.cancel()
            if sys.exc_info()[0] is not None:
                process.kill()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "exit_code": process.returncode,
        "seconds": time.monotonic() - began,
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        # Peak of the largest child so far, which is this one, in KiB on Linux.
        "peak_mib": after.ru_maxrss / 1024,
        "said": printed,
    }


def against_truth(robot: PlainRobot, result: dict[str, Any]) -> dict[str, Any]:
    """Return held-out errors, and errors of estimates and intervals."""
    rows = {name: result["parameters"][name] for name in robot.truth if name in result["parameters"]}
    reported = {name: row for name, row in rows.items() if row["verdict"] != "not identifiable"}
    ratios = [
        abs(math.log(row["estimate"] / robot.truth[name]))
        for name, row in reported.items()
        if not name.endswith(".encoder_bias")
    ]
    held = [row["low"] <= robot.truth[name] <= row["high"] for name, row in reported.items()]
    rmse = result["provenance"].get("heldout_rmse", {}).get("mean", {})
    return {
        "laws": [law["law"] for law in result["provenance"].get("laws", ())],
        "method": result["method"],
        "search": result["provenance"].get("search", ""),
        "chi2": result["chi2"],
        "steps": result["steps"],
        "told": len(reported),
        "log_error_x100": 100 * float(np.mean(ratios)) if ratios else None,
        "coverage90": float(np.mean(held)) if held else None,
        "latency_true": robot.delay_s,
        "latency_found": result["latency_s"],
        "alarms": result["alarms"],
        "heldout_nrmse": result["heldout_nrmse"],
        "heldout_rmse": rmse,
    }


def words(row: dict[str, Any]) -> str:
    """Return a row as text."""
    text = (
        f"{row['joints']} joints, {row['parameters']} parameters, {row['fitted_s']:g} s fitted, seed "
        f"{row['seed']}: {row['seconds']:.0f} s ({row['cpu_s']:.0f} s of processor time), peak memory "
        f"{row['peak_mib']:.0f} MiB, load {row['load_before']:.1f} to {row['load_after']:.1f}"
    )
    if row["error"]:
        return f"{text}; {row['error']}"
    if row["stopped"]:
        text += ", stopped at the limit"
    errors = {name: value for name, value in row.get("heldout_rmse", {}).items() if value is not None}
    if errors:
        text += "; held-out RMSE " + ", ".join(
            f"{name} {1e3 * value:.2f}e-3" for name, value in errors.items()
        )
    elif row.get("heldout_nrmse"):
        shares = (f"{name} {value:.4f}" for name, value in row["heldout_nrmse"].items())
        text += "; held-out error over the range " + ", ".join(shares)
    if row.get("told"):
        text += (
            f"; {row['told']} parameters have a value, 100 mean |ln| {row['log_error_x100']:.1f}, "
            f"90 % intervals hold {100 * row['coverage90']:.0f} %"
        )
    return "\n".join([text, *(f"  {line}" for line in row["said"])])


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser(__doc__)
    options.add_argument("--joints", type=int, nargs="+", default=[7, 14], choices=range(1, 15), metavar="N")
    options.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="SEED")
    options.add_argument("--seconds", type=float, default=60.0, help="length of what is fitted [s]")
    options.add_argument("--lacking", action="store_true", help="a model without dry friction, wrong masses")
    options.add_argument("--limit", type=float, default=1200.0, help="stop a calibration after this time [s]")
    options.add_argument("--options", default="", help="more options of deal-hw calibrate, in one word")
    options.add_argument("--profile", type=Path, help="file for cProfile's figures; the last run's are kept")
    given = options.parse_args(arguments)
    # The limit ends a calibration by Ctrl-C.
    hear_signals()
    rows = Rows(__file__, given.out)
    for joints in given.joints:
        for seed in given.seeds:
            more = given.options.split()
            row = measure(
                joints, seed, given.seconds, given.limit, more, given.profile, lacking=given.lacking
            )
            rows.add(row, words(row))
    if given.profile is not None and given.profile.exists():
        figures = pstats.Stats(str(given.profile))
        figures.sort_stats("cumulative").print_stats(SHOWN_FUNCTIONS)
        figures.sort_stats("tottime").print_stats(SHOWN_FUNCTIONS)
    return int(any(row["error"] for row in rows.rows))


if __name__ == "__main__":
    sys.exit(main())
