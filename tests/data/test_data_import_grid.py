"""From a table to trajectories on a uniform grid, and through `align`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.data.importing.grid import (
    Gains,
    common_period,
    grid_periods,
    period_of,
    to_trajectories,
    unevenness_s,
)
from deal_hw.data.importing.load import own_episodes
from deal_hw.data.importing.store import write_dataset
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.table import Table, table_of
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError
from deal_hw.sim.recordings.episode import align
from deal_hw.types import Status

MakeTable = Callable[..., Table]
GAINS = Gains(stiffness=(20.0,) * 3, damping=(1.5,) * 3, effort_limit=(9.0,) * 3, speed_limit=(30.0,) * 3)


def robot(table: Table, rate_hz: float, per_sample: int) -> RobotDescription:
    """Return a description with the table's joints and a device rate that is a multiple of its rate."""
    A, J = len(table.actuated), len(table.joint_names)
    return dataclasses.replace(
        DESCRIPTION,
        name="imported",
        joint_names=table.joint_names,
        actuated=table.actuated,
        position_units=table.units,
        default_position=(0.0,) * J,
        stiffness=(20.0,) * A,
        damping=(1.5,) * A,
        effort_limit=(9.0,) * A,
        speed_limit=(30.0,) * A,
        control_rate_hz=rate_hz,
        state_rate_hz=rate_hz,
        device_rate_hz=rate_hz * per_sample,
    )


def jittered(table: Table, share: float, seed: int = 0) -> Table:
    """Return the table with the times between its samples changed by up to a share."""
    steps = np.diff(table.time_s) * (
        1 + share * np.random.default_rng(seed).uniform(-1, 1, table.time_s.size - 1)
    )
    time_s = np.concatenate(([0.0], np.cumsum(steps)))
    return dataclasses.replace(table, time_s=time_s, command_s=time_s)


@pytest.mark.parametrize("per_sample", [1, 4, 10])
@pytest.mark.parametrize("rate_hz", [100.0, 49.8, 49.84996391])
def test_align_gives_the_arrays_back(make_table: MakeTable, rate_hz: float, per_sample: int) -> None:
    """Positions, targets and usability come back unchanged, at rates that are no whole number of ms."""
    time_s = np.arange(1200) / rate_hz
    table = make_table(time_s=time_s, command_s=time_s)
    (part,) = to_trajectories(table, GAINS)
    assert 1 / period_of(table) == pytest.approx(rate_hz, rel=1e-12)
    assert part.trajectory.metadata["import"]["method"] == "kept"
    episode = align(part.trajectory, robot(table, 1 / period_of(table), per_sample))
    np.testing.assert_array_equal(episode.position, table.position)
    np.testing.assert_array_equal(episode.sample, per_sample * np.arange(1200))
    assert episode.usable[:-1].all()
    # Command k acts from sample k until the next one: all device periods between hold it.
    np.testing.assert_array_equal(episode.target, np.repeat(table.target[:-1], per_sample, axis=0))
    np.testing.assert_array_equal(episode.stiffness, np.full((1199 * per_sample, 3), 20.0))


def test_uneven_stamps_within_two_percent_move_to_the_grid(make_table: MakeTable) -> None:
    """Values stay, commands of the same stamp act with their sample, and the shift is reported."""
    table = jittered(make_table(), 0.015)
    (part,) = to_trajectories(table, GAINS)
    facts = part.trajectory.metadata["import"]
    assert facts["method"] == "kept" and 0 < facts["largest_shift_s"] < 0.01
    np.testing.assert_array_equal(part.trajectory.position, table.position)
    np.testing.assert_allclose(part.trajectory.command_age_s, 0.0, atol=1e-12)
    episode = align(part.trajectory, robot(table, 1 / period_of(table), 5))
    np.testing.assert_array_equal(episode.target, np.repeat(table.target[:-1], 5, axis=0))


