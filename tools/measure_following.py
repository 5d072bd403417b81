#!/usr/bin/env python3
"""Whether "does it follow?" trips where it must, and nowhere else: every robot in virtual time.

python tools/measure_following.py --seeds 0-9 --out following.json
python tools/measure_following.py --faults --seeds 0-9 --out following_faults.json
python tools/measure_following.py --table following.json

Without --faults each robot plays all its shipped motions with each profile of its emulator; nothing is wrong
with it, so no run may trip on following. The column `push` is the largest push without motion, as a time at
the drive's limit; 0.3 s trips. With --faults a joint's reading or all drives fail in the middle of a motion,
and the time until the robot is passive is measured, with the largest distance of a set-point from its joint.
A fault of a joint that the motion does not move shows nothing, so the faulty joint is one that moves.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from measuring import Rows, add_seeds, markdown, parser, read_rows
from virtual_fleet import FleetRobot, fleet, run

from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.following import PUSH_S
from deal_hw.data.recording.record import CycleRecord
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.types import FloatArray

FAULTS: Final = {
    "frozen reading": "frozen_after_s",
    "exchanged readings": "exchanged_after_s",
    "turned reading": "turned_after_s",
    "drives limp for 2 s": "limp_after_s",
    "joints held for 2 s": "held_after_s",
}
MOTIONS: Final = ("multisine", "walk")
"""The motion of a robot in which it gets faults: the first that it has."""
NOT_THERE: Final = {"exchanged readings": "cartpole"}
"""A cart-pole's two readings have other units: nothing exchanges them."""
_AT_S: Final = (1.0, 3.0)
"""When a fault begins, after the first command of the motion itself [s]."""


def sound(one: FleetRobot, profile: str, motion: str, seed: int) -> dict[str, Any]:
    """Run a motion with nothing wrong."""
    report, safety = run(one.make(profile, seed), one.run_plan(motion, seed))
    return {
        "outcome": report.outcome.value,
        "flags": list(report.flags),
        "reason": report.reason,
        "push_s": round(safety._following.worst, 3),
        "error": "",
    }


def faulty(one: FleetRobot, profile: str, fault: str, seed: int) -> dict[str, Any]:
    """Run a motion in which something fails, and measure the time until the robot is passive."""
    motion = next(name for name in MOTIONS if name in one.motions)
    plan, made = one.run_plan(motion, seed), one.make(profile, seed)
    rng = np.random.default_rng([seed, len(fault)])
    at_s = float(rng.uniform(*_AT_S)) + (plan.posture.before_s if plan.stand else 0.0)
    d = made.robot.description
    joint = str(rng.choice(d.actuated))
    begin: dict[str, Any] = {FAULTS[fault]: 0.0}
    faults = JointFaults(faulty_joint=joint, **begin)
    first_ns, begun_ns, sent_ns, far = -1, -1, -1, 0.0

    def sink(record: CycleRecord) -> bool:
        nonlocal first_ns, begun_ns, sent_ns, far
        if record.sent is not None:
            first_ns = record.start_ns if first_ns < 0 else first_ns
            sent_ns = record.start_ns
            if begun_ns < 0 and record.start_ns - first_ns >= at_s * 1e9:
                begun_ns = record.start_ns
                made.device.joint_faults.give(faults, made.device.device_ns)
            if begun_ns >= 0:
                far = max(far, _distance(record, d.actuated_index))
        return True

    report, _ = run(made, plan, sink)
    tripped = report.outcome is Outcome.TRIPPED and begun_ns >= 0
    period_s = 1.0 / d.control_rate_hz
    return {
        "motion": motion,
        "joint": joint,
        "outcome": report.outcome.value,
        "flags": list(report.flags),
        "reason": report.reason,
        # The cycle after the last command is the first passive one.
        "passive_after_s": round((sent_ns - begun_ns) * 1e-9 + period_s, 3) if tripped else None,
        "distance": round(far, 3),
        "error": "",
    }


def _distance(record: CycleRecord, index: Sequence[int]) -> float:
    if not record.states or record.sent is None:
        return 0.0
    position: FloatArray = record.states[-1].position[list(index)]
    return float(np.abs(record.sent.position_target - position).max())


def sound_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return runs, trips and the largest push of each robot."""
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        found[row["robot"]].append(row)
    lines = [
        (
            robot,
            len(mine),
            sum("not_following" in row["flags"] for row in mine),
            f"{max(row['push_s'] for row in mine):.2f}",
        )
        for robot, mine in found.items()
    ]
    return markdown(("robot", "runs", "trips on following", f"largest push [s], {PUSH_S:g} trips"), lines)


def fault_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return, for each robot and fault, how many runs ended passive, and after which time."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        found[row["robot"], row["fault"]].append(row)
    lines = []
    for (robot, fault), mine in found.items():
        late = [row["passive_after_s"] for row in mine if row["passive_after_s"] is not None]
        spread = f"{np.median(late):.2f} / {max(late):.2f}" if late else ""
        far = f"{max(row['distance'] for row in mine):.2f}"
        lines.append((robot, fault, f"{len(late)} of {len(mine)}", spread, far))
    heads = ("robot", "fault", "passive", "after: median / worst [s]", "largest distance [rad or m]")
    return markdown(heads, lines)


def main() -> int:
    """Measure, or print the table of a file."""
    made = parser(__doc__, table=True)
    add_seeds(made, 0)
    made.add_argument("--robots", help="names such as so101,go2; by default all")
    made.add_argument("--faults", action="store_true", help="measure faults")
    made.add_argument("--profiles", help="by default all of a robot; with --faults the last")
    args = made.parse_args()
    if args.table is not None:
        rows = read_rows(args.table)
        print(fault_table(rows) if "fault" in rows[0] else sound_table(rows))
        return 0
    robots = fleet()
    names = tuple(args.robots.split(",")) if args.robots else tuple(robots)
    key = ("robot", "profile", "fault" if args.faults else "motion", "seed")
    kept = Rows(__file__, args.out, key)
    for name in names:
        one = robots[name]
        profiles = args.profiles.split(",") if args.profiles else one.profiles
        if args.faults:
            todo = [
                (profiles[-1], fault) for fault in FAULTS if not name.startswith(NOT_THERE.get(fault, "-"))
            ]
        else:
            todo = [(profile, motion) for profile in profiles for motion in one.motions]
        for profile, what in todo:
            for seed in args.seeds:
                if kept.done(name, profile, what, seed):
                    continue
                measure = faulty if args.faults else sound
                row = dict(zip(key, (name, profile, what, seed), strict=True))
                kept.add(row | measure(one, profile, what, seed), "")
    print(fault_table(kept.rows) if args.faults else sound_table(kept.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
