"""Calibrations over wires: medians over runs, failed runs counted, errors over the serial one's."""

from __future__ import annotations

from typing import Any

from measure_wire_calibration import measure, table


def row(transport: str, error_percent: float) -> dict[str, Any]:
    """Return a row of a run that went through."""
    return {
        "transport": transport,
        "error": "",
        "error_percent": error_percent,
        "median_percent": 0.5,
        "interval_percent": 1.5,
        "coverage90": 0.875,
    }


def test_medians_and_their_share_of_serial() -> None:
    """Serial 1, 2 and 4 % and CAN 3 and 5 %: medians 2 and 4, twice serial; the failed run is counted."""
    rows = [*(row("serial", e) for e in (1.0, 4.0, 2.0)), row("can", 3.0), row("can", 5.0)]
    failed = {"transport": "can", "error": "TransportLostError: gone"}
    lines = table([*rows, failed, {"transport": "odrive", "error": "no"}]).splitlines()
    assert lines[2:] == [
        "| serial | 3 | 2.00 | 1.00 | 0.50 | 1.50 | 0.88 |",
        "| can | 2, 1 failed | 4.00 | 2.00 | 0.50 | 1.50 | 0.88 |",
        "| odrive | 0, 1 failed | | | | | |",
    ]


def test_what_goes_wrong_is_kept_in_the_row() -> None:
    """An emulator that refuses its profile leaves a row that says so."""
    found = measure("serial", "nosuch", 1)
    assert found["error"] and "nosuch" in found["error"] and "error_percent" not in found


def test_a_row_holds_what_calibration_found() -> None:
    """A whole row over a real emulator: right to 20 % in the median, every parameter with its interval."""
    found = measure("can", "ideal", 1)
    assert found["error"] == "" and len(found["parameters"]) == 9
    assert found["median_percent"] < 20 and 0 <= found["coverage90"] <= 1
    assert all(v["low"] < v["estimate"] < v["high"] for v in found["parameters"].values())