def test_jittering_stamps_are_interpolated(make_table: MakeTable) -> None:
    """30 % jitter: samples lie on the grid, on the motion at its times; commands keep their own times."""
    time_s = jittered(make_table(), 0.3).time_s
    line = np.outer(time_s, [1.0, -2.0, 0.5])  # Interpolation of a straight line is exact.
    table = make_table(time_s=time_s, command_s=time_s, position=line)
    (part,) = to_trajectories(table, GAINS)
    trajectory, facts = part.trajectory, part.trajectory.metadata["import"]
    assert facts["method"] == "interpolated" and 1e-4 < facts["largest_shift_s"] < 0.0066
    np.testing.assert_allclose(np.diff(trajectory.device_s), period_of(table), rtol=1e-9)
    slope = np.diff(trajectory.position, axis=0) / np.diff(trajectory.device_s)[:, None]
    np.testing.assert_allclose(slope[1:-1], np.tile([1.0, -2.0, 0.5], (len(slope) - 2, 1)), rtol=1e-9)
    # The command in force at a sample is the newest whose time has come: recompute it from the stamps.
    offset = trajectory.position[0, 0]
    at = np.searchsorted(time_s, trajectory.device_s + offset + 1e-9, side="right") - 1
    sent = trajectory.position_target[trajectory.command_sequence]
    np.testing.assert_array_equal(sent, table.target[at])
    np.testing.assert_allclose(trajectory.command_age_s, trajectory.device_s + offset - time_s[at], atol=1e-9)


def test_commands_on_stamps_of_their_own(make_table: MakeTable) -> None:
    """20 Hz commands, 4 ms after a sample: the age counts from there, samples before the first have none."""
    sent_s = 0.034 + 0.05 * np.arange(200)
    target = np.outer(np.arange(200), [1.0, 2.0, 3.0])
    (part,) = to_trajectories(make_table(command_s=sent_s, target=target), GAINS)
    trajectory = part.trajectory
    assert trajectory.command_sequence[:4].tolist() == [-1] * 4
    assert np.isnan(trajectory.command_age_s[:4]).all()
    np.testing.assert_allclose(trajectory.command_age_s[4:9], [0.006, 0.016, 0.026, 0.036, 0.046], atol=1e-12)
    assert trajectory.command_sequence[4:10].tolist() == [0] * 5 + [1]
    np.testing.assert_array_equal(trajectory.position_target, target)


def test_gap_splits_and_lost_samples_stay_lost(make_table: MakeTable) -> None:
    """Two samples missing stay absent; four missing start another stretch with its command still in force."""
    sound = make_table()
    keep = np.ones(1200, dtype=bool)
    keep[[300, 301]] = False
    keep[700:704] = False
    target = np.repeat(sound.target[::100], 100, axis=0)
    table = make_table(
        time_s=sound.time_s[keep],
        position=sound.position[keep],
        target=target[::100],
        command_s=sound.time_s[::100],
    )
    first, second = (part.trajectory for part in to_trajectories(table, GAINS))
    np.testing.assert_allclose(first.device_s, sound.time_s[:700][keep[:700]], atol=1e-9)
    np.testing.assert_allclose(second.device_s, np.arange(496) * 0.01, atol=1e-9)
    np.testing.assert_array_equal(second.position, sound.position[704:])
    np.testing.assert_array_equal(second.position_target[second.command_sequence[0]], target[704])
    assert second.command_age_s[0] == pytest.approx(0.04)
    assert [t.metadata["import"]["stretch"] for t in (first, second)] == [0, 1]


def test_samples_without_position_or_with_an_old_stamp_are_left_out(make_table: MakeTable) -> None:
    """They are counted in the metadata; nothing takes their place."""
    position, time_s = make_table().position.copy(), make_table().time_s.copy()
    position[50, 1] = np.nan
    time_s[61] = time_s[60]
    (part,) = to_trajectories(make_table(position=position, time_s=time_s), GAINS)
    assert part.trajectory.device_s.size == 1198
    assert part.trajectory.metadata["import"]["rows_left_out"] == 2


