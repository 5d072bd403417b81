"""The timing table of the cart-pole's wires: its figures, and one short row over a real pty."""

from __future__ import annotations

import pytest
from measure_cartpole_wires import WIRE_MS, measure, table

from deal_hw.drivers.cartpole.wire.can_link import database

pytestmark = pytest.mark.real_time


def test_times_on_the_wire_follow_from_the_frames() -> None:
    """Worst case at 500 kbit/s; 95 bits for 4 bytes and 135 for 8, as the page works out."""

    def ms(*names: str) -> float:
        lengths = [database()[name].length for name in names]
        return sum(44 + 8 * n + (34 + 8 * n - 1) // 4 + 3 for n in lengths) / 500

    command, state = WIRE_MS["can"]
    assert command == pytest.approx(ms("Target1", "Target2", "Target3"), abs=0.005)
    assert state == pytest.approx(ms(*(f"State{k}" for k in range(1, 6))), abs=0.005)
    assert WIRE_MS["odrive"] == pytest.approx(((95 + 3 * 135) / 500, 4 * 135 / 500))


def test_a_row_counts_every_command() -> None:
    """A second at 50 Hz over CAN: 50 commands, nearly all named by a state, none lost on the way."""
    row = measure("can", 50, 1.0)
    assert row["commands"] == 50
    assert row["named"] >= 40
    assert row["transport_errors"] == 0
    assert f"| can | 50 | 1 | {row['round_trip_ms']['p50']:.2f} /" in table([row])
