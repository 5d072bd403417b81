"""Ranges in which a sensor holds its last value are found by the jumps over them; motion is not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.data.checks.blind import CROSSINGS, BlindRange, check_blind, find_blind, seen, without_blind
from deal_hw.data.checks.spikes import DEFAULT_SPIKES
from deal_hw.data.checks.suite import check, examine
from deal_hw.data.table import Table
from deal_hw.findings import Severity
from deal_hw.types import FloatArray, Trajectory
from deal_hw.workflows.calibration.dataset import sound_recordings

RATE_HZ = 100.0
TIME_S = np.arange(1000) / RATE_HZ
SLOW = np.sin(2 * np.pi * 0.4 * TIME_S) * (1 - 0.04 * TIME_S)
"""0.4 Hz: 0.025 rad a sample at first, 0.015 at last; 4 passes each way through any place up to 0.6 rad."""

NOISE = np.random.default_rng(0).normal(size=len(TIME_S))
STEPS = np.convolve(0.4 * np.sign(np.sin(2 * np.pi * TIME_S + 0.01)), [0.05, 0.2, 0.6, 0.15], mode="same")
"""A fast servo's steps between two places, in step with the clock."""


def recording(position: FloatArray, time_s: FloatArray = TIME_S, unit: str = "rad") -> Table:
    """Return a recording of one joint."""
    return Table(
        joint_names=("pole",),
        actuated=("pole",),
        units=(unit,),
        time_s=time_s,
        position=position[:, None],
        velocity=None,
        effort=None,
        command_s=time_s,
        target=position[:, None],
        orientation=None,
        gyro=None,
        source={"file": "a.csv", "part": ""},
    )


def held(position: FloatArray, low: float, high: float, noise: FloatArray | float = 0.0) -> FloatArray:
    """Return what a sensor reports that holds the end at which it comes into a range."""
    found, last = position.copy(), low
    for k, value in enumerate(position):
        if value <= low:
            last = low
        elif value >= high:
            last = high
        else:
            found[k] = last
    return found + noise


def test_range_and_samples_are_found() -> None:
    """Readings stand at 0.2 and 0.5 rad and jump: both are the ends, and every held sample is left out."""
    truth = SLOW
    position = held(truth, 0.2, 0.5)
    (found,) = find_blind([recording(position)])
    assert (found.joint, found.unit) == ("pole", "rad")
    assert found.low == pytest.approx(0.2)
    assert found.high == pytest.approx(0.5)
    # 4 periods pass there 8 times.
    assert found.crossings == 8
    kept = seen(recording(position), [found])
    expected = (truth < 0.2) | (truth > 0.5)
    # The sample before a jump may be a held one, too.
    assert not np.any(kept & ~expected)
    assert np.sum(expected & ~kept) <= found.crossings


@pytest.mark.parametrize("seed", range(5))
def test_noise_on_held_values_leaves_none_of_them(seed: int) -> None:
    """With noise of 1 mrad no sample is kept that is wrong by more than noise."""
    noise = 1e-3 * np.random.default_rng(seed).normal(size=len(SLOW))
    position = held(SLOW, 0.2, 0.5, noise)
    ranges = find_blind([recording(position)])
    assert len(ranges) == 1
    kept = seen(recording(position), ranges)
    assert np.max(np.abs(position - SLOW)[kept]) < 6e-3
    assert np.mean(kept) > 0.85 * np.mean((SLOW < 0.2) | (SLOW > 0.5))


def test_turning_back_in_the_range_is_left_out() -> None:
    """A joint that comes out where it came in does not jump, but its samples are held ones, too."""
    ranges = find_blind([recording(held(SLOW, 0.2, 0.5))])
    truth = 0.4 * SLOW
    position = held(truth, 0.2, 0.5)
    assert not find_blind([recording(position)])
    np.testing.assert_array_equal(seen(recording(position), ranges), truth < 0.2)


def test_recordings_of_a_robot_are_judged_together() -> None:
    """One pass in each of three recordings is enough, and all lose their samples there."""
    passes = slice(0, 60)
    tables = [recording(held(size * SLOW, 0.2, 0.5)[passes], TIME_S[passes]) for size in (1.0, 0.8, 0.6)]
    assert not find_blind(tables[:2])
    (found,) = find_blind(tables)
    assert found.crossings == CROSSINGS
    for table in tables:
        assert np.all(np.diff(without_blind(table, [found]).position[:, 0]) != 0)
    assert find_blind([]) == ()


@pytest.mark.parametrize(
    ("position", "why"),
    [
        (SLOW, "motion"),
        (2 * np.sign(SLOW), "jumps from rest to rest, too wide"),
        (0.3 * np.sign(SLOW), "jumps from rest to rest"),
        (0.3 * np.sign(SLOW) + 1e-3 * NOISE, "jumps from rest to rest with noise"),
        (STEPS, "steps that are all alike, with one or two samples on their way"),
        (SLOW + 0.3 * (TIME_S > 5.0), "one jump that stays"),
        (np.round(SLOW / 0.05) * 0.05, "a coarse encoder"),
        (np.mod(6 * SLOW + np.pi, 2 * np.pi) - np.pi, "an angle that turns over"),
        (2.0 * np.sin(2 * np.pi * 9.0 * TIME_S), "fast motion: 1.1 rad a sample"),
        (np.where(np.arange(1000) % 97 == 0, SLOW + 1.0, SLOW), "spikes, at other places each time"),
    ],
)
def test_what_is_no_blind_range(position: FloatArray, why: str) -> None:
    """Other signals with jumps have none."""
    assert find_blind([recording(position)]) == (), why


