"""The long walk's velocities and its figures of memory; the walk itself is what `deal-hw deploy go2` does."""

from __future__ import annotations

from pathlib import Path

import pytest
from measure_go2_long_walk import PARTS, repeated, walked_part

from deal_hw.workflows.emulation.walk_script import PROFILE_S, write_script


def test_velocities_repeat_over_the_whole_walk(tmp_path: Path) -> None:
    """50 s need three rounds of 17 s; the second one begins with standing again."""
    script = repeated(50.0)
    assert len(script) == 12 and script[-1][0] == 2 * PROFILE_S + 12.0
    assert script[4] == (PROFILE_S, (0.0, 0.0, 0.0))
    lines = write_script(tmp_path / "v.csv", script).read_text().splitlines()
    assert lines[0] == "time_s,x,y,yaw" and lines[6] == "19,1,0,0"


@pytest.mark.parametrize(
    ("values", "wanted"),
    [([1, 2, 3, 4, 5, 6, 7, 8, 9, 90], [3, 5, 6]), ([7], [7, 7, 7])],
)
def test_memory_is_that_of_the_walk(values: list[float], wanted: list[float]) -> None:
    """Of a walk of 30 s, values every 5 s: from 10 s on, and not what reading the recording takes."""
    assert walked_part(values, 30.0) == wanted


def test_processes_are_known_by_modules_that_exist() -> None:
    """A renamed module would leave its memory out."""
    root = Path(__file__).parents[2] / "deal_hw"
    assert all(list(root.rglob(f"{part}.py")) for part in PARTS)
