"""Cost of the laws: rows of small rollouts."""

from __future__ import annotations

import pytest
from measure_laws import LAWS, measure

from deal_hw.sim.parameters import KIND_TABLE


def test_a_row_for_each_law() -> None:
    """Two laws on the six joints of an arm: times and ratios belong together."""
    rows = measure("so101", ["friction-speed", "play"], 2, 20, 3)
    assert [row["law"] for row in rows] == ["friction-speed", "play"]
    for row in rows:
        assert (row["joints"], row["members"], row["steps"], row["repeats"]) == (6, 2, 20, 3)
        low, high = row["ratio_quartiles"]
        assert 0 < low <= row["ratio"] <= high and row["bare_us_per_step"] > 0
        assert row["engine_ratio"] > 0


@pytest.mark.parametrize("law", LAWS)
def test_laws_are_of_known_kinds(law: str) -> None:
    """Each parameter of a law is of a kind that robots have."""
    assert set(LAWS[law]) <= set(KIND_TABLE)