def test_a_joint_that_turns_over_is_blind_in_each_turn() -> None:
    """It is one range, and all turns lose samples there."""
    truth = 0.9 * TIME_S * (1 + 0.1 * TIME_S)
    folded = held(np.mod(truth, 2 * np.pi), 1.1, 1.4)
    position = np.unwrap(folded)
    (found,) = find_blind([recording(position)])
    assert found.turns
    assert (found.low, found.high) == pytest.approx((1.1, 1.4), abs=0.02)
    assert found.crossings == 3
    kept = seen(recording(position), [found])
    wrong = np.abs(folded - np.mod(truth, 2 * np.pi)) > 1e-9
    assert not np.any(kept & wrong)
    assert np.sum(~kept & ~wrong) <= 2 * found.crossings


def test_slow_clock_needs_more_passes() -> None:
    """At 50 Hz a pole at 7 rad/s leaves one or two samples in 0.26 rad: twelve passes tell, four do not.

    So it is with the potentiometer of a real cart-pole.
    """
    time_s = np.arange(600) / 50.0
    truth = 4.0 * np.sin(2 * np.pi * 0.28 * time_s) * (1 - 0.04 * time_s)
    position = held(truth, 0.5, 0.76)
    assert not find_blind([recording(position[:200], time_s[:200])])
    (found,) = find_blind([recording(position, time_s)])
    assert (found.low, found.high) == pytest.approx((0.5, 0.76))
    assert found.faster < 3.0


@given(
    amplitude=st.floats(0.01, 3.0),
    rate=st.floats(0.05, 8.0),
    phase=st.floats(0.0, 6.28),
    noise=st.floats(0.0, 0.02),
    seed=st.integers(0, 10_000),
)
def test_smooth_motion_with_noise_has_none(
    amplitude: float, rate: float, phase: float, noise: float, seed: int
) -> None:
    """Two sines and white noise at any size and speed."""
    rng = np.random.default_rng(seed)
    wave = np.sin(2 * np.pi * rate * TIME_S + phase) + 0.5 * np.sin(2 * np.pi * 0.37 * rate * TIME_S)
    assert find_blind([recording(amplitude * wave + noise * rng.normal(size=len(TIME_S)))]) == ()


@given(values=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=0, max_size=40))
def test_any_values_are_read(values: list[float]) -> None:
    """Damaged recordings raise nothing."""
    position = np.array(values, dtype=np.float64)
    for one in find_blind([recording(position, np.arange(len(values)) / RATE_HZ)]):
        assert one.low < one.high


def test_unknown_unit_is_left_alone() -> None:
    """No threshold is known for a damaged recording's unit."""
    assert find_blind([recording(held(SLOW, 0.2, 0.5), unit="-")]) == ()


def test_warning_names_the_place() -> None:
    """It has joint, ends, number of jumps and share of samples. A recording away from there has none."""
    table = recording(held(SLOW, 0.2, 0.5))
    ranges = find_blind([table])
    warning = check_blind(table, ranges)
    assert warning.severity is Severity.WARN
    lost = f"{np.mean(~seen(table, ranges)):.1%}"
    for words in ("pole is between 0.20 and 0.50 rad", "8 times", lost):
        assert words in warning.message
    away = recording(0.1 * SLOW)
    assert check_blind(away, ranges).severity is Severity.OK
    assert without_blind(away, ranges) is away


def test_checks_see_the_recording_without_held_values() -> None:
    """The suite reports it once, by its code, as a warning."""
    table = dataclasses.replace(recording(held(SLOW, 0.2, 0.5)), target=SLOW[:, None])
    found = {one.code: one.severity for one in examine(table)}
    assert found["blind"] is Severity.WARN
    given_range = BlindRange("pole", "rad", 0.2, 0.5, (0.2, 0.5), 3, 9.0)
    assert {one.code: one.severity for one in examine(recording(0.1 * SLOW), blind=[given_range])}[
        "blind"
    ] is Severity.OK


def test_episodes_of_a_dataset_lose_their_held_samples(
    make_trajectory: Callable[..., Trajectory], tmp_path: Path
) -> None:
    """One episode shows the range; a second one, which comes there once, loses its samples, too."""
    clean = make_trajectory()
    time_s = clean.device_s
    swings = np.cos(5 * time_s) * (1 - 0.1 * time_s)
    one, other = (
        make_trajectory(position=np.stack([clean.position[:, 0], held(pole, 0.2, 0.5)], axis=1))
        for pole in (swings, 0.4 * swings)
    )
    assert {v.code for v in check(one) if v.severity is not Severity.OK} == {"blind"}
    assert not [v for v in check(other) if v.code == "blind" and v.severity is not Severity.OK]
    said: list[str] = []
    kept, lines = sound_recordings({0: one, 3: other}, tmp_path, DEFAULT_SPIKES, said.append)
    for number, pole in ((0, swings), (3, 0.4 * swings)):
        rows = np.isin(time_s, kept[number].device_s)
        assert not np.any(rows & (pole > 0.2) & (pole < 0.5))
        assert 0.7 * np.mean((pole < 0.2) | (pole > 0.5)) < np.mean(rows) < 0.95
        assert np.array_equal(kept[number].sent_s, clean.sent_s)
    assert [line.split(": ")[0] for line in said] == ["episode 0", "episode 3"]
    assert sum("no sample lies where pole" in line for line in lines) == 2
