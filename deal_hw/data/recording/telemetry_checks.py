"""Telemetry checks find errors in a recording that would mislead a calibration.

A check returns one :class:`Finding`: "ok", "warn" (usable, with a limitation) or "fail" (``calibrate``
refuses the recording).
Limits of the device are part of the data and never fail. Limits of deal-hw's own safety filter are reported,
because then the robot did not get the policy's commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from deal_hw.data.recording.clock_sync import find_jumps
from deal_hw.data.recording.spikes import DEFAULT_SPIKES, SpikeSettings, describe, find_spikes, position_units
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray, Status, Trajectory

MIN_DURATION_S = 2.0
MAX_GAP_S = 0.05
FROZEN_S = 0.5
CLIP_TOLERANCE = 1e-5
"""Smaller differences between requested and sent are the wire's rounding [m or rad]."""


def check(trajectory: Trajectory, spikes: SpikeSettings = DEFAULT_SPIKES) -> tuple[Finding, ...]:
    """Run all checks on a recording; the order is fixed.

    Args:
        trajectory: The recording.
        spikes: What counts as a spike.
    """
    if trajectory.device_s.size < 2:
        count = trajectory.device_s.size
        return (
            Finding("length", Severity.FAIL, f"{count} state samples; record at least {MIN_DURATION_S:g} s"),
        )
    return (
        _length(trajectory),
        _finite(trajectory),
        _clock(trajectory),
        _gaps(trajectory),
        _lost_frames(trajectory),
        _jitter(trajectory),
        _frozen(trajectory),
        spikes_verdict(
            trajectory.device_s,
            trajectory.position,
            trajectory.joint_names,
            position_units(trajectory),
            spikes,
        ),
        _commands(trajectory),
        _clamped_by_device(trajectory),
        _clamped_by_us(trajectory),
        _stopped(trajectory),
        _hand_over(trajectory),
    )


def spikes_verdict(
    time_s: FloatArray,
    position: FloatArray,
    joints: Sequence[str],
    units: Sequence[str],
    settings: SpikeSettings,
) -> Finding:
    """Check for samples that jump away and come back; arguments as of :func:`find_spikes`."""
    found = find_spikes(time_s, position, units, settings)
    if not found:
        return Finding("spikes", Severity.OK, "no position jumps away and comes back")
    count = len({row for spike in found for row in spike.rows})
    text = (
        f"{count} samples jump and come back, faster than the joint ever moves otherwise: "
        f"{describe(found, time_s, joints, units)}"
    )
    if count > settings.most * time_s.size:
        return Finding(
            "spikes",
            Severity.FAIL,
            f"{text}; that is {count / time_s.size:.1%} of all samples: the sensor or its cable fails. "
            "Repair it and record again",
        )
    return Finding(
        "spikes",
        Severity.WARN,
        f"{text}. Calibration leaves them out (--spike-ratio); check the sensor and its cable",
    )


def nominal_period_s(trajectory: Trajectory) -> float:
    """Return the time between state samples: by the description, else the median of the recording [s]."""
    rate_hz = trajectory.metadata.get("description", {}).get("state_rate_hz")
    return 1.0 / rate_hz if rate_hz else float(np.median(np.diff(trajectory.device_s)))


def _length(trajectory: Trajectory) -> Finding:
    duration_s, count = trajectory.duration_s, trajectory.device_s.size
    text = f"{duration_s:.2f} s, {count} state samples, {trajectory.sent_s.size} commands"
    if duration_s >= MIN_DURATION_S:
        return Finding("length", Severity.OK, text)
    return Finding("length", Severity.FAIL, f"{text}; too short, record at least {MIN_DURATION_S:g} s")


