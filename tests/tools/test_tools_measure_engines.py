"""Throughput of the engines: a row of a small rollout, and what a machine without a GPU gets."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
from measure_engines import TASKS, measure, measure_environment

from deal_hw.robots.registry import parameter_spaces


@pytest.mark.parametrize("task", ["cartpole", "ant"])
def test_a_row_counts_the_steps_of_all_worlds(task: str) -> None:
    """Six worlds, twenty steps, none diverged."""
    row = measure(task, "mujoco", 6, 20, 1)
    assert (row["worlds"], row["steps"], row["diverged"]) == (6, 20, 0)
    assert row["steps_per_s"] == pytest.approx(120 / row["seconds"])


def test_a_row_of_an_environment_counts_its_ticks() -> None:
    """Three ticks of four cart-poles."""
    row = measure_environment("cartpole", "mujoco", 4, 3)
    assert (row["members"], row["ticks"]) == (4, 3)
    assert row["steps_per_s"] == pytest.approx(4 / row["tick_s"])


def test_tasks_are_those_of_the_paper() -> None:
    """Each has a parameter set with its name."""
    assert all("paper" in parameter_spaces(task) for task in TASKS)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="MuJoCo Warp is not installed (extra gpu)")
def test_warp_is_measured_beside_its_bare_steps() -> None:
    """On its CPU device, more worlds than members: they are windows of the same members."""
    row = measure("cartpole", "warp-cpu", 512, 3, 1)
    assert row["worlds"] == 512 and row["diverged"] == 0
    assert row["device"] and row["bare_ratio"] > 0
