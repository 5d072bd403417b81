"""The cost model: hand-computed seconds, numbers recovered from rows, and its error on measured rows."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from cost_model import MEASURED, Cost, costs, fit, predicted

from deal_hw.bench.rows import load_rows

COST = Cost(step_s=2e-6, steps=1000.0, fixed_s=0.1, member_s=1e-3)


def row(population: int, rest_s: float, physics_s: float = 3.0) -> dict[str, Any]:
    """Return a row of ten generations."""
    return {
        "task": "cartpole",
        "population": population,
        "generations": 10,
        "seconds": physics_s + 10 * rest_s,
        "seconds_physics": physics_s,
        "bare_step_us": 0.5,
        "threads": 2,
        "steps": population * 10 * 1000,
    }


def test_cores_share_the_physics_alone() -> None:
    """100 members of 1,000 steps of 2 us are 0.2 s; the rest is 0.2 s; more cores than members are idle."""
    assert COST.on_cores(100, 1) == pytest.approx(0.4)
    assert COST.on_cores(100, 4) == pytest.approx(0.25)
    assert COST.on_cores(100, 1000) == COST.on_cores(100, 100) == pytest.approx(0.202)


def test_the_rest_is_linear_in_the_members_and_scaled_to_each_task() -> None:
    """0.1 s and 1 ms a member are found again; a task with twice the rest has twice of both."""
    rows = [row(50, 0.15), row(100, 0.2), row(200, 0.3)]
    assert fit(rows) == pytest.approx((0.1, 1e-3))
    (cost,) = costs([row(200, 0.6)], rows).values()
    assert dataclasses.astuple(cost) == pytest.approx((1e-6, 1000.0, 0.2, 2e-3))


def test_measured_rows_that_took_no_part_are_predicted() -> None:
    """To 10 %: another population, and as many or more parameters, which cost nothing."""
    varied = load_rows(MEASURED / "speed_cost.json")
    fitted = [r for r in varied if r["task"] == "cartpole" and r["population"] < 400]
    known = costs(load_rows(MEASURED / "speed.json"), fitted)
    others = [r for r in varied if r not in fitted]
    assert {r["parameters"] for r in others} > {92, 122} and len(others) == 5
    for other in others:
        assert predicted(known[other["task"]], other) == pytest.approx(other["seconds"], rel=0.1)
