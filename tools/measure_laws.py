"""Cost of the laws between physics steps, on all joints of a robot, over that of the bare physics.

A law of `deal_hw.sim` (friction by speed or load, the effort by speed, a servo's firmware, an elastic
transmission) writes the model's fields before each step. A row is one robot, law and number of members:
`ratio` is the processor time of a rollout with the law on all joints over that of one without, in one thread.
They run in turns, and the median of the turns' ratios counts, with its quartiles, so that other work
changes little. `engine_ratio` is the part of it within MuJoCo's steps. A law that changes the motion changes
the time of contacts and friction, too: the solver needs more iterations for joints that rattle, and a ratio
below 1 can be. Robots begin in their default pose, under random set-points, which change every ten steps.

.venv/bin/python tools/measure_laws.py --out laws.json
.venv/bin/python tools/measure_laws.py --robots so101 --laws transmission --members 16 --steps 400
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
from fakes.law_robots import known
from measuring import Rows, parser
from mujoco.batch import Batch

from deal_hw.parameters import ParameterSpace
from deal_hw.robots.registry import robot_description
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.parameters import find_kind

ROBOTS = ("so101", "go2")
SPRING = {"transmission_stiffness": 1000.0, "transmission_damping": 1.0}
LAWS: dict[str, dict[str, float]] = {
    "friction-speed": {"dof_friction_stribeck": 0.1},
    "friction-load": {"dof_friction_load": 0.1},
    "free-speed": {"motor_free_speed": 8.0},
    "firmware": {"servo_dead_zone": 0.01},
    "transmission": SPRING,
    "play": SPRING | {"transmission_play": 0.01},
    "encoder-at-motor": SPRING | {"encoder_at_motor": 1.0},
    "friction-at-motor": SPRING | {"friction_at_motor": 1.0},
    "without-rotors": {"dof_armature": 1e-4},
}
"""Parameters of each law: kinds and their values. The last is no law, but what a link is in the open gap of a
gear with play: MuJoCo's own steps of such a robot take longer."""
EVERY = 10
"""Steps between recorded states, and of a set-point."""


def members_with(robot: RobotModel, law: str, count: int) -> ServoBatch:
    """Return members with a law on all joints; "" for none."""
    names = robot.description.joint_names, robot.actuator_names
    found = [
        known(kind, element, value)
        for kind, value in LAWS.get(law, {}).items()
        for element in names[find_kind(kind).element == "actuator"]
    ]
    if not found:
        found = [known("dof_damping", names[0][0], float(robot.model.dof_damping[robot.qvel[0]]))]
    return ServoBatch(robot, ParameterSpace(found), count, threads=1)


def rollout(members: ServoBatch, steps: int) -> Callable[[], float]:
    """Return a function that simulates from the default pose and returns its processor time [s]."""
    description = members.robot.description
    position, velocity = members.position.copy(), np.zeros_like(members.velocity)
    rest = np.array(description.default_position)
    position[:, position.shape[1] - len(rest) :] = rest
    rng = np.random.default_rng(0)
    held = rng.uniform(-0.2, 0.2, (members.count, -(-steps // EVERY), len(members.robot.actuator)))
    command = np.repeat(held, EVERY, axis=1)[:, :steps]
    if description.actuation == "position":
        command += rest[list(description.actuated_index)]

    def run() -> float:
        members.set_state(position, velocity)
        began = time.process_time()
        found, _ = members.advance(command, every=EVERY)
        spent = time.process_time() - began
        if np.isnan(found).any():
            raise SystemExit("a rollout diverged; its time says nothing")
        return spent

    return run


def within_steps(run: Callable[[], float]) -> float:
    """Return the processor time of a run within MuJoCo's steps [s]: all of it without a law between them."""
    spent, step = 0.0, Batch.step

    def timed(batch: Batch) -> None:
        nonlocal spent
        began = time.process_time()
        step(batch)
        spent += time.process_time() - began

    with mock.patch.object(Batch, "step", timed):
        whole = run()
    return spent or whole


def measure(robot: str, laws: list[str], count: int, steps: int, repeats: int) -> list[dict[str, Any]]:
    """Return a row of each law."""
    model = load_model(robot_description(robot))
    runs = {law: rollout(members_with(model, law, count), steps) for law in ["", *laws]}
    for run in runs.values():
        run()
    spent = np.array([[run() for run in runs.values()] for _ in range(repeats)])
    ratios = spent[:, 1:] / spent[:, :1]
    engine = np.array([[within_steps(runs[law]) for law in laws] for _ in range(repeats)])
    engine_ratios = np.median(engine / spent[:, :1], axis=0)
    rows = []
    for law, ratio, within, mine in zip(laws, ratios.T, engine_ratios, spent[:, 1:].T, strict=True):
        row: dict[str, Any] = {"robot": robot, "law": law, "joints": len(model.description.joint_names)}
        row |= {"members": count, "steps": steps, "repeats": repeats}
        low, middle, high = np.percentile(ratio, (25, 50, 75))
        row |= {"ratio": round(middle, 3), "ratio_quartiles": [round(low, 3), round(high, 3)]}
        row["engine_ratio"] = round(float(within), 3)
        row["bare_us_per_step"] = round(float(np.median(spent[:, 0])) / steps * 1e6, 2)
        row["law_us_per_step"] = round(float(np.median(mine - spent[:, 0])) / steps * 1e6, 2)
        rows.append(row)
    return rows


def main() -> None:
    """Measure as the command line says; print a row for each robot, number of members and law."""
    options = parser(__doc__)
    options.add_argument("--robots", default=",".join(ROBOTS), help="built-in robots")
    options.add_argument("--laws", default=",".join(LAWS), help=f"of {', '.join(LAWS)}")
    options.add_argument("--members", default="16,64")
    options.add_argument("--steps", type=int, default=200, help="physics steps of a rollout")
    options.add_argument("--repeats", type=int, default=15, help="turns, of which the median counts")
    args = options.parse_args()
    rows = Rows(__file__, args.out)
    laws = args.laws.split(",")
    if unknown := [law for law in laws if law not in LAWS]:
        options.error(f"--laws: {', '.join(unknown)} is unknown; the laws are {', '.join(LAWS)}")
    for robot in args.robots.split(","):
        for count in map(int, args.members.split(",")):
            for row in measure(robot, laws, count, args.steps, args.repeats):
                rows.add(row)


if __name__ == "__main__":
    main()
