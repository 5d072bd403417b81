"""The tool that measures where the search of the default ends: whole calibrations with other spreads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import measure_brief_search
import pytest

from deal_hw.bench.calibration import Cell
from deal_hw.calib.search import deal, eki


def test_a_calibration_runs_with_the_spread_of_its_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both searches read the spread while the cell runs, and the usual one after it."""
    usual, seen = eki.NEAR_SPREAD, []

    def run(cell: Cell, **budget: Any) -> dict[str, Any]:
        seen.append((cell.method, cell.seed, cell.range_ratio, vars(deal)["NEAR_SPREAD"], eki.NEAR_SPREAD))
        row = {
            "profile": cell.profile,
            "error": "",
            "search": "deal",
            "error_percent": 2.0,
            "steps": 10,
            "seconds": 1.0,
        }
        return row | {"heldout_nrmse_nominal": 0.2, "heldout_nrmse_calibrated": 0.05, "alarms": []}

    monkeypatch.setattr(measure_brief_search, "run_cell", run)
    out = tmp_path / "spread.json"
    words = f"--seeds 3 --spread 0.4 1.6 --range-ratio 20 --out {out}"
    monkeypatch.setattr("sys.argv", ["measure_brief_search.py", *words.split()])
    assert measure_brief_search.main() == measure_brief_search.main() == 0
    assert seen == [("default", 3, 20.0, 0.4, 0.4), ("default", 3, 20.0, 1.6, 1.6)]
    assert vars(deal)["NEAR_SPREAD"] == eki.NEAR_SPREAD == usual
    rows = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert [(row["spread"], row["seed"], row["search"]) for row in rows] == [
        (0.4, 3, "deal"),
        (1.6, 3, "deal"),
    ]
