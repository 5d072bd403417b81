"""Makes the shipped demonstration policies of ant and Go2, trained under uniform domain randomisation.

    python tools/train_demo_policy.py ant
    python tools/train_demo_policy.py go2

writes policies/assets/ROBOT_udr.onnx and, beside it, the record of its training and of what it can do with
robots that it has not seen. They are early checkpoints, made in minutes on one core: good enough to excite a
robot for calibration (the paper's Table 5 studies such ones), not good locomotion.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import inspect
import json
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.drivers import parameter_spaces, robot_description
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.ant_env import AntEnv
from deal_hw.policies.go2_env import Go2Env
from deal_hw.policies.locomotion import judge
from deal_hw.policies.onnx_export import export_network
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.sac import SacConfig, SacTrainer

ASSETS = Path(__file__).parents[1] / "policies" / "assets"
ENVIRONMENTS: dict[str, type[AntEnv] | type[Go2Env]] = {"ant": AntEnv, "go2": Go2Env}
UDR_RATIO = 5.0
LATENCY_S = (0.0, 0.02)
MEMBERS = 64
JUDGED = 256
JUDGE_SEED = 1_000_003
"""Robots, commands and starts that the policy is judged by are the draws of this seed, none of training's."""

COMMON = SacConfig(
    hidden=(128, 128), gradient_steps=8, batch=256, learning_rate=1e-3, final_learning_rate=3e-4,
    gamma=0.98, tau=0.02, entropy=0.1, warmup=5_000, buffer=500_000, averaged=0.05,
)  # fmt: skip
CONFIGS = {
    "ant": dataclasses.replace(COMMON, steps=240_000, target_entropy=-8.0),
    "go2": dataclasses.replace(COMMON, steps=240_000, target_entropy=-12.0),
}


def train(robot: str, path: Path, *, seed: int, steps: int | None, members: int, judged: int) -> OnnxPolicy:
    """Train, judge and write a policy; return it, read back from its file."""
    distribution = udr(robot)
    description, make = robot_description(robot), ENVIRONMENTS[robot]
    config = CONFIGS[robot]
    if steps is not None:
        config = dataclasses.replace(config, steps=steps, warmup=min(config.warmup, steps // 2))
    env = make(description, distribution, members)
    started, cpu = time.monotonic(), time.process_time()
    policy = SacTrainer().train(env, config, np.random.default_rng(seed), _progress(started))
    record: dict[str, Any] = {
        "format": "deal_hw.training/1",
        "robot": robot,
        "seed": seed,
        "training": dict(policy.spec.training),
        "task": dataclasses.asdict(env.task),
        "reward": inspect.cleandoc(make.__doc__ or "").partition("\n\nArgs:")[0],
        "distribution": distribution.to_json(),
        "distribution_digest": distribution.digest(),
        "spec_digest": policy.spec.digest(),
        "seconds": time.monotonic() - started,
        "cpu_seconds": time.process_time() - cpu,
        "machine": f"one thread of {platform.machine()}, shared, Python {platform.python_version()}",
    }
    exported = export_network(policy.network, policy.spec, path)
    record["onnx_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    add_judgement(robot, exported, record, judged)
    return exported


def add_judgement(robot: str, policy: OnnxPolicy, record: dict[str, Any], judged: int) -> None:
    """Judge a policy under the distribution that it was trained under, and write its record."""
    env = ENVIRONMENTS[robot](robot_description(robot), udr(robot), judged)
    record["evaluation"] = judge(policy, env, JUDGE_SEED)
    record["at_rest"] = judge(_Rest(policy), env, JUDGE_SEED)
    text = json.dumps(record, indent=1, sort_keys=True)
    policy.path.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    print(f"{robot}: {record['evaluation']}\nat rest: {record['at_rest']}\nwrote {policy.path}")


def udr(robot: str) -> ParameterDistribution:
    """Return uniform domain randomisation over a robot's default space."""
    space = next(iter(parameter_spaces(robot).values()))()
    return ParameterDistribution.uniform(space.with_ratio(UDR_RATIO), LATENCY_S)


class _Rest:
    """Does nothing: what the policy's figures are to be compared with."""

    def __init__(self, policy: OnnxPolicy) -> None:
        self.spec = policy.spec

    def act_batch(self, observations: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.zeros((len(observations), len(self.spec.actuated)))


def _progress(started: float) -> Any:
    def show(done: int, total: int, recent: float) -> None:
        print(f"{time.monotonic() - started:6.0f} s {done:8d}/{total} return {recent:8.1f}", flush=True)

    return show


def main() -> None:
    """Train as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", choices=sorted(ENVIRONMENTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, help="environment steps; by default those of the shipped policy")
    parser.add_argument("--members", type=int, default=MEMBERS)
    parser.add_argument("--judged", type=int, default=JUDGED, help="robots that the policy is judged by")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--judge", action="store_true", help="train nothing, judge the file that is there")
    args = parser.parse_args()
    path = args.out or ASSETS / f"{args.robot}_udr.onnx"
    if args.judge:
        record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        add_judgement(args.robot, OnnxPolicy(path), record, args.judged)
        return
    train(args.robot, path, seed=args.seed, steps=args.steps, members=args.members, judged=args.judged)


if __name__ == "__main__":
    main()
