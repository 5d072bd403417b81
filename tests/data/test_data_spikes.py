"""Samples that jump away and come back are found; real motion, chatter and jumps for good are not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.data.checks.spikes import SpikeSettings, describe, find_spikes, sound, without_spikes
from deal_hw.data.checks.suite import check, despiked, examine
from deal_hw.data.importing.npz_source import read_npz
from deal_hw.data.table import Table
from deal_hw.findings import Severity
from deal_hw.types import FloatArray, Trajectory

TIME_S = np.arange(200, dtype=np.float64) * 0.01
WAVE = np.sin(2 * np.pi * 1.0 * TIME_S)
"""1 Hz: at most 0.0628 rad a sample, so a spike is more than 0.314 rad from both neighbours."""


def rows(position: FloatArray, time_s: FloatArray = TIME_S, unit: str = "rad") -> list[tuple[int, ...]]:
    """Return the samples of each spike of one joint."""
    return [spike.rows for spike in find_spikes(time_s, position[:, None], (unit,))]


def changed(values: dict[int, float], of: FloatArray = WAVE) -> FloatArray:
    """Return a signal with some samples replaced."""
    found = of.copy()
    for row, value in values.items():
        found[row] = value
    return found


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, []),
        ({50: 3.0}, [(50,)]),
        ({50: -2.0, 51: -2.5}, [(50, 51)]),
        ({50: 3.0, 51: 3.0, 52: 3.1}, [(50, 51, 52)]),
        ({50: 3.0, 51: 3.0, 52: 3.0, 53: 3.0}, []),  # Four samples may be anything.
        ({50: 3.0, 52: -4.0, 120: 2.0}, [(50,), (52,), (120,)]),
        ({50: 4.0, 51: -4.0}, [(50, 51)]),
        ({0: 2.0}, [(0,)]),  # A driver that had not read yet.
        ({199: 3.0}, [(199,)]),
    ],
)
def test_what_a_spike_is(values: dict[int, float], expected: list[tuple[int, ...]]) -> None:
    """One to three samples that come back are found to the sample; four are not."""
    assert rows(changed(values)) == expected


def test_a_unit_that_is_none_is_left_alone() -> None:
    """A damaged recording may name any unit: no threshold is known for it, and nothing is raised."""
    assert rows(changed({50: 3.0}), unit="-") == []


def test_threshold_is_the_fastest_motion_times_the_ratio() -> None:
    """A joint moves 0.02 rad a sample, so 0.1 rad is five times that: 0.105 is a spike, 0.095 is not.

    Both are distances from the nearer neighbour, 0.02 rad less than from the line through both.
    """
    ramp = 0.02 * np.arange(200.0)
    settings = SpikeSettings(least={"rad": 1e-3}, speed={"rad": 0.0})
    for off, count in ((0.125, 1), (0.115, 0)):
        found = find_spikes(TIME_S, changed({100: 2.0 + off}, ramp)[:, None], ("rad",), settings)
        assert len(found) == count
        assert all(spike.size == pytest.approx(off) for spike in found)
    gentle = SpikeSettings(ratio=10.0, least={"rad": 1e-3}, speed={"rad": 0.0})
    assert not find_spikes(TIME_S, changed({100: 2.125}, ramp)[:, None], ("rad",), gentle)


def test_joint_at_rest_is_allowed_some_speed_and_some_way() -> None:
    """At rest there is no speed to compare with: 0.1 rad and 10 rad/s, or 1 cm and 1 m/s, decide.

    At 100 Hz 10 rad/s are 0.1 rad; at 20 Hz they are 0.5 rad; at 1 kHz only the 0.1 rad count.
    """
    still = np.zeros(200)
    assert rows(changed({70: 0.09}, still)) == [] and rows(changed({70: 0.11}, still)) == [(70,)]
    assert rows(changed({70: 0.4}, still), 5 * TIME_S) == []
    assert rows(changed({70: 0.6}, still), 5 * TIME_S) == [(70,)]
    assert rows(changed({70: 0.09}, still), TIME_S / 10) == []
    assert rows(changed({70: 0.02}, still), unit="m") == [(70,)]


def test_a_jump_for_good_and_a_stop_half_way_are_no_spikes() -> None:
    """A clock that lost rows, or a joint that was moved by hand, does not come back."""
    assert rows(np.where(TIME_S < 1.0, WAVE, WAVE + 3.0)) == []
    assert rows(changed({100: 1.5}, np.where(TIME_S < 1.005, 0.0, 3.0))) == []
    assert rows(changed({100: 1.4, 101: 1.4}, np.where(TIME_S < 1.005, 0.0, 3.0))) == []


def test_chatter_near_half_the_rate_is_motion() -> None:
    """A limit cycle of 0.5 rad at every other sample jumps and comes back all along."""
    chatter = 0.25 * (-1.0) ** np.arange(200, dtype=np.float64)
    assert rows(chatter) == []
    burst = np.where((TIME_S > 1.0) & (TIME_S < 1.2), chatter, 0.0)
    assert rows(burst) == []


def test_a_blow_with_fast_motion_is_motion() -> None:
    """A joint that swings at 30 rad/s and bounces off a stop turns within a sample."""
    bounce = np.abs(((0.3 * np.arange(200)) % 3.0) - 1.5)
    assert rows(bounce) == []


def test_lost_samples_allow_more_motion() -> None:
    """Across a gap of ten samples a joint may go ten times as far."""
    kept = (np.arange(200) < 50) | (np.arange(200) >= 60)
    lonely = kept.copy()
    lonely[55] = True
    moved = changed({55: WAVE[55] + 1.0})
    assert rows(moved[lonely], TIME_S[lonely]) == []
    assert rows(moved, TIME_S) == [(55,)]


def test_values_that_are_not_numbers_are_nobodys_neighbours() -> None:
    """Rows without a position or with a stamp twice are passed over; the others keep their numbers."""
    position = changed({50: 3.0, 49: np.nan, 51: np.inf})
    time_s = TIME_S.copy()
    time_s[53] = time_s[52]
    assert rows(position, time_s) == [(50,)]
    assert rows(np.full(200, np.nan)) == [] and rows(np.zeros(3), np.arange(3.0)) == []


def test_words_name_joint_size_time_and_length() -> None:
    """One line, five spikes at most; the size is measured from the line between the neighbours."""
    position = np.stack([np.zeros(200), np.zeros(200)], axis=1)
    position[50, 0], position[120:122, 1] = 3.0, -2.0
    found = find_spikes(TIME_S, position, ("rad", "m"))
    assert describe(found, TIME_S, ("hip", "rail"), ("rad", "m")) == (
        "hip +3 rad at 0.500 s, rail -2 m at 1.200 s (2 samples)"
    )
    assert np.flatnonzero(~sound(found, 200)).tolist() == [50, 120, 121]
    position[10:50:8, 0] = 3.0
    many = find_spikes(TIME_S, position, ("rad", "m"))
    assert describe(many, TIME_S, ("hip", "rail"), ("rad", "m")).endswith("and 2 more")


@given(
    st.lists(st.integers(5, 190), min_size=1, max_size=4, unique=True),
    st.floats(1.5, 1e6),
    st.sampled_from((-1.0, 1.0)),
    st.floats(-100, 100),
)
def test_large_jumps_are_found_wherever_they_are(
    places: list[int], size: float, sign: float, level: float
) -> None:
    """Whatever four single samples jump, and from whatever level, exactly those are found."""
    places = [p for p in sorted(places) if all(abs(p - q) > 4 for q in places if q != p)]
    position = level + WAVE
    position[places] += sign * size
    assert rows(position) == [(p,) for p in places]


@given(st.integers(0, 2**32 - 1), st.floats(0.001, 2.0), st.floats(0.2, 45.0))
def test_noise_and_sines_have_no_spikes(seed: int, size: float, frequency_hz: float) -> None:
    """Sums of a sine below half the rate, quantised, and white noise are all motion."""
    rng = np.random.default_rng(seed)
    motion = size * np.sin(2 * np.pi * frequency_hz * TIME_S + rng.uniform(0, 6))
    assert rows(motion + 0.003 * rng.standard_normal(200)) == []
    assert rows(np.round(motion / 0.0015) * 0.0015) == []


def test_check_of_an_imported_recording(make_table: Callable[..., Table]) -> None:
    """Spikes are reported, and the other checks, which they would upset, see the recording without them."""
    position = make_table().position.copy()
    position[300, 0], position[700, 2] = 300.0, -3.0
    table = make_table(position=position)
    limits = np.array([[-1.0, 1.0]] * 3)
    (found,) = [v for v in examine(table, limits) if v.severity is not Severity.OK]
    assert found.code == "spikes" and found.severity is Severity.WARN
    assert (
        "hip +300 rad at 3.000 s, foot -2.84 rad at 7" in found.message and "--spike-ratio" in found.message
    )
    kept = despiked(table, SpikeSettings())
    assert np.array_equal(kept.time_s, np.delete(table.time_s, [300, 700]))
    assert len(kept.target) == len(table.target)
    overruled = examine(table, limits, None, SpikeSettings(ratio=1e6))
    assert any(v.code == "units" and v.severity is Severity.FAIL for v in overruled)


def test_a_sensor_that_fails_is_refused(make_table: Callable[..., Table]) -> None:
    """26 of 1200 samples are more than 2 %."""
    position = make_table().position.copy()
    position[40:1200:45, 1] += 3.0
    found = next(v for v in examine(make_table(position=position)) if v.code == "spikes")
    assert found.severity is Severity.FAIL and "26 samples" in found.message and "2.2%" in found.message


def test_check_of_our_own_recording(make_trajectory: Callable[..., Trajectory]) -> None:
    """A spike is a warning, and its sample is left out like a lost one."""
    clean = make_trajectory()
    assert without_spikes(clean) is clean
    position = clean.position.copy()
    position[100, 1] += 3.0
    recorded = make_trajectory(position=position)
    (found,) = [v for v in check(recorded) if v.severity is not Severity.OK]
    assert found.code == "spikes" and "pole +3 rad at 0.500 s" in found.message
    kept = without_spikes(recorded)
    assert np.array_equal(kept.device_s, np.delete(clean.device_s, 100))
    assert np.array_equal(kept.position, np.delete(clean.position, 100, axis=0))
    assert np.array_equal(kept.sent_s, clean.sent_s)


def test_real_recordings_have_none() -> None:
    """Two real robots, nine recordings, contacts among them: no sample is left out, with much to spare."""
    folder = os.environ.get("DEAL_HW_REAL_RECORDINGS")
    if not folder:
        pytest.skip(
            "DEAL_HW_REAL_RECORDINGS names no folder of real recordings (docs/results/example-so101.md)"
        )
    files = sorted(Path(folder).glob("*/*.npz"))
    assert files, f"{folder} holds no */*.npz"
    for file in files:
        channels = read_npz(file)
        name = "position" if "position" in channels.arrays else "dof_pos"
        time_s, position = channels.column("time"), channels.array(name)
        close = SpikeSettings(ratio=1.5, speed={"rad": 0.0}, least={"rad": 0.0})
        found = find_spikes(time_s - time_s[0], position, ("rad",) * position.shape[1], close)
        print(f"{file.name}: {position.size} values, {len(found)} spikes at 1.5 times the fastest motion")
        assert not found, describe(found, time_s, list(map(str, range(position.shape[1]))), ("rad",) * 99)
