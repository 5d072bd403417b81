"""The bench of speed: the cost of a search, beside bare physics in the same run and the paper's Table 3.

Bare physics is the engine alone: as many members advance as many steps on the same threads, with the commands
that the policy gave each of them, in one call and with one record at its end. So robots move as in the search
and have the same contacts. The rest of a search's time goes into policy calls, records, critic and its own
arithmetic. Beside it are the engine's seconds with constant commands, where a robot soon rests.
"""

from __future__ import annotations

import itertools
import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deal_hw.bench.rows import Cells, Row, RowTable, noted_in, printed
from deal_hw.bench.settings import Speed
from deal_hw.bench.tasks import TASKS, Case, check_tasks, make_case
from deal_hw.workflows.calibration.intake import CalibrationInput
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import CalibrateSettings

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import Problem
    from deal_hw.calibration import CalibrationResult
    from deal_hw.sim.engine.gpu import EngineName
    from deal_hw.types import FloatArray

REPETITIONS: Final = 5
"""Number of rollouts of bare physics; the median counts."""

KEY: Final = ("task", "space", "method", "population", "generations", "seed", "engine")


def table(settings: Speed) -> RowTable:
    """Return the bench: its cells by :func:`run_cell`; policies move the robots, as in the paper.

    Raises:
        UnknownNameError: There is no such task or method.
    """
    from deal_hw.calib.pipeline.methods import check_method, usual_population

    check_tasks(settings.task)
    for method in settings.methods:
        check_method(method)
    run = partial(
        run_cell, profile=settings.profile, range_ratio=settings.range_ratio, threads=settings.threads
    )
    args = []
    # Rows from before there was another engine have none.
    engine = "" if settings.engine == "mujoco" else settings.engine
    for task, seed, method in itertools.product(settings.task, settings.seeds, settings.methods):
        members = settings.population or usual_population(method)
        cell = (task, settings.space, method, members, settings.generations, seed, engine)
        args.append((cell, cell))
    return RowTable(cells=Cells(names=KEY, run=run, args=args), line=line, summary=printed(summary))


def run_cell(
    task: str,
    space: str,
    method: str,
    population: int,
    generations: int,
    seed: int,
    engine: EngineName | Literal[""] = "",
    *,
    profile: str,
    range_ratio: float,
    threads: int | None,
) -> Row:
    """Time one search; an error goes into the row, so that the other cells still run.

    Args:
        task: Name of the task.
        space: Name of the parameter set; "" for the task's default.
        method: Name of the method.
        population: Members of the search.
        generations: Its generations.
        seed: Seed of everything.
        engine: What simulates the population; "" for mujoco.
        profile: Profile of the robot.
        range_ratio: Ratio of the search range.
        threads: Simulation threads.
    """
    row: Row = {"bench": "speed", "task": task, "space": space, "method": method, "profile": profile}
    row |= {"population": population, "generations": generations, "seed": seed}
    row |= {"engine": engine, "error": ""}
    with noted_in(row):
        case = make_case(task, profile, seed, range_ratio, space, by_policy=True)
        row |= measure(case, method, population, generations, threads, engine or "mujoco")
    return row


def measure(
    case: Case,
    method: str,
    population: int,
    generations: int,
    threads: int | None,
    engine: EngineName = "mujoco",
) -> Row:
    """Search once without refinement, then step the engine alone; imports are not counted.

    Returns:
        The row's figures: wall-clock and processor seconds, physics steps, the engine's own seconds for as
        many steps, under the policy's and under constant commands, and the ratio to the former.
    """
    from deal_hw.calib.data.problem import Problem
    from deal_hw.sim.engine.batch import default_threads

    work = CalibrationInput(robot=case.robot, space=case.space, episodes=[case.fit], policy=case.policy)
    settings = CalibrateSettings(
        method=method,
        population=population,
        refine=False,
        seed=case.seed,
        threads=threads,
        engine=engine,
        starts="recorded",
    )

    def search(generations: int) -> CalibrationResult:
        return calibrate_or_raise(replace(settings, generations=generations), work, method)

    # The first search of a process imports torch, which is no part of a search.
    search(1)
    cpu_s = time.process_time()
    result = search(generations)
    cpu_s = time.process_time() - cpu_s
    problem = Problem(case.robot, case.space, [case.fit], threads=threads, policy=case.policy)
    moving_s, constant_s = bare_step_s(problem, population)
    physics_s = result.steps * moving_s
    return {
        "parameters": len(case.space),
        "recorded_s": float(case.fit.steps * case.fit.step_s),
        "threads": threads or default_threads(),
        "steps": result.steps,
        "seconds": result.seconds,
        "cpu_seconds": cpu_s,
        "bare_step_us": 1e6 * moving_s,
        "seconds_physics": physics_s,
        "seconds_physics_constant": result.steps * constant_s,
        "ratio": result.seconds / physics_s,
        "paper_seconds": TASKS[case.task].paper_s,
        "load": os.getloadavg()[0],
    }


