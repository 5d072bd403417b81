"""The Go2's loop bench: walk, calibrate from the walk, fine-tune, walk again; the truths are hidden.

One row per seed, in virtual time: driver, bytes, safety filter, control loop and recorder are those of the
wire. Four policies walk the same profile with the same robot. They are the shipped one, and that one after
more training under uniform randomisation, under the calibrated distribution, and under the truth.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from deal_hw.bench.rows import Cells, Row, RowTable, noted_in, per_parameter, printed
from deal_hw.bench.scores import check_truth
from deal_hw.bench.settings import Go2Loop
from deal_hw.calibration import CalibrationResult
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import walk_space
from deal_hw.drivers.go2.emulator.truth import Go2Truth, draw_truth
from deal_hw.motions.scores.velocity_error import velocity_error
from deal_hw.motions.velocity import ScriptVelocity
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.training import TrainingFiles
from deal_hw.workflows.calibrate import calibrate
from deal_hw.workflows.emulation.virtual_go2 import walk
from deal_hw.workflows.emulation.walk_script import HELDOUT, HELDOUT_S, PROFILE, PROFILE_S, Walk, write_script
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import train_policy, udr_distribution

POLICIES: Final = ("udr", "udr_more", "calibrated", "oracle")


class Walks(NamedTuple):
    """What the robot walks: for the calibration and its test, and how often each policy walks the first."""

    profile: Walk = Walk(PROFILE, PROFILE_S)
    heldout: Walk = Walk(HELDOUT, HELDOUT_S)
    repeats: int = 3


WALKS: Final = Walks()
NEXT_NOISE: Final = 100_000
"""Distance between the noise seeds of two walks."""
KINDS: Final = ("stiffness", "damping")
KEY: Final = ("profile", "seed", "steps")


def table(settings: Go2Loop) -> RowTable:
    """Return the bench: a cell for each seed, by :func:`loop_row`."""
    profile, steps = settings.profile, settings.steps if settings.train else 0
    folder = settings.beside("runs")
    runs = [
        (
            (profile, seed, steps),
            partial(loop_row, profile, seed, steps, folder=folder, threads=settings.threads),
        )
        for seed in settings.seeds
    ]
    return RowTable(cells=Cells(names=KEY, runs=runs), line=line, summary=printed(summary))


def loop_row(
    profile: str, seed: int, steps: int, *, folder: Path, threads: int | None, walks: Walks = WALKS
) -> Row:
    """Run one cell; an error goes into the row, so that the other cells still run.

    Args:
        profile: Profile of the emulated robot.
        seed: Seed of its truth, of the search and of the training.
        steps: Steps of each fine-tune; 0 for none.
        folder: Folder of recordings and policies.
        threads: Simulation threads.
        walks: What the robot walks.
    """
    row: Row = {
        "bench": "go2-loop",
        "profile": profile,
        "seed": seed,
        "steps": steps,
        "error": "",
    }
    with noted_in(row):
        truth, out = draw_truth(profile, seed), folder / f"{profile}_{seed}"
        check_truth(walk_space(), truth.walk_parameters())
        out.mkdir(parents=True, exist_ok=True)
        began = time.process_time()
        dataset = recorded(truth, out, walks)
        found = calibrate(dataset=dataset, space="walk", holdout=1, seed=seed, threads=threads)
        row |= calibration_part(found.result, truth)
        row["cpu_seconds_calibrate"] = round(time.process_time() - began, 1)
        row |= policies_part(found.result, truth, steps, out, walks)
    return row


def recorded(truth: Go2Truth, out: Path, walks: Walks) -> Path:
    """Let the shipped policy walk the profile and another one, and record both; return the dataset."""
    folder, policy = out / "dataset", OnnxPolicy(required_policy("go2"))
    with Dataset.create_or_open(folder, DRIVER) as store:
        for name, (script, seconds) in (("profile", walks.profile), ("heldout", walks.heldout))[
            len(store.episodes) :
        ]:
            source = ScriptVelocity(write_script(out / f"{name}.csv", script))
            path = store.next_episode_path()
            done = walk(truth, policy, source, seconds, path, {"robot": "go2", "seconds": seconds})
            store.note_episode(path, {"outcome": done.report.outcome.value, "task": "walk"})
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


def policies_part(result: CalibrationResult, truth: Go2Truth, steps: int, out: Path, walks: Walks) -> Row:
    """Fine-tune the shipped policy in three ways, and let all four walk; without steps the shipped one."""
    space = walk_space()
    values = np.array([truth.walk_parameters()[name] for name in space.names])
    shipped = OnnxPolicy(required_policy("go2"))
    start = shipped.path.with_suffix(".safetensors")
    under: Mapping[str, ParameterDistribution] = {
        "udr_more": udr_distribution("go2"),
        "calibrated": result.distribution(),
        "oracle": ParameterDistribution.point(space, values, 1e-3 * truth.latency_ms),
    }
    row: Row = {}
    for name in POLICIES if steps else POLICIES[:1]:
        policy = shipped
        if name != "udr":
            began, file = time.process_time(), out / f"{name}.onnx"
            files = TrainingFiles(checkpoint=file.with_suffix(".safetensors"), start=start)
            policy = train_policy("go2", under[name], file, seed=truth.seed, steps=steps, files=files)
            row[f"cpu_seconds_train_{name}"] = round(time.process_time() - began, 1)
        row |= {f"{key}_{name}": value for key, value in score(truth, policy, out, walks).items()}
    return row


def score(truth: Go2Truth, policy: OnnxPolicy, out: Path, walks: Walks) -> dict[str, Any]:
    """Let a policy walk the profile several times, each with other noise; return its errors by the truth.

    They are mean errors [m/s, rad/s] of the walks that lasted long enough, and the number of falls.
    """
    source, errors, falls = ScriptVelocity(write_script(out / "profile.csv", walks.profile.parts)), [], 0
    for number in range(walks.repeats):
        noisy = dataclasses.replace(truth, seed=truth.seed + number * NEXT_NOISE)
        done = walk(noisy, policy, source, walks.profile.seconds, record=False)
        falls += done.report.outcome is not Outcome.FINISHED
        error = None if done.wanted is None else velocity_error(done.track, done.wanted)
        if error is not None:
            errors.append((error.velocity_m_s, error.yaw_rad_s))
    velocity, yaw = np.mean(errors, axis=0) if errors else (np.nan, np.nan)
    return {"velocity_error": float(velocity), "yaw_error": float(yaw), "falls": falls}


def line(row: Row) -> str:
    """Return a row in words."""
    head = f"go2-loop {row['profile']} seed {row['seed']}"
    if row["error"]:
        return f"{head}: {row['error']}"
    walked = [n for n in POLICIES if f"velocity_error_{n}" in row]
    errors = ", ".join(f"{n} {row[f'velocity_error_{n}']:.3f}" for n in walked)
    return f"{head}: held-out ratio {row['heldout_ratio']:.2f}; velocity error [m/s]: {errors}"


def summary(rows: Sequence[Row]) -> list[str]:
    """Return a summary: medians, falls, and the paired comparison with equal training under UDR."""
    if not rows:
        return []
    lines = [f"held-out ratio: median {np.median([row['heldout_ratio'] for row in rows]):.2f}"]
    for kind in KINDS:
        lines.append(
            f"{kind}: median log error {np.median([row[f'{kind}_log_error'] for row in rows]):.3f} "
            f"(nominal {np.median([row[f'{kind}_log_error_nominal'] for row in rows]):.3f}), "
            f"{np.mean([row[f'{kind}_inside'] for row in rows]):.0%} in their 90 % intervals"
        )
    whole = [row for row in rows if "velocity_error_oracle" in row]
    for name in POLICIES if whole else ():
        found = [row[f"velocity_error_{name}"] for row in whole]
        falls = sum(row[f"falls_{name}"] for row in whole)
        lines.append(
            f"{name}: velocity error {np.mean(found):.3f} m/s, {falls} falls in "
            f"{WALKS.repeats * len(whole)} walks"
        )
    if whole:
        gains = np.array([row["velocity_error_udr_more"] - row["velocity_error_calibrated"] for row in whole])
        lines.append(
            f"calibrated against equal training under UDR, paired: {gains.mean():.4f} m/s better on average, "
            f"better for {int((gains > 0).sum())} of {len(gains)}"
        )
    return lines
