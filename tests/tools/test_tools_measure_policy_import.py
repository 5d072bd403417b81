"""The tool that measures which errors of an import are found writes a row for each, with its head."""

from __future__ import annotations

import json
from pathlib import Path

import measure_policy_import
import pytest


@pytest.mark.slow
def test_a_row_for_each_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And one for the sound policy; the last line counts."""
    chosen = ("diagonal legs exchanged", "actions")
    out = tmp_path / "rows.json"
    options = ("--seeds", "1", "--seconds", "2", "--robots", "1")
    assert measure_policy_import.main([*options, "--errors", *chosen, "--out", str(out)]) == 0
    rows = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert [(row["policy"], row["mistake"], row["seed"]) for row in rows] == [
        ("shipped", name, 1) for name in ("", *chosen)
    ]
    assert [bool(row["faults"]) for row in rows] == [False, True, True]
    assert capsys.readouterr().out.splitlines()[-1] == "2 of 2 errors found; 0 sound policies refused"