def _finite(trajectory: Trajectory) -> Finding:
    bad = {
        f"{channel} of {joint}": int(np.sum(~np.isfinite(getattr(trajectory, channel)[:, index])))
        for channel in ("position", "velocity", "effort")
        for index, joint in enumerate(trajectory.joint_names)
    }
    # The file of an import may have no effort at all.
    if "import" in trajectory.metadata and np.isnan(trajectory.effort).all():
        bad = {name: count for name, count in bad.items() if not name.startswith("effort")}
    found = [f"{name}: {count}" for name, count in bad.items() if count]
    if not found:
        return Finding("finite", Severity.OK, "all values are finite")
    # Effort is the device's own estimate; a robot without one reports NaN, and calibration does not read it.
    severity = Severity.WARN if all(name.startswith("effort") for name in found) else Severity.FAIL
    return Finding("finite", severity, f"values that are not finite ({', '.join(found)}); check the sensors")


def _clock(trajectory: Trajectory) -> Finding:
    back = int(np.sum(np.diff(trajectory.device_s) < 0))
    if back:
        text = f"the device clock ran backwards {back} times; probably it restarted. Record again"
        return Finding("clock", Severity.FAIL, text)
    jumps = find_jumps(trajectory.device_s, trajectory.receive_s - trajectory.device_s)
    if jumps:
        places = ", ".join(f"{jump.size_s * 1e3:+.1f} ms at {jump.device_s:.2f} s" for jump in jumps[:5])
        text = f"{len(jumps)} clock jumps ({places}); do not set clocks while recording. Record again"
        return Finding("clock", Severity.FAIL, text)
    repeated = int(np.sum(np.diff(trajectory.device_s) == 0))
    if repeated:
        severity = Severity.FAIL if repeated > 0.02 * trajectory.device_s.size else Severity.WARN
        text = f"{repeated} samples repeat the device time of the one before; check that the device measures"
        return Finding("clock", severity, text)
    return Finding("clock", Severity.OK, "the clocks of device and host run evenly")


def _gaps(trajectory: Trajectory) -> Finding:
    steps = np.diff(trajectory.device_s)
    period_s = nominal_period_s(trajectory)
    count, longest_s = int(np.sum(steps > 1.5 * period_s)), float(np.max(steps))
    text = f"{count} gaps in the state stream, the longest {longest_s * 1e3:.1f} ms"
    if longest_s > max(MAX_GAP_S, 2.5 * period_s):
        return Finding(
            "gaps", Severity.FAIL, f"{text}; more than {MAX_GAP_S * 1e3:g} ms is too long. Check the cable"
        )
    return Finding("gaps", Severity.WARN if count > 0.02 * steps.size else Severity.OK, text)


def _lost_frames(trajectory: Trajectory) -> Finding:
    lost = int(trajectory.metadata.get("lost_frames", 0))
    share = lost / (lost + trajectory.device_s.size)
    text = f"{lost} state samples never arrived ({share:.1%})"
    if share > 0.2:
        return Finding("lost_frames", Severity.FAIL, f"{text}; check the cable and the load of this computer")
    return Finding("lost_frames", Severity.WARN if share > 0.02 else Severity.OK, text)


def _jitter(trajectory: Trajectory) -> Finding:
    delay_s = trajectory.receive_s - trajectory.device_s
    lateness_s = delay_s - np.min(delay_s)
    p50, p99 = np.percentile(lateness_s, [50, 99])
    text = f"samples arrive {p50 * 1e3:.2f} ms (p50), {p99 * 1e3:.2f} ms (p99) after the fastest one"
    if p99 > 0.02:
        return Finding(
            "jitter", Severity.WARN, f"{text}; control was late, but the device's own stamps are not affected"
        )
    return Finding("jitter", Severity.OK, text)


def _frozen(trajectory: Trajectory) -> Finding:
    moving = np.any(np.diff(trajectory.position, axis=0) != 0, axis=1)
    found = []
    for index, joint in enumerate(trajectory.joint_names):
        still_s = _longest_still(trajectory, index, moving)
        if still_s > FROZEN_S:
            found.append(f"{joint} for {still_s:.2f} s")
    if not found:
        return Finding("frozen", Severity.OK, "no position stands still while others move")
    text = (
        f"positions without any change while other joints move: {', '.join(found)}; check that the sensor "
        "is connected"
    )
    whole = any(not np.any(np.diff(column)) for column in trajectory.position.T)
    return Finding("frozen", Severity.FAIL if whole else Severity.WARN, text)


