"""``deal-hw bench first-answer``: time until a calibration is nearly as good as its final result.

Five robots are calibrated as a user would, from an MJCF and recordings with default settings. Each
intermediate fit counts from its time, with its error on held-out motion. mujoco.sysid runs beside it, on the
same recordings, parameters and ranges, with the latency as one more parameter. Reading files and importing
packages does not count, on either side.
"""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.bench.rows import Cells, Row, RowTable, noted_in, printed
from deal_hw.bench.settings import FirstAnswer
from deal_hw.calibration import Budget, Progress
from deal_hw.documentation import page
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.testing.plain_robots import PlainRobot, make_robot, write
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input, usual_method
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import FilesSettings

KEY = ("task", "seed")


NEAR: Final = 1.1
"""Largest held-out error of a first answer, as a multiple of the final one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstAnswerSettings:
    """Settings of the bench.

    Attributes:
        window_s: Length of held-out predictions [s].
        sysid_window_s: Windows of mujoco.sysid [s]: on the public SO-101 recordings 2 s did best.
        sysid_iterations: Most iterations of its optimiser: its own default.
        seconds: Length of each simulated recording [s]; two are fitted, one is held out.
    """

    window_s: float = 2.0
    sysid_window_s: float = 2.0
    sysid_iterations: int = 200
    seconds: float = 12.0


SETTINGS = FirstAnswerSettings()

SO101_PARAMETERS = """\
parameters:
  - {kind: servo_stiffness, elements: "*"}
  - {kind: dof_damping, elements: "*"}
  - {kind: dof_frictionloss, elements: "*", range: [0.01, 1.0]}
  - {kind: dof_armature, elements: "*"}
  - {kind: servo_effort_limit, elements: gripper}
"""
"""As in docs/results/example-so101.md."""

GO2_PARAMETERS = """\
parameters:
  - {kind: servo_stiffness, elements: "*"}
  - {kind: servo_damping, elements: "*"}
  - {kind: dof_frictionloss, elements: "*_hip_joint"}
  - {kind: dof_frictionloss, elements: "*_thigh_joint"}
  - {kind: dof_frictionloss, elements: "*_calf_joint", range: [0.02, 4]}
  - {kind: tendon_frictionloss, elements: ["*_rod", "*_strap"], nominal: 5, ratio: 10}
  - {kind: dof_armature, elements: "*_joint"}
