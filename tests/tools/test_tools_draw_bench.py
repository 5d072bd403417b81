"""Figures from rows, without measuring."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from draw_bench import main

MEASURED = Path(__file__).resolve().parents[2] / "docs" / "measured"
ROWS = MEASURED / "paper_cartpole_ideal.json"
TRANSFER = MEASURED / "transfer_cartpole.json"


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    """Run the tool."""
    monkeypatch.setattr(sys, "argv", ["draw_bench.py", *map(str, arguments)])
    main()


def test_a_figure_is_drawn_beside_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rows stay as they are; where every cell failed, that is reported and nothing is drawn."""
    rows, failed = tmp_path / "searches.json", tmp_path / "failed.json"
    rows.write_bytes(ROWS.read_bytes())
    document = json.loads(ROWS.read_text(encoding="utf-8"))
    document["rows"] = [row | {"error": "refused"} for row in document["rows"]]
    failed.write_text(json.dumps(document), encoding="utf-8")
    run(monkeypatch, rows, failed)
    assert (
        rows.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
        and rows.read_bytes() == ROWS.read_bytes()
    )
    assert not failed.with_suffix(".png").exists()
    assert f"{failed}: every cell failed" in capsys.readouterr().out


def test_rows_of_the_transfer_bench_have_a_figure_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Returns in the target instead of parameter errors."""
    rows = tmp_path / "transfer.json"
    rows.write_bytes(TRANSFER.read_bytes())
    run(monkeypatch, rows)
    assert rows.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
