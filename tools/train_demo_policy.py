r"""Make the shipped policies of Allegro hand, ant, humanoid and Go2, trained under uniform randomisation.

    python tools/train_demo_policy.py allegro --checkpoint runs/base/allegro.safetensors --hours 1
    python tools/train_demo_policy.py ant
    python tools/train_demo_policy.py humanoid --checkpoint runs/base/humanoid.safetensors --hours 1
    python tools/train_demo_policy.py go2
    python tools/train_demo_policy.py go2 --task canter --start policies/assets/go2_walk.safetensors
    python tools/train_demo_policy.py go2 --task climb --start policies/assets/go2_walk.safetensors
    python tools/train_demo_policy.py go2 --task climb --trainer rma \
        --start policies/assets/go2_climb.safetensors
    python tools/train_demo_policy.py go2 --task canter --trainer amp \
        --start policies/assets/go2_walk.safetensors

writes policies/assets/allegro_turn.onnx, ant_udr.onnx, humanoid_walk.onnx, go2_walk.onnx, go2_canter.onnx,
go2_climb.onnx, go2_climb_rma.onnx or go2_canter_amp.onnx and, beside it, the record of its training and of
its results on other robots. Task, trainer and settings are those of `deal-hw train ROBOT --udr`, with
`--task` and `--trainer`.

`--hours` ends the training after so many processor hours, those of the stopped parts included. The same
command with `--resume` goes on from the checkpoint, also after a crash. The curve of the return against steps
and processor hours is kept beside the checkpoint (.curve.json) and copied into the record.

allegro_udr, ant_udr and humanoid_udr are early checkpoints, made in minutes on one core: good enough to
excite a robot for calibration (the paper's Table 5 studies such ones), not good at their task. Those of hand
and humanoid are of former tasks, which this tool no longer trains. They are kept because stored rows of the
benches were made with them.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import math
import os
import platform
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.policies.checkpoint import read_checkpoint, write_checkpoint
from deal_hw.policies.locomotion import judge
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.trainers import TRAINERS
from deal_hw.robots import recorded_description, training_task
from deal_hw.training import TrainingFiles, TrainingStatus
from deal_hw.workflows.train import train_policy, udr_distribution

ASSETS = Path(__file__).parents[1] / "policies" / "assets"
FILES = {"allegro": "allegro_turn", "ant": "ant_udr", "go2": "go2_walk", "humanoid": "humanoid_walk"}
OTHER_TASKS = {("go2", "canter"): "go2_canter", ("go2", "climb"): "go2_climb"}
NAMED = ("amp", "rma")
"""Trainers whose name is in that of the policy."""
POINTS = 100
"""Number of points of a curve over all steps of a training."""
JUDGED = 256
JUDGE_SEED = 1_000_003
"""Seed of the robots, commands and starts that judge the policy; training uses another one."""


class Curve:
    """The return against steps and processor time, and the limit of the time.

    Attributes:
        before: Points of the trainings whose checkpoint was the start, one after the other.
        points: Points of this training. Their processor hours include those before.

    Args:
        path: A file that keeps the curve, so that a resumed training goes on with it; None: no file.
        resume: Go on with the curve in the file.
        start: The file with the curve of the start; None: from scratch.
        hours: Processor hours after which the training ends, those of its former parts included.
    """

    def __init__(
        self,
        path: Path | None = None,
        *,
        resume: bool = False,
        start: Path | None = None,
        hours: float = math.inf,
    ) -> None:
        self._path, self._hours = path, hours
        self.before: list[dict[str, Any]] = []
        self.points: list[dict[str, Any]] = []
        if resume and path is not None and path.exists():
            found = json.loads(path.read_text(encoding="utf-8"))
            self.before, self.points = found["before"], found["points"]
        elif start is not None and start.exists():
            found = json.loads(start.read_text(encoding="utf-8"))
            self.before = found["before"] + found["points"]
        past = self.before + self.points
        self._spent = past[-1]["cpu_hours"] if past else 0.0
        self._started = time.process_time()

    @property
    def cpu_hours(self) -> float:
        """Processor hours so far."""
        return float(self._spent + (time.process_time() - self._started) / 3600)

    def over(self) -> bool:
        """Return whether the time is used up."""
        return self.cpu_hours >= self._hours

    def note(self, status: TrainingStatus) -> None:
        """Add a point if a hundredth of the steps is done since the last one, and show it."""
        # A training that crashed goes on from its last checkpoint, before the last points.
        self.points = [point for point in self.points if point["steps"] < status.steps]
        last = self.points[-1]["steps"] if self.points else -math.inf
        if status.steps - last < status.total / POINTS and status.steps < status.total:
            return
        point = {"steps": status.steps, "cpu_hours": self.cpu_hours, "mean_return": status.mean_return}
        self.points.append({**point, **status.measures})
        if self._path is not None:
            draft = self._path.with_name(f".{self._path.name}.draft")
            kept = {"before": self.before, "points": self.points}
            draft.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
            os.replace(draft, self._path)
        shown = " ".join(f"{name}={value:.3f}" for name, value in status.measures.items())
        print(
            f"{3600 * self.cpu_hours:6.0f} cpu-s {status.steps:9d}/{status.total} "
            f"return {math.nan if status.mean_return is None else status.mean_return:8.1f} {shown}",
            flush=True,
        )


def train(
    robot: str,
    path: Path,
    *,
    seed: int,
    steps: int | None,
    members: int | None,
    judged: int,
    checkpoint: Path | None = None,
    resume: bool = False,
    start: Path | None = None,
    hours: float = math.inf,
    task: str = "",
    trainer: str | None = None,
) -> OnnxPolicy:
    """Train, judge and write a policy; return it, read back from its file."""
    if checkpoint is not None:
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
    curve = Curve(_curve_file(checkpoint), resume=resume, start=_curve_file(start), hours=hours)
    policy = train_policy(
        robot,
        udr_distribution(robot, task),
        path,
        task=task,
        trainer=trainer,
        seed=seed,
        steps=steps,
        members=members,
        progress=curve.note,
        files=TrainingFiles(checkpoint=checkpoint, resume=resume, start=start, stop=curve.over),
    )
    record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    record["machine"] = f"one thread of {platform.machine()}, shared, Python {platform.python_version()}"
    record["onnx_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    # The record of a training that crashed is missing, its curve is not.
    record["cpu_seconds"] = 3600 * curve.cpu_hours
    record["curve_before"], record["curve"] = _short(curve.before), _short(curve.points)
    add_judgement(robot, policy, record, judged, task)
    if checkpoint is not None:
        ship_checkpoint(checkpoint, policy)
    return policy


def _curve_file(checkpoint: Path | None) -> Path | None:
    """Return the file of the curve beside a checkpoint."""
    return None if checkpoint is None else checkpoint.with_suffix(".curve.json")


def _short(points: Sequence[Mapping[str, float | None]]) -> list[dict[str, float | None]]:
    """Return the points of a curve with four digits; steps are exact."""
    return [
        {name: x if x is None or name == "steps" else float(f"{x:.4g}") for name, x in point.items()}
        for point in points
    ]


def ship_checkpoint(source: Path, policy: OnnxPolicy) -> None:
    """Write a checkpoint's networks beside a policy, to fine-tune from; not the optimiser's memory."""
    found = read_checkpoint(source, policy.spec)
    kept = {name: value for name, value in found.tensors.items() if "optimizer." not in name}
    write_checkpoint(
        policy.path.with_suffix(".safetensors"), dataclasses.replace(found, tensors=kept), policy.spec
    )


def add_judgement(
    robot: str, policy: OnnxPolicy, record: dict[str, Any], judged: int, task: str = ""
) -> None:
    """Judge a policy under its training distribution, and write its record."""
    drawn = udr_distribution(robot, task)
    env = training_task(robot, task).make(recorded_description(robot), drawn, judged)
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


def main() -> None:
    """Train as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", choices=sorted(FILES))
    parser.add_argument("--task", default="", choices=["", *(task for _, task in OTHER_TASKS)])
    parser.add_argument("--trainer", choices=sorted(TRAINERS), help="by default that of the shipped policy")
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
    parser.add_argument("--start", type=Path, help="a checkpoint whose networks are the start")
    parser.add_argument("--hours", type=float, default=math.inf, help="processor hours; by default no limit")
    parser.add_argument("--resume", action="store_true", help="continue from --checkpoint")
    parser.add_argument("--judge", action="store_true", help="do not train: evaluate the existing file")
    args = parser.parse_args()
    name = OTHER_TASKS[args.robot, args.task] if args.task else FILES[args.robot]
    name += f"_{args.trainer}" if args.trainer in NAMED else ""
    path = args.out or ASSETS / f"{name}.onnx"
    if args.judge:
        record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        add_judgement(args.robot, OnnxPolicy(path), record, args.judged, args.task)
        if args.checkpoint is not None:
            ship_checkpoint(args.checkpoint, OnnxPolicy(path))
        return
    train(
        args.robot,
        path,
        seed=args.seed,
        steps=args.steps,
        members=args.members,
        judged=args.judged,
        checkpoint=args.checkpoint,
        resume=args.resume,
        start=args.start,
        hours=args.hours,
        task=args.task,
        trainer=args.trainer,
    )


if __name__ == "__main__":
    main()
