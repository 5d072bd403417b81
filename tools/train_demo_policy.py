"""Make the shipped policies of Allegro hand, ant, humanoid and Go2, trained under uniform randomisation.

    python tools/train_demo_policy.py allegro
    python tools/train_demo_policy.py ant
    python tools/train_demo_policy.py humanoid
    python tools/train_demo_policy.py go2

writes policies/assets/allegro_udr.onnx, ant_udr.onnx, humanoid_udr.onnx or go2_walk.onnx and, beside it, the
record of its training and of its results on other robots. Task, trainer and settings are those of `deal-hw
train ROBOT --udr`. All but the Go2's are early checkpoints, made in minutes on one core: good enough to
excite a robot for calibration (the paper's Table 5 studies such ones), not good at their task.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import math
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.drivers import recorded_description
from deal_hw.policies.checkpoint import read_checkpoint, write_checkpoint
from deal_hw.policies.locomotion import judge
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.tasks import training_task
from deal_hw.training import TrainingFiles, TrainingStatus
from deal_hw.workflows.train import train_policy, udr_distribution

ASSETS = Path(__file__).parents[1] / "policies" / "assets"
FILES = {"allegro": "allegro_udr", "ant": "ant_udr", "go2": "go2_walk", "humanoid": "humanoid_udr"}
JUDGED = 256
JUDGE_SEED = 1_000_003
"""Seed of the robots, commands and starts that judge the policy; training uses another one."""


def train(
    robot: str,
    path: Path,
    *,
    seed: int,
    steps: int | None,
    members: int | None,
    judged: int,
    files: TrainingFiles | None = None,
) -> OnnxPolicy:
    """Train, judge and write a policy; return it, read back from its file."""
    distribution = udr_distribution(robot)
    policy = train_policy(
        robot, distribution, path, seed=seed, steps=steps, members=members, progress=_progress(), files=files
    )
    record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    record["machine"] = f"one thread of {platform.machine()}, shared, Python {platform.python_version()}"
    record["onnx_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    add_judgement(robot, policy, record, judged)
    if files is not None and files.checkpoint is not None:
        ship_checkpoint(files.checkpoint, policy)
    return policy


def ship_checkpoint(source: Path, policy: OnnxPolicy) -> None:
    """Write a checkpoint's networks beside a policy, to fine-tune from; not the optimiser's memory."""
    found = read_checkpoint(source, policy.spec)
    kept = {name: value for name, value in found.tensors.items() if not name.startswith("optimizer.")}
    write_checkpoint(
        policy.path.with_suffix(".safetensors"), dataclasses.replace(found, tensors=kept), policy.spec
    )


def add_judgement(robot: str, policy: OnnxPolicy, record: dict[str, Any], judged: int) -> None:
    """Judge a policy under its training distribution, and write its record."""
    env = training_task(robot).make(recorded_description(robot), udr_distribution(robot), judged)
    record["evaluation"] = judge(policy, env, JUDGE_SEED)
    record["at_rest"] = judge(_Rest(policy), env, JUDGE_SEED)
    text = json.dumps(record, indent=1, sort_keys=True)
    policy.path.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    print(f"{robot}: {record['evaluation']}\nat rest: {record['at_rest']}\nwrote {policy.path}")


class _Rest:
    """A policy without motion, for comparison."""

    def __init__(self, policy: OnnxPolicy) -> None:
        self.spec = policy.spec

    def act_batch(self, observations: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.zeros((len(observations), len(self.spec.actuated)))


def _progress() -> Any:
    started, shown = time.process_time(), [0]

    def show(status: TrainingStatus) -> None:
        share = 100 * status.steps // status.total
        if share == shown[0] and status.steps < status.total:
            return
        shown[0] = share
        measures = " ".join(f"{name}={value:.3f}" for name, value in status.measures.items())
        print(
            f"{time.process_time() - started:6.0f} cpu-s {status.steps:9d}/{status.total} "
            f"return {math.nan if status.mean_return is None else status.mean_return:8.1f} {measures}",
            flush=True,
        )

    return show


def main() -> None:
    """Train as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", choices=sorted(FILES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, help="environment steps; by default those of the shipped policy")
    parser.add_argument("--members", type=int, help="by default those of the shipped policy")
    parser.add_argument("--judged", type=int, default=JUDGED, help="robots on which the policy is evaluated")
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--checkpoint",
        type=Path,
        help="a .safetensors file to keep while it trains; its networks are shipped beside the policy",
    )
    parser.add_argument("--resume", action="store_true", help="continue from --checkpoint")
    parser.add_argument("--judge", action="store_true", help="do not train: evaluate the existing file")
    args = parser.parse_args()
    path = args.out or ASSETS / f"{FILES[args.robot]}.onnx"
    if args.judge:
        record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        add_judgement(args.robot, OnnxPolicy(path), record, args.judged)
        if args.checkpoint is not None:
            ship_checkpoint(args.checkpoint, OnnxPolicy(path))
        return
    files = TrainingFiles(checkpoint=args.checkpoint, resume=args.resume)
    train(
        args.robot,
        path,
        seed=args.seed,
        steps=args.steps,
        members=args.members,
        judged=args.judged,
        files=files,
    )


if __name__ == "__main__":
    main()
