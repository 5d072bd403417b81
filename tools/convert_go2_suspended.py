r"""Convert the public recording of a suspended Unitree Go2 into an NPZ file and its column map.

The recording is datasets/go2/traj_0.pt of iit-DLSLab/sim2real-robot-identification (BSD-3-Clause) at commit
06739ea. The base is held in the air. All twelve joints are under PD control by the robot's own drivers: kp 20
and kd 1.5 in that project's configuration. There are position set-points and 200 samples a second. Its keys
are time (T) [s], dof_pos and des_dof_pos (T, 12) [rad]. Columns are leg by leg FL, FR, RL, RR, in each leg
hip, thigh, calf (that project's collecting script).

Fetch it and convert it:

    git clone https://github.com/iit-DLSLab/sim2real-robot-identification
    python tools/convert_go2_suspended.py sim2real-robot-identification/datasets/go2/traj_0.pt --out go2

then check it, and import it for a model of the Go2 whose base is fixed:

    deal-hw data import go2/traj_0.npz --columns go2/columns.yaml --model go2_suspended.xml \
        --out runs/go2/dataset

Keep the licence text of the source beside the converted file when you pass it on.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np

KEYS = ("time", "dof_pos", "des_dof_pos")
JOINTS = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
COLUMNS = """\
# Suspended Go2 of iit-DLSLab/sim2real-robot-identification (BSD-3-Clause): meaning of the arrays in the NPZ.
# Leg by leg as its collecting script writes them; the hips of the right legs are commanded against the left.
time: time
position: dof_pos
target: des_dof_pos
unit: rad
joints:
"""


def convert(source: Path, out: Path, parts: int = 1, seconds: float = np.inf) -> list[Path]:
    """Write the NPZ files and the column map and return the paths of the former.

    Args:
        source: The torch file.
        out: Folder to write to.
        parts: Number of parts of equal length to write, so that any of them can be held out.
        seconds: The recording up to this time is taken [s].

    Raises:
        SystemExit: The file has other contents than its source describes.
    """
    import torch

    # weights_only, because a torch file is a pickle and could otherwise run any code.
    data = torch.load(source, map_location="cpu", weights_only=True)
    if not isinstance(data, dict) or any(key not in data for key in KEYS):
        raise SystemExit(f"{source} has no {', '.join(KEYS)}; it is not a recording of that project")
    arrays = {key: np.asarray(data[key].numpy(), dtype=np.float64) for key in KEYS}
    shapes = {key: values.shape for key, values in arrays.items()}
    count = arrays["time"].shape[0]
    if shapes != {"time": (count,), "dof_pos": (count, 12), "des_dof_pos": (count, 12)}:
        raise SystemExit(f"{source} has the shapes {shapes}, expected (T,), (T, 12), (T, 12)")
    count = int(np.count_nonzero(arrays["time"] - arrays["time"][0] <= seconds))
    out.mkdir(parents=True, exist_ok=True)
    edges = np.linspace(0, count, parts + 1).round().astype(int)
    paths = []
    for number, (first, last) in enumerate(itertools.pairwise(edges), start=1):
        paths.append(out / (f"{source.stem}_part{number}.npz" if parts > 1 else f"{source.stem}.npz"))
        rows: dict[str, Any] = {key: values[first:last] for key, values in arrays.items()}
        np.savez_compressed(paths[-1], joint_names=np.array(JOINTS), **rows)
    lines = "".join(f"  - {joint}\n" for joint in JOINTS)
    (out / "columns.yaml").write_text(COLUMNS + lines, encoding="utf-8")
    return paths


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, help="datasets/go2/traj_0.pt of the source project")
    parser.add_argument("--out", type=Path, required=True, help="folder for traj_0.npz and columns.yaml")
    parser.add_argument(
        "--parts", type=int, default=1, help="number of equal parts to write, to hold one of them out"
    )
    parser.add_argument(
        "--seconds", type=float, default=np.inf, help="take the recording up to this time [s] (default: all)"
    )
    options = parser.parse_args(arguments)
    if options.parts < 1:
        parser.error(f"--parts must be at least 1, got {options.parts}")
    if not options.seconds > 0:
        parser.error(f"--seconds must be above 0, got {options.seconds:g}")
    for path in convert(options.source, options.out, options.parts, options.seconds):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
