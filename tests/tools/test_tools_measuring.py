"""What the measuring scripts share: options, rows that are kept after each run, and tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from measuring import Rows, add_seeds, head, markdown, parser, read_rows, spread, write_document


def row(seed: int, error: str = "") -> dict[str, Any]:
    return {"wire": "can", "seed": seed, "error": error}


def test_the_file_is_whole_after_each_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Row, command and machine; the row is printed as JSON, or as a given text, beside a table on stderr."""
    path = tmp_path / "folder" / "rows.json"
    rows = Rows("anywhere/measure_it.py", path)
    for number, output in enumerate((None, "one row", "")):
        rows.add(row(number), output, table=number > 0)
        document = json.loads(path.read_text(encoding="utf-8"))
        assert document["rows"] == [row(k) for k in range(number + 1)] == read_rows(path)
        assert document["argv"][0] == "tools/measure_it.py" and document["machine"]["versions"]
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == (json.dumps(row(0)) + "\n", "one row\n")


def test_rows_of_an_earlier_call_stay_where_they_have_names(tmp_path: Path) -> None:
    """A row with an error is not done; without names a call begins anew."""
    path = tmp_path / "rows.json"
    Rows("measure_it.py", path).keep([row(1), row(2, "TransportLostError: gone")])
    rows = Rows("measure_it.py", path, ("wire", "seed"))
    assert rows.done("can", 1) and not rows.done("can", 2) and not rows.done("serial", 1)
    rows.add(row(2), "")
    assert rows.done("can", 2) and len(read_rows(path)) == 3
    Rows("measure_it.py", path).keep([row(7)])
    assert read_rows(path) == [row(7)]


def test_without_a_file_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows are printed only."""
    monkeypatch.chdir(tmp_path)
    Rows("measure_it.py", None, ("seed",)).add(row(1))
    write_document(None, {"a": 1})
    assert json.loads(capsys.readouterr().out) == row(1) and not list(tmp_path.iterdir())


def test_a_document_begins_with_its_call(tmp_path: Path) -> None:
    """The head of a file that is no list of rows, with the time if asked."""
    path = tmp_path / "a.json"
    write_document(path, {**head("x/measure_it.py", dated=True), "what": "5 \u00b5s"})
    found = json.loads(path.read_text(encoding="utf-8"))
    assert found["argv"][0] == "tools/measure_it.py" and found["date"].endswith("+00:00")
    assert found["what"] == "5 \u00b5s" and found["machine"]["git_commit"]
    assert "date" not in head("x/measure_it.py")


def test_options_are_added_as_asked() -> None:
    """`--out`, `--table` and seeds with ranges; a docstring keeps its lines."""
    made = parser("One.\n\n    two", table=True)
    add_seeds(made, 1, 2)
    assert vars(made.parse_args([])) == {"out": None, "table": None, "seeds": (1, 2)}
    assert tuple(made.parse_args(["--seeds", "1000-1002,7"]).seeds) == (1000, 1001, 1002, 7)
    assert "    two\n" in made.format_help()
    with pytest.raises(SystemExit):
        parser("One.", out=False).parse_args(["--out", "a.json"])


def test_a_table_has_a_cell_for_each_head() -> None:
    """An empty cell is one space wide."""
    assert markdown(("a", "b"), [(1, ""), ("x", 2.5)]) == "| a | b |\n|---|---|\n| 1 | |\n| x | 2.5 |"


@pytest.mark.parametrize("make", [list, np.array])
def test_spread_has_the_middle_and_the_tail(make: Any) -> None:
    """Of 0 to 100: 50, 99 and 100; without values nothing is known."""
    assert spread(make(np.arange(101.0))) == {"p50": 50.0, "p99": 99.0, "max": 100.0}
    assert list(spread(make([1.0]), "_ms")) == ["p50_ms", "p99_ms", "max_ms"]
    assert np.isnan(list(spread(make([])).values())).all()
