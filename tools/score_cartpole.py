r"""Predict recordings of a real cart-pole that a calibration has not seen, one left out at a time.

    python tools/score_cartpole.py cartpole --out FILE.json

The folder is that of `tools/convert_cartpole.py`: one NPZ file a recording, columns.yaml and cartpole.xml.
For each recording the model is calibrated on all others, as a user would, and predicts it. Figures:

- windows of 0.2 s and of 1 s, back to back, on the firmware's clock. They start at samples whose two
  neighbours on each side were measured, and end inside the recording;
- the start state is a local quadratic over these five samples (value and slope in the middle);
- the prediction is open loop, with the recorded commands, each in force from its time and the latency on;
- root mean square of prediction minus measurement over all angles from 8 to 4086 counts, all windows of the
  recording together, cart [mm] and pole [mrad]. For comparison: a cart-pole that stays as it is, the model as
  it is, and with ``--page`` least squares of one page (tools/one_page.py) on the same recordings, with the
  same parameters and ranges and the latency. The rotor's inertia has to be in the MJCF for it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import mujoco
import numpy as np
import one_page
from measuring import head, parser, write_document

import deal_hw
from deal_hw.calib.data.problem import Problem
from deal_hw.sim.engine.model import model_with
from deal_hw.sim.recordings.parts import joined
from deal_hw.types import FloatArray, IntArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

Search: TypeAlias = Literal["deal", "eki", "deal-paper"]
PERIOD_S = 0.02
WINDOWS_S = (0.2, 1.0)
AROUND = 2
"""Samples on each side of a start that its quadratic needs."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording on the firmware's clock.

    Attributes:
        position: Cart [m] and pole [rad] at each period; NaN where nothing was measured, (T, 2).
        command_s: Time of each command since the first period, (C,) [s].
        force_n: Commands, (C,) [N].
    """

    position: FloatArray
    command_s: FloatArray
    force_n: FloatArray

    @property
    def measured(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Which periods have a sample, (T,)."""
        return np.isfinite(self.position[:, 0])


def read(path: Path) -> Recording:
    """Read a file of tools/convert_cartpole.py."""
    with np.load(path) as file:
        begin_s = file["every_time"][0]
        stamp = np.round((file["every_time"] - begin_s) / PERIOD_S).astype(np.int64)
        position = np.full((stamp[-1] + 1, 2), np.nan)
        position[stamp] = np.stack([file["every_cart_position"], file["every_pole_angle"]], axis=1)
        return Recording(position, file["command_time"] - begin_s, file["cart_force"])


def starts(recording: Recording, samples: int) -> IntArray:
    """Return the first samples of windows back to back, of ``samples`` periods each."""
    five = np.lib.stride_tricks.sliding_window_view(recording.measured, 2 * AROUND + 1).all(axis=1)
    found: list[int] = []
    for at in np.flatnonzero(five) + AROUND:
        if at + samples < len(recording.position) and (not found or at >= found[-1] + samples):
            found.append(int(at))
    return np.array(found, dtype=np.int64)


def start_state(recording: Recording, at: int) -> tuple[FloatArray, FloatArray]:
    """Return position and velocity in the middle of a quadratic through five samples, (2,) each."""
    five = recording.position[at - AROUND : at + AROUND + 1]
    # Least squares of a quadratic at equal steps (Savitzky and Golay).
    return np.array([-3, 12, 17, 12, -3]) / 35 @ five, np.array([-2, -1, 0, 1, 2]) / (10 * PERIOD_S) @ five


