"""The Go2's loop bench: a row of a hidden robot, and what rows say together."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from deal_hw.bench import go2_loop, go2_tasks
from deal_hw.bench.go2_tasks import ENDED, HEIGHTS_M, TASKS, TRIES, LoopTask, score_climb, score_walk
from deal_hw.bench.rows import load_rows, run_cells, save_rows
from deal_hw.bench.settings import Go2Loop
from deal_hw.drivers.go2.emulator.truth import draw_truth
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.workflows.emulation.walk_script import HELDOUT, Walk
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import nominal_distribution

NOMINAL = ("velocity_error_nominal", "yaw_error_nominal", "falls_nominal")
"""What a row has of the policy that is trained under the nominal model."""


def head(seed: int, **more: Any) -> dict[str, Any]:
    return {"profile": "sensor", "seed": seed, "error": "", "heldout_ratio": 0.3, **more}


def row(seed: int, udr_more: float, calibrated: float, falls: int = 0) -> dict[str, Any]:
    """Return a row with these velocity errors [m/s]."""
    found = head(seed)
    for kind in go2_loop.KINDS:
        found |= {f"{kind}_log_error": 0.05, f"{kind}_log_error_nominal": 0.2, f"{kind}_inside": 0.75}
    errors = {"udr": 0.1, "udr_more": udr_more, "nominal": 0.15, "calibrated": calibrated, "oracle": 0.05}
    for name, error in errors.items():
        found |= {f"velocity_error_{name}": error, f"yaw_error_{name}": 0.1, f"falls_{name}": 0}
    return found | {"falls_calibrated": falls}


def test_rows_are_compared_in_pairs_and_falls_are_counted() -> None:
    """Robots differ more than policies: what counts is the difference on the same robot."""
    lines = go2_loop.summary([row(0, 0.10, 0.08), row(1, 0.20, 0.19, falls=2), row(2, 0.10, 0.11)])
    assert lines[-2:] == [
        "calibrated against equal training under the nominal model, paired: 0.0233 m/s better on average, "
        "better for 2 of 3",
        "calibrated against equal training under UDR, paired: 0.0067 m/s better on average, better for 2 "
        "of 3",
    ]
    assert "calibrated: velocity error 0.127 m/s, 2 falls" in lines
    assert lines[0] == "held-out ratio: median 0.30"
    assert go2_loop.summary([]) == []


def test_a_row_in_words_names_its_error_or_its_policies() -> None:
    """An error alone, or the ratio and each policy that walked."""
    assert go2_loop.line({**row(4, 0.1, 0.1), "error": "TrainingError: no"}).endswith("TrainingError: no")
    assert go2_loop.line(row(4, 0.1, 0.1)).endswith(
        "udr 0.100, udr_more 0.100, nominal 0.150, calibrated 0.100, oracle 0.050"
    )


def older(found: dict[str, Any]) -> dict[str, Any]:
    """Return a row as it was before policies were trained under the nominal model."""
    return {name: value for name, value in found.items() if name not in NOMINAL}


def test_a_policy_that_some_rows_lack_is_not_compared() -> None:
    """Robots differ, so means over other robots cannot be compared."""
    lines = go2_loop.summary([row(0, 0.10, 0.08), older(row(1, 0.20, 0.19))])
    assert "udr: velocity error 0.100 m/s, 0 falls" in lines
    assert not any(line.startswith("nominal:") or "the nominal model" in line for line in lines)


def test_an_older_row_gets_the_policy_that_it_lacks_and_keeps_all_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No walk is recorded or calibrated: one policy is trained, under nominal values, with the seed."""
    out, trained = tmp_path / "rows.json", []

    def train(robot: str, under: ParameterDistribution, file: Path, **how: Any) -> OnnxPolicy:
        trained.append((under, file.name, how["seed"], how["steps"], how["files"].start))
        return OnnxPolicy(required_policy(robot, how["task"]))

    canter = TASKS["canter"]._replace(score=lambda *_: {"velocity_error": 0.07, "yaw_error": 0.1, ENDED: 1})
    monkeypatch.setattr(go2_loop, "train_policy", train)
    monkeypatch.setattr(go2_loop, "TASKS", {**TASKS, "canter": canter})
    monkeypatch.setattr(go2_loop, "recorded", lambda *_: pytest.fail("the robot walked again"))
    before = {**older(row(4, 0.1, 1 / 3)), "task": "canter", "steps": 10}
    whole = {**row(5, 0.1, 0.1), "task": "canter", "steps": 10}
    save_rows(out, [before, whole])
    settings = Go2Loop(task="canter", seeds=(4, 5), steps=10, out=out)
    done: list[Any] = []
    run_cells(go2_loop.table(settings).cells, out, lambda place, *_: done.append(place))
    kept, completed = load_rows(out)
    assert done == ["2/2"] and kept == whole
    more = {name: completed.pop(name) for name in (*NOMINAL, "cpu_seconds_train_nominal")}
    assert completed == before
    assert more["velocity_error_nominal"] == 0.07 and more["falls_nominal"] == 1
    ((under, file, *how),) = trained
    assert under.digest() == nominal_distribution("go2", "canter").digest() and file == "nominal.onnx"
    assert how == [4, 10, required_policy("go2", "canter").with_suffix(".safetensors")]


