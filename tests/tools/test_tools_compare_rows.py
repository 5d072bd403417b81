"""What `tools/compare_rows.py` calls a loss, on rows made by hand."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import compare_rows
import pytest

Row = dict[str, Any]


def row(seed: int = 0, error: float = 1.0, heldout: float = 0.01, coverage: float = 0.9, **other: Any) -> Row:
    """Return a row of the bench `fixed-range`."""
    return {
        "bench": "fixed-range", "task": "cartpole", "space": "", "profile": "sensor",
        "demonstration": "excite", "method": "default", "refined": True, "range_ratio": 5.0, "seed": seed,
        "error": "", "error_percent": error, "log_error_x100": error, "heldout_nrmse_calibrated": heldout,
        "coverage90": coverage, "alarms": [], "seconds": 10.0, **other,
    }  # fmt: skip


class Files:
    """Writes two files of rows and compares them."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self._folder, self._capsys = folder, capsys

    def __call__(self, old: Sequence[Row], new: Sequence[Row], *options: str) -> tuple[int, str]:
        """Return the exit code and what was printed."""
        paths = []
        for name, rows in (("old", old), ("new", new)):
            path = self._folder / f"{name}.json"
            path.write_text(json.dumps({"format": "deal_hw.bench/1", "rows": rows}), encoding="utf-8")
            paths.append(str(path))
        code = compare_rows.main([*paths, *options])
        printed = self._capsys.readouterr()
        return code, printed.out + printed.err


@pytest.fixture
def files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Files:
    """Return what compares rows."""
    return Files(tmp_path, capsys)


def test_same_rows_are_no_loss(files: Files) -> None:
    """A file beside itself: every ratio is 1."""
    code, printed = files([row(0), row(1)], [row(0), row(1)])
    assert code == 0
    line = printed.splitlines()[1]
    assert line.split() == [
        "fixed-range", "cartpole", "sensor", "ratio", "5", "default", "2",
        "1", "1", "1.00", "0.01", "0.01", "1.00", "0.900/0.900", "0/0", "10.0/10.0",
    ]  # fmt: skip
    assert printed.splitlines()[-1] == "1 cells, 0 worse"


@pytest.mark.parametrize(
    ("errors", "loss"),
    [
        # Medians of three: 2 before; 2.2 is 1.1 times that, 2.21 is more.
        ((1.0, 2.2, 9.0), ""),
        ((1.0, 2.21, 9.0), "median error_percent 2 -> 2.21, more than 1.1 times"),
        ((0.0, 0.0, float("nan")), ""),
        ((float("nan"), float("nan"), float("nan")), "median error_percent 2 -> inf"),
    ],
)
def test_median_error(files: Files, errors: tuple[float, ...], loss: str) -> None:
    """The median over seeds may grow by a tenth."""
    old = [row(0, 1.0), row(1, 2.0), row(2, 5.0)]
    code, printed = files(old, [row(seed, error) for seed, error in enumerate(errors)])
    assert code == bool(loss)
    assert loss in printed


def test_errors_at_numerical_zero_are_equal(files: Files) -> None:
    """A hundred times an error of 1e-6 % is below the floor of 1e-3 %."""
    assert files([row(error=1e-6, heldout=1e-9)], [row(error=1e-4, heldout=1e-6)])[0] == 0
    code, printed = files([row(error=1e-6)], [row(error=1e-4)], "--error-floor", "1e-5")
    assert code == 1
    assert "seed 0: error_percent 1e-06 -> 0.0001" in printed


def test_heldout_error(files: Files) -> None:
    """The held-out error may grow by a fiftieth: 0.01 to 0.0102."""
    assert files([row()], [row(heldout=0.0102)])[0] == 0
    code, printed = files([row()], [row(heldout=0.0103)])
    assert code == 1
    assert "median heldout_nrmse_calibrated 0.01 -> 0.0103, more than 1.02 times" in printed
    assert files([row()], [row(heldout=0.0103)], "--heldout-limit", "1.05")[0] == 0


def test_bad_seed_is_named(files: Files) -> None:
    """A median hides one bad seed; it is named and not judged."""
    code, printed = files([row(s) for s in range(3)], [row(0), row(1), row(2, error=19.6)])
    assert code == 0
    assert "seed 2: error_percent 1 -> 19.6" in printed


@pytest.mark.parametrize(
    ("old", "new", "other", "losses"),
    [
        (0.9, 0.89, {}, ["coverage 0.900 -> 0.890"]),
        (0.8, 0.84, {}, ["coverage 0.840 is below 0.85 though the model is right"]),
        (0.9, 0.8, {}, ["coverage 0.900 -> 0.800", "below 0.85"]),
        (0.5, 0.6, {"profile": "realistic"}, []),
        (0.5, 0.6, {"bench": "mismatch"}, []),
        (0.6, 0.5, {"profile": "realistic"}, ["coverage 0.600 -> 0.500"]),
        (0.1, 0.1, {"method": "deal", "refined": False}, []),
        (0.1, 0.1, {"method": "deal", "refined": True}, ["below 0.85"]),
    ],
)
def test_coverage(files: Files, old: float, new: float, other: Row, losses: list[str]) -> None:
    """Not below the old one; where the model is right and intervals are claimed, not below 0.85."""
    code, printed = files([row(coverage=old, **other)], [row(coverage=new, **other)])
    assert code == bool(losses)
    assert printed.count("worse: ") == len(losses)
    assert all(loss in printed for loss in losses)


