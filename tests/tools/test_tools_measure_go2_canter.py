"""The canter's measurement: deviation from a line, the gait diagram, and the table."""

from __future__ import annotations

from pathlib import Path

import measure_go2_canter
import numpy as np
from PIL import Image

from deal_hw.policies.canter_env import ContactSchedule


def test_the_diagram_has_plan_and_policy(tmp_path: Path) -> None:
    """A picture is written, with bars of both."""
    time_s = np.arange(0.0, 1.0, 0.01)
    down = ContactSchedule().stance(2.5 * time_s).astype(int).tolist()
    path = tmp_path / "gait.png"
    shown = {"time_s": time_s.tolist(), "plan": down, "policy": down}
    measure_go2_canter.draw(path, shown, "a robot")
    with Image.open(path) as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20) or []}
    # Grey for the plan, matplotlib's blue for the policy.
    assert {(102, 102, 102), (31, 119, 180)} <= colours


def test_a_reference_takes_the_place_of_the_plan(tmp_path: Path) -> None:
    """A reference that never stands leaves the upper half without bars, whatever the plan is."""
    time_s = np.arange(0.0, 1.0, 0.01)
    down = ContactSchedule().stance(2.5 * time_s).astype(int)
    path, values = tmp_path / "gait.png", {"time_s": time_s.tolist(), "plan": down.tolist()}
    shown = {**values, "policy": down.tolist(), "reference": np.zeros_like(down).tolist()}
    measure_go2_canter.draw(path, shown, "a robot")
    with Image.open(path) as picture:
        pixels = {colour: count for count, colour in picture.convert("RGB").getcolors(1 << 20) or []}
    # Smoothed letters have some grey, too.
    assert pixels[(31, 119, 180)] > 10_000 > 100 > pixels.get((102, 102, 102), 0)


def test_the_table_has_sizes_not_signs() -> None:
    """A deviation to the left and one to the right do not cancel; runs that ended early are counted."""
    rows = [
        {"speed_m_s": 1.0, "outcome": "finished", "deviation_m": 0.4},
        {"speed_m_s": 1.0, "outcome": "tripped", "deviation_m": -0.6},
        {"speed_m_s": 1.5, "outcome": "finished", "deviation_m": None},
    ]
    lines = measure_go2_canter.table(rows).splitlines()
    assert lines == [
        "1 m/s: 2 runs, 1 ended early; deviation_m 0.500 (worst 0.600)",
        "1.5 m/s: 1 runs, 0 ended early",
    ]
