"""Requested velocities of the Go2 over time, for demo and bench, and their file for ``--velocity``."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

Script = tuple[tuple[float, tuple[float, float, float]], ...]
PROFILE: Final = (
    (0.0, (0.0, 0.0, 0.0)),
    (2.0, (1.0, 0.0, 0.0)),
    (7.0, (0.0, 0.5, 0.0)),
    (12.0, (0.0, 0.0, 1.0)),
)
"""The walk of every policy: time [s], velocity ahead and to the left [m/s], turn [rad/s]."""
PROFILE_S: Final = 17.0
HELDOUT: Final = (
    (0.0, (0.0, 0.0, 0.0)),
    (1.0, (0.5, 0.0, 0.0)),
    (4.0, (0.3, 0.0, 0.3)),
    (6.0, (0.0, -0.2, 0.0)),
)
"""The held-out walk, for testing the calibration. It is gentle: otherwise every second robot falls."""
HELDOUT_S: Final = 8.0


class Walk(NamedTuple):
    """Requested velocities over time, and how long they are followed [s]."""

    parts: Script
    seconds: float


def write_script(path: Path, script: Script) -> Path:
    """Write velocities as ``deploy --velocity`` reads them; return the file."""
    rows = [",".join(f"{value:g}" for value in (time_s, *velocity)) for time_s, velocity in script]
    path.write_text("\n".join(("time_s,x,y,yaw", *rows)) + "\n", encoding="utf-8")
    return path