def bare_step_s(problem: Problem, population: int) -> tuple[float, float]:
    """Return the engine's seconds for one physics step of one member, all threads together.

    Members are drawn from the whole range, as in the first generation. The first value is under the commands
    that the policy gives each member, the second under the first of them, held.
    """
    from deal_hw.calib.data.innovations import Members
    from deal_hw.calib.paper.fitness import FitnessSettings
    from deal_hw.calib.paper.rollouts import control_ticks, policy_of, rollout_population
    from deal_hw.sim.engine.closed_loop import on_physics_steps
    from deal_hw.sim.laws.setpoints import slew

    episode = problem.episodes[0]
    most = FitnessSettings().most_transitions(problem.robot.description.name)
    ticks = control_ticks(problem, 0, most, policy_of(problem).history)
    theta = problem.space.sample(np.random.default_rng(0), population)
    action = rollout_population(problem, Members(theta, np.zeros(population)), 0, ticks)[2]
    batch = problem.batch(population, 0)
    batch.set_parameters(theta)
    first, (begin, end) = int(ticks.sample[0]), (int(ticks.start[0]), int(ticks.start[-1]))
    limit = batch.servo_factor("servo_speed_limit")[:, None] * episode.speed_limit[None, begin:end]

    def per_step_s(command: FloatArray) -> float:
        target = np.repeat(command, np.diff(ticks.start), axis=1)
        target[:, ticks.lead :] = target[:, : target.shape[1] - ticks.lead]
        path = slew(target[:, 0], target, limit * episode.step_s)
        control = on_physics_steps(batch, path, episode.step_s)
        taken = []
        for _ in range(REPETITIONS):
            batch.set_state(
                problem.starts[0].position[first],
                problem.starts[0].velocity[first],
                reference=None if episode.reference is None else episode.reference[first],
            )
            began = time.perf_counter()
            batch.advance(control)
            taken.append(time.perf_counter() - began)
        return float(statistics.median(taken) / (population * control.shape[1]))

    return per_step_s(action), per_step_s(np.repeat(action[:, :1], action.shape[1], axis=1))


def line(row: Row) -> str:
    """Return one row in words."""
    what = f"speed {row['task']} {row['method']} seed {row['seed']}"
    if row.get("engine"):
        what += f" on {row['engine']}"
    if row["error"]:
        return f"{what}: {row['error']}"
    paper = f", the paper's {row['paper_seconds']:.0f} s" if row["paper_seconds"] else ""
    return (
        f"{what}: {row['seconds']:.1f} s ({row['cpu_seconds']:.1f} cpu s){paper}; "
        f"{row['population']} members, {row['generations']} generations, {row['steps']:.3g} physics steps; "
        f"bare physics {row['seconds_physics']:.1f} s, ratio {row['ratio']:.2f}"
    )


def summary(rows: Sequence[Row]) -> list[str]:
    """Return the median over seeds of each task and method."""
    found = []
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if not row["error"]:
            what = row["method"] + (f" on {row['engine']}" if row.get("engine") else "")
            groups.setdefault((row["task"], what, row["population"], row["generations"]), []).append(row)
    for (task, what, population, generations), group in groups.items():
        seconds, ratio = (statistics.median(row[name] for row in group) for name in ("seconds", "ratio"))
        paper = TASKS[task].paper_s if task in TASKS else None
        beside = f"; the paper: {paper:.0f} s on a GPU" if paper else ""
        found.append(
            f"{task} {what}, {population} x {generations}: {seconds:.1f} s, {ratio:.2f} times bare physics"
            f"{beside}"
        )
    return found
