"""The tool that measures which errors of an import are found writes a row for each, with its head."""

from __future__ import annotations

import json
from pathlib import Path

import measure_policy_import
import pytest
from fakes.wrong_policy import ERRORS

from deal_hw.policies import walking_trial


def test_a_row_for_each_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And one for the sound policy; the last line counts."""
    monkeypatch.setattr(walking_trial, "SECONDS", 2.0)
    monkeypatch.setattr(walking_trial, "ROBOTS", 1)
    chosen = {name: ERRORS[name] for name in ("diagonal legs exchanged", "actions")}
    monkeypatch.setattr(measure_policy_import, "ERRORS", chosen)
    out = tmp_path / "rows.json"
    assert measure_policy_import.main(["--seeds", "1", "--out", str(out)]) == 0
    rows = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert [(row["policy"], row["mistake"], row["seed"]) for row in rows] == [
        ("shipped", name, 1) for name in ("", *chosen)
    ]
    assert [bool(row["faults"]) for row in rows] == [False, True, True]
    assert capsys.readouterr().out.splitlines()[-1] == "2 of 2 errors found; 0 sound policies refused"
