r"""Convert public recordings of an SO-101 arm into NPZ files and their column map.

The recordings are output/real/so101/custom/<motion>/ of isaac-sim2real/sage (Apache-2.0) at commit 4ffd262: a
real arm of six Feetech STS3215 servos in position mode, about fifty motions at 49.85 samples a second. In
each folder:

    control.csv      type, timestamp [us], positions: a list of six commanded positions in one cell
    state_motor.csv  type, timestamp [us], positions, velocities, torques: lists of six

Joints, in that order: Rotation, Pitch, Elbow, Wrist_Pitch, Wrist_Roll, Jaw. Angles are in rad, zero in the
middle of the calibrated travel; the Jaw is not an angle but 0..1 of its travel, 1524 of the servo's 4096
ticks a turn. Torques are the servo's load estimate without a unit. A command is written and the state read
right after, under one stamp.

Fetch and convert:

    git clone https://github.com/isaac-sim2real/sage
    python tools/convert_so101.py sage/output/real/so101/custom --out so101 --motions multisine

then import for a model with the joint names of mujoco_menagerie (shoulder_pan, ...). Check signs and zeros
against your model: under P control gravity makes a joint sag, and the model's joint must sag, too.

    deal-hw data import so101/multisine.npz --columns so101/columns.yaml --model so101.xml \
        --out runs/so101/dataset

Keep the licence text of the source beside the converted files when you pass them on.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np

from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.csv_source import read_csv
from deal_hw.errors import DealHwError

RECORDED = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
MODEL = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
JAW_CLOSED_RAD = -0.174533
JAW_TRAVEL_RAD = 1524 * 2 * math.pi / 4096
COLUMNS = """\
# SO-101 of isaac-sim2real/sage (Apache-2.0): meaning of the arrays in the NPZ files.
# Signs (1 or -1) and offsets [rad] against your model are not known: check them before you trust a fit.
time: time
command_time: command_time
position: position
target: position_target
velocity: velocity
effort: torque
joints:
"""


def convert(folder: Path, out: Path) -> Path:
    """Write one motion as an NPZ file and return its path.

    Args:
        folder: Of one motion: with control.csv and state_motor.csv.
        out: Folder to write to.

    Raises:
        DealHwError: A file is missing or has other content.
    """
    control, state = read_csv(folder / "control.csv"), read_csv(folder / "state_motor.csv")
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{folder.name}.npz"
    np.savez_compressed(
        path,
        joint_names=np.array(RECORDED),
        time=state.column("timestamp") * 1e-6,
        position=_six(state, "positions"),
        velocity=_six(state, "velocities"),
        torque=_six(state, "torques"),
        command_time=control.column("timestamp") * 1e-6,
        position_target=_six(control, "positions"),
    )
    return path


def column_map() -> str:
    """Return the column map of all motions, YAML."""
    lines = [
        f"  - {{name: {model}, column: {recorded}, sign: 1, offset: 0.0}}\n"
        for model, recorded in zip(MODEL[:-1], RECORDED[:-1], strict=True)
    ]
    opened = JAW_CLOSED_RAD + JAW_TRAVEL_RAD
    scale = f"{{from: [0, 1], to: [{JAW_CLOSED_RAD:.6f}, {opened:.6f}]}}"
    return (
        COLUMNS + "".join(lines) + f"  - {{name: {MODEL[-1]}, column: {RECORDED[-1]}, normalised: {scale}}}\n"
    )


def _six(channels: Channels, name: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    values = channels.array(name)
    if values.ndim != 2 or values.shape[1] != len(RECORDED):
        raise DealHwError(f"{channels.path}: {name} has shape {values.shape}, expected six values a cell")
    return values


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, help="output/real/so101/custom of the source project")
    parser.add_argument("--out", type=Path, required=True, help="folder for <motion>.npz and columns.yaml")
    parser.add_argument("--motions", nargs="*", default=[], help="motions to convert; default: all")
    options = parser.parse_args(arguments)
    found = sorted(path.parent.name for path in options.source.glob("*/state_motor.csv"))
    if not found:
        print(f"{options.source} holds no <motion>/state_motor.csv", file=sys.stderr)
        return 1
    try:
        for motion in options.motions or found:
            print(convert(options.source / motion, options.out))
    except DealHwError as error:
        print(f"error: {error}; motions here: {', '.join(found)}", file=sys.stderr)
        return 1
    (options.out / "columns.yaml").write_text(column_map(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
