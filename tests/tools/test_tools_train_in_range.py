"""The tool that trains DEAL's demonstrating policies: each in its search range, with its returns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import train_in_range

from deal_hw.bench.tasks import make_case


def test_the_range_is_that_of_the_bench() -> None:
    """Policies are trained where `bench paper` searches, and as many draws lie below a middle as above."""
    drawn = train_in_range.in_range("cartpole", 10.0)
    case = make_case("cartpole", "ideal", 1010, 10.0, centred=True, by_policy=True)
    for trained, searched in zip(drawn.space, case.space, strict=True):
        assert (trained.low, trained.high, trained.scale) == (searched.low, searched.high, "linear")
    theta = drawn.sample(np.random.default_rng(0), 4000)
    low, high = drawn.space.low, drawn.space.high
    np.testing.assert_allclose(np.mean((theta - low) / (high - low), axis=0), 0.5, atol=0.02)


@pytest.mark.slow
def test_a_row_has_the_returns_in_range_and_target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The policy's file is named by task and ratio, and a second call trains nothing again."""
    folder, out = tmp_path / "c", tmp_path / "range.json"
    words = f"--task cartpole --range-ratio 10 --steps 1100 --folder {folder} --out {out}"
    monkeypatch.setattr("sys.argv", ["train_in_range.py", *words.split()])
    train_in_range.main()
    (row,) = json.loads(out.read_text(encoding="utf-8"))["rows"]
    record = json.loads((folder / "cartpole_10.json").read_text(encoding="utf-8"))
    assert record["training"]["config"]["steps"] == row["steps"] == 1100
    # An episode of 250 ticks with the pole upright has a return of up to 250.
    assert 0 < row["return_worst_range"] <= row["return_range"] <= 250
    assert 0 < row["return_worst_target"] <= row["return_target"] <= 250
    monkeypatch.setattr(train_in_range, "train_policy", None)
    train_in_range.main()
