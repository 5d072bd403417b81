"""Physics steps a second of MuJoCo Warp and of mujoco.batch, against the number of worlds.

For a machine with an NVIDIA GPU: without one `--engine warp` is refused, and `--engine warp-cpu` only tries
the script. The tasks are those of the DEAL paper's Table 3. A row is a rollout of members that differ all
over their search range, from the rest pose, under random set-points, read after each control period: what a
generation of `calibrate` asks. `bare_ratio` is its time over that of as many bare steps of MuJoCo Warp in the
same worlds, without controls, records and copies. The first rollout, which compiles, is said apart.

With --environments a row is a tick of the task's training environment with as many robots, under random
actions: physics, observations, rewards and restarts, without the learning.

.venv/bin/python tools/measure_engines.py --worlds 256,1024,4096,16384,32768 --out engines.json
.venv/bin/python tools/measure_engines.py --environments --tasks go2 --worlds 1024,2048,4096 --out ticks.json
.venv/bin/python tools/measure_engines.py --engine mujoco,warp-cpu --tasks cartpole --worlds 4 --steps 20
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from measuring import Rows, parser

from deal_hw.robots.registry import default_space, robot_description, training_task
from deal_hw.sim.engine.batch import ServoBatch, default_threads
from deal_hw.sim.engine.model import load_model
from deal_hw.workflows.robot import described
from deal_hw.workflows.train import udr_distribution

TASKS = ("cartpole", "ant", "allegro", "go2", "humanoid")
MOST_MEMBERS = 256
"""Members; more worlds are windows of the same members, as in a search."""


def measure(task: str, engine: Any, worlds: int, steps: int, repeats: int) -> dict[str, Any]:
    """Return one row."""
    description = robot_description(task)
    model = load_model(description)
    space = default_space(task)
    members = min(worlds, MOST_MEMBERS)
    windows = max(worlds // members, 1)
    batch = ServoBatch(model, space, members, engine=engine)
    rng = np.random.default_rng(0)
    batch.set_parameters(space.sample(rng, members))
    if model.model.nkey:
        batch.batch.bind("qpos")[:] = model.model.key_qpos[0]
    start = tuple(np.repeat(values[:, None], windows, axis=1) for values in (batch.position, batch.velocity))
    rest = np.array(description.default_position)[list(description.actuated_index)]
    command = rng.uniform(-0.2, 0.2, (members, windows, steps, len(rest)))
    command += rest if description.actuation == "position" else 0.0
    every = min(description.steps_per_control, steps)

    def roll() -> None:
        x, _ = batch.advance_windows((start[0], start[1]), command, every)
        row["diverged"] = int(np.isnan(x).any(axis=(2, 3)).sum())

    count = members * windows
    row: dict[str, Any] = {"task": task, "engine": engine, "worlds": count, "steps": steps}
    row["threads"] = default_threads()
    row["first_s"] = seconds(roll, 1)
    row["seconds"] = seconds(roll, repeats)
    row["steps_per_s"] = count * steps / row["seconds"]
    if engine != "mujoco":
        bare, row["device"] = batch.engine.bare(count, steps)  # type: ignore[attr-defined]
        row["bare_ratio"] = row["seconds"] / seconds(bare, repeats)
    return row


def measure_environment(task: str, engine: Any, members: int, ticks: int) -> dict[str, Any]:
    """Return the row of a training environment, whose robots are anywhere in their episodes."""
    given = described(task), udr_distribution(task), members
    env = training_task(task).make(*given, engine=engine, threads=None)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    env._elapsed[:] = rng.integers(0, env.ticks, members)

    def tick() -> None:
        env.step(rng.uniform(-0.3, 0.3, env.action_space.shape))

    row: dict[str, Any] = {"task": task, "engine": engine, "members": members, "ticks": ticks}
    row["threads"] = default_threads()
    row["first_s"] = seconds(tick, 1)
    began = time.perf_counter()
    for _ in range(ticks):
        tick()
    row["tick_s"] = (time.perf_counter() - began) / ticks
    return row | {"steps_per_s": members / row["tick_s"]}


def seconds(work: Callable[[], None], repeats: int) -> float:
    """Return the shortest time [s] of so many."""
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        found.append(time.perf_counter() - began)
    return min(found)


def main() -> None:
    """Measure as the command line says; print a row for each task, engine and number of worlds."""
    options = parser(__doc__)
    options.add_argument("--engine", default="mujoco,warp", help="of mujoco, warp, warp-cpu")
    options.add_argument("--tasks", default=",".join(TASKS))
    options.add_argument("--worlds", default="256,512,1024,2048,4096,8192,16384,32768")
    options.add_argument("--steps", type=int, default=200, help="physics steps of a rollout")
    options.add_argument("--environments", action="store_true", help="ticks of training environments instead")
    options.add_argument("--ticks", type=int, default=20, help="ticks of an environment")
    options.add_argument("--repeats", type=int, default=3, help="rollouts, of which the fastest counts")
    args = options.parse_args()
    rows = Rows(__file__, args.out)
    for task in args.tasks.split(","):
        for engine in args.engine.split(","):
            for worlds in map(int, args.worlds.split(",")):
                if args.environments:
                    rows.add(measure_environment(task, engine, worlds, args.ticks))
                else:
                    rows.add(measure(task, engine, worlds, args.steps, args.repeats))


if __name__ == "__main__":
    main()
