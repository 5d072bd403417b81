"""Requested velocities of the Go2 over time, for demo and bench, and their file for ``--velocity``."""

from __future__ import annotations

from collections.abc import Mapping
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


CANTER: Final = Walk(
    (
        (0.0, (0.0, 0.0, 0.0)),
        (2.0, (1.0, 0.0, 0.0)),
        (6.0, (1.4, 0.0, 0.0)),
        (10.0, (0.8, 0.0, 0.4)),
        (13.5, (0.8, 0.0, -0.4)),
    ),
    17.0,
)
"""The canter of every policy."""
CANTER_HELDOUT: Final = Walk(
    ((0.0, (0.0, 0.0, 0.0)), (1.0, (0.6, 0.0, 0.0)), (4.0, (1.2, 0.0, 0.2)), (6.0, (0.5, 0.0, -0.3))), 8.0
)
APPROACH: Final = Walk(
    (
        (0.0, (0.0, 0.0, 0.0)),
        (2.0, (0.8, 0.0, 0.0)),
        (7.0, (0.5, 0.0, 0.3)),
        (12.0, (0.6, 0.0, -0.3)),
    ),
    17.0,
)
"""What a robot that climbs walks for its calibration, on the flat floor: contacts with a platform are not in
the calibration's model."""
APPROACH_HELDOUT: Final = Walk(
    ((0.0, (0.0, 0.0, 0.0)), (1.0, (0.5, 0.0, 0.0)), (4.0, (0.7, 0.0, 0.2)), (6.0, (0.4, 0.0, -0.2))), 8.0
)
WALKS: Final[Mapping[str, tuple[Walk, Walk]]] = {
    "walk": (Walk(PROFILE, PROFILE_S), Walk(HELDOUT, HELDOUT_S)),
    "canter": (CANTER, CANTER_HELDOUT),
    "climb": (APPROACH, APPROACH_HELDOUT),
}
"""By task: the walk to calibrate from, and the one that judges the calibration."""


def write_script(path: Path, script: Script) -> Path:
    """Write velocities as ``deploy --velocity`` reads them; return the file."""
    rows = [",".join(f"{value:g}" for value in (time_s, *velocity)) for time_s, velocity in script]
    path.write_text("\n".join(("time_s,x,y,yaw", *rows)) + "\n", encoding="utf-8")
    return path
