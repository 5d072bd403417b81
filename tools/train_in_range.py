"""Trains the policies that demonstrate in DEAL's tables: under uniform randomisation in each search range.

    python tools/train_in_range.py --task cartpole,ant --range-ratio 10,15,20 --folder c --out range.json

writes c/cartpole_10.onnx and so on, each with the record of its training, and rows with the policy's return
in its range (32 drawn robots) and in the target of `deal-hw bench paper` (the model's nominal values).
`deal-hw bench paper --checkpoint c/cartpole_10.onnx --range-ratio 10` then demonstrates with it.
"""

from __future__ import annotations

import time
from pathlib import Path

from measuring import Row, Rows, add_seeds, parser

from deal_hw.bench.settings import parse_ratios
from deal_hw.bench.tasks import TASKS, check_tasks, paper_ranges
from deal_hw.bench.transfer_target import judged
from deal_hw.cli.piped import PipedProgress
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.demonstration import BatchPolicy
from deal_hw.robots import default_space, training_task
from deal_hw.workflows.train import train_policy


def in_range(task: str, range_ratio: float) -> ParameterDistribution:
    """Return the uniform distribution over a task's search range in DEAL's tables."""
    space = default_space(task)
    return ParameterDistribution.uniform(paper_ranges(space, range_ratio), training_task(task).udr_latency_s)


def returns(task: str, drawn: ParameterDistribution, policy: BatchPolicy, seed: int) -> Row:
    """Return how a policy does on robots of its range and on the nominal one."""
    space = drawn.space
    nominal = ParameterDistribution.point(space, space.nominal, 0.0)
    places = {"range": drawn, "target": nominal}
    found = {name: judged(task, of, policy, seed) for name, of in places.items()}
    return {f"{key}_{name}": value for name, row in found.items() for key, value in row.items()}


def train(task: str, range_ratio: float, seed: int, path: Path, steps: int | None) -> Row:
    """Train a policy in a range, and return its row."""
    drawn, began = in_range(task, range_ratio), time.perf_counter()
    with PipedProgress(f"train {path.stem}") as piped:
        policy = train_policy(
            task,
            drawn,
            path,
            seed=seed,
            steps=steps,
            progress=lambda status: piped.at(f"{status.steps} of {status.total} steps"),
        )
    seconds = round(time.perf_counter() - began, 1)
    row = {"task": task, "range_ratio": range_ratio, "seed": seed, "steps": steps, "error": ""}
    return row | returns(task, drawn, policy, seed) | {"seconds": seconds}


def main() -> None:
    """Train each task in each range."""
    args = parser(__doc__)
    args.add_argument("--task", default="cartpole,ant", help=f"tasks, of {', '.join(TASKS)}")
    args.add_argument("--range-ratio", type=parse_ratios, default=(10.0, 15.0, 20.0))
    args.add_argument("--steps", type=int, help="environment steps; by default as for the shipped policy")
    args.add_argument("--folder", type=Path, default=Path("policies_in_range"))
    add_seeds(args, 0)
    given = args.parse_args()
    tasks = given.task.split(",")
    check_tasks(tasks)
    given.folder.mkdir(parents=True, exist_ok=True)
    rows = Rows(__file__, given.out, names=("task", "range_ratio", "seed", "steps"))
    for task in tasks:
        for ratio in given.range_ratio:
            for seed in given.seeds:
                name = f"{task}_{ratio:g}" + (f"_{seed}" if len(given.seeds) > 1 else "")
                if not rows.done(task, ratio, seed, given.steps):
                    rows.add(train(task, ratio, seed, given.folder / f"{name}.onnx", given.steps))


if __name__ == "__main__":
    main()
