#!/usr/bin/env python3
"""Which errors of an import does the walk in the simulator find?

    python tools/measure_policy_import.py --out policy_import.json
    python tools/measure_policy_import.py --policies shipped walk.onnx other.onnx --seeds 1000,1001

Each policy of a Go2 walks as it is, and with each error of `fakes/wrong_policy.py`: exchanged legs and wrong
signs. A row has the faults that `deal-hw policy import` would find, the time up, and the share of each
command that was followed. A sound policy should have none, each error at least one.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from fakes.wrong_policy import ERRORS
from measuring import Row, Rows, add_seeds, parser

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.walking_trial import TriedPolicy, WalkingTrial, try_walking
from deal_hw.workflows.shipped import required_policy

SOUND = ""
"""Name of no error."""


def measure(policy: TriedPolicy, name: str, mistake: str, trial: WalkingTrial) -> Row:
    """Return the row of a policy with a mistake."""
    report = try_walking(policy, DRIVER, trial)
    return {
        "policy": name,
        "mistake": mistake,
        "seed": trial.seed,
        "faults": len(report.faults()),
        "up": [round(walk.up, 3) for walk in report.walks],
        "followed": [round(walk.followed, 3) for walk in report.walks if any(walk.command)],
        "clipped": round(report.clipped, 3),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script."""
    made = parser(__doc__)
    made.add_argument("--policies", nargs="+", default=["shipped"], help="files (.onnx), or shipped")
    made.add_argument("--errors", nargs="+", default=list(ERRORS), choices=list(ERRORS), help="of the import")
    made.add_argument("--seconds", type=float, default=WalkingTrial().seconds, help="length of a walk [s]")
    made.add_argument("--robots", type=int, default=WalkingTrial().robots, help="robots for each command")
    add_seeds(made, 1000)
    options = made.parse_args(arguments)
    rows = Rows(__file__, options.out)
    for source in options.policies:
        policy = OnnxPolicy(required_policy("go2") if source == "shipped" else Path(source))
        name = source if source == "shipped" else Path(source).stem
        for seed in options.seeds:
            trial = WalkingTrial(seconds=options.seconds, robots=options.robots, seed=seed)
            rows.add(measure(policy, name, SOUND, trial))
            for mistake in options.errors:
                rows.add(measure(ERRORS[mistake](policy), name, mistake, trial))
    found = [row for row in rows.rows if row["mistake"]]
    caught = sum(bool(row["faults"]) for row in found)
    refused = sum(bool(row["faults"]) for row in rows.rows if not row["mistake"])
    print(f"{caught} of {len(found)} errors found; {refused} sound policies refused")
    return 0


if __name__ == "__main__":
    sys.exit(main())
