"""Makes the shipped policy of the cart-pole, trained under uniform domain randomisation.

    python tools/train_udr_policy.py

writes policies/assets/cartpole_udr.onnx and, beside it, the record of its training and its results on the
hidden robots of the tuning seeds. Steps and settings are those of `deal-hw train`, because policies are
compared at equal steps and settings. Of several training seeds the one that balances most robots is kept. A
user who trains under a calibrated distribution uses one seed only, so the choice favours this policy.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.policies.demonstration import BatchPolicy
from deal_hw.policies.evaluate import evaluate_batch
from deal_hw.workflows.train import train_policy, udr_distribution

ASSETS = Path(__file__).parents[1] / "policies" / "assets"
ROBOTS = 30
START_ANGLE_RAD = 0.03
HOST_DELAY_S = 0.003


def judge(policy: BatchPolicy) -> dict[str, Any]:
    """Return how the policy balances the robots of seeds 0 to 29 in profile `sensor`."""
    space = k9_space()
    truths = [draw_truth("sensor", seed) for seed in range(ROBOTS)]
    theta = np.array([[truth.parameters[name] for name in space.names] for truth in truths])
    latency_s = np.array([truth.latency_s for truth in truths]) + HOST_DELAY_S
    rng = np.random.default_rng(0)
    start = np.zeros((ROBOTS, 2))
    start[:, 1] = rng.uniform(-START_ANGLE_RAD, START_ANGLE_RAD, ROBOTS)
    results = evaluate_batch(policy, DESCRIPTION, space, theta, latency_s, rng, start_position=start)
    return {
        "robots": ROBOTS,
        "balanced_10_s": sum(not r.fell for r in results),
        "balanced_1_s": sum(r.upright_s >= 1.0 for r in results),
        "angle_error_rad": [round(r.angle_error_rad, 5) for r in results],
        "angle_error_rad_median": float(np.median([r.angle_error_rad for r in results])),
        "upright_s": [round(r.upright_s, 2) for r in results],
    }


def main() -> None:
    """Train, judge, keep the best."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2], help="training seeds to choose from"
    )
    parser.add_argument("--out", type=Path, default=ASSETS / "cartpole_udr.onnx")
    args = parser.parse_args()
    best: tuple[tuple[int, float], Path, dict[str, Any]] | None = None
    with tempfile.TemporaryDirectory() as folder:
        for seed in args.seeds:
            path = Path(folder) / f"{seed}.onnx"
            result = judge(train_policy("cartpole", udr_distribution("cartpole"), path, seed=seed))
            print(f"seed {seed}: {result}", flush=True)
            rank = (result["balanced_10_s"], -result["angle_error_rad_median"])
            if best is None or rank > best[0]:
                best = (rank, path, result)
        if best is None:
            raise SystemExit("give at least one seed")
        _, path, result = best
        record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        record["evaluation"] = {**result, "profile": "sensor", "training_seeds_tried": args.seeds}
        shutil.copy(path, args.out)
        text = json.dumps(record, indent=1, sort_keys=True)
        args.out.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
