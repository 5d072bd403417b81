"""The verb `bench`: seeds, rows, resuming."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from deal_hw.cli.bench import Bench, bench, parse_seeds
from deal_hw.errors import ConfigurationError, DatasetError, UnknownNameError

FIELDS = {
    "bench", "task", "profile", "method", "polish", "xi", "seed", "error_percent", "log_error_x100",
    "null_error_percent", "null_log_error_x100", "coverage90", "width90", "heldout_nrmse_nominal",
    "heldout_nrmse_calibrated", "latency_true", "latency_found", "steps", "seconds", "flagged", "error",
}  # fmt: skip


def test_seeds() -> None:
    """Numbers and ranges, and an error that shows how."""
    assert parse_seeds("0,3, 1000-1002") == (0, 3, 1000, 1001, 1002)
    for text in ("", "a", "3-", "5-2"):
        with pytest.raises(ConfigurationError, match="seed"):
            parse_seeds(text)


def test_rows_have_the_fields_of_the_benchmark_and_are_not_run_twice(tmp_path: Path) -> None:
    """The centre of the range scores its own null error; a second run recomputes nothing."""
    out = tmp_path / "loop.json"
    settings = Bench(
        bench="loop", profile="sensor", seeds="0", methods="centre", out=out, threads=1, quiet=True
    )
    assert bench(settings) == 0
    values = json.loads(out.read_text())
    (row,) = values["rows"]
    assert set(row) >= FIELDS
    assert row["error"] == "" and row["polish"] is False
    assert row["error_percent"] == pytest.approx(row["null_error_percent"])
    assert row["heldout_nrmse_calibrated"] > 0
    assert "processors" in values["machine"] and "mujoco" in values["machine"]["versions"]
    assert out.with_suffix(".png").stat().st_size > 1000
    with out.with_suffix(".csv").open() as file:
        assert [r["method"] for r in csv.DictReader(file)] == ["centre"]
    before = row["seconds"]
    assert bench(settings) == 0
    assert json.loads(out.read_text())["rows"][0]["seconds"] == before


def test_unknown_method_is_refused_before_anything_runs(tmp_path: Path) -> None:
    """The methods are listed."""
    with pytest.raises(UnknownNameError, match="weki"):
        bench(Bench(bench="loop", methods="magic", out=tmp_path / "loop.json"))


def test_foreign_file_is_not_overwritten(tmp_path: Path) -> None:
    """A file that is no bench file stays as it is."""
    out = tmp_path / "notes.json"
    out.write_text('{"a": 1}')
    with pytest.raises(DatasetError, match="not a bench file"):
        bench(Bench(bench="loop", methods="centre", out=out))
    assert out.read_text() == '{"a": 1}'
