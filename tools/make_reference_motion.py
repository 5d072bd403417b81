"""Make the motion that trainer `amp` imitates: a policy of ours on the nominal robot, in the simulator.

    python tools/make_reference_motion.py --out policies/assets/go2_canter_motion.npz

Some robots follow commands that are drawn as in the training of the canter, without noise, pushes, payload
or latency. The first seconds, in which they begin to move, are left out. The file has one piece a robot.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Final

import numpy as np

from deal_hw.policies.canter_env import REFERENCE, CanterEnv, CanterTask
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.reference_motion import ReferenceMotion
from deal_hw.robots import recorded_description
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import nominal_distribution

BEGIN_S: Final = 2.0


def clean_task(seconds: float) -> CanterTask:
    """Return the canter without noise, pushes and other floors; each robot keeps its command."""
    return dataclasses.replace(
        CanterTask(),
        ticks=round((BEGIN_S + seconds) * 50.0) + 1,
        command_ticks=10**9,
        push_ticks=10**9,
        friction=(0.8, 0.8),
        payload_kg=(0.0, 0.0),
        host_delay_s=(0.0, 0.0),
        encoder_bias_rad=0.0,
        orientation_noise_rad=0.0,
        gyro_noise_rad_s=0.0,
        velocity_noise_rad_s=0.0,
    )


def reference(policy: OnnxPolicy, robots: int, seconds: float, seed: int) -> ReferenceMotion:
    """Return the motion of a policy.

    Args:
        policy: The policy.
        robots: Number of pieces.
        seconds: Length of each [s].
        seed: Seeds commands and starts.

    Raises:
        SystemExit: A robot fell.
    """
    description = recorded_description("go2")
    drawn = nominal_distribution("go2", "canter")
    env = CanterEnv(description, drawn, robots, task=clean_task(seconds))
    env.observe_for(policy.spec)
    seen, _ = env.reset(seed=seed)
    rows = []
    for tick in range(env.ticks - 1):
        if tick >= BEGIN_S * description.control_rate_hz:
            rows.append(env.motion())
        seen, _, terminated, _, _ = env.step(policy.act_batch(seen))
        if terminated.any():
            raise SystemExit(f"robot {int(terminated.argmax())} fell after {tick} control periods")
    values = np.stack(rows, axis=1)
    return ReferenceMotion(
        names=env.motion_names(),
        rate_hz=description.control_rate_hz,
        starts=tuple(range(0, values.shape[0] * values.shape[1], values.shape[1])),
        values=values.reshape(-1, values.shape[2]),
    )


def main() -> None:
    """Make the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, default=required_policy("go2", "canter"))
    parser.add_argument("--robots", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=REFERENCE)
    given = parser.parse_args()
    found = reference(OnnxPolicy(given.policy), given.robots, given.seconds, given.seed)
    found.write(given.out)
    print(
        f"{len(found.values)} rows of {len(found.names)} features in {len(found.starts)} pieces: {given.out}"
    )


if __name__ == "__main__":
    main()
