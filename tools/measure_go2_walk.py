"""Measure how well a policy walks the emulated Go2 behind the safety filter, in virtual time.

    python tools/measure_go2_walk.py --profile realistic --seeds 0 1 2
    python tools/measure_go2_walk.py --policy runs/train/policies/policy.onnx --rounds 35
    python tools/measure_go2_walk.py --ends 20 --seeds 0 1 2 3 4 5 6 7 8 9 --out go2_walk_ends.json

Driver, wire format, filter, safety checks and control loop are those of `deal-hw deploy go2`; only time is
virtual, so a busy machine does not change the result. A round stands for 2 s, then commands 1 m/s ahead, 0.5
m/s to the left and a turn of 1 rad/s, 5 s each. Errors are against the emulator's true motion: mean velocity
in the base's heading over one step of the gait, from 1 s after each change of the command on.

With --ends, each robot walks with each of five velocities, and ends at so many phases of the gait: 2 s after
the walk began, and later by one control cycle each (a stride has 20). Each end is a planned one. The process
is copied at each phase (fork), so that the ends of one walk share its beginning. A row is one robot and
velocity: the number of ends that fell (tripped, or leaned by more than 0.8 rad at any time), the largest lean
of all, and the longest time from the request to lying down. Rows in --out are kept, so that a stopped command
goes on where it was.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import head, parser, program, write_document

from deal_hw.bench.rows import Cells, Row, run_cells
from deal_hw.control.process.channel import Outcome
from deal_hw.drivers.go2.descriptions.driver import DRIVER, LEG_LIMITS
from deal_hw.drivers.go2.emulator.truth import PROFILES, draw_truth, nominal_truth
from deal_hw.motions.planned_end import PlannedEnd
from deal_hw.motions.posture import PostureConfig
from deal_hw.motions.scores.velocity_error import velocity_error
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.types import FloatArray, RobotState
from deal_hw.workflows.emulation.virtual_go2 import VirtualWalk, walk
from deal_hw.workflows.emulation.walk_script import PROFILE, PROFILE_S, Walk
from deal_hw.workflows.shipped import shipped_policy

SCRIPT = Walk(PROFILE, PROFILE_S)
NAMES = ("stand", "ahead", "left", "turn")
"""Names of the profile's parts."""


class Rounds:
    """A walk, repeated."""

    def __init__(self, script: Walk) -> None:
        self._script = script

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity of the present part."""
        begins = [begin for begin, _ in self._script.parts]
        part = np.searchsorted(begins, time_s % self._script.seconds, side="right") - 1
        return np.array(self._script.parts[int(part)][1])


def measure(
    policy: OnnxPolicy,
    profile: str,
    seed: int | None,
    rounds: int,
    script: Walk = SCRIPT,
    names: Sequence[str] = NAMES,
) -> dict[str, Any]:
    """Walk some rounds with one robot.

    Args:
        policy: The policy.
        profile: The emulator's profile.
        seed: Seed of its hidden parameters; None: the nominal ones.
        rounds: Number of rounds.
        script: The walk of a round.
        names: Names of its parts.

    Returns:
        Plain JSON values: end of the run, clipped commands, and mean errors by part [m/s, rad/s].
    """
    truth = nominal_truth(profile) if seed is None else draw_truth(profile, seed)
    done = walk(truth, policy, Rounds(script), rounds * script.seconds, record=False)
    row: dict[str, Any] = {
        "profile": profile,
        "seed": seed,
        "seconds": rounds * script.seconds,
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
            for name, (_, velocity) in zip(names, script.parts, strict=True)
        }
        row |= {
            "velocity_error_m_s": round(error.velocity_m_s, 4),
            "yaw_error_rad_s": round(error.yaw_rad_s, 4),
            "parts": {wanted[k]: dict(zip(columns, v, strict=True)) for k, v in error.parts.items()},
        }
    return row


VELOCITIES = ((0.4, 0.0, 0.0), (1.0, 0.0, 0.0), (-0.4, 0.0, 0.0), (0.0, 0.4, 0.0), (0.3, 0.0, 0.8))
"""Velocities of the walks that end: ahead, to the left [m/s], turn [rad/s]."""
FIRST_END_S = 2.0
_ENDED = "measured end"


class Branches:
    """One velocity; at each of some times the process is copied, and the copy ends its walk.

    Attributes:
        end: The walk's planned end.
        ends_s: Times of the ends, in order [s]; at the last one this process ends its own walk.
        ended_s: Time of this process's end [s].
        copies: Pipes from the copies.
        answer: Pipe to the process that made this copy; -1 in the first one.
    """

    def __init__(self, velocity: Sequence[float], ends_s: Sequence[float]) -> None:
        self._velocity = np.array(velocity)
        self.end, self.ends_s = PlannedEnd(), list(ends_s)
        self.ended_s = 0.0
        self.copies: list[int] = []
        self.answer = -1

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity; at the time of an end, copy the process, and end the copy's walk."""
        if self.answer < 0 and self.ends_s and time_s >= self.ends_s[0] - 1e-6:
            self.ends_s.pop(0)
            if not self.ends_s or self._copied():
                self.ended_s = time_s
                self.end.request(_ENDED)
        return self._velocity

    def _copied(self) -> bool:
        """Copy the process; return whether this is the copy. The first one waits: one runs at a time."""
        read, write = os.pipe()
        if (pid := os.fork()) == 0:
            self.answer = write
            return True
        os.close(write)
        os.waitpid(pid, 0)
        self.copies.append(read)
        return False


