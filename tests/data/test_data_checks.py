"""Telemetry checks: each fault is found by its own check, and a sound recording passes all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from deal_hw.data.checks.suite import check, examine
from deal_hw.data.recording.excitation import excitation
from deal_hw.data.table import table_of
from deal_hw.findings import Finding, Severity, worst
from deal_hw.types import Status, Trajectory

MakeTrajectory = Callable[..., Trajectory]


def verdict(trajectory: Trajectory, name: str) -> Finding:
    """Return one verdict by its name."""
    (found,) = [verdict for verdict in check(trajectory) if verdict.code == name]
    return found


def cut(trajectory: Trajectory, keep: np.ndarray) -> Trajectory:
    """Return a trajectory with only some of its samples."""
    names = (
        "receive_s",
        "device_s",
        "position",
        "velocity",
        "effort",
        "status",
        "command_sequence",
        "command_age_s",
    )
    return replace(trajectory, **{name: getattr(trajectory, name)[keep] for name in names})


def test_sound_recording_passes(make_trajectory: MakeTrajectory) -> None:
    """Every check says ok."""
    verdicts = check(make_trajectory())
    assert [v for v in verdicts if v.severity is not Severity.OK] == []
    assert worst(verdicts) is Severity.OK
    assert len({v.code for v in verdicts}) == len(verdicts)


def test_short_recording_fails(make_trajectory: MakeTrajectory) -> None:
    """1.5 s are too short, and the message says what to do."""
    found = verdict(cut(make_trajectory(), np.arange(800) < 301), "length")
    assert found.severity is Severity.FAIL
    assert found.message.startswith("1.50 s, 301 state samples")
    assert "record at least 2 s" in found.message
    assert check(cut(make_trajectory(), np.arange(800) < 1))[0].severity is Severity.FAIL


def test_nan_fails_but_not_in_effort(make_trajectory: MakeTrajectory) -> None:
    """A NaN position fails with joint and count; a NaN effort, which calibration does not read, warns."""
    position = make_trajectory().position.copy()
    position[[5, 9], 1] = np.nan
    found = verdict(make_trajectory(position=position), "finite")
    assert found.severity is Severity.FAIL
    assert "position of pole (2 samples)" in found.message
    assert verdict(make_trajectory(effort=np.full((800, 2), np.nan)), "finite").severity is Severity.WARN


def test_clock_faults_fail(make_trajectory: MakeTrajectory) -> None:
    """A device clock that runs back, jumps or stands still is reported."""
    sound = make_trajectory()
    for shift, words in (
        (-1.0, "goes backwards 1 times, first after sample 400"),
        (0.1, "1 clock jumps (-100.0 ms at 2.10 s)"),
    ):
        device_s = sound.device_s + np.where(np.arange(800) >= 400, shift, 0.0)
        found = verdict(replace(sound, device_s=device_s), "clock")
        assert found.severity is Severity.FAIL
        assert words in found.message
    repeated = sound.device_s.copy()
    repeated[1::10] = repeated[::10]
    found = verdict(replace(sound, device_s=repeated), "clock")
    assert found.severity is Severity.FAIL
    assert "80 samples repeat" in found.message


def test_gaps_and_lost_frames(make_trajectory: MakeTrajectory) -> None:
    """A gap of 100 ms fails; one sample lost here and there is ok, 5 % warn."""
    sound = make_trajectory()
    number = np.arange(800)
    found = verdict(cut(sound, (number < 400) | (number >= 419)), "gaps")
    assert found.severity is Severity.FAIL
    assert "1 gaps, the longest 100 ms" in found.message
    assert verdict(cut(sound, number % 200 != 7), "gaps").severity is Severity.OK
    assert verdict(cut(sound, number % 20 != 7), "gaps").severity is Severity.WARN
    for lost, severity in ((8, Severity.OK), (40, Severity.WARN), (300, Severity.FAIL)):
        assert verdict(make_trajectory(metadata={"lost_frames": lost}), "lost_frames").severity is severity


def test_jitter_warns(make_trajectory: MakeTrajectory) -> None:
    """2 % of the samples 30 ms late warn; device stamps make them usable."""
    receive_s = make_trajectory().receive_s + np.where(np.arange(800) % 50 == 0, 0.03, 0.0)
    found = verdict(make_trajectory(receive_s=receive_s), "jitter")
    assert found.severity is Severity.WARN
    assert "0.00 ms (p50), 30.00 ms (p99)" in found.message


def test_frozen_channel(make_trajectory: MakeTrajectory) -> None:
    """A sensor that stops while the rest moves warns; one that never moves fails."""
    sound = make_trajectory()
    partly, wholly = sound.position.copy(), sound.position.copy()
    partly[300:500, 1] = partly[300, 1]
    wholly[:, 0] = 0.1
    found = verdict(replace(sound, position=partly), "frozen")
    assert found.severity is Severity.WARN
    assert "pole for 1 s" in found.message
    assert verdict(replace(sound, position=wholly), "frozen").severity is Severity.FAIL


def test_commands_that_never_arrive_fail(make_trajectory: MakeTrajectory) -> None:
    """Two thirds of the commands unseen fail; no command at all warns."""
    sound = make_trajectory()
    found = verdict(replace(sound, command_sequence=sound.command_sequence // 3 * 3), "commands")
    assert found.severity is Severity.FAIL
    assert "% of the commands were seen in force" in found.message
    nothing = {name: getattr(sound, name)[:0] for name in ("sent_s", "sent_sequence", "requested_position")}
    nothing["position_target"] = sound.position_target[:0]
    assert verdict(replace(sound, **nothing), "commands").severity is Severity.WARN


def test_clamping_by_the_device_is_data_and_by_us_is_flagged(make_trajectory: MakeTrajectory) -> None:
    """The device's limits never warn; our own filter does beyond 5 % of the commands."""
    sound = make_trajectory()
    status = np.where(np.arange(800) < 200, int(Status.EFFORT_CLAMPED), 0)
    found = verdict(replace(sound, status=status), "clamped_by_device")
    assert found.severity is Severity.OK
    assert "effort 25.0%" in found.message
    asked = sound.requested_position.copy()
    asked[:20] += 0.2
    found = verdict(replace(sound, requested_position=asked), "clamped_by_us")
    assert found.severity is Severity.WARN
    assert "changed 20 of 200 commands" in found.message
    rounding = replace(sound, requested_position=sound.requested_position + 0.5e-6)
    assert verdict(rounding, "clamped_by_us").severity is Severity.OK