def test_coverage_that_is_enough(files: Files) -> None:
    """Intervals that held all truths were too wide; that they are narrower can be allowed."""
    assert files([row(coverage=1.0)], [row(coverage=0.92)])[0] == 1
    assert files([row(coverage=1.0)], [row(coverage=0.92)], "--coverage-enough", "0.9")[0] == 0


def test_a_whole_methods_refinement_does_not_matter(files: Files) -> None:
    """It chooses for itself; settings that a row leaves out are the usual ones."""
    old = [row(method=method, refined=False) for method in ("default", "local", "output-error")]
    new = [row(method=method, refined=True, range_ratio=5) for method in ("default", "local", "output-error")]
    new = [{k: v for k, v in one.items() if k not in {"space", "demonstration"}} for one in new]
    assert files(old, new)[0] == 0
    assert files(new, old)[0] == 0


def test_search_with_and_without_refinement_are_two_cells(files: Files) -> None:
    """The refined search is not compared with the bare one."""
    code, printed = files([row(method="eki")], [row(method="eki", refined=False)])
    assert code == 1
    assert "missing in NEW" in printed
    assert "only in new.json: fixed-range cartpole sensor ratio 5 eki\n" in printed


def test_map_compares_methods_by_hand(files: Files) -> None:
    """One method of OLD beside another of NEW."""
    old, new = [row(method="eki", error=2.0)], [row(method="deal", error=2.1)]
    assert files(old, new)[0] == 1
    assert files(old, new, "--map", "eki=deal")[0] == 0


def test_what_is_missing_is_a_loss(files: Files) -> None:
    """A cell, a seed, a figure, or a seed with an error; an old error and a new cell are none."""
    _, printed = files([row(), row(range_ratio=20.0)], [row()])
    assert "missing in NEW" in printed
    code, printed = files([row(0), row(1), row(2)], [row(0), row(1) | {"error": "CalibrationError: no"}])
    assert code == 1
    assert "seed 2 is missing in NEW" in printed
    assert "seed 1: CalibrationError: no" in printed
    code, printed = files([row()], [row(coverage90=None)])
    assert (code, "coverage90 is missing in NEW for seed 0" in printed) == (1, True)
    code, printed = files([row(0), row(1) | {"error": "refused"}], [row(0), row(1), row(range_ratio=20.0)])
    assert (code, "seed 1 had an error in OLD" in printed) == (0, True)


def test_real_recordings_are_judged_in_radians_too(files: Files) -> None:
    """Each split is a cell; the pooled error counts beside the mean of joints."""
    real: Row = {
        "bench": "real", "task": "so101", "split": "a", "profile": "real", "method": "default",
        "refined": True, "range_ratio": 5.0, "seed": 0, "error": "", "alarms": ["x"], "seconds": 9.0,
        "heldout_nrmse_calibrated": 0.02, "heldout_rmse_calibrated": 0.005,
        "heldout_pooled_calibrated": 0.006,
    }  # fmt: skip
    other = real | {"split": "b"}
    code, printed = files([real, other], [real, other | {"heldout_pooled_calibrated": 0.007}])
    assert code == 1
    assert printed.count("worse: ") == 1
    assert "real so101 real b ratio 5 default\n  worse: median heldout_pooled_calibrated" in printed


def test_seconds_are_judged_where_asked(files: Files) -> None:
    """Twice the seconds are shown, and a loss only by --seconds-limit."""
    old, new = [row()], [row(seconds=20.0)]
    assert files(old, new)[0] == 0
    assert files(old, new, "--seconds-limit", "1.5")[0] == 1


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        ([row(), row()], [], "two rows for seed 0"),
        ([{"bench": "go2-codec"}], [], "row 0 has no 'task'"),
        (["text"], [], "row 0 is no object"),
        ([row()], ["--map", "eki"], "give a method of OLD and one of NEW"),
    ],
)
def test_what_cannot_be_compared(files: Files, rows: list[Any], options: list[str], message: str) -> None:
    """One line and exit code 2."""
    code, printed = files([row()], rows, *options)
    assert code == 2
    assert message in printed


def test_file_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file that is missing, no JSON or of another kind is named."""
    (tmp_path / "a.json").write_text("{", encoding="utf-8")
    (tmp_path / "b.json").write_text("[]", encoding="utf-8")
    for name in ("none.json", "a.json", "b.json"):
        assert compare_rows.main([str(tmp_path / name)] * 2) == 2
        assert capsys.readouterr().err.startswith("compare_rows: ")