def test_velocity_effort_and_imu_follow(make_table: MakeTable) -> None:
    """A missing velocity is differenced, a missing effort NaN; the base's channels come at the samples."""
    table = make_table()
    (part,) = to_trajectories(table)
    np.testing.assert_allclose(part.trajectory.velocity, np.gradient(table.position, table.time_s, axis=0))
    assert np.isnan(part.trajectory.effort).all() and np.isnan(part.trajectory.stiffness).all()
    assert set(part.trajectory.status) == {int(Status.ARMED)}
    turn = np.stack([np.cos(table.time_s), np.sin(table.time_s), 0 * table.time_s, 0 * table.time_s], axis=1)
    turn[600:] *= -1  # The same orientation, written with the other sign.
    (part,) = to_trajectories(jittered(make_table(orientation=turn, gyro=table.position), 0.3))
    assert part.orientation is not None and part.gyro is not None
    np.testing.assert_allclose(np.linalg.norm(part.orientation, axis=1), 1.0, rtol=1e-12)
    assert np.max(np.abs(np.diff(part.orientation, axis=0))) < 0.02


def test_refusals(make_table: MakeTable) -> None:
    """A clock that goes back, no commands, and recordings of different rates are refused."""
    time_s = make_table().time_s.copy()
    time_s[5] = 1.0
    with pytest.raises(DatasetError, match="goes backwards 1 times"):
        to_trajectories(make_table(time_s=time_s))
    with pytest.raises(DatasetError, match="no commands"):
        to_trajectories(make_table(command_s=np.empty(0), target=np.empty((0, 3))))
    slow = make_table(time_s=make_table().time_s * 1.1)
    with pytest.raises(DatasetError, match="different rates"):
        common_period([make_table(), slow])


def test_two_recordings_share_one_grid(make_table: MakeTable) -> None:
    """Clocks that differ by 100 ppm get one period, and every sample still lies on the grid."""
    tables = [
        make_table(),
        make_table(time_s=make_table().time_s * 1.0001, command_s=make_table().time_s * 1.0001),
    ]
    period = common_period(tables)
    for table in tables:
        (part,) = to_trajectories(table, GAINS, period)
        np.testing.assert_allclose(part.trajectory.device_s, np.arange(1200) * period, rtol=1e-12)
        np.testing.assert_array_equal(part.trajectory.position, table.position)


def at_rate(make_table: MakeTable, rate_hz: float) -> Table:
    """Return the 1200 samples of the table at another rate."""
    time_s = np.arange(1200) / rate_hz
    return make_table(time_s=time_s, command_s=time_s)


@pytest.mark.parametrize(
    ("rates_hz", "shared"),
    [
        ((193.0, 70.0, 199.0), ((0,), (1,), (2,))),
        ((200.0, 199.0, 200.01), ((0, 2), (1,))),
        ((100.0, 100.02, 99.99), ((0, 1, 2),)),
        ((50.0, 500.0, 62.5, 50.004, 499.9), ((0, 3), (1, 4), (2,))),
    ],
)
def test_each_rate_has_a_grid_of_its_own(
    make_table: MakeTable, rates_hz: tuple[float, ...], shared: tuple[tuple[int, ...], ...]
) -> None:
    """Recordings share a grid if their clocks agree to a thousandth; all others have their own."""
    tables = [at_rate(make_table, rate_hz) for rate_hz in rates_hz]
    periods = grid_periods(tables)
    for rows in shared:
        assert {periods[i] for i in rows} == {float(np.median([period_of(tables[i]) for i in rows]))}
    assert len(set(periods)) == len(shared)


def test_short_recordings_with_jitter_share_a_grid(make_table: MakeTable) -> None:
    """The rate of 80 samples whose ends are 2 ms off is 2.5 parts in 1000 off; none moves half a period."""
    first = np.arange(80) * 0.01
    late = first.copy()
    late[-1] += 0.002
    tables = [
        make_table(
            time_s=t, command_s=t, **{n: getattr(make_table(), n)[:80] for n in ("position", "target")}
        )
        for t in (first, late)
    ]
    assert len(set(grid_periods(tables))) == 1


