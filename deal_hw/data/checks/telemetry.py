"""Checks that only our own recorder's data allow: two clocks, lost frames, commands and limits in force.

Limits of the device are part of the data and never fail. Limits of deal-hw's own safety filter are reported,
because then the robot did not get the policy's commands.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.data.checks.clock_sync import find_jumps
from deal_hw.findings import Finding, Severity
from deal_hw.types import Status, Trajectory

CLIP_TOLERANCE: Final = 1e-5
"""Smaller differences between requested and sent are the wire's rounding [m or rad]."""


def check_jumps(trajectory: Trajectory) -> Finding:
    """Check that nobody set the clock of device or host."""
    jumps = find_jumps(trajectory.device_s, trajectory.receive_s - trajectory.device_s)
    if not jumps:
        return Finding("clock", Severity.OK, "the clocks of device and host run evenly")
    places = ", ".join(f"{jump.size_s * 1e3:+.1f} ms at {jump.device_s:.2f} s" for jump in jumps[:5])
    text = f"{len(jumps)} clock jumps ({places})"
    return Finding("clock", Severity.FAIL, text, "do not set clocks while recording: record again")


def check_lost_frames(trajectory: Trajectory) -> Finding:
    """Check the share of state samples that never arrived."""
    lost = int(trajectory.metadata.get("lost_frames", 0))
    share = lost / (lost + trajectory.device_s.size)
    text = f"{lost} state samples never arrived ({share:.1%})"
    severity = Severity.FAIL if share > 0.2 else Severity.WARN if share > 0.02 else Severity.OK
    remedy = "" if severity is Severity.OK else "check the cable and the load of this computer"
    return Finding("lost_frames", severity, text, remedy)


def check_jitter(trajectory: Trajectory) -> Finding:
    """Check how late samples arrive after the fastest one."""
    delay_s = trajectory.receive_s - trajectory.device_s
    lateness_s = delay_s - np.min(delay_s)
    p50, p99 = np.percentile(lateness_s, [50, 99])
    text = f"samples arrive {p50 * 1e3:.2f} ms (p50), {p99 * 1e3:.2f} ms (p99) after the fastest one"
    if p99 > 0.02:
        text += "; control was late, but the device's own stamps are not affected"
        return Finding("jitter", Severity.WARN, text)
    return Finding("jitter", Severity.OK, text)


def check_arrival(trajectory: Trajectory) -> Finding:
    """Check that the device reports the commands as in force.

    Logs of others have no such report: :func:`.meaning.check_commands` judges their clock and motion. There a
    recording without commands is refused; ours may be one of a passive robot.
    """
    seen = np.unique(trajectory.command_sequence[trajectory.command_sequence >= 0])
    sent = trajectory.sent_sequence
    if not sent.size:
        text = "no command was sent; the motors were passive in the whole recording"
        return Finding("commands", Severity.WARN, text)
    inside = sent[sent <= (seen[-1] if seen.size else -1)]
    arrived = float(np.mean(np.isin(inside, seen))) if inside.size else 0.0
    text = f"{arrived:.1%} of the commands were seen in force"
    if arrived < 0.5:
        text += "; the device does not get the others"
        return Finding("commands", Severity.FAIL, text, "check the cable to it")
    return Finding("commands", Severity.WARN if arrived < 0.98 else Severity.OK, text)


def check_device_limits(trajectory: Trajectory) -> Finding:
    """Report how long the device's own limits were in force."""
    effort = np.mean((trajectory.status & int(Status.EFFORT_CLAMPED)) != 0)
    speed = np.mean((trajectory.status & int(Status.SPEED_CLAMPED)) != 0)
    text = (
        f"the device's own limits were in force: effort {effort:.1%}, speed {speed:.1%} of the time; "
        "this is no error"
    )
    return Finding("clamped_by_device", Severity.OK, text)


def check_safety_filter(trajectory: Trajectory) -> Finding:
    """Check how many commands our own safety filter changed."""
    asked, sent = trajectory.requested_position, trajectory.position_target
    clipped = np.any(np.abs(asked - sent) > CLIP_TOLERANCE, axis=1)
    count = int(np.sum(clipped))
    text = f"our safety filter changed {count} of {clipped.size} commands"
    wrong = count > 0.05 * clipped.size
    return Finding.judged("clamped_by_us", wrong, text, "request smaller targets or raise its limits")


def check_stops(trajectory: Trajectory) -> Finding:
    """Check for motors that were off, and for end stops."""
    watchdog, fault, stops = (
        float(np.mean((trajectory.status & int(bit)) != 0))
        for bit in (Status.WATCHDOG, Status.FAULT, Status.AT_END_STOP)
    )
    text = f"watchdog {watchdog:.1%}, fault {fault:.1%}, at an end stop {stops:.1%} of the time"
    if watchdog or fault:
        return Finding("stopped", Severity.WARN, f"{text}; the motors were off then", "use the part before")
    return Finding.judged("stopped", stops > 0, text, "check the model's end stops")


def check_hand_over(trajectory: Trajectory) -> Finding:
    """Check that every control cycle reached the recorder."""
    lost = int(trajectory.metadata.get("hand_over_losses", 0))
    text = f"{lost} control cycles did not reach the recorder"
    if lost:
        text += "; their samples are missing"
    return Finding.judged("hand_over", lost > 0, text, "check for a slow disk or an overloaded computer")
