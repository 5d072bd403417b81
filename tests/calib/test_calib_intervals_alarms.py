"""One alarm of unexplained residuals, however many checks find them."""

from __future__ import annotations

from deal_hw.calib.fit.unexplained import Unexplained, as_one, autocorrelated
from deal_hw.findings import Finding

BOUND = Finding.alarm("Ended at the bound.", "The data press it.", "Widen it.")


def test_alarms_of_unexplained_residuals_become_one() -> None:
    """All facts stand in the first one's place; a place that was looked for is kept; others stay."""
    window = " over 0.4 s from fitted start states"
    found = as_one(
        [
            Unexplained.larger(9.0, place="No cause is known. It is spread over channels."),
            Unexplained.of([autocorrelated(23.04)]),
            BOUND,
            Unexplained.larger(9.0, window),
        ]
    )
    assert [alarm.code for alarm in found] == ["unexplained", ""] and found[1] == BOUND
    assert found[0].seen == (
        "Residuals are autocorrelated over 23.0 samples (the sensor's noise is not) and 3.0 times the "
        "sensor's noise over 0.4 s from fitted start states. No cause is known. It is spread over channels."
    )
    assert "a sensor is wrong there" in found[0].means and "held-out error" in found[0].do


def test_a_single_alarm_stays_as_it_is() -> None:
    """Without a place it names no sensor; an order without such alarms is kept."""
    alone = Unexplained.larger(16.0)
    assert (
        alone.seen == "Residuals are 4.0 times the sensor's noise." and "sensor is wrong" not in alone.means
    )
    assert as_one([BOUND, alone]) == (BOUND, alone)
    assert as_one([]) == ()
