"""The verb `bench go2-codec`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from deal_hw.bench import go2_codec
from deal_hw.bench.go2_codec import TARGETS_US, bench_codec
from deal_hw.bench.settings import Go2Codec
from deal_hw.cli.main import main


def test_the_codec_bench_writes_medians_and_the_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A row for each operation, with its target where it has one; how fast it is, is no matter of a test."""
    out = tmp_path / "codec.json"
    bench_codec(Go2Codec(out=out), batches=3)
    values = json.loads(out.read_text())
    rows = {row["operation"]: row for row in values["rows"]}
    assert set(TARGETS_US) < set(rows)
    for name, row in rows.items():
        assert 0 < row["lowest_us"] <= row["median_us"] <= row["p99_us"]
        assert row["target_us"] == TARGETS_US.get(name)
    assert values["machine"]["processors"] >= 1
    assert "encode LowCmd with CRC" in capsys.readouterr().out


def test_json_is_the_only_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The document is the file of rows, by default BENCH.json; the text goes to the error output."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(go2_codec, "_calls", lambda: {"nothing": lambda: None})
    assert main(["bench", "go2-codec", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((tmp_path / "go2-codec.json").read_text())
    assert "nothing" in printed.err and "written: go2-codec.json" in printed.err


def test_quiet_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    """As with every bench."""
    bench_codec(Go2Codec(quiet=True), batches=1)
    assert capsys.readouterr().out == ""