def _longest_still(trajectory: Trajectory, index: int, moving: np.ndarray[Any, np.dtype[np.bool_]]) -> float:
    """Return the longest time that one position does not change at all while another one does [s]."""
    changes = np.flatnonzero(np.diff(trajectory.position[:, index]) != 0) + 1
    edges = np.concatenate(([0], changes, [trajectory.device_s.size - 1]))
    spans = np.diff(trajectory.device_s[edges])
    total = np.concatenate(([0], np.cumsum(moving)))
    others = np.diff(total[edges]) > 0.5 * np.diff(edges)
    return float(np.max(spans[others], initial=0.0))


def _commands(trajectory: Trajectory) -> Finding:
    seen = np.unique(trajectory.command_sequence[trajectory.command_sequence >= 0])
    sent = trajectory.sent_sequence
    if not sent.size:
        return Finding(
            "commands", Severity.WARN, "no command was sent; the motors were passive in the whole recording"
        )
    inside = sent[sent <= (seen[-1] if seen.size else -1)]
    arrived = float(np.mean(np.isin(inside, seen))) if inside.size else 0.0
    text = f"{arrived:.1%} of the commands were seen in force"
    if arrived < 0.5:
        return Finding(
            "commands", Severity.FAIL, f"{text}; the device does not get the others. Check the cable to it"
        )
    return Finding("commands", Severity.WARN if arrived < 0.98 else Severity.OK, text)


def _clamped_by_device(trajectory: Trajectory) -> Finding:
    effort = np.mean((trajectory.status & int(Status.EFFORT_CLAMPED)) != 0)
    speed = np.mean((trajectory.status & int(Status.SPEED_CLAMPED)) != 0)
    text = (
        f"the device's own limits were in force: effort {effort:.1%}, speed {speed:.1%} of the time; "
        "this is no error"
    )
    return Finding("clamped_by_device", Severity.OK, text)


def _clamped_by_us(trajectory: Trajectory) -> Finding:
    asked, sent = trajectory.requested_position, trajectory.position_target
    clipped = np.any(np.abs(asked - sent) > CLIP_TOLERANCE, axis=1)
    count = int(np.sum(clipped))
    text = f"our safety filter changed {count} of {clipped.size} commands"
    if count > 0.05 * clipped.size:
        return Finding("clamped_by_us", Severity.WARN, f"{text}; request smaller targets or raise its limits")
    return Finding("clamped_by_us", Severity.OK, text)


def _stopped(trajectory: Trajectory) -> Finding:
    watchdog = float(np.mean((trajectory.status & int(Status.WATCHDOG)) != 0))
    fault = float(np.mean((trajectory.status & int(Status.FAULT)) != 0))
    stops = float(np.mean((trajectory.status & int(Status.AT_END_STOP)) != 0))
    text = f"watchdog {watchdog:.1%}, fault {fault:.1%}, at an end stop {stops:.1%} of the time"
    if watchdog or fault:
        return Finding("stopped", Severity.WARN, f"{text}; the motors were off then: use the part before")
    if stops:
        return Finding("stopped", Severity.WARN, f"{text}; check the model's end stops")
    return Finding("stopped", Severity.OK, text)


def _hand_over(trajectory: Trajectory) -> Finding:
    lost = int(trajectory.metadata.get("hand_over_losses", 0))
    text = f"{lost} control cycles did not reach the recorder"
    if lost:
        text += "; their samples are missing. Check for a slow disk or an overloaded computer"
    return Finding("hand_over", Severity.WARN if lost else Severity.OK, text)
