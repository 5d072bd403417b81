"""Measure how often a Go2's policy gets onto a platform, by its height, in the batched environment.

    python tools/measure_go2_climb.py --seeds 0 --out climb.json
    python tools/measure_go2_climb.py --policy runs/climb/policies/policy.onnx --blind --heights 0.1 0.15 0.2

The robots differ as in training (uniform domain randomisation, floor, payload, encoders, latency), and each
stands at another distance before its platform. They are requested to walk ahead at 0.6 m/s for 6 s, behind
the safety filter of deploying. A try succeeds if all four feet were on the platform at once and the robot did
not fall. Distance and height are told, or with --blind not; the shipped walk, the default, takes neither. A
row is one height and seed. Intervals are exact binomial ones of 95 %. `scuffs_per_try` is how often a leg
came to press against the platform's front.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from measuring import Row, Rows, add_seeds, parser

from deal_hw.bench.go2_tasks import climbs
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import udr_distribution


def measure(policy: Any, height: float, seed: int, tries: int, *, blind: bool) -> Row:
    """Return the row of one height.

    Args:
        policy: The policy; it need not observe the platform.
        height: Of the platform [m].
        seed: Seeds the robots, their distances and the noise.
        tries: Number of robots.
        blind: Whether the robots are told nothing.
    """
    # Slow to load, and the test of this tool is collected with all others.
    from scipy.stats import binomtest

    told = any(term.quantity == "obstacle" for term in policy.spec.observation)
    done = climbs(policy, udr_distribution("go2", "climb"), height, seed, tries, blind=blind)
    interval = binomtest(done.climbed, tries).proportion_ci()
    return {
        "height_m": height,
        "seed": seed,
        "told": told and not blind,
        "tries": tries,
        "climbed": done.climbed,
        "fell": done.fell,
        "scuffs_per_try": round(done.scuffs, 2),
        "torque_rms_nm": round(done.torque_nm, 2),
        "interval": [round(float(interval.low), 3), round(float(interval.high), 3)],
        "error": "",
    }


def main() -> None:
    """Climb as the command line says; print a row for each height."""
    options = parser(__doc__)
    options.add_argument("--policy", type=Path, default=required_policy("go2"))
    options.add_argument("--heights", type=float, nargs="+", default=[0.04, 0.06, 0.08, 0.1, 0.15])
    options.add_argument("--tries", type=int, default=50)
    options.add_argument("--blind", action="store_true", help="tell the robots nothing")
    add_seeds(options, 0)
    args = options.parse_args()
    policy = OnnxPolicy(args.policy)
    rows = Rows(__file__, args.out)
    for seed in args.seeds:
        for height in args.heights:
            rows.add(measure(policy, height, seed, args.tries, blind=args.blind))


if __name__ == "__main__":
    main()