def predict(
    model: mujoco.MjModel, full_n: float, latency_s: float, recording: Recording, at: int, samples: int
) -> FloatArray:
    """Return the positions at the ``samples`` periods after a start, (samples, 2).

    Args:
        model: The calibrated model.
        full_n: Force of the uncalibrated motor for a control of 1 [N], which is what the commands are in.
        latency_s: Time from a command to its force [s].
        recording: The recording.
        at: Index of the start.
        samples: Number of periods.
    """
    data = mujoco.MjData(model)
    data.qpos, data.qvel = start_state(recording, at)
    steps = round(PERIOD_S / model.opt.timestep)
    acts_s = recording.command_s + latency_s
    found = np.empty((samples, 2))
    for k in range(samples * steps):
        now_s = at * PERIOD_S + k * PERIOD_S / steps
        row = max(int(np.searchsorted(acts_s, now_s + 1e-9, side="right")) - 1, 0)
        data.ctrl[0] = recording.force_n[row] / full_n
        mujoco.mj_step(model, data)
        if (k + 1) % steps == 0:
            found[k // steps] = data.qpos
    return found


def errors(
    model: mujoco.MjModel | None, full_n: float, latency_s: float, recording: Recording, window_s: float
) -> FloatArray:
    """Return the root mean square error of cart [mm] and pole [mrad], (2,); without a model nothing moves."""
    samples = round(window_s / PERIOD_S)
    differences = []
    for at in starts(recording, samples):
        truth = recording.position[at + 1 : at + samples + 1]
        if model is None:
            predicted = np.tile(start_state(recording, int(at))[0], (samples, 1))
        else:
            predicted = predict(model, full_n, latency_s, recording, int(at), samples)
        differences.append(predicted - truth)
    return np.asarray(1e3 * np.sqrt(np.nanmean(np.concatenate(differences) ** 2, axis=0)))


def scores(
    model: mujoco.MjModel | None, full_n: float, latency_s: float, recording: Recording
) -> dict[str, list[float]]:
    """Return the errors over each length of window: cart [mm], pole [mrad]."""
    return {
        f"{window_s:g}": errors(model, full_n, latency_s, recording, window_s).round(3).tolist()
        for window_s in WINDOWS_S
    }


def page(
    folder: Path, files: list[Path], left_out: Path, window_s: float, full_n: float
) -> dict[str, list[float]]:
    """Fit windows [s] of all recordings but one by one page of least squares, and predict that one."""
    work = calibration_input(
        FilesSettings(
            model=folder / "cartpole.xml",
            data=tuple(path for path in files if path != left_out),
            holdout=(left_out,),
            columns=folder / "columns.yaml",
        )
    )
    # Whole recordings: its windows must not end where ours were cut.
    problem = Problem(work.robot, work.space, joined(work.episodes), threads=1)
    theta, latency_s = one_page.fit(problem, window_s)
    model = model_with(work.robot, work.space, theta)
    return scores(model, full_n, latency_s, read(left_out))


def fold(
    folder: Path,
    files: list[Path],
    left_out: Path,
    seed: int,
    search: Search | None = None,
    windows_s: Sequence[float] = (),
) -> dict[str, Any]:
    """Calibrate on all recordings but one, with the default's search or another, and predict that one.

    ``windows_s`` are the windows of pages of least squares for comparison [s].
    """
    nominal = mujoco.MjModel.from_xml_path(str(folder / "cartpole.xml"))
    full_n = float(nominal.actuator_gear[0, 0] * nominal.actuator_gainprm[0, 0])
    began, cpu = time.monotonic(), time.process_time()
    found = deal_hw.calibrate(
        model=folder / "cartpole.xml",
        data=[path for path in files if path != left_out],
        holdout=[left_out],
        columns=folder / "columns.yaml",
        search=search,
        seed=seed,
        threads=1,
        say=lambda text: print(f"  {text}", flush=True),
    )
    seconds, processor_s = time.monotonic() - began, time.process_time() - cpu
    calibrated = found.save_model(folder / f"calibrated-without-{left_out.stem}.xml")
    print(found.table(), flush=True)
    recording = read(left_out)
    model = mujoco.MjModel.from_xml_path(str(calibrated))
    pages = {f"page {window_s:g}": page(folder, files, left_out, window_s, full_n) for window_s in windows_s}
    return {
        "left_out": left_out.stem,
        **pages,
        "calibrated": scores(model, full_n, found.result.latency_s, recording),
        "nominal": scores(nominal, full_n, 0.0, recording),
        "nothing_moves": scores(None, full_n, 0.0, recording),
        "latency_s": found.result.latency_s,
        "parameters": {row["parameter"]: row["estimate"] for row in found.rows()},
        "search": found.result.provenance.get("search"),
        "colour": found.colour,
        "alarms": [alarm.means for alarm in found.result.alarms],
        "seconds": round(seconds, 1),
        "processor_seconds": round(processor_s, 1),
    }


def medians(rows: list[dict[str, Any]]) -> dict[str, dict[str, list[float]]]:
    """Return the median over recordings of each figure."""
    return {
        who: {
            f"{window_s:g}": np.median([row[who][f"{window_s:g}"] for row in rows], axis=0).tolist()
            for window_s in WINDOWS_S
        }
        for who in rows[0]
        if isinstance(rows[0][who], dict) and "0.2" in rows[0][who]
    }


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("folder", type=Path, help="of tools/convert_cartpole.py")
    made.add_argument("--leave-out", nargs="*", default=[], help="names of recordings; default: each one")
    made.add_argument("--search", choices=get_args(Search), help="search of the calibration")
    made.add_argument("--page", type=float, nargs="*", default=[], help="windows of the page's fits [s]")
    made.add_argument("--seed", type=int, default=0)
    options = made.parse_args(arguments)
    files = sorted(options.folder.glob("*.npz"))
    if len(files) < 2:
        made.error(f"{options.folder} holds {len(files)} recordings (*.npz); two or more are needed")
    unknown = set(options.leave_out) - {path.stem for path in files}
    if unknown:
        made.error(f"no recording {', '.join(sorted(unknown))}; here are {', '.join(p.stem for p in files)}")
    result: dict[str, Any] = {**head(__file__, dated=True), "rows": []}
    for path in files:
        if options.leave_out and path.stem not in options.leave_out:
            continue
        row = fold(options.folder, files, path, options.seed, options.search, options.page)
        result["rows"].append(row)
        print(json.dumps({k: row[k] for k in ("left_out", "calibrated", "processor_seconds")}), flush=True)
        result["median"] = medians(result["rows"])
        write_document(options.out, result)
    print(json.dumps(result["median"], indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
