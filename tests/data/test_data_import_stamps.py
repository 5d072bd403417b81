"""Logs whose samples repeat, or whose stamps jitter: what is left out, moved and said."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.data.importing.grid import period_of
from deal_hw.data.importing.load import load_tables, tables_of
from deal_hw.data.importing.memory_source import read_memory
from deal_hw.data.importing.repeats import without_repeats
from deal_hw.data.importing.stamps import on_even_clock
from deal_hw.data.table import Table
from deal_hw.types import FloatArray

MakeTable = Callable[..., Table]
RATE_HZ, T = 100, 1000
TRUE_S = np.arange(T) / RATE_HZ


def motion(time_s: FloatArray, noise: float = 3e-4) -> FloatArray:
    """Return positions of two joints, (T, 2) [rad]."""
    paths = [0.6 * np.sin(2.5 * time_s), 0.5 * np.sin(4.1 * time_s + 1)]
    return np.stack(paths, axis=1) + np.random.default_rng(0).normal(0, noise, (len(time_s), 2))


def table(time_s: FloatArray, position: FloatArray) -> Table:
    """Return a recording as it is read, on its stamps."""
    values = {
        "time": time_s,
        "a_pos": position[:, 0],
        "b_pos": position[:, 1],
        "a_cmd": TRUE_S,
        "b_cmd": TRUE_S,
    }
    (found,) = tables_of([read_memory(values, "r")])
    return found


@pytest.mark.parametrize(
    ("readings", "kept", "tolerance_s", "words"),
    [
        (
            np.arange(T) // 2 * 2,
            500,
            1e-12,
            "every second sample repeats the one before: the readings come at 50 Hz",
        ),
        (
            np.arange(T) // 3 * 3,
            334,
            1e-12,
            "2 of 3 samples repeat the one before: the readings come at 33.3 Hz",
        ),
        ((np.arange(T) * 0.6).astype(int), 600, 7e-3, "40% of the samples in motion repeat the one before"),
    ],
)
def test_held_samples_are_left_out(readings: FloatArray, kept: int, tolerance_s: float, words: str) -> None:
    """Each reading stays once, at the time at which it first came."""
    found = table(TRUE_S, motion(TRUE_S)[readings])
    assert len(found.time_s) == kept and len(found.command_s) == T
    assert words in found.source["repeats"] and "not fitted" in found.source["repeats"]
    first = np.unique(readings, return_index=True)[1]
    np.testing.assert_allclose(found.time_s, TRUE_S[first], atol=tolerance_s)


def test_one_joint_that_holds_its_readings_is_named() -> None:
    """The readings of the other joint are new, so no sample is left out."""
    position = motion(TRUE_S)
    position[:, 1] = position[np.arange(T) // 2 * 2, 1]
    found = table(TRUE_S, position)
    assert len(found.time_s) == T
    assert (
        found.source["repeats"].startswith("b: every second sample repeats")
        and "stay" in found.source["repeats"]
    )


@pytest.mark.parametrize("step", [5e-3, 2e-2])
def test_coarse_and_resting_readings_are_no_repeats(step: float) -> None:
    """Rounded readings repeat where the joint is slow; joints that stop and go on repeat, too."""
    rounded = np.round(motion(TRUE_S, 0) / step) * step
    stopping = motion(np.maximum.accumulate(TRUE_S - 0.3 * (TRUE_S // 2 % 2)), 0)
    for position in (rounded, stopping):
        assert (position[1:] == position[:-1]).all(axis=1).any()
        found = table(TRUE_S, position)
        assert len(found.time_s) == T and "repeats" not in found.source


@pytest.mark.parametrize("seed", range(4))
def test_stamps_that_are_late_are_put_on_the_even_clock(seed: int) -> None:
    """Samples were even and stamped up to 8 ms late: the rate is right, and no value moves."""
    stamps = TRUE_S + np.random.default_rng(seed).uniform(0, 0.008, T)
    found = table(stamps, motion(TRUE_S))
    np.testing.assert_array_equal(found.position, motion(TRUE_S))
    np.testing.assert_allclose(found.time_s, TRUE_S, atol=1e-3)
    np.testing.assert_array_equal(found.command_s, found.time_s)
    assert period_of(found) == pytest.approx(0.01, rel=2e-4)
    assert "the stamps jitter by 2." in found.source["stamps"] and "about 100" in found.source["stamps"]


def test_samples_that_were_taken_unevenly_keep_their_stamps() -> None:
    """The motion is smoother at the stamps, so they are true; the rate is the mean one."""
    stamps = TRUE_S + np.random.default_rng(1).uniform(0, 0.008, T)
    found = table(stamps, motion(stamps))
    np.testing.assert_allclose(found.time_s, stamps - stamps[0])
    assert period_of(found) == pytest.approx(0.01, rel=2e-4)
    assert "so they are used" in found.source["stamps"]


def test_lost_samples_and_pauses_stay(make_table: MakeTable) -> None:
    """A clock that is even but for lost samples is not touched; jitter is judged in each part of a log."""
    even = make_table()
    kept = np.random.default_rng(0).uniform(size=len(even.time_s)) > 0.1
    assert on_even_clock(even.rows(kept))[1] == without_repeats(even.rows(kept))[1] == ""
    paused = TRUE_S + 5.003 * (TRUE_S >= 5)
    stamps = paused + np.random.default_rng(2).uniform(0, 0.004, T)
    moved, text = on_even_clock(
        dataclasses.replace(table(TRUE_S, motion(TRUE_S)), time_s=stamps, command_s=stamps)
    )
    np.testing.assert_allclose(moved.time_s, paused, atol=1e-3)
    assert "about 100 Hz" in text


def test_half_precision_is_said(tmp_path: Path) -> None:
    """Time as float16 comes in steps of 4 and 8 ms from 4 s on; the rate is right all the same."""
    arrays: dict[str, Any] = {"time": TRUE_S, "dof_pos": motion(TRUE_S), "des_dof_pos": motion(TRUE_S, 0)}
    halves = {name: values.astype(np.float16) for name, values in arrays.items()}
    np.savez(tmp_path / "r.npz", joint_names=np.array(["a", "b"]), **halves)
    said: list[str] = []
    (found,) = load_tables(tmp_path / "r.npz", say=said.append)
    assert period_of(found) == pytest.approx(0.01, rel=2e-4)
    assert "time has half precision (float16): at 9.992 its values come in steps of 0.0078" in "\n".join(said)
    assert "the stamps jitter by 1." in "\n".join(said) and "in steps of 3.91 ms" in "\n".join(said)
