"""The layout by its values: what is at the top, which part of each axis is shown, which axes are linked."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.viz.blueprint import inspect_blueprint, joint_groups

LINKED = 2
"""Of rerun's LinkAxis."""


def views(part: Any) -> Iterator[Any]:
    """Yield the views inside a container."""
    for one in getattr(part, "contents", None) or ():
        if isinstance(one, str):
            yield part
            return
        yield from views(one)
    if not hasattr(part, "contents") or isinstance(part.contents, str):
        yield part


def axis(view: Any) -> tuple[float, float]:
    """Return the shown part of a view's y axis."""
    low, high = view.properties["ScalarAxis"].range.as_arrow_array().to_pylist()[0]
    return low, high


@pytest.fixture(scope="module")
def layout(shown: Any) -> Any:
    """The layout of the shown episode."""
    return inspect_blueprint(shown.trajectory, DESCRIPTION, shown.overlay, shown.cycles, alarms=True)


@pytest.fixture(scope="module")
def plots(layout: Any) -> dict[str, Any]:
    """The plots by name."""
    return {view.name: view for view in views(layout.root_container) if "ScalarAxis" in view.properties}


def test_the_verdict_is_at_the_top(layout: Any) -> None:
    """At the top left, and higher than the rest of its column where there are alarms."""
    left, right = layout.root_container.contents
    texts, robot = left.contents
    assert [view.origin for view in texts.contents] == ["/verdict", "/summary", "/events", "/status"]
    assert texts.active_tab == 0 and robot.origin == "/world"
    assert left.row_shares[0] == max(left.row_shares)
    assert [tab.name for tab in right.contents] == ["Position", "Velocity", "Commands", "Loop timing"]


def test_every_plot_names_its_unit_and_shares_the_time_axis(plots: dict[str, Any]) -> None:
    """All time axes are linked; a unit stands in the name."""
    assert len(plots) == 12
    for name, view in plots.items():
        assert view.properties["TimeAxis"].link.as_arrow_array().to_pylist() == [LINKED]
        assert name.endswith("]") and "[" in name


def test_axes_hold_what_is_drawn(plots: dict[str, Any], shown: Any) -> None:
    """All that was measured and sent, with room; predictions and their errors; two labels at least."""
    t, overlay = shown.trajectory, shown.overlay
    nominal = overlay.predictions["nominal"]
    drawn = {
        "cart position [m]": (t.position[:, 0], nominal.position[..., 0]),
        "pole velocity [rad/s]": (t.velocity[:, 1], nominal.velocity[..., 1]),
        "cart: predicted - measured [m]": (overlay.position_error("nominal")[..., 0],),
        "cart: target and position [m]": (t.position[:, 0], t.position_target[:, 0]),
        "cart effort [N]": (t.effort[:, 0],),
        "Time between samples and between commands [ms]": (1e3 * np.diff(t.receive_s),),
    }
    for name, arrays in drawn.items():
        low, high = axis(plots[name])
        assert low < min(a.min() for a in arrays) and max(a.max() for a in arrays) < high
    for name, view in plots.items():
        low, high = axis(view)
        steps = 10.0 ** np.arange(-9, 9)
        labels = np.floor(high / steps) - np.ceil(low / steps) + 1
        assert ((labels >= 3) & (labels <= 28)).any(), name


def test_a_prediction_that_runs_away_leaves_the_plot(shown: Any) -> None:
    """It may take a quarter of the measured range to either side: the measured one keeps half of the plot."""
    wild = dataclasses.replace(
        shown.overlay.predictions["nominal"], position=1e6 * shown.overlay.predictions["nominal"].position
    )
    overlay = dataclasses.replace(shown.overlay, predictions={"nominal": wild})
    layout = inspect_blueprint(shown.trajectory, DESCRIPTION, overlay)
    found = {view.name: view for view in views(layout.root_container)}
    real = shown.trajectory.position[:, 0]
    low, high = axis(found["cart position [m]"])
    assert low < real.min() - 0.25 * np.ptp(real) and real.max() + 0.25 * np.ptp(real) < high
    assert high - low < 2 * np.ptp(real)


def test_efforts_that_were_not_recorded_have_no_plot(shown: Any) -> None:
    """An imported recording may have none."""
    silent = dataclasses.replace(shown.trajectory, effort=np.full_like(shown.trajectory.effort, np.nan))
    names = {view.name for view in views(inspect_blueprint(silent, DESCRIPTION).root_container)}
    assert "cart: target and position [m]" in names and "cart effort [N]" not in names


def test_joints_share_tabs() -> None:
    """By leg where names tell them, else in their order; few joints need no tabs."""
    assert joint_groups(("a", "b"), 2) == {"": [0, 1]}
    legs = ("FL_hip", "FL_calf", "FR_hip", "FR_calf")
    assert joint_groups(legs, 3) == {"FL": [0, 1], "FR": [2, 3]}
    arm = ("pan", "lift", "flex", "turn", "grip")
    assert joint_groups(arm, 3) == {"pan to flex": [0, 1, 2], "turn to grip": [3, 4]}
    assert joint_groups(("pan", "lift"), 1) == {"pan": [0], "lift": [1]}