def test_cells_are_told_apart_by_what_they_measure(tmp_path: Path) -> None:
    """A seed without training is another cell than the same with it."""
    trained, plain = (
        go2_loop.table(Go2Loop(steps=10, out=tmp_path / "rows.json", train=train)).cells
        for train in (True, False)
    )
    assert [cell for cell, _ in trained.args] == [("", "sensor", 0, 10), ("", "sensor", 1, 10)]
    assert [cell for cell, _ in plain.args] == [("", "sensor", 0, 0), ("", "sensor", 1, 0)]


def test_a_truth_outside_its_range_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gains ten times too stiff: nothing is recorded, and the row says which parameter."""
    truth = draw_truth("sensor", 4)
    stiff = dataclasses.replace(truth, stiffness=tuple(10 * k for k in truth.stiffness))
    monkeypatch.setattr(go2_loop, "draw_truth", lambda *_: stiff)
    found = go2_loop.loop_row("", "sensor", 4, 0, folder=tmp_path, threads=1)
    assert "lies outside its search range" in found["error"] and ".stiffness" in found["error"]
    assert not list(tmp_path.iterdir())


def test_climbs_are_counted_at_each_height() -> None:
    """By hand: two robots, 10 tries each; 13 of 20 at 0.1 m told have an interval of 41 to 85 %."""

    def climb(seed: int, calibrated: int, more: int) -> dict[str, Any]:
        found = head(seed, task="climb")
        for kind in go2_loop.KINDS:
            found |= {f"{kind}_log_error": 0.05, f"{kind}_log_error_nominal": 0.2, f"{kind}_inside": 0.75}
        counts = {"udr": 0, "udr_more": more, "nominal": 5, "calibrated": calibrated, "oracle": TRIES}
        for name, count in counts.items():
            each = [count] * len(HEIGHTS_M)
            found |= {
                f"climbed_{name}": {"told": each, "blind": [0] * len(HEIGHTS_M)},
                f"success_{name}": 0.5 * count / TRIES,
                f"falls_{name}": 1,
            }
        return found

    rows = [climb(0, 7, 2), climb(1, 6, 9)]
    lines = go2_loop.summary(rows)
    assert "calibrated: success 0.325 of tries, 2 falls" in lines
    (told,) = (line for line in lines if line.startswith("0.10 m, told"))
    assert "calibrated 13/20 (41% to 85%), oracle 20/20 (83% to 100%)" in told
    assert lines[-1].endswith("0.0500 of tries better on average, better for 1 of 2")
    assert go2_loop.line(rows[0]).endswith(
        "success [of tries]: udr 0.000, udr_more 0.100, nominal 0.250, calibrated 0.350, oracle 0.500"
    )


@pytest.mark.slow
def test_the_walk_climbs_what_is_flat_and_no_wall(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With one hidden robot: 2 cm are taken by most, 25 cm by none; a score has all heights."""
    policy = OnnxPolicy(required_policy("go2"))
    monkeypatch.setattr(go2_tasks, "HEIGHTS_M", (0.02, 0.25))
    monkeypatch.setattr(go2_tasks, "TRIES", 4)
    found = score_climb(draw_truth("realistic", 3), policy, tmp_path)
    assert found["climbed"]["told"][0] >= 2 and found["climbed"]["told"][1] == 0
    assert all(found[f"scuffs_{name}"] > 0 and found[f"torque_nm_{name}"] > 0 for name in ("told", "blind"))
    assert found["success"] == sum(map(sum, found["climbed"].values())) / 16


@pytest.mark.slow
def test_a_walk_tells_gains_payload_and_what_is_to_come(tmp_path: Path) -> None:
    """From 4 s of walking: gains nearer than nominal ones, the payload, and other walks half as wrong."""
    first = Walk(((0.0, (0.8, 0.0, 0.0)), (2.0, (0.0, 0.4, 0.8))), 4.0)
    score = partial(score_walk, first, repeats=1)
    task = LoopTask("", first, Walk(HELDOUT, 4.0), score, "velocity_error", "m/s")
    found = go2_loop.loop_row("", "realistic", 4, 0, folder=tmp_path, threads=1, task=task)
    assert found["error"] == ""
    assert found["heldout_ratio"] < 0.6
    assert found["stiffness_log_error"] < 0.5 * found["stiffness_log_error_nominal"]
    assert found["stiffness_inside"] >= 0.6
    assert found["payload_error_kg"] == pytest.approx(0.0, abs=0.3)
    assert found["velocity_error_udr"] < 0.2 and found["falls_udr"] == 0
    # Resumed, it takes the recordings that are there.
    folder = tmp_path / "walk_realistic_4"
    assert go2_loop.recorded(draw_truth("realistic", 4), folder, task) == folder / "dataset"
