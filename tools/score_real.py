r"""Predict held-out motion of real robots, with laws that the MJCF lacks and without, beside other methods.

    python tools/score_real.py FOLDER --robots so101,go2 --out real_robots.json
    python tools/score_real.py --table real_robots.json

FOLDER has a folder of each robot, as the converters write them from the public sources that they name:

    so101            convert_so101.py; holds out step_response and slow_precision of six motions. so101-other:
                     chirp_sweep and friction_gravity
    go2              convert_go2_suspended.py --parts 4 --seconds 12.92; holds out the last part. go2-first:
                     the first one
    cartpole         convert_cartpole.py, six recordings v1_*; holds out v1_800 and v1_1700. cartpole-bare:
                     the same without the rotor's inertia in the MJCF, as the rig's own files are
    double_pendulum  the CSV files of docs/results/example-double-pendulum.md; holds out 02, 04 and 06
    bam_xl330        convert_bam.py; fits the P gains 100, 200 and 800, holds out 400
    ur10e            convert_ur10e.py; fits motions of 5 and 6 February, holds out one of 10 February, and
                     moves from point to point of 17 January
    simple_pendulum  convert_simple_pendulum.py; fits sac and direct_collocation, holds out energy_shaping
                     and ddp

All methods get the same recordings, parameters and ranges:

    nominal       the MJCF as it is
    one-page      least squares as one writes it in an afternoon (tools/one_page.py), with the latency
    mujoco-sysid  MuJoCo's own toolbox, with the latency as one more parameter; not for several P gains
    no-laws       `deal-hw calibrate --no-laws`
    default       `deal-hw calibrate`

Errors are of predictions from smoothed reported states, root mean square over all windows, mean of the
joints: in rad (cart-pole: m and rad), and as a share of the signal's range.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import one_page
from measuring import Row, Rows, markdown, parser, read_rows

from deal_hw.bench.first_answer import SETTINGS, go2_inputs, so101_inputs
from deal_hw.calib.baselines.sysid import with_delay
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import names_at_bound
from deal_hw.calib.report.verdict import trust
from deal_hw.calib.validation.metrics import HeldOut
from deal_hw.calibration import Budget, CalibrationResult
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.parts import joined
from deal_hw.workflows.calibration.intake import CalibrationInput, calibration_input, usual_method
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import FilesSettings

METHODS = ("nominal", "one-page", "mujoco-sysid", "no-laws", "default")


@dataclass(frozen=True, slots=True)
class Robot:
    """A real robot.

    Attributes:
        inputs: Returns the inputs of a calibration from the robot's folder and one for files that it writes.
        window_s: Length of held-out predictions [s].
        fitted_s: Length of the windows that the other methods fit [s]; short for a motion that is unstable.
        folder: Name of its folder.
    """

    inputs: Callable[[Path, Path], FilesSettings]
    window_s: float
    fitted_s: float
    folder: str


SO101_SWAPPED = ("chirp_sweep", "friction_gravity")
UR10E_FITTED = ("ur-20_02_05-20sec_8harm", "ur-20_02_06-20sec_5harm", "ur-20_02_06-20sec_10harm")
UR10E_HELD_OUT = ("ur-20_02_10-20sec_7harm", "ur-20_01_17-ptp_10_points")
XL330_MOTIONS = ("sin_sin", "sin_time_square", "up_and_down")


def cartpole(folder: Path, made: Path, *, rotor: bool = True) -> FilesSettings:
    """Return the inputs of the cart-pole; the rotor's inertia is in its MJCF, or in none."""
    model = folder / "cartpole.xml"
    if not rotor:
        bare = re.sub(r' armature="[^"]*"', "", model.read_text(encoding="utf-8"))
        model = made / "cartpole.xml"
        model.write_text(bare, encoding="utf-8")
    return FilesSettings(
        model=model,
        data=_npz(folder, ["v1_0", "v1_1", "v1_5", "v1_1200"]),
        holdout=_npz(folder, ["v1_800", "v1_1700"]),
        columns=folder / "columns.yaml",
    )


def double_pendulum(folder: Path, made: Path) -> FilesSettings:
    """Return the inputs of the double pendulum; see docs/results/example-double-pendulum.md."""
    del made
    files = [folder / f"trajectory_{number:02}.csv" for number in range(7)]
    held_out = (2, 4, 6)
    return FilesSettings(
        model=folder / "double_pendulum.xml",
        data=_there([f for number, f in enumerate(files) if number not in held_out]),
        holdout=_there([files[number] for number in held_out]),
        columns=folder / "columns.yaml",
    )


