"""The climb over a wire: the whole of deploy against an emulated Go2 before a platform."""

from __future__ import annotations

import measure_go2_climb_wire
import pytest

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


def test_a_walk_that_is_too_short_ends_before_the_platform(monkeypatch: pytest.MonkeyPatch) -> None:
    """After one second the run ends as planned, on the floor. A policy that is missing is an error."""
    monkeypatch.setattr(measure_go2_climb_wire, "CLIMB_S", 1.0)
    row = measure_go2_climb_wire.measure("climb", "zenoh", 0.05, 3, blind=False)
    assert row["exit_code"] == 0 and row["end"].startswith("finished") and not row["error"]
    assert not row["climbed"] and 0.2 < row["furthest_m"] < 1.3
    missing = measure_go2_climb_wire.measure("none.onnx", "zenoh", 0.05, 3, blind=True)
    assert not missing["climbed"] and missing["exit_code"] == 2 and "none.onnx" in missing["error"]
