"""Measure how the emulated Go2 canters behind the safety filter, in virtual time, and draw its gait.

    python tools/measure_go2_canter.py --policy runs/canter/policies/policy.onnx --seeds 0-4
    python tools/measure_go2_canter.py --seeds 1000-1004 --speeds 1 1.5 --out canter.json --draw canter.png
    python tools/measure_go2_canter.py --table canter.json --draw canter.png

Driver, wire format, filter, safety checks and control loop are those of `deal-hw deploy go2`; only time is
virtual. A robot stands for 1 s, then canters straight ahead at one speed for the time that 6 m take and 2 s
more, and comes to a stand. A row is one robot and speed:

- the end of the run, and how often the filter changed a command;
- errors of velocity and yaw rate, against the emulator's true motion, from 1 s after the command on;
- deviation: distance of the base after 5 m from the line along its heading when the policy began (positive:
  to the left), and its change of heading there;
- duty, phase and steps of each foot by the robot's own foot sensors, and their errors against the schedule of
  the policy's training (`deal_hw.policies.canter_env.ContactSchedule`).

The gait diagram has the schedule above and the policy below: a bar is a foot on the floor. With `--reference
FILE` it has another policy on the same robot above, such as the one that the policy imitates.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from measuring import Row, Rows, add_seeds, parser

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import LEGS
from deal_hw.drivers.go2.emulator.truth import PROFILES, draw_truth
from deal_hw.motions.scores.gait import gait_score, stances
from deal_hw.motions.scores.straightness import LINE_M, straightness
from deal_hw.motions.scores.velocity_error import velocity_error, wanted_velocity
from deal_hw.policies.canter_env import ContactSchedule
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.types import FloatArray, RobotState, Trajectory
from deal_hw.workflows.emulation.virtual_go2 import walk

ASSETS = Path(__file__).parents[1] / "policies" / "assets"
STAND_S: Final = 1.0
SETTLE_S: Final = 1.0
"""Time after the command that the gait is not judged [s]."""
SHOWN_S: Final = 2.0
"""Time that a gait diagram shows [s]."""


class StraightAhead:
    """A velocity ahead, after standing."""

    def __init__(self, speed: float) -> None:
        self._speed = speed

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity."""
        return np.array([self._speed if time_s >= STAND_S else 0.0, 0.0, 0.0])


def measure(
    policy: OnnxPolicy, schedule: ContactSchedule, profile: str, seed: int, speed: float, hold: bool = False
) -> tuple[Row, dict[str, Any]]:
    """Canter with one robot at one speed.

    Args:
        policy: The policy.
        schedule: The plan of its contacts.
        profile: The emulator's profile.
        seed: Seed of its hidden parameters.
        speed: Commanded velocity ahead [m/s].
        hold: Whether the robot's inertial sensor holds the heading, as `deal-hw deploy --hold-heading`.

    Returns:
        The row, and the stances of the gait diagram: times, plan and policy.
    """
    seconds = STAND_S + (LINE_M + 1.0) / speed + 2.0
    done = walk(draw_truth(profile, seed), policy, StraightAhead(speed), seconds, hold_heading=hold)
    row: Row = {
        "profile": profile,
        "seed": seed,
        "speed_m_s": speed,
        "hold_heading": hold,
        "outcome": done.report.outcome.value,
        "reason": done.report.reason,
        "clipped": done.report.clipped,
        "cycles": done.report.cycles_sent,
        "largest_lean_rad": round(float(np.max(done.tilt)), 3),
        "error": "",
    }
    trajectory, wanted = done.trajectory, done.wanted
    if trajectory is None or wanted is None:
        return row, {}
    line = straightness(done.track, float(wanted.time_s[0]))
    row |= {
        "deviation_m": None if line is None else round(line.deviation_m, 4),
        "heading_rad": None if line is None else round(line.heading_rad, 4),
    }
    error = velocity_error(done.track, wanted)
    if error is not None:
        row |= {
            "velocity_error_m_s": round(error.velocity_m_s, 4),
            "yaw_error_rad_s": round(error.yaw_rad_s, 4),
            "ahead_m_s": error.parts.get(f"{speed:g},0,0", [None] * 3)[2],
        }
    return row | gait_of(trajectory, policy, schedule), diagram(trajectory, policy, schedule)


