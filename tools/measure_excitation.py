"""Effect of an excitation on the calibration: error and interval width on emulated cart-poles.

Each robot is recorded once with each excitation, and calibrated by the default method; K9, range ratio 5.

    deal-hw design-excitation cartpole --out excitation.json
    python tools/measure_excitation.py --seeds 0,1,2 --excite rich,multisine,excitation.json --out rows.json
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.bench.rows import write_rows
from deal_hw.calibration import Budget
from deal_hw.control.excitation_plan import FAMILIES, read_plan
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.oracle import draw_truth
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align
from deal_hw.workflows.calibration.run import calibrate_episodes
from deal_hw.workflows.emulation.virtual import VirtualCartpole
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.shipped import shipped_policy

RANGE_RATIO = 5.0


def plan_of(name: str, seconds: float, seed: int) -> RunPlan:
    """Return the run of an excitation: `rich`, a family's name, or a file."""
    policy = str(shipped_policy("cartpole") or "")
    if name == "rich":
        return RunPlan(robot="cartpole", motion="rich", policy=policy, seconds=seconds, seed=seed)
    length = seconds if name in FAMILIES else read_plan(Path(name)).seconds
    return RunPlan(robot="cartpole", motion="excite", excite=name, policy=policy, seconds=length, seed=seed)


def measure(profile: str, seed: int, name: str, seconds: float, threads: int | None) -> dict[str, Any]:
    """Record one robot with one excitation, calibrate, compare with the truth."""
    truth = draw_truth(profile, seed, range_ratio=RANGE_RATIO)
    space = k9_space().with_ratio(RANGE_RATIO)
    plan = plan_of(name, seconds, seed)
    run = VirtualCartpole(truth).run(make_behaviour(plan, DESCRIPTION), plan.seconds)
    row: dict[str, Any] = {
        "profile": profile,
        "seed": seed,
        "excite": name,
        "seconds_recorded": plan.seconds,
        "outcome": run.report.outcome.value,
        "reason": run.report.reason,
        "clipped": dict(run.report.clipped),
    }
    if run.report.outcome.value != "finished":
        return row
    begin = time.perf_counter()
    result = calibrate_episodes(
        load_model(DESCRIPTION),
        space,
        [align(run.trajectory, DESCRIPTION)],
        [],
        method="default",
        budget=Budget(),
        rng=np.random.default_rng(seed),
        threads=threads,
    )
    theta = np.array([truth.parameters[p] for p in space.names])
    error = np.abs(result.estimate / theta - 1)
    width = np.log(result.interval[:, 1] / result.interval[:, 0])
    inside = (result.interval[:, 0] <= theta) & (theta <= result.interval[:, 1])
    return row | {
        "error_percent": float(100 * error.mean()),
        "width_percent": float(100 * width.mean()),
        "width_geometric_percent": float(100 * np.exp(np.log(width).mean())),
        "coverage90": float(inside.mean()),
        "chi2": result.chi2,
        "alarms": [str(alarm) for alarm in result.alarms],
        "per_parameter": {
            p: {"error_percent": float(100 * error[k]), "width_percent": float(100 * width[k])}
            for k, p in enumerate(space.names)
        },
        "seconds": time.perf_counter() - begin,
    }


def main() -> None:
    """Measure and print one line a row."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--profile", default="sensor")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--excite", default="rich,multisine,chirp", help="rich, a family's name, or a file")
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--out", type=Path, default=None)
    given = parser.parse_args()
    rows = []
    for seed in map(int, given.seeds.split(",")):
        for name in given.excite.split(","):
            row = measure(given.profile, seed, name, given.seconds, given.threads)
            rows.append(row)
            numbers = ("error_percent", "width_percent", "width_geometric_percent", "coverage90", "chi2")
            text = " ".join(f"{key} {row[key]:.3g}" for key in numbers if key in row)
            print(f"seed {seed} {name}: {row['outcome']} {text or row['reason']}", flush=True)
            if given.out is not None:
                write_rows(given.out, rows, program=f"tools/{Path(__file__).name}")


if __name__ == "__main__":
    main()
