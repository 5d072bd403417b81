"""The Go2's loop bench: walk, calibrate from the walk, fine-tune, walk again; the truths are hidden.

One row per seed, in virtual time: driver, bytes, safety filter, control loop and recorder are those of the
wire. Five policies do the same with the same robot. They are the shipped one of the task, and that one after
more training under uniform randomisation, under the nominal model, under the calibrated distribution, and
under the truth. A row that lacks policies is completed by those alone.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from deal_hw.bench.go2_tasks import ENDED, TASKS, LoopTask, climb_lines
from deal_hw.bench.rows import Cells, Row, RowTable, noted_in, per_parameter, printed
from deal_hw.bench.scores import check_truth
from deal_hw.bench.settings import Go2Loop
from deal_hw.calibration import CalibrationResult
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import walk_space
from deal_hw.drivers.go2.emulator.truth import Go2Truth, draw_truth
from deal_hw.motions.velocity import ScriptVelocity
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.training import TrainingFiles
from deal_hw.workflows.calibrate import calibrate
from deal_hw.workflows.emulation.virtual_go2 import walk
from deal_hw.workflows.emulation.walk_script import write_script
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import nominal_distribution, train_policy, udr_distribution

POLICIES: Final = ("udr", "udr_more", "nominal", "calibrated", "oracle")
WALK: Final = "walk"
KINDS: Final = ("stiffness", "damping")
KEY: Final = ("task", "profile", "seed", "steps")
RIVALS: Final = {"nominal": "the nominal model", "udr_more": "UDR"}
"""Trainings as long that read no recording, against which the calibrated one is compared."""


def table(settings: Go2Loop) -> RowTable:
    """Return the bench: a cell for each seed, by :func:`loop_row`."""
    steps = settings.steps if settings.train else 0
    # Rows of the walk have no task: there was one task when the first were made.
    name = TASKS[settings.task].name
    # What a task lacks is said before the first walk.
    required_policy("go2", name)
    run = partial(loop_row, folder=settings.beside("runs"), threads=settings.cell_threads)
    args = [((name, settings.profile, seed, steps),) * 2 for seed in settings.seeds]
    cells = Cells(
        names=KEY,
        run=run,
        args=args,
        tasks=settings.tasks(),
        bench=settings.name,
        whole=lambda row: not lacking(row),
    )
    return RowTable(cells=cells, line=line, summary=printed(summary))


def loop_row(
    name: str,
    profile: str,
    seed: int,
    steps: int,
    earlier: Row | None = None,
    *,
    folder: Path,
    threads: int | None,
    task: LoopTask | None = None,
) -> Row:
    """Run one cell; an error goes into the row, so that the other cells still run.

    Args:
        name: The task's name; "" for the walk.
        profile: Profile of the emulated robot.
        seed: Seed of its truth, of the search and of the training.
        steps: Steps of each fine-tune; 0 for none.
        earlier: The cell's row of an earlier version, without an error. It is completed: what it has is kept.
        folder: Folder of recordings and policies.
        threads: Simulation threads.
        task: What the robot does; by default that of the name.
    """
    head: Row = {
        "bench": "go2-loop",
        "task": name,
        "profile": profile,
        "seed": seed,
        "steps": steps,
        "error": "",
    }
    task, row = task or TASKS[name or WALK], {**(earlier or head)}
    with noted_in(row):
        truth, out = draw_truth(profile, seed), folder / f"{name or WALK}_{profile}_{seed}"
        check_truth(walk_space(), truth.walk_parameters())
        out.mkdir(parents=True, exist_ok=True)
        under = uncalibrated(truth, task)
        if earlier is None or "calibrated" in lacking(row):
            began = time.process_time()
            dataset = recorded(truth, out, task)
            found = calibrate(
                dataset=dataset, space="walk", episodes=0, holdout=1, seed=seed, threads=threads
            )
            row |= calibration_part(found.result, truth)
            row["cpu_seconds_calibrate"] = round(time.process_time() - began, 1)
            under["calibrated"] = found.result.distribution()
        for policy in lacking(row):
            row |= policy_part(policy, under.get(policy), truth, steps, out, task)
    return row


def lacking(row: Row) -> list[str]:
    """Return the policies of which a row has no numbers; without steps only the shipped one is asked for."""
    measure = TASKS[row.get("task") or WALK].measure
    return [n for n in POLICIES if (row["steps"] or n == "udr") and f"{measure}_{n}" not in row]


def uncalibrated(truth: Go2Truth, task: LoopTask) -> dict[str, ParameterDistribution]:
    """Return the distributions of the fine-tunes that need no calibration, by policy."""
    space = walk_space()
    values = np.array([truth.walk_parameters()[name] for name in space.names])
    return {
        "udr_more": udr_distribution("go2", task.name),
        "nominal": nominal_distribution("go2", task.name),
        "oracle": ParameterDistribution.point(space, values, 1e-3 * truth.latency_ms),
    }


def recorded(truth: Go2Truth, out: Path, task: LoopTask) -> Path:
    """Let the shipped policy walk the profile and another one, and record both; return the dataset."""
    folder, policy = out / "dataset", OnnxPolicy(required_policy("go2", task.name))
    with Dataset.create_or_open(folder, DRIVER) as store:
        for motion, (script, seconds) in (("profile", task.profile), ("heldout", task.heldout))[
            len(store.episodes) :
        ]:
            source = ScriptVelocity(write_script(out / f"{motion}.csv", script))
            path = store.next_episode_path()
            done = walk(truth, policy, source, seconds, path, {"robot": "go2", "seconds": seconds})
            store.note_episode(path, {"outcome": done.report.outcome.value, "task": task.name or WALK})
    return folder


def calibration_part(result: CalibrationResult, truth: Go2Truth) -> Row:
    """Return the calibration's part of the row."""
    true = truth.walk_parameters()
    names = result.space.names
    values = np.array([true[name] for name in names])
    inside = (result.interval[:, 0] <= values) & (values <= result.interval[:, 1])
    known = result.space.known
    row: Row = {
        "heldout_nrmse_nominal": result.heldout_nrmse["nominal"],
        "heldout_nrmse_calibrated": result.heldout_nrmse["calibrated"],
        "heldout_ratio": result.heldout_nrmse["calibrated"] / result.heldout_nrmse["nominal"],
        "payload_kg_true": truth.payload_kg,
        "payload_error_kg": known.get("base.mass", np.nan) - true["base.mass"],
        "latency_ms_true": truth.latency_ms,
        "latency_ms_found": 1e3 * result.latency_s,
        "alarms": [alarm.seen for alarm in result.alarms],
        "per_parameter": per_parameter(result, values),
    }
    nominal = {p.name: p.nominal for p in walk_space()}
    for kind in (*KINDS, "frictionloss", "friction"):
        of_kind = [k for k, name in enumerate(names) if name.endswith(f".{kind}")]
        before = np.array([nominal[names[k]] for k in of_kind])
        row[f"{kind}_inside"] = float(inside[of_kind].mean())
        row[f"{kind}_log_error"] = float(
            np.median(np.abs(np.log(result.estimate[of_kind] / values[of_kind])))
        )
        row[f"{kind}_log_error_nominal"] = float(np.median(np.abs(np.log(before / values[of_kind]))))
    return row