"""
"""As in docs/results/example-go2-suspended.md."""


@dataclass(frozen=True, slots=True)
class _Ask:
    """Inputs of a problem.

    Attributes:
        folder: For files.
        seed: Seed of a simulated robot's truth.
        real: Folder of real recordings, or None.
        seconds: Length of each simulated recording [s].
    """

    folder: Path
    seed: int
    real: Path | None
    seconds: float

    def recordings(self, name: str, example: str) -> Path:
        """Return the folder of a real robot.

        Raises:
            ConfigurationError: There is none; the message says how to make it.
        """
        if self.real is None:
            raise ConfigurationError(f"no real recordings: give --real DIR; {example} makes DIR/{name}")
        return self.real / name


def _written(robot: PlainRobot, ask: _Ask) -> FilesSettings:
    model, fit, held_out = write(robot, ask.folder, seconds=ask.seconds)
    return FilesSettings(model=model, data=fit, holdout=held_out)


def _plain(ask: _Ask, kind: str) -> FilesSettings:
    return _written(make_robot(kind, ask.seed), ask)


def _torque_arm(ask: _Ask) -> FilesSettings:
    """Return an arm of two links with torque motors instead of servos."""
    robot = make_robot("double-pendulum", ask.seed)
    gains = {name.partition(".")[0]: value for name, value in _stiffness(robot.model).items()}

    def driven(mjcf: str) -> str:
        """Return a model whose motors are stronger in the ratio in which its servos are stiffer."""
        for joint, stiffness in _stiffness(mjcf).items():
            gain = stiffness / gains[joint]
            mjcf = re.sub(
                f'<position name="{joint}" joint="{joint}" kp="[^"]*"/>',
                f'<general name="{joint}" joint="{joint}" gainprm="{gain:.9g}"/>',
                mjcf,
            )
        return mjcf

    return _written(
        replace(robot, kind="torque-arm", model=driven(robot.model), robot=driven(robot.robot)), ask
    )


def _stiffness(mjcf: str) -> dict[str, float]:
    return {name: float(kp) for name, kp in re.findall(r'joint="(\w+)" kp="([^"]*)"', mjcf)}


def _recorded(folder: Path, motions: Sequence[str], example: str) -> list[Path]:
    """Return files of a real robot.

    Raises:
        ConfigurationError: One is missing; the message says how to make them.
    """
    files = [folder / f"{motion}.npz" for motion in motions]
    if missing := [str(f) for f in (*files, folder / "columns.yaml") if not f.exists()]:
        raise ConfigurationError(f"{', '.join(missing)} missing: {example} shows how to make them")
    return files


SO101_EXAMPLE, GO2_EXAMPLE = page("results/example-so101.md"), page("results/example-go2-suspended.md")
SO101_FAST = ("chirp_sweep", "multisine", "friction_gravity", "prbs_excitation")
SO101_SLOW = ("step_response", "slow_precision")
"""Motions of the SO-101 that no table disturbs."""


def so101_inputs(folder: Path, made: Path, held_out: Sequence[str] = SO101_SLOW) -> FilesSettings:
    """Return the inputs of a calibration of the SO-101; its parameters are written into the folder ``made``.

    Raises:
        ConfigurationError: A recording is missing.
    """
    from deal_hw.drivers.so101.description import DESCRIPTION

    fitted = [motion for motion in (*SO101_FAST, *SO101_SLOW) if motion not in held_out]
    files = _recorded(folder, (*fitted, *held_out), SO101_EXAMPLE)
    parameters = made / "so101.yaml"
    parameters.write_text(SO101_PARAMETERS, encoding="utf-8")
    return FilesSettings(
        model=DESCRIPTION.mjcf,
        data=files[: len(fitted)],
        holdout=files[len(fitted) :],
        parameters=parameters,
        columns=folder / "columns.yaml",
        leave_out=(("chirp_sweep.npz", 105.0, 999.0),),
        fit_seconds=30.0,
        physics_step=0.004,
    )


def go2_inputs(folder: Path, made: Path, held_out: int = 4) -> FilesSettings:
    """Return the inputs of a calibration of the Go2 on its stand, with a part of 1 to 4 held out.

    Its parameters are written into the folder ``made``.

    Raises:
        ConfigurationError: A recording is missing.
    """
    from deal_hw.drivers.go2.descriptions.on_stand_recording import DESCRIPTION

    files = _recorded(folder, [f"traj_0_part{number}" for number in range(1, 5)], GO2_EXAMPLE)
    judge = files.pop(held_out - 1)
    parameters = made / "go2.yaml"
    parameters.write_text(GO2_PARAMETERS, encoding="utf-8")
    return FilesSettings(
        model=DESCRIPTION.mjcf,
        data=files,
        holdout=judge,
        parameters=parameters,
        columns=folder / "columns.yaml",
        window=0.2,
    )


def _so101(ask: _Ask) -> FilesSettings:
    return so101_inputs(ask.recordings("so101", SO101_EXAMPLE), ask.folder)


def _go2(ask: _Ask) -> FilesSettings:
    return go2_inputs(ask.recordings("go2", GO2_EXAMPLE), ask.folder)


PROBLEMS: Mapping[str, Callable[[_Ask], FilesSettings]] = {
    "double-pendulum": partial(_plain, kind="double-pendulum"),
    "cart-pole": partial(_plain, kind="cart-pole"),
    "torque-arm": _torque_arm,
    "so101": _so101,
    "go2-suspended": _go2,
}
"""The robots by name: three in plain MuJoCo with hidden truths, two real ones."""

REAL = frozenset({"so101", "go2-suspended"})
"""Problems with real recordings."""


def table(settings: FirstAnswer) -> RowTable:
    """Return the bench; a real robot has one truth, so it runs for the first seed only.

    Raises:
        UnknownNameError: There is no such problem.
    """
    problems, seeds = settings.problems or tuple(PROBLEMS), settings.seeds
    for name in problems:
        if name not in PROBLEMS:
            raise UnknownNameError("problem of first-answer", name, PROBLEMS)

    run = partial(run_cell, real=settings.real, budget=settings.budget, threads=settings.threads)
    chosen = [(name, seed) for seed in seeds for name in problems if name not in REAL or seed == seeds[0]]
    cells = Cells(names=KEY, run=run, args=[(cell, cell) for cell in chosen])
    return RowTable(cells=cells, line=line, summary=printed(summary))


def run_cell(
    name: str,
    seed: int,
    *,
    real: Path | None,
    budget: Budget,
    threads: int | None,
    settings: FirstAnswerSettings = SETTINGS,
) -> Row:
    """Calibrate one robot with both programs; an error goes into the row.

    Args:
        name: A name in `PROBLEMS`.
        seed: Seed of the truth, and of everything random in our calibration.
        real: Folder of real recordings.
        budget: Limits of a search.
        threads: Simulation threads.
        settings: Settings of the bench.
    """
    row: Row = {"bench": "first-answer", "task": name, "seed": seed, "error": "", "skipped": ""}
    with tempfile.TemporaryDirectory() as folder:
        try:
            chosen = PROBLEMS[name](_Ask(Path(folder), seed, real, settings.seconds))
        except ConfigurationError as err:
            return row | {"skipped": str(err)}
        config = replace(
            chosen,
            seed=seed,
            threads=threads,
            population=budget.population,
            generations=budget.generations,
        )
        with noted_in(row):
            row |= _compared(config, settings)
        return row


@dataclass(slots=True)
class _Stopwatch:
    """Wall clock and processor time since a moment."""

    wall_s: float
    cpu_s: float

    @classmethod
    def start(cls) -> _Stopwatch:
        return cls(time.perf_counter(), time.process_time())

    def passed(self) -> tuple[float, float]:
        """Return wall clock and processor time so far [s]."""
        return time.perf_counter() - self.wall_s, time.process_time() - self.cpu_s


@dataclass(frozen=True, slots=True)
class _Shown:
    """An intermediate fit: stage, wall clock and processor time [s], values (K,), latency [s], parameters."""

    stage: str
    wall_s: float
    cpu_s: float
    theta: FloatArray
    latency_s: float
    space: ParameterSpace


def _compared(config: FilesSettings, settings: FirstAnswerSettings) -> Row:
    from deal_hw.calib.baselines.sysid import with_delay
    from deal_hw.calib.data.problem import Problem
    from deal_hw.calib.pipeline.methods import make_method
    from deal_hw.calib.report.verdict import trust
    from deal_hw.calib.validation.metrics import HeldOut
    from deal_hw.sim.parameters import without_masses_and_zeros
    from deal_hw.sim.recordings.parts import joined
    from deal_hw.sim.recordings.sysid_adapter import require_sysid

    work = calibration_input(config)
    if config.parameters is None:
        # mujoco.sysid has neither zeros of encoders, nor what one expects of a mass to hold the common scale.
        work = replace(work, space=without_masses_and_zeros(work.space))
    # Imports are not counted.
    method = usual_method(config, work)
    make_method(method, refine=True)
    require_sysid()
    load, shown, since = os.getloadavg()[0], list[_Shown](), _Stopwatch.start()

    def watch(progress: Progress) -> None:
        if progress.estimate is not None:
            theta, latency_s = progress.estimate.copy(), progress.latency_s or 0.0
            space = progress.space or work.space
            shown.append(_Shown(progress.stage, *since.passed(), theta, latency_s, space))

    result = calibrate_or_raise(config, work, method, progress=watch)
    shown.append(_Shown("end", *since.passed(), result.estimate, result.latency_s, result.space))

    # Whole recordings, as far as they are fitted: its windows must not end where ours were cut.
    whole = Problem(work.robot, work.space, joined(work.episodes), threads=config.threads)
    since = _Stopwatch.start()
    sysid = with_delay(settings.sysid_window_s).run(
        whole, Budget(generations=settings.sysid_iterations), np.random.default_rng(config.seed)
    )
    sysid_s, sysid_cpu_s = since.passed()

    held_out = HeldOut(work.robot, work.space, work.holdout, settings.window_s, config.threads)
    fits = {"sysid": (sysid.estimate, sysid.latency_s), "nominal": (work.space.nominal, 0.0)}
    errors = held_out.errors(fits).mean()
    ours = [held_out.of(fit.space).errors({"fit": (fit.theta, fit.latency_s)}).mean()["fit"] for fit in shown]
    first = next(fit for fit, error in zip(shown, ours, strict=True) if error <= NEAR * ours[-1])
    return {
        "method": method,
        "parameters": len(work.space),
        "fitted_s": float(sum(len(e.sample) * e.period_s for e in work.episodes)),
        "load": load,
        "first_stage": first.stage,
        "first_s": first.wall_s,
        "first_cpu_s": first.cpu_s,
        "seconds": shown[-1].wall_s,
        "cpu_s": shown[-1].cpu_s,
        "sysid_s": sysid_s,
        "sysid_cpu_s": sysid_cpu_s,
        "seconds_ratio": first.wall_s / sysid_s,
        "cpu_ratio": first.cpu_s / sysid_cpu_s,
        "heldout_window_s": settings.window_s,
        "heldout_rmse": ours[-1],
        "heldout_rmse_sysid": errors["sysid"],
        "heldout_rmse_nominal": errors["nominal"],
        "heldout_rmse_null": errors["null"],
        "heldout_ratio": ours[-1] / errors["sysid"],
        "latency_found": result.latency_s,
        "latency_sysid": sysid.latency_s,
        "colour": trust(result).colour,
        "search": result.provenance.get("search", ""),
        "sysid_iterations": sysid.provenance.get("iterations"),
        "sysid_stopped": sysid.provenance.get("stopped"),
        "shown": [
            {"stage": fit.stage, "seconds": fit.wall_s, "cpu_s": fit.cpu_s, "heldout_rmse": error}
            for fit, error in zip(shown, ours, strict=True)
        ],
    }


def line(row: Mapping[str, Any]) -> str:
    """Return one row in words."""
    head = f"{row['task']} seed {row['seed']}"
    if row["error"] or row["skipped"]:
        return f"{head}: {row['error'] or 'skipped: ' + row['skipped']}"
    return (
        f"{head}, {row['parameters']} parameters: first answer after {row['first_s']:.1f} s "
        f"({row['first_stage']}), end after {row['seconds']:.1f} s, mujoco.sysid {row['sysid_s']:.1f} s, "
        f"ratio {row['seconds_ratio']:.2f} (processor time {row['cpu_ratio']:.2f}); held-out error "
        f"{1e3 * row['heldout_rmse']:.3f}e-3, mujoco.sysid {1e3 * row['heldout_rmse_sysid']:.3f}e-3, "
        f"ratio {row['heldout_ratio']:.3f}"
    )


def summary(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for each problem: medians over seeds of both ratios."""
    found = []
    for task in dict.fromkeys(row["task"] for row in rows):
        mine = [row for row in rows if row["task"] == task and not row["error"] and not row["skipped"]]
        if not mine:
            found.append(f"{task}: not run")
            continue
        names = ("seconds_ratio", "cpu_ratio", "heldout_ratio")
        seconds, cpu, error = (float(np.median([row[name] for row in mine])) for name in names)
        found.append(
            f"{task}: {len(mine)} seeds; first answer / mujoco.sysid: {seconds:.2f} in seconds, {cpu:.2f} in "
            f"processor time, {error:.3f} in held-out error"
        )
    return found