def bam_xl330(folder: Path, made: Path) -> FilesSettings:
    """Return the inputs of the XL330 with a weight: a set-up for each P gain."""
    del made
    return FilesSettings(
        model=folder / "pendulum.xml",
        data=_npz(folder, [f"kp{gain}-{motion}" for gain in (100, 200, 800) for motion in XL330_MOTIONS]),
        holdout=_npz(folder, [f"kp400-{motion}" for motion in XL330_MOTIONS]),
        columns=folder / "columns.yaml",
        parameters=folder / "parameters.yaml",
        setups=folder / "setups.yaml",
    )


def ur10e(folder: Path, made: Path) -> FilesSettings:
    """Return the inputs of the UR10e: motor currents as torques."""
    del made
    return FilesSettings(
        model=folder / "ur10e.xml",
        data=_npz(folder, UR10E_FITTED),
        holdout=_npz(folder, UR10E_HELD_OUT),
        columns=folder / "columns.yaml",
        parameters=folder / "parameters.yaml",
    )


def simple_pendulum(folder: Path, made: Path) -> FilesSettings:
    """Return the inputs of the pendulum on an AK80-6: measured torques."""
    del made
    return FilesSettings(
        model=folder / "simple_pendulum.xml",
        data=_npz(folder, ["sac", "direct_collocation"]),
        holdout=_npz(folder, ["energy_shaping", "ddp"]),
        columns=folder / "columns.yaml",
    )


ROBOTS: Mapping[str, Robot] = {
    "so101": Robot(so101_inputs, 5.0, 2.0, "so101"),
    "so101-other": Robot(
        partial(so101_inputs, held_out=("chirp_sweep", "friction_gravity")), 5.0, 2.0, "so101"
    ),
    "go2": Robot(go2_inputs, 2.5, 2.0, "go2"),
    "go2-first": Robot(partial(go2_inputs, held_out=1), 2.5, 2.0, "go2"),
    "cartpole": Robot(cartpole, 0.2, 0.2, "cartpole"),
    "cartpole-bare": Robot(partial(cartpole, rotor=False), 0.2, 0.2, "cartpole"),
    "double_pendulum": Robot(double_pendulum, 0.2, 0.2, "double_pendulum"),
    "bam_xl330": Robot(bam_xl330, 1.0, 1.0, "bam_xl330"),
    "ur10e": Robot(ur10e, 0.3, 0.3, "ur10e"),
    "simple_pendulum": Robot(simple_pendulum, 0.3, 0.3, "simple_pendulum"),
}


def _npz(folder: Path, names: Sequence[str]) -> tuple[Path, ...]:
    return _there([folder / f"{name}.npz" for name in names])


def _there(files: Sequence[Path]) -> tuple[Path, ...]:
    if missing := [str(path) for path in files if not path.exists()]:
        raise ConfigurationError(f"{', '.join(missing)} missing: --help names the converter that makes them")
    return tuple(files)


def score(robot: Robot, folder: Path, method: str, seed: int) -> Row:
    """Fit with one method and predict what was held out.

    Raises:
        DealHwError: A recording is missing, or the method cannot fit it.
    """
    with tempfile.TemporaryDirectory() as made:
        config = robot.inputs(folder / robot.folder, Path(made))
        work = calibration_input(config)
        began, cpu = time.monotonic(), time.process_time()
        space, theta, latency_s, more = fitted(robot, config, work, method, seed)
        row = {"seconds": time.monotonic() - began, "processor_seconds": time.process_time() - cpu}
        held_out = HeldOut(work.robot, work.space, work.holdout, robot.window_s, threads=1).of(space)
        errors = held_out.errors({"fit": (theta, latency_s)})
        return row | {
            "parameters": len(space),
            "fitted_s": float(sum(len(e.sample) * e.period_s for e in work.episodes)),
            "window_s": robot.window_s,
            "rmse": errors.mean()["fit"],
            "rmse_null": errors.mean()["null"],
            "share": errors.nrmse["fit"],
            "by_joint": dict(zip(errors.names, map(float, errors.rmse["fit"]), strict=True)),
            "latency_s": latency_s,
            "at_bound": names_at_bound(space, theta),
            "estimate": dict(zip(space.names, map(float, theta), strict=True)),
            **more,
        }


