"""tools/measure_bridge.py: its sums, and messages that carry their number."""

from __future__ import annotations

import bridge_sides
import measure_bridge
import pytest


def test_one_way_times_count_what_both_sides_noted() -> None:
    """Messages before the first that arrived and after the last are nobody's loss; those between are."""
    sent = {str(number): 1_000_000 * number for number in range(1, 11)}
    received = {number: stamp + 2_000_000 for number, stamp in sent.items() if number in "34678"}
    row = measure_bridge._one_way(sent, {**received, "99": 5})
    assert row == {"p50_ms": 2.0, "p99_ms": 2.0, "max_ms": 2.0, "messages": 5, "lost": 3}


def test_a_spread_is_least_median_longest() -> None:
    """Milliseconds, and how many."""
    assert measure_bridge._spread([3.0, 1.0, 2.0]) == {
        "times": 3,
        "least_ms": 1.0,
        "median_ms": 2.0,
        "longest_ms": 3.0,
    }


@pytest.mark.parametrize("number", [1, 4711, 1_000_003])
def test_messages_carry_their_number(number: int) -> None:
    """As sound states and commands, which the bridge passes."""
    assert bridge_sides._state_number(bridge_sides._state()(number)) == number
    assert bridge_sides._command_number(bridge_sides._command()(number)) == number
