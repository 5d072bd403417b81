"""Makes mjlab's actuator settings from actuators.yaml."""

from __future__ import annotations

import sys
from pathlib import Path

import yaml
from mjlab.actuator import BuiltinPositionActuatorCfg


def main(path: Path) -> None:
    """Make a position actuator of each row."""
    rows = yaml.safe_load(path.read_text(encoding="utf-8"))["mjlab"]["actuators"]
    made = [
        BuiltinPositionActuatorCfg(**{**row, "target_names_expr": tuple(row["target_names_expr"])})
        for row in rows
    ]
    print(f"{len(made)} actuators, {[cfg.delay_max_lag for cfg in made]} steps late")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