def fitted(
    robot: Robot, config: FilesSettings, work: CalibrationInput, method: str, seed: int
) -> tuple[ParameterSpace, Any, float, Row]:
    """Return a method's parameters, their values (K,), its latency [s], and more for the row."""
    if method == "nominal":
        return work.space, work.space.nominal, 0.0, {}
    if method in ("one-page", "mujoco-sysid"):
        # Whole recordings, as far as they are fitted: its windows must not end where ours were cut.
        problem = Problem(work.robot, work.space, joined(work.episodes), threads=1)
        if method == "one-page":
            theta, latency_s = one_page.fit(problem, robot.fitted_s)
            return work.space, theta, latency_s, {}
        if work.robot.setups:
            raise ConfigurationError("mujoco.sysid has one model for all recordings")
        found = with_delay(robot.fitted_s).run(
            problem, Budget(generations=SETTINGS.sysid_iterations), np.random.default_rng(seed)
        )
        return work.space, found.estimate, found.latency_s, {}
    chosen = replace(config, seed=seed, threads=1, heldout_window=robot.window_s, laws=method == "default")
    result: CalibrationResult = calibrate_or_raise(chosen, work, usual_method(config, work))
    facts = {name: result.provenance.get(name) for name in ("laws", "candidates")}
    return (
        result.space,
        result.estimate,
        result.latency_s,
        {
            **facts,
            "method_name": result.method,
            "colour": trust(result).colour,
            "alarms": [str(alarm) for alarm in result.alarms],
            "steps": result.steps,
        },
    )


def laws_of(row: Row) -> list[str]:
    """Return the laws of a row's result. Rows from before laws were taken on top of others have one."""
    taken = row["laws"] if "laws" in row else [row["law"]]
    return [str(one["law"]) for one in taken or () if one]


def table(rows: Sequence[Row]) -> str:
    """Return errors by robot and method, as a share of the signal's range and over those without laws."""
    lines = []
    for robot in dict.fromkeys(row["robot"] for row in rows):
        mine = {row["method"]: row for row in rows if row["robot"] == robot and not row["error"]}
        shares = [f"{100 * mine[m]['share']:.3f}" if m in mine else "" for m in METHODS]
        ratio, law = "", ""
        if {"default", "no-laws"} <= set(mine):
            ratio = f"{mine['default']['rmse'] / mine['no-laws']['rmse']:.3f}"
            law = ", ".join(laws_of(mine["default"]))
        lines.append((robot, *shares, ratio, law))
    heads = ("robot", *(f"{method} [%]" for method in METHODS), "default / no-laws", "law")
    return markdown(heads, lines)


def main(arguments: list[str] | None = None) -> int:
    """Score robots by methods."""
    made = parser(__doc__, table=True)
    made.add_argument("folder", type=Path, nargs="?", help="with a folder of each robot")
    made.add_argument("--robots", default=",".join(ROBOTS), help=f"default: {','.join(ROBOTS)}")
    made.add_argument("--methods", default=",".join(METHODS), help=f"default: {','.join(METHODS)}")
    made.add_argument("--seed", type=int, default=0)
    options = made.parse_args(arguments)
    if options.table is not None:
        print(table(read_rows(options.table)))
        return 0
    if options.folder is None:
        made.error("name the folder of the recordings, or give --table FILE")
    robots, methods = options.robots.split(","), options.methods.split(",")
    if unknown := [*({*robots} - {*ROBOTS}), *({*methods} - {*METHODS})]:
        made.error(
            f"unknown: {', '.join(unknown)}; robots: {', '.join(ROBOTS)}; methods: {', '.join(METHODS)}"
        )
    rows = Rows(__file__, options.out, names=("robot", "method", "seed"))
    for name in robots:
        for method in methods:
            rows.measured(
                {"robot": name, "method": method, "seed": options.seed},
                f"{name}, {method}",
                partial(score, ROBOTS[name], options.folder, method, options.seed),
                lambda row: format(row["rmse"], ".5f"),
            )
    print(table(rows.rows))
    return int(any(row["error"] for row in rows.rows))


if __name__ == "__main__":
    raise SystemExit(main())
