"""The paper's update without data: its place in the range is that of the bench's no-data rows."""

from __future__ import annotations

import numpy as np
import pytest
from measure_paper_update import measure, measure_with_recording, printed_rows

from deal_hw.bench import calibration
from deal_hw.bench.settings import Paper

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize(
    ("update", "method"), [("literal", "deal-paper-literal-flat"), ("deal-paper", "deal-paper-flat")]
)
def test_a_row_is_the_benchs_row_without_data(update: str, method: str) -> None:
    """The same seed, ratio and number of parameters give the same error, without a robot."""
    asked = Paper(profile="ideal", methods=(method,), range_ratio=(10.0,), seeds=(3,), demonstration="policy")
    (cell,) = calibration.make_cells(asked)
    row = calibration.run_cell(cell, population=None, generations=50, threads=1)
    found = measure(update, 9, 10.0, 3)
    assert found["error_percent"] == pytest.approx(row["error_percent"], rel=1e-6)


def test_the_noise_decides_where_the_update_ends() -> None:
    """Without noise it ends far up the range, with all of it near the lower end, where the truth is."""
    errors = {
        name: np.mean([measure(name, 11, 10.0, seed)["error_percent"] for seed in range(3)])
        for name in ("literal", "literal, eta 0", "deal-paper")
    }
    assert errors["literal"] < 100 < 300 < errors["deal-paper"]
    assert errors["literal, eta 0"] > 3 * errors["literal"]


def test_a_box_around_zero_keeps_the_middle_of_the_range() -> None:
    """Without data a centred box ends at 405 % of the linear midpoint at ratio 10, whatever its width."""
    for name in ("literal, box [-1, 1]", "literal, box [-1, 1], eta 0.1", "literal, unit variance"):
        errors = [measure(name, 11, 10.0, seed)["error_percent"] for seed in range(3)]
        assert np.mean(errors) == pytest.approx(405, rel=0.15), name


@pytest.mark.slow
def test_with_a_recording_a_row_is_the_benchs_row() -> None:
    """`literal` is the bench's method; another reading is another search on the same recording."""
    asked = Paper(
        profile="ideal",
        methods=("deal-paper-literal",),
        range_ratio=(10.0,),
        seeds=(3,),
        demonstration="policy",
    )
    (cell,) = calibration.make_cells(asked)
    row = calibration.run_cell(cell, population=None, generations=1, threads=1)
    found = measure_with_recording("literal", 10.0, 3, generations=1)
    for key in ("error_percent", "heldout_nrmse_calibrated", "steps"):
        assert found[key] == pytest.approx(row[key], rel=1e-6)
    other = measure_with_recording("literal, clip 0.1", 10.0, 3, generations=1)
    assert other["error_percent"] != pytest.approx(row["error_percent"], rel=1e-6)
    assert other["pole_moved_rad"] == found["pole_moved_rad"] > 0.01


def test_the_papers_deal_has_one_place_at_all_ratios() -> None:
    """Nine errors of 81 to 263 % are one place in the ranges, within 0.007; the truth's place halves."""
    rows = printed_rows()
    places = [row["place"] for row in rows if row["update"] == "DEAL"]
    assert len(rows) == 45 and len(places) == 9
    assert 0.172 < min(places) and max(places) < 0.180
    for row in rows:
        factor = 1 / row["range_ratio"] + row["place"] * (row["range_ratio"] - 1 / row["range_ratio"])
        assert 100 * (factor - 1) == pytest.approx(row["error_percent"])
