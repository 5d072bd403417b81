"""Figures of benches: nothing is empty, nothing is nameless."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from deal_hw.bench.figures import POLICIES, draw
from deal_hw.bench.rows import load_rows
from deal_hw.bench.tables import method_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED = Path(__file__).resolve().parents[2] / "docs" / "measured"


def row(method: str, seed: int, error: float, **more: Any) -> dict[str, Any]:
    """Return a row of a bench with a known truth."""
    return {
        "bench": "fixed-range",
        "task": "ant",
        "profile": "ideal",
        "method": method,
        "range_ratio": 5.0,
        "seed": seed,
        "error": "",
        "log_error_x100": error,
        "null_log_error_x100": 60.0 + seed,
        **more,
    }


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved."""
    figures: list[Figure] = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, path, dpi: figures.append(figure))
    return figures


def words(texts: Any) -> list[str]:
    """Return what texts say."""
    return [text.get_text() for text in texts]


def ticks(axes: Axes) -> list[str]:
    """Return the names at the left of a panel."""
    return words(axes.get_yticklabels())


def legend(figure: Figure) -> list[str]:
    """Return what the legend names."""
    return words(figure.legends[0].get_texts())


def marks(axes: Axes) -> tuple[float, list[float]]:
    """Return where the one mark of a panel is, and the ends of its bar."""
    from matplotlib.container import ErrorbarContainer

    (container,) = axes.containers
    assert isinstance(container, ErrorbarContainer)
    mark, _, (bar,) = container.lines
    return float(np.ravel(mark.get_xdata())[0]), bar.get_segments()[0][:, 0].tolist()


def test_methods_ratios_and_no_data_are_named(drawn: list[Figure], tmp_path: Path) -> None:
    """Methods stand at the axis, ratios and the midpoint's error in the legend, seeds in the title."""
    rows = [row("eki", seed, 1.0 + seed) for seed in range(3)]
    rows += [row("midpoint", seed, 60.0) for seed in range(3)]
    rows += [row("eki", 0, 4.0, range_ratio=20.0, refined=True, null_log_error_x100=120.0)]
    draw(tmp_path / "a.png", rows)
    (axes,) = drawn[0].axes
    assert ticks(axes) == ["eki", "midpoint\n(no data)", "eki + refinement"]
    assert legend(drawn[0]) == [
        "range ratio 5",
        "range ratio 20",
        "midpoint of the range, range ratio 5 (no data)",
        "midpoint of the range, range ratio 20 (no data)",
    ]
    lines = [float(np.ravel(line.get_xdata())[0]) for line in axes.lines if line.get_linestyle() == "--"]
    assert lines == [61.0, 120.0], "medians of the rows of each ratio"
    assert axes.get_title() == "ant, profile ideal\nmedian, smallest, largest of 1 to 3 seeds"
    assert axes.get_xscale() == "log"


def test_the_bar_reaches_from_the_smallest_to_the_largest(drawn: list[Figure], tmp_path: Path) -> None:
    """1, 2 and 7: the mark is at 2, the bar from 1 to 7; less than the floor is drawn there, and reported."""
    draw(tmp_path / "a.png", [row("eki", seed, value) for seed, value in enumerate((1.0, 7.0, 2.0))])
    middle, bar = marks(drawn[0].axes[0])
    assert middle == 2.0 and bar == [1.0, 7.0]
    draw(tmp_path / "b.png", [row("eki", 0, 0.0)])
    assert marks(drawn[1].axes[0])[0] == 1e-3
    assert drawn[1].axes[0].get_xlabel().endswith("(at least 0.001)")


def test_policies_are_drawn_only_where_some_were_trained(drawn: list[Figure], tmp_path: Path) -> None:
    """Each has its name, one line a robot; without policies there is no panel."""
    trained = {f"angle_error_{name}": 0.1 for name in POLICIES}
    draw(tmp_path / "a.png", [row("default", seed, 1.0, **trained) for seed in range(2)])
    assert ticks(drawn[0].axes[1]) == list(POLICIES.values())
    assert drawn[0].axes[1].get_xlabel() == "mean |pole angle| [rad]"
    draw(tmp_path / "b.png", [row("default", 0, 1.0)])
    assert len(drawn[1].axes) == 1


def test_real_recordings_stand_beside_what_needs_no_data(drawn: list[Figure], tmp_path: Path) -> None:
    """A panel a split, the nominal model and a robot that stands still as lines; nothing of what diverged."""
    real = {
        "bench": "real",
        "task": "arm",
        "profile": "real",
        "error": "",
        "range_ratio": 5.0,
        "method": "eki",
    }
    rmse = {"heldout_rmse_nominal": 0.02, "heldout_rmse_null": 0.05}
    rows = [real | rmse | {"split": split, "heldout_rmse_calibrated": 0.004} for split in ("a", "b")]
    draw(tmp_path / "a.png", rows)
    assert [axes.get_title() for axes in drawn[0].axes] == [f"arm, held out: {s}\n1 seed" for s in "ab"]
    assert legend(drawn[0]) == ["calibrated model", "nominal model (no data)", "nothing moves (no data)"]
    draw(tmp_path / "b.png", [rows[0] | {"heldout_rmse_calibrated": None}])
    assert len(drawn) == 1


ESTIMATES = sorted(path for path in MEASURED.glob("*.png") if not path.stem.startswith("transfer_"))
"""Figures of calibrations; those of the transfer bench are tested with it."""


@pytest.mark.parametrize("path", ESTIMATES, ids=lambda path: str(path.stem))
def test_published_figures_have_no_empty_panel(path: Path, drawn: list[Figure], tmp_path: Path) -> None:
    """Of the rows beside each: every axis has a name and marks, every method of its rows is at one."""
    rows = [one for one in load_rows(path.with_suffix(".json")) if not one["error"]]
    draw(tmp_path / "a.png", rows)
    named: set[str] = set()
    for axes in drawn[0].axes:
        assert axes.get_xlabel() and axes.get_ylabel() and axes.get_title()
        assert axes.containers, "an empty panel"
        named |= {label.removesuffix("\n(no data)") for label in ticks(axes)}
    assert {method_name(one) for one in rows} <= named
    assert any("no data" in text for text in legend(drawn[0]))