def policy_part(
    name: str,
    under: ParameterDistribution | None,
    truth: Go2Truth,
    steps: int,
    out: Path,
    task: LoopTask,
) -> Row:
    """Fine-tune the shipped policy under a distribution, and score it; with None it is scored as it is."""
    row: Row = {}
    policy = OnnxPolicy(required_policy("go2", task.name))
    if under is not None:
        began, file = time.process_time(), out / f"{name}.onnx"
        start = policy.path.with_suffix(".safetensors")
        files = TrainingFiles(checkpoint=file.with_suffix(".safetensors"), start=start)
        policy = train_policy("go2", under, file, task=task.name, seed=truth.seed, steps=steps, files=files)
        row[f"cpu_seconds_train_{name}"] = round(time.process_time() - began, 1)
    return row | {f"{key}_{name}": value for key, value in task.score(truth, policy, out).items()}


def line(row: Row) -> str:
    """Return a row in words."""
    name = row.get("task") or WALK
    task = TASKS[name]
    head = f"go2-loop {name} {row['profile']} seed {row['seed']}"
    if row["error"]:
        return f"{head}: {row['error']}"
    walked = [n for n in POLICIES if f"{task.measure}_{n}" in row]
    values = ", ".join(f"{n} {row[f'{task.measure}_{n}']:.3f}" for n in walked)
    words = task.measure.replace("_", " ")
    return f"{head}: held-out ratio {row['heldout_ratio']:.2f}; {words} [{task.unit}]: {values}"


def summary(rows: Sequence[Row]) -> list[str]:
    """Return a summary: medians, falls, and the paired comparisons with equal training of :data:`RIVALS`."""
    if not rows:
        return []
    lines = [f"held-out ratio: median {np.median([row['heldout_ratio'] for row in rows]):.2f}"]
    for kind in KINDS:
        lines.append(
            f"{kind}: median log error {np.median([row[f'{kind}_log_error'] for row in rows]):.3f} "
            f"(nominal {np.median([row[f'{kind}_log_error_nominal'] for row in rows]):.3f}), "
            f"{np.mean([row[f'{kind}_inside'] for row in rows]):.0%} in their 90 % intervals"
        )
    for name, task in TASKS.items():
        whole = [row for row in rows if (row.get("task") or WALK) == name and f"{task.measure}_oracle" in row]
        lines += _compared(name, task, whole) if whole else []
    return lines


def _compared(name: str, task: LoopTask, rows: Sequence[Row]) -> list[str]:
    """Return how the policies did in one task; those of which every row has numbers, as robots differ."""
    lines, words = [], task.measure.replace("_", " ")
    policies = [n for n in POLICIES if all(f"{task.measure}_{n}" in row for row in rows)]
    for policy in policies:
        found = [row[f"{task.measure}_{policy}"] for row in rows]
        falls = sum(row[f"{ENDED}_{policy}"] for row in rows)
        lines.append(f"{policy}: {words} {np.mean(found):.3f} {task.unit}, {falls} falls")
    if name == "climb":
        lines += climb_lines(rows, policies)
    sign = 1.0 if task.more_is_better else -1.0
    for rival, means in RIVALS.items():
        if rival in policies:
            gains = sign * np.array(
                [row[f"{task.measure}_calibrated"] - row[f"{task.measure}_{rival}"] for row in rows]
            )
            lines.append(
                f"calibrated against equal training under {means}, paired: {gains.mean():.4f} {task.unit} "
                f"better on average, better for {int((gains > 0).sum())} of {len(gains)}"
            )
    return lines
