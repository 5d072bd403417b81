"""Converts an episode with rerun's MCAP importer, verifies the result and looks for plots in it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

PLOTS = ("/joint_states/position", "/joint_states/velocity", "/joint_commands/position")


def main(path: Path) -> None:
    """Run the importer and `rrd verify`; positions must have become scalars with names, tf transforms."""
    tool = str(Path(sys.executable).parent / "rerun")
    with tempfile.TemporaryDirectory() as folder:
        target = str(Path(folder) / "episode.rrd")
        subprocess.run([tool, "mcap", "convert", str(path), "-o", target], check=True, capture_output=True)
        subprocess.run([tool, "rrd", "verify", target], check=True, capture_output=True)
        printed = subprocess.run([tool, "rrd", "print", target], check=True, capture_output=True, text=True)
    lines = printed.stdout.splitlines()
    for entity in PLOTS:
        if not any(f" {entity} " in line and "Scalars:scalars" in line for line in lines):
            raise AssertionError(f"{entity} is no plot")
    if not any(" /tf " in line and "Transform3D" in line for line in lines):
        raise AssertionError("/tf is no transform")
    print(f"verified; {', '.join(PLOTS)} are plots, /tf is a transform")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