def test_watchdog_end_stop_and_hand_over_warn(make_trajectory: MakeTrajectory) -> None:
    """Motors that were off, end stops and cycles that were not recorded are reported."""
    for flag in (Status.WATCHDOG, Status.FAULT, Status.AT_END_STOP):
        status = np.where(np.arange(800) > 700, int(flag), 0)
        assert verdict(make_trajectory(status=status), "stopped").severity is Severity.WARN
    found = verdict(make_trajectory(metadata={"hand_over_losses": 4}), "hand_over")
    assert found.severity is Severity.WARN
    assert found.message.startswith("4 control cycles")


def test_excitation_by_hand(make_trajectory: MakeTrajectory) -> None:
    """A square wave of 0.1 over 4 s changes at 0, 0.5, 1, ... s; the pole turns at 5 rad/s."""
    summary = excitation(make_trajectory())
    assert summary.duration_s == pytest.approx(3.995)
    assert summary.target_range == pytest.approx((0.2,))
    assert summary.position_range == pytest.approx((0.2, 2.0), abs=1e-3)
    assert summary.speed_max == pytest.approx((0.6, 5.0), abs=1e-3)
    # Up to 3.995 s cos(6 t) changes sign at pi/12, 3 pi/12, ...: 8 times; sin(5 t) at pi/5, 2 pi/5, ...: 6.
    assert summary.reversals == (8, 6)


def test_excitation_of_a_resting_robot_is_zero(make_trajectory: MakeTrajectory) -> None:
    """Nothing moves, nothing is commanded; NaN does not spread."""
    still = np.zeros((800, 2))
    velocity = np.where(np.arange(1600).reshape(800, 2) == 7, np.nan, 0.0)
    target = np.full((200, 1), 0.1)
    summary = excitation(make_trajectory(position=still, velocity=velocity, position_target=target))
    assert summary.position_range == (0.0, 0.0)
    assert summary.speed_max == (0.0, 0.0)
    assert summary.reversals == (0, 0)
    assert summary.target_changes == (0,)


def test_one_pause_is_judged_by_whose_recording_it_is(make_trajectory: MakeTrajectory) -> None:
    """Ours are used in one piece, so 100 ms are too long; those of others are split there."""
    number = np.arange(800)
    paused = cut(make_trajectory(), (number < 400) | (number >= 419))
    ours, others = verdict(paused, "gaps"), {f.code: f for f in examine(table_of(paused))}["gaps"]
    assert (ours.severity, others.severity) == (Severity.FAIL, Severity.WARN)
    assert ours.seen.startswith("1 gaps, the longest 100 ms")
    assert others.seen == "2 parts; the pause between them is not fitted (100 ms)" and not others.do


def test_roll_outs_are_parts_and_a_logger_that_loses_samples_fails(make_trajectory: MakeTrajectory) -> None:
    """Pauses of seconds between parts are no fault; parts too short for a window are, if they are many."""
    table, number = table_of(make_trajectory()), np.arange(800)
    roll_outs = replace(table, time_s=table.time_s + 3.0 * (number // 200))
    found = {f.code: f for f in examine(roll_outs)}
    assert found["gaps"].severity is Severity.WARN
    assert found["gaps"].seen == "4 parts; 3 pauses between them are not fitted (the longest 3 s)"
    # Nothing was measured in a pause, so nothing stood still in it.
    assert found["frozen"].severity is Severity.OK
    torn = replace(table, time_s=table.time_s + 0.1 * (number // 30))
    lost = {f.code: f for f in examine(torn)}["gaps"]
    assert lost.severity is Severity.FAIL and "27 parts are shorter than 0.2 s" in lost.message


def test_short_files_of_others_are_used(make_trajectory: MakeTrajectory) -> None:
    """0.8 s of a log are used, an episode that was imported from one, too; 0.15 s are not."""
    short = cut(make_trajectory(), np.arange(800) < 161)
    assert {f.code: f for f in examine(table_of(short))}["rate"].severity is Severity.OK
    assert verdict(replace(short, metadata={"import": {"period_s": 0.005}}), "length").severity is Severity.OK
    less = table_of(cut(make_trajectory(), np.arange(800) < 31))
    assert "at least 0.2 s" in {f.code: f for f in examine(less)}["rate"].message


@pytest.mark.parametrize("channel", ["position", "velocity", "effort"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_no_values_stop_the_checks(make_trajectory: MakeTrajectory, channel: str, value: float) -> None:
    """Of a channel without one sound value all other checks still report."""
    found = check(make_trajectory(**{channel: np.full((800, 2), value)}))
    assert len(found) == len(check(make_trajectory()))
    assert (worst(found) is Severity.FAIL) == (channel != "effort" and not np.isfinite(value))
