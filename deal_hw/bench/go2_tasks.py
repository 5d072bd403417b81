"""What the Go2's loop bench lets a robot do in each task, and how its policies are scored there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from deal_hw.control.process.channel import Outcome
from deal_hw.drivers.go2.descriptions.floor import walk_space
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.motions.scores.straightness import straightness
from deal_hw.motions.scores.velocity_error import velocity_error
from deal_hw.motions.velocity import FixedVelocity, ScriptVelocity
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.climb_env import ClimbEnv, ClimbTask
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.robots import recorded_description
from deal_hw.sim.legged.terrain import Kind, Terrain
from deal_hw.workflows.emulation.virtual_go2 import walk
from deal_hw.workflows.emulation.walk_script import WALKS, Walk, write_script

NEXT_NOISE: Final = 100_000
"""Distance between the noise seeds of two walks."""
REPEATS: Final = 3
"""How often a policy walks; a climb has :data:`TRIES`."""
STRAIGHT_M_S: Final = 1.2
STRAIGHT_S: Final = 7.0
"""The walk whose deviation from a straight line is measured: velocity ahead, and how long."""
HEIGHTS_M: Final = (0.05, 0.10, 0.15, 0.20, 0.25)
TRIES: Final = 10
"""Tries of a climb at each height, told and blind."""
CLIMB_M_S: Final = 0.6
CLIMB_S: Final = 6.0
ENDED: Final = "falls"
"""Measure of walks that did not reach their end; it is added, where others are averaged."""

Score = Callable[[Go2Truth, OnnxPolicy, Path], dict[str, Any]]


class LoopTask(NamedTuple):
    """A task of the loop bench.

    Attributes:
        name: Name of the robot's further task; "" for its usual one, the walk.
        profile: The motion that is recorded and calibrated from.
        heldout: The motion that judges the calibration.
        score: Called with a robot, a policy and a folder; returns measures by name.
        measure: The measure that compares policies.
        unit: Its unit.
        more_is_better: Whether a larger value is better.
    """

    name: str
    profile: Walk
    heldout: Walk
    score: Score
    measure: str
    unit: str
    more_is_better: bool = False


def score_walk(script: Walk, truth: Go2Truth, policy: OnnxPolicy, out: Path, repeats: int = REPEATS) -> Any:
    """Let a policy walk a script several times, each with other noise; return its errors by the truth.

    They are mean errors [m/s, rad/s] of the walks that lasted long enough, and the number of falls.
    """
    source, errors, falls = ScriptVelocity(write_script(out / "profile.csv", script.parts)), [], 0
    for number in range(repeats):
        noisy = dataclasses.replace(truth, seed=truth.seed + number * NEXT_NOISE)
        done = walk(noisy, policy, source, script.seconds, record=False)
        falls += done.report.outcome is not Outcome.FINISHED
        error = None if done.wanted is None else velocity_error(done.track, done.wanted)
        if error is not None:
            errors.append((error.velocity_m_s, error.yaw_rad_s))
    velocity, yaw = np.mean(errors, axis=0) if errors else (np.nan, np.nan)
    return {"velocity_error": float(velocity), "yaw_error": float(yaw), ENDED: falls}


def score_canter(script: Walk, truth: Go2Truth, policy: OnnxPolicy, out: Path) -> dict[str, Any]:
    """Return the errors of :func:`score_walk`, and the deviation of 5 m straight ahead [m].

    The heading is held there by the inertial sensor, as `deal-hw deploy --hold-heading`.
    """
    found = score_walk(script, truth, policy, out)
    away = []
    for number in range(REPEATS):
        noisy = dataclasses.replace(truth, seed=truth.seed + number * NEXT_NOISE)
        ahead = FixedVelocity((STRAIGHT_M_S, 0.0, 0.0))
        done = walk(noisy, policy, ahead, STRAIGHT_S, record=False, hold_heading=True)
        found[ENDED] += done.report.outcome is not Outcome.FINISHED
        line = None if done.wanted is None else straightness(done.track, float(done.wanted.time_s[0]))
        if line is not None:
            away.append(abs(line.deviation_m))
    return {**found, "deviation": float(np.mean(away)) if away else np.nan}


def score_climb(truth: Go2Truth, policy: OnnxPolicy, out: Path) -> dict[str, Any]:
    """Return the share of successful climbs, told and blind, and the number of falls, at each height.

    Scuffs and torques (:class:`ClimbTries`) are means over the heights.
    """
    space = walk_space()
    values = np.array([truth.walk_parameters()[name] for name in space.names])
    robot = ParameterDistribution.point(space, values, 1e-3 * truth.latency_ms)
    found: dict[str, Any] = {"climbed": {}, ENDED: 0}
    for name, blind in (("told", False), ("blind", True)):
        tries = [climbs(policy, robot, height, truth.seed, TRIES, blind=blind) for height in HEIGHTS_M]
        found["climbed"][name] = [one.climbed for one in tries]
        found[ENDED] += sum(one.fell for one in tries)
        found[f"scuffs_{name}"] = float(np.mean([one.scuffs for one in tries]))
        found[f"torque_nm_{name}"] = float(np.mean([one.torque_nm for one in tries]))
    found["success"] = float(np.mean(list(found["climbed"].values()))) / TRIES
    return found


def climb_task(rise: float, *, blind: bool, kind: Kind = "box") -> ClimbTask:
    """Return a climb of one rise [m or rad] at one velocity, without pushes, told to all or to none."""
    ends, run = (rise, rise), Terrain(kind=kind, rise=rise).top_begins_m
    return ClimbTask(
        ticks=round((CLIMB_S + run / CLIMB_M_S) * 50.0),
        terrains=(kind,),
        rise_m=ends,
        step_m=ends,
        slope_rad=ends,
        flat=0.0,
        blind=float(blind),
        command_range=((CLIMB_M_S, CLIMB_M_S), (0.0, 0.0), (0.0, 0.0)),
        standing=0.0,
        push_ticks=10**9,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ClimbTries:
    """What became of tries to climb.

    Attributes:
        climbed: Number of robots whose four feet were on the (last) platform at once and that did not fall.
        fell: Number of robots that fell.
        scuffs: How often a leg or the trunk came to press against the platform's front, mean over the robots.
        torque_nm: Root mean square of the joints' torques until the robots ended.
    """

    climbed: int
    fell: int
    scuffs: float
    torque_nm: float


def climbs(
    policy: Any,
    distribution: ParameterDistribution,
    rise: float,
    seed: int,
    tries: int,
    *,
    blind: bool,
    kind: Kind = "box",
) -> ClimbTries:
    """Let robots climb in the batched environment, behind the safety filter of deploying.

    Args:
        policy: The policy; it need not observe the platform.
        distribution: Of the robots.
        rise: Height of the platform or of one step [m], or angle of the slope [rad].
        seed: Seeds the robots, their distances and the noise.
        tries: Number of robots.
        blind: Whether the robots are told nothing.
        kind: Kind of the terrain.
    """
    task = climb_task(rise, blind=blind, kind=kind)
    env = ClimbEnv(recorded_description("go2"), distribution, tries, task=task)
    env.observe_for(policy.spec)
    seen, _ = env.reset(seed=seed)
    going, climbed = np.ones(tries, dtype=bool), np.zeros(tries, dtype=bool)
    fell, pressing, scuffs = np.zeros(tries, dtype=bool), np.zeros(tries, dtype=bool), np.zeros(tries)
    torque = env.loop.batch.engine.bind("actuator_force")
    squares, ticks = 0.0, 0
    for _ in range(env.ticks):
        seen, _, terminated, truncated, _ = env.step(policy.act_batch(seen))
        climbed |= going & (env.outcomes()["climbed"] > 0.0)
        fell |= going & terminated
        going &= ~(terminated | truncated)
        left = np.flatnonzero(going)
        scuffs[left] += (env.pressing & ~pressing)[left]
        pressing = env.pressing
        squares, ticks = squares + float(np.square(torque[left]).mean(axis=1).sum()), ticks + len(left)
    return ClimbTries(
        climbed=int((climbed & ~fell).sum()),
        fell=int(fell.sum()),
        scuffs=float(scuffs.mean()),
        torque_nm=float(np.sqrt(squares / max(ticks, 1))),
    )


TASKS: Final[Mapping[str, LoopTask]] = {
    "walk": LoopTask("", *WALKS["walk"], partial(score_walk, WALKS["walk"][0]), "velocity_error", "m/s"),
    "canter": LoopTask(
        "canter", *WALKS["canter"], partial(score_canter, WALKS["canter"][0]), "velocity_error", "m/s"
    ),
    "climb": LoopTask("climb", *WALKS["climb"], score_climb, "success", "of tries", more_is_better=True),
}


def climb_lines(rows: Sequence[Mapping[str, Any]], policies: Sequence[str]) -> list[str]:
    """Return the successes at each height, with exact binomial intervals of 95 %."""
    from scipy.stats import binomtest

    lines = []
    for name in ("told", "blind"):
        for number, height in enumerate(HEIGHTS_M):
            parts = []
            for policy in policies:
                done = sum(row[f"climbed_{policy}"][name][number] for row in rows)
                tries = TRIES * len(rows)
                interval = binomtest(done, tries).proportion_ci()
                parts.append(f"{policy} {done}/{tries} ({interval.low:.0%} to {interval.high:.0%})")
            lines.append(f"{height:.2f} m, {name}: {', '.join(parts)}")
    return lines