def _contacts(trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return times since the policy's clock was zero, and forces on the feet, without slowing down."""
    wanted, body = wanted_velocity(trajectory), trajectory.body
    assert wanted is not None and body is not None
    time_s = trajectory.receive_s - wanted.time_s[0]
    judged = (time_s >= STAND_S + SETTLE_S) & (trajectory.receive_s < wanted.end_s)
    return time_s[judged], body.foot_force[judged]


def gait_of(trajectory: Trajectory, policy: OnnxPolicy, schedule: ContactSchedule) -> Row:
    """Return duty, phases and their errors, as a part of a row."""
    time_s, force = _contacts(trajectory)
    if time_s.size < 2:
        return {}
    score = gait_score(
        time_s, force, clock_hz=policy.spec.clock_hz, touchdown=schedule.touchdown, duty=schedule.duty
    )
    if score is None:
        return {}
    values = asdict(score)
    return {
        name: [round(float(x), 4) for x in value] if isinstance(value, np.ndarray) else round(value, 4)
        for name, value in values.items()
    }


def diagram(trajectory: Trajectory, policy: OnnxPolicy, schedule: ContactSchedule) -> dict[str, Any]:
    """Return the stances to draw, as plain values."""
    time_s, force = _contacts(trajectory)
    shown = time_s < (time_s[0] if time_s.size else 0.0) + SHOWN_S
    if not shown.any():
        return {}
    clock = time_s[shown] * policy.spec.clock_hz % 1.0
    down = stances(force, time_s, 0.1 / policy.spec.clock_hz)[shown]
    return {
        "time_s": [round(float(t), 4) for t in time_s[shown]],
        "plan": schedule.stance(clock).astype(int).tolist(),
        "policy": down.astype(int).tolist(),
    }


def draw(path: Path, shown: dict[str, Any], title: str) -> None:
    """Draw the plan, or a reference in its place, and the policy, one above the other."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    time_s = np.array(shown["time_s"])
    figure, rows = plt.subplots(2, 1, figsize=(8, 3.6), sharex=True, layout="constrained")
    above = "reference" if "reference" in shown else "plan"
    for axes, name in zip(rows, (above, "policy"), strict=True):
        down = np.array(shown[name], dtype=bool)
        for place, leg in enumerate(("RL", "RR", "FL", "FR")):
            state = np.concatenate([[False], down[:, LEGS.index(leg)], [False]]).astype(int)
            begins, ends = (np.flatnonzero(np.diff(state) == change).tolist() for change in (1, -1))
            last = len(time_s) - 1
            bars = [(time_s[a], time_s[min(b, last)] - time_s[a]) for a, b in zip(begins, ends, strict=True)]
            axes.broken_barh(
                bars, (3 - place - 0.35, 0.7), facecolors="tab:blue" if name == "policy" else "0.4"
            )
        axes.set_yticks([3, 2, 1, 0], ["RL", "RR", "FL", "FR"])
        axes.set_ylabel(name)
        axes.set_xlim(time_s[0], time_s[-1])
    rows[0].set_title(title)
    rows[1].set_xlabel("time since the policy began [s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def table(rows: list[Row]) -> str:
    """Return the medians and worst values for each speed, as lines."""
    lines = []
    for speed in sorted({row["speed_m_s"] for row in rows}):
        of_speed = [row for row in rows if row["speed_m_s"] == speed]
        ended = sum(row["outcome"] != "finished" for row in of_speed)
        parts = [f"{speed:g} m/s: {len(of_speed)} runs, {ended} ended early"]
        for name in (
            "velocity_error_m_s",
            "ahead_m_s",
            "deviation_m",
            "duty_error",
            "phase_error",
            "pattern_error",
            "suspended",
        ):
            values = [row[name] for row in of_speed if row.get(name) is not None]
            if values:
                size = np.abs(values)
                parts.append(f"{name} {np.median(size):.3f} (worst {np.max(size):.3f})")
        lines.append("; ".join(parts))
    return "\n".join(lines)


def main() -> None:
    """Canter as the command line says."""
    options = parser(__doc__, table=True)
    options.add_argument("--policy", type=Path, default=ASSETS / "go2_canter.onnx")
    options.add_argument("--profile", choices=sorted(PROFILES), default="realistic")
    add_seeds(options, 0)
    options.add_argument("--speeds", type=float, nargs="+", default=[1.0, 1.5])
    options.add_argument("--hold-heading", action="store_true", help="as `deal-hw deploy --hold-heading`")
    options.add_argument("--reference", type=Path, help="draw this policy in place of the schedule")
    options.add_argument("--draw", type=Path, help="draw the gait of the first row to this PNG file")
    args = options.parse_args()
    if args.table is not None:
        rows = json.loads(args.table.read_text(encoding="utf-8"))["rows"]
    else:
        policy, schedule = OnnxPolicy(args.policy), ContactSchedule()
        policy.spec.check_fits(DRIVER)
        kept = Rows(__file__, args.out, ("profile", "seed", "speed_m_s"))
        for seed in args.seeds:
            for speed in args.speeds:
                if not kept.done(args.profile, seed, speed):
                    row, shown = measure(policy, schedule, args.profile, seed, speed, args.hold_heading)
                    first = not any("diagram" in other for other in kept.rows)
                    if first and args.reference is not None:
                        of = (
                            OnnxPolicy(args.reference),
                            schedule,
                            args.profile,
                            seed,
                            speed,
                            args.hold_heading,
                        )
                        shown["reference"] = measure(*of)[1]["policy"]
                    kept.add({**row, "diagram": shown} if first else row, json.dumps(row))
        rows = kept.rows
    print(table(rows))
    drawn = next((row for row in rows if row.get("diagram")), None)
    if args.draw is not None and drawn is not None:
        title = f"emulated Go2 ({drawn['profile']}, seed {drawn['seed']}) at {drawn['speed_m_s']:g} m/s"
        draw(args.draw, drawn["diagram"], title)
        print(f"written: {args.draw}")


if __name__ == "__main__":
    main()