def test_how_uneven_a_clock_is(make_table: MakeTable) -> None:
    """A sine of 0.2 ms on the stamps is found; another rate, and the pauses of roll-outs, are none."""
    even = at_rate(make_table, 70.0)
    paused = dataclasses.replace(even, time_s=even.time_s + 2.003 * (np.arange(1200) // 200))
    wave = dataclasses.replace(even, time_s=even.time_s + 2e-4 * np.sin(np.arange(1200) / 7))
    assert unevenness_s(even) < 1e-9 and unevenness_s(paused) < 1e-9
    assert unevenness_s(wave) == pytest.approx(2e-4, rel=0.05)


@settings(max_examples=40, deadline=None)
@given(
    rate_hz=st.floats(20, 1000),
    jitter=st.floats(0, 0.45),
    lost=st.sets(st.integers(1, 398), max_size=30),
    seed=st.integers(0, 99),
)
def test_any_clock_gives_consistent_trajectories(
    rate_hz: float, jitter: float, lost: set[int], seed: int
) -> None:
    """Whatever the stamps: uniform indices, ages that fit the commands, nothing beyond the ends."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum((1 + jitter * rng.uniform(-1, 1, 400)) / rate_hz)
    keep = np.array([i not in lost for i in range(400)])
    time_s = time_s[keep] - time_s[0]
    table = Table(
        joint_names=("a",),
        actuated=("a",),
        units=("rad",),
        time_s=time_s,
        position=time_s[:, None],
        velocity=None,
        effort=None,
        command_s=time_s,
        target=time_s[:, None],
        orientation=None,
        gyro=None,
        source={"file": "x", "part": ""},
    )
    for part in to_trajectories(table):
        trajectory = part.trajectory
        index = trajectory.device_s / trajectory.metadata["import"]["period_s"]
        np.testing.assert_allclose(index, np.round(index), atol=1e-6)
        assert np.all(np.diff(index) > 0.5)
        known = trajectory.command_sequence >= 0
        age = trajectory.device_s - trajectory.sent_s[np.maximum(trajectory.command_sequence, 0)]
        np.testing.assert_allclose(trajectory.command_age_s[known], np.maximum(age[known], 0), atol=1e-8)
        assert np.min(trajectory.position) >= -1e-9 and np.max(trajectory.position) <= time_s[-1] + 1e-9


def test_dataset_of_an_import_reads_back(make_table: MakeTable, tmp_path: Path) -> None:
    """What is written as episodes reads back as the same trajectory, and aligns to the same arrays."""
    table = jittered(make_table(effort=np.ones((1200, 3))), 0.01)
    recordings = to_trajectories(table, GAINS)
    description = robot(table, 1 / period_of(table), 5)
    dataset = write_dataset(tmp_path / "dataset", recordings, description, [{"plausibility": []}])
    assert dataset.episodes[0].states == 1200 and dataset.episodes[0].purpose == "import"
    assert not [v for v in dataset.episodes[0].verdicts if v["severity"] == "fail"]
    (after,) = map(read_trajectory, own_episodes(tmp_path / "dataset"))
    (again,) = map(read_trajectory, own_episodes(dataset.path(0)))
    before = recordings[0].trajectory
    for name in (
        "position",
        "velocity",
        "effort",
        "position_target",
        "stiffness",
        "command_sequence",
        "status",
    ):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name), err_msg=name)
    for name in ("device_s", "receive_s", "sent_s", "command_age_s"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-9, err_msg=name)
    assert after.metadata["import"] == before.metadata["import"]
    np.testing.assert_array_equal(align(after, description).target, align(before, description).target)
    returned = table_of(after)
    np.testing.assert_array_equal(returned.target, table.target)
    np.testing.assert_allclose(returned.command_s, returned.time_s, atol=2e-9)