def end_of(done: VirtualWalk, branches: Branches) -> dict[str, Any]:
    """Return how a walk ended: whether it fell, its largest lean, and its duration to lying down."""
    report, posture = done.report, PostureConfig()
    lean = float(np.max(done.tilt))
    ended = report.outcome is Outcome.STOPPED and report.reason == _ENDED
    stiff_s = report.cycles_sent / DRIVER.control_rate_hz
    return {
        "fell": not (ended and lean <= LEG_LIMITS.tilt),
        "reason": report.reason,
        "lean_rad": round(lean, 3),
        "end_s": round(stiff_s - posture.before_s - branches.ended_s - posture.lie_s, 3),
    }


def measure_ends(
    policy: OnnxPolicy, profile: str, seed: int | None, velocity: Sequence[float], count: int
) -> Row:
    """End a robot's walk with one velocity at some phases of the gait.

    Args:
        policy: The policy.
        profile: The emulator's profile.
        seed: Seed of its hidden parameters; None: the nominal ones.
        velocity: Ahead, left [m/s], turn [rad/s].
        count: Number of phases, one control cycle apart.
    """
    truth = nominal_truth(profile) if seed is None else draw_truth(profile, seed)
    times = FIRST_END_S + np.arange(count) / DRIVER.control_rate_hz
    branches = Branches(velocity, times.tolist())
    done = walk(truth, policy, branches, times[-1] + 1.0, record=False, end=branches.end)
    mine = end_of(done, branches)
    if branches.answer >= 0:
        os.write(branches.answer, json.dumps(mine).encode())
        os._exit(0)
    ends = []
    for pipe in branches.copies:
        with os.fdopen(pipe) as answer:
            ends.append(json.loads(answer.read()))
    ends.append(mine)
    return {
        "profile": profile,
        "seed": seed,
        "velocity": ",".join(f"{v:g}" for v in velocity),
        "ends": len(ends),
        "fell": sum(end["fell"] for end in ends),
        "largest_lean_rad": max(end["lean_rad"] for end in ends),
        "longest_end_s": max(end["end_s"] for end in ends),
        "falls": [end["reason"] for end in ends if end["fell"]],
        "error": "",
    }


def main() -> None:
    """Walk as the command line says; print a row for each robot."""
    options = parser(__doc__)
    options.add_argument("--policy", type=Path, default=shipped_policy("go2"))
    options.add_argument("--profile", choices=sorted(PROFILES), default="realistic")
    options.add_argument("--seeds", type=int, nargs="*", default=[0], help="none: the nominal robot")
    options.add_argument("--rounds", type=int, default=1)
    options.add_argument("--ends", type=int, default=0, help="end walks at so many phases; needs --out")
    args = options.parse_args()
    policy = OnnxPolicy(args.policy)
    if args.ends:
        walks = [
            (
                (args.profile, seed, ",".join(f"{v:g}" for v in velocity)),
                (seed, velocity),
            )
            for seed in args.seeds or [None]
            for velocity in VELOCITIES
        ]

        def ends(seed: int | None, velocity: tuple[float, float, float]) -> Row:
            return measure_ends(policy, args.profile, seed, velocity, args.ends)

        cells = Cells(names=("profile", "seed", "velocity"), run=ends, args=walks)
        if args.out is None:
            options.error("--ends needs --out FILE.json, which keeps the rows")

        def after(number: str, row: Row, rows: list[Row]) -> None:
            print(number, json.dumps(row), flush=True)

        run_cells(cells, args.out, after, program(__file__))
        return
    rows = []
    for seed in args.seeds or [None]:
        rows.append(measure(policy, args.profile, seed, args.rounds))
        print(json.dumps(rows[-1]), flush=True)
    write_document(args.out, {**head(__file__), "policy": policy.digest, "rows": rows})


if __name__ == "__main__":
    main()
