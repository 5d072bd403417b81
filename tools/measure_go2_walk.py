"""Measure how well a policy walks the emulated Go2 behind the safety filter, in virtual time.

    python tools/measure_go2_walk.py --profile realistic --seeds 0 1 2
    python tools/measure_go2_walk.py --policy runs/train/policies/policy.onnx --rounds 35

Driver, wire format, filter, safety checks and control loop are those of `deal-hw deploy go2`; only time is
virtual, so a busy machine does not change the result. A round stands for 2 s, then commands 1 m/s ahead, 0.5
m/s to the left and a turn of 1 rad/s, 5 s each. Errors are against the emulator's true motion: mean velocity
in the base's heading over one step of the gait, from 1 s after each change of the command on.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.bench.rows import describe_call
from deal_hw.control.velocity_error import velocity_error
from deal_hw.drivers.go2.emulator.profiles import PROFILES
from deal_hw.drivers.go2.emulator.truth import draw_truth, nominal_truth
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.types import FloatArray, RobotState
from deal_hw.workflows.emulation.virtual_go2 import walk
from deal_hw.workflows.emulation.walk_script import PROFILE, PROFILE_S
from deal_hw.workflows.shipped import shipped_policy

NAMES = ("stand", "ahead", "left", "turn")
"""Durations of the profile's parts."""


class Rounds:
    """The profile, repeated."""

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity of the present part."""
        part = np.searchsorted([begin for begin, _ in PROFILE], time_s % PROFILE_S, side="right") - 1
        return np.array(PROFILE[int(part)][1])


def measure(policy: OnnxPolicy, profile: str, seed: int | None, rounds: int) -> dict[str, Any]:
    """Walk some rounds with one robot.

    Args:
        policy: The policy.
        profile: The emulator's profile.
        seed: Seed of its hidden parameters; None: the nominal ones.
        rounds: Number of rounds.

    Returns:
        Plain JSON values: end of the run, clipped commands, and mean errors by part [m/s, rad/s].
    """
    truth = nominal_truth(profile) if seed is None else draw_truth(profile, seed)
    done = walk(truth, policy, Rounds(), rounds * PROFILE_S, record=False)
    row: dict[str, Any] = {
        "profile": profile,
        "seed": seed,
        "seconds": rounds * PROFILE_S,
        "outcome": done.report.outcome.value,
        "reason": done.report.reason,
        "clipped": done.report.clipped,
        "cycles": done.report.cycles_sent,
    }
    error = None if done.wanted is None else velocity_error(done.track, done.wanted)
    if error is not None:
        columns = ("velocity_error", "yaw_error", "ahead", "left", "turn")
        wanted = {
            ",".join(f"{v:g}" for v in velocity): name
            for name, (_, velocity) in zip(NAMES, PROFILE, strict=True)
        }
        row |= {
            "velocity_error_m_s": round(error.velocity_m_s, 4),
            "yaw_error_rad_s": round(error.yaw_rad_s, 4),
            "parts": {wanted[k]: dict(zip(columns, v, strict=True)) for k, v in error.parts.items()},
        }
    return row


def main() -> None:
    """Walk as the command line says; print a row for each robot."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, default=shipped_policy("go2"))
    parser.add_argument("--profile", choices=sorted(PROFILES), default="realistic")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0], help="none: the nominal robot")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--out", type=Path, help="write the rows to this JSON file, too")
    args = parser.parse_args()
    policy = OnnxPolicy(args.policy)
    rows = []
    for seed in args.seeds or [None]:
        rows.append(measure(policy, args.profile, seed, args.rounds))
        print(json.dumps(rows[-1]), flush=True)
    if args.out is not None:
        document = {**describe_call(f"tools/{Path(__file__).name}"), "policy": policy.digest, "rows": rows}
        args.out.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
