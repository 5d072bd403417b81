"""Measure how often a Go2's policy gets onto a platform, steps or a slope, in the batched environment.

    python tools/measure_go2_climb.py --seeds 0 --out climb.json
    python tools/measure_go2_climb.py --policy runs/climb/policies/policy.onnx --blind --heights 0.1 0.15 0.2
    python tools/measure_go2_climb.py --terrain slope --heights 0.1 0.2 0.3

The robots differ as in training (uniform domain randomisation, floor, payload, encoders, latency), and each
stands at another distance before its terrain. They are requested to walk ahead at 0.6 m/s for 6 s, and as
much longer as that takes along steps or a slope, behind the safety filter of deploying. A try succeeds if all
four feet were on the platform at once, on the last step, or on the platform behind the slope, and the robot
did not fall. Distance and height (of steps that of one) are told, or with --blind not; nobody tells of a
slope, and the shipped walk, the default, takes neither. A row is one height [m], or angle of a slope [rad],
and seed. Intervals are exact binomial ones of 95 %. `scuffs_per_try` is how often a leg came to press against
a front.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

from measuring import Row, Rows, add_seeds, parser

from deal_hw.bench.go2_tasks import climbs
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.sim.legged.terrain import Kind
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import udr_distribution


def measure(policy: Any, kind: Kind, rise: float, seed: int, tries: int, *, blind: bool) -> Row:
    """Return the row of one terrain.

    Args:
        policy: The policy; it need not observe the platform.
        kind: Kind of the terrain.
        rise: Height of the platform or of one step [m], or angle of the slope [rad].
        seed: Seeds the robots, their distances and the noise.
        tries: Number of robots.
        blind: Whether the robots are told nothing.
    """
    # Slow to load, and the test of this tool is collected with all others.
    from scipy.stats import binomtest

    told = any(term.quantity == "obstacle" for term in policy.spec.observation)
    done = climbs(policy, udr_distribution("go2", "climb"), rise, seed, tries, blind=blind, kind=kind)
    interval = binomtest(done.climbed, tries).proportion_ci()
    return {
        "terrain": kind,
        "slope_rad" if kind == "slope" else "height_m": rise,
        "seed": seed,
        "told": told and not blind and kind != "slope",
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
    options.add_argument("--terrain", choices=get_args(Kind), default="box")
    options.add_argument(
        "--heights",
        type=float,
        nargs="+",
        default=[0.04, 0.06, 0.08, 0.1, 0.15],
        help="of the platform or of one step [m]; angles of a slope [rad]",
    )
    options.add_argument("--tries", type=int, default=50)
    options.add_argument("--blind", action="store_true", help="tell the robots nothing")
    add_seeds(options, 0)
    args = options.parse_args()
    policy = OnnxPolicy(args.policy)
    rows = Rows(__file__, args.out)
    for seed in args.seeds:
        for height in args.heights:
            rows.add(measure(policy, args.terrain, height, seed, args.tries, blind=args.blind))


if __name__ == "__main__":
    main()
