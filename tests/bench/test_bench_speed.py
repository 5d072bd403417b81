"""The bench of speed: what it runs, what its rows hold, what it says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.bench import speed
from deal_hw.bench.rows import load_rows
from deal_hw.bench.settings import Speed
from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.cli.bench import bench
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.types import FloatArray


def test_a_cell_is_a_search_and_the_same_steps_of_the_engine(tmp_path: Path) -> None:
    """4 members for 2 generations of 200 ticks: the ratio is that of the two times, the steps are counted."""
    out = tmp_path / "speed.json"
    asked = Speed(profile="ideal", seeds=(3,), population=4, generations=2, threads=1, out=out, quiet=True)
    assert bench(asked) == 0
    (row,) = load_rows(out)
    case = make_case("cartpole", "ideal", 3, 5.0, by_policy=True)
    problem = Problem(case.robot, case.space, [case.fit], threads=1)
    per_tick = round(1 / (case.robot.description.control_rate_hz * problem.robot.step_s))
    assert row["error"] == ""
    # Each member starts at the first of 200 transitions in each generation.
    assert row["steps"] == pytest.approx(4 * 2 * 200 * per_tick, rel=0.1)
    assert row["ratio"] == pytest.approx(row["seconds"] / row["seconds_physics"])
    assert row["seconds_physics"] == pytest.approx(row["steps"] * row["bare_step_us"] * 1e-6)
    assert (row["paper_seconds"], row["threads"], row["parameters"]) == (75.0, 1, len(case.space))
    # What is done is not done again.
    before = out.read_bytes()
    assert bench(asked) == 0
    assert out.read_bytes() == before


def test_the_engine_alone_repeats_what_the_policy_commanded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of a step is a rollout's over members times steps; its commands are the policy's, or held."""
    case = make_case("cartpole", "ideal", 3, 5.0, by_policy=True)
    problem = Problem(case.robot, case.space, [case.fit], threads=1, policy=case.policy)
    # Moving members take 0.5 s for a rollout, others 0.25 s.
    now, sent = 0.0, list[FloatArray]()
    monkeypatch.setattr("time.perf_counter", lambda: now)
    advance = ServoBatch.advance

    def timed(self: ServoBatch, setpoint: FloatArray, *more: Any) -> Any:
        nonlocal now
        sent.append(setpoint)
        now += 0.5 if np.any(setpoint != setpoint[:, :1]) else 0.25
        return advance(self, setpoint, *more)

    monkeypatch.setattr(ServoBatch, "advance", timed)
    moving_s, constant_s = speed.bare_step_s(problem, 5)
    whole = sent[-1].shape[1]
    assert moving_s == pytest.approx(0.5 / (5 * whole))
    assert constant_s == pytest.approx(0.25 / (5 * whole))
    # The rollout in closed loop advances by one control period at a time.
    ticks = [part for part in sent if part.shape[1] < whole]
    assert sum(part.shape[1] for part in ticks) == whole
    rolled = np.stack([part[:, -1] for part in ticks], axis=1)
    for repeated in sent[-2 * speed.REPETITIONS : -speed.REPETITIONS]:
        # Before the first command they differ by the set-point that the recording begins with.
        again = repeated[:, ticks[0].shape[1] - 1 :: ticks[0].shape[1]]
        np.testing.assert_allclose(again[:, 20:], rolled[:, 20:], rtol=1e-9, atol=1e-12)


def test_rows_in_words() -> None:
    """One line a row with both times, a summary of medians, errors left out of it."""
    row = {
        "task": "ant",
        "method": "easi",
        "seed": 0,
        "error": "",
        "seconds": 10.0,
        "cpu_seconds": 20.0,
        "population": 200,
        "generations": 50,
        "steps": 2_000_000,
        "seconds_physics": 5.0,
        "ratio": 2.0,
        "paper_seconds": 98.0,
    }
    assert speed.line(row) == (
        "speed ant easi seed 0: 10.0 s (20.0 cpu s), the paper's 98 s; 200 members, 50 generations, "
        "2e+06 physics steps; bare physics 5.0 s, ratio 2.00"
    )
    assert speed.line(row | {"error": "X: y"}).endswith("seed 0: X: y")
    rows = [
        row,
        row | {"seconds": 14.0, "ratio": 3.0},
        row | {"seconds": 11.0, "ratio": 2.5},
        row | {"error": "X: y"},
    ]
    assert speed.summary(rows) == [
        "ant easi, 200 x 50: 11.0 s, 2.50 times bare physics; the paper: 98 s on a GPU"
    ]
