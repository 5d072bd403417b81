"""LoopTiming: hand-computed deadlines, overruns and spreads under a virtual clock."""

from __future__ import annotations

import json
import math
from array import array

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.timing import LoopTiming, LoopTimingReport, Spread
from deal_hw.errors import ConfigurationError

MS = 1_000_000


@pytest.fixture
def clock() -> VirtualClock:
    """A clock that starts at an odd time."""
    return VirtualClock(123)


def test_cycles_start_on_the_grid_whatever_their_work_takes(clock: VirtualClock) -> None:
    """Work of 3, 19 and 0 ms leaves starts at 0, 20, 40 and 60 ms: lateness never adds up."""
    loop_timing = LoopTiming(clock, 50.0)
    starts = []
    for work_ms in (3, 19, 0, 5):
        index, deadline_ns = loop_timing.begin()
        starts.append((index, clock.now_ns() - 123, deadline_ns - 123))
        clock.advance_ns(work_ms * MS)
    assert starts == [(0, 0, 0), (1, 20 * MS, 20 * MS), (2, 40 * MS, 40 * MS), (3, 60 * MS, 60 * MS)]
    report = loop_timing.report()
    assert (report.cycles, report.overruns, report.overruns_beyond_period, report.skipped_periods) == (
        4,
        0,
        0,
        0,
    )
    assert report.period == Spread(0.02, 0.02, 0.02)


def test_a_late_cycle_starts_at_once_and_the_next_is_on_time(clock: VirtualClock) -> None:
    """25 ms of work: cycle 1 starts at 25 ms, 5 ms late, and cycle 2 at 40 ms."""
    loop_timing = LoopTiming(clock, 50.0)
    loop_timing.begin()
    clock.advance_ns(25 * MS)
    assert loop_timing.begin() == (1, 123 + 20 * MS)
    assert loop_timing.late_ns == 5 * MS
    assert loop_timing.begin() == (2, 123 + 40 * MS)
    report = loop_timing.report()
    assert (report.overruns, report.overruns_beyond_period, report.skipped_periods) == (1, 0, 0)
    # Periods 25 and 15 ms: median 20, maximum 25.
    assert report.period.p50_s == pytest.approx(0.020)
    assert report.period.max_s == 0.025
    assert report.lateness.max_s == 0.005


def test_whole_periods_are_skipped_not_caught_up(clock: VirtualClock) -> None:
    """85 ms of work: three deadlines are over, the cycle of 80 ms runs at 85, the next at 100."""
    loop_timing = LoopTiming(clock, 50.0)
    loop_timing.begin()
    clock.advance_ns(85 * MS)
    assert loop_timing.begin() == (4, 123 + 80 * MS)
    assert loop_timing.late_ns == 65 * MS
    assert loop_timing.next_index == 5
    assert loop_timing.begin() == (5, 123 + 100 * MS)
    assert clock.now_ns() == 123 + 100 * MS
    report = loop_timing.report()
    assert (report.cycles, report.overruns, report.overruns_beyond_period, report.skipped_periods) == (
        3,
        1,
        1,
        3,
    )


@pytest.mark.parametrize(
    ("late_ms", "overruns", "beyond"), [(2, 0, 0), (2.1, 1, 0), (19.9, 1, 0), (20, 1, 1)]
)
def test_an_overrun_is_a_tenth_of_a_period_late(
    clock: VirtualClock, late_ms: float, overruns: int, beyond: int
) -> None:
    """Up to 2 ms of 20 is punctual; 20 ms or more is beyond one period."""
    loop_timing = LoopTiming(clock, 50.0)
    loop_timing.begin()
    clock.advance_ns(20 * MS + round(late_ms * MS))
    loop_timing.begin()
    report = loop_timing.report()
    assert (report.overruns, report.overruns_beyond_period) == (overruns, beyond)


def test_sections_and_state_ages_are_spread(clock: VirtualClock) -> None:
    """101 samples of 0..100 us have median 50, 99th percentile 99 and maximum 100 us."""
    loop_timing = LoopTiming(clock, 50.0)
    for k in range(101):
        with loop_timing.section("send"):
            clock.advance_ns(k * 1000)
        loop_timing.note_state_age(k * 1000)
    report = loop_timing.report()
    assert report.sections["send"] == Spread(50e-6, 99e-6, 100e-6)
    assert report.state_age == Spread(50e-6, 99e-6, 100e-6)


def test_report_survives_json(clock: VirtualClock) -> None:
    """What was never measured is null in JSON and NaN again after reading; the rest is equal."""
    loop_timing = LoopTiming(clock, 50.0)
    loop_timing.begin()
    report = loop_timing.report(
        states=4, losses=1, transport_errors=2, cycles_without_state=3, scheduling="SCHED_FIFO"
    )
    text = json.dumps(report.to_json(), allow_nan=False)
    again = LoopTimingReport.from_json(json.loads(text))
    assert again.to_json() == report.to_json()
    assert math.isnan(again.period.p50_s)
    assert (again.states, again.losses, again.transport_errors, again.cycles_without_state) == (4, 1, 2, 3)
    assert "SCHED_FIFO" in "\n".join(again.lines())


def test_a_rate_of_nothing_is_refused(clock: VirtualClock) -> None:
    """0 Hz and NaN are no rates."""
    for rate in (0.0, -50.0, math.nan):
        with pytest.raises(ConfigurationError, match="above 0 Hz"):
            LoopTiming(clock, rate)


def test_spread_of_nothing_is_nan() -> None:
    """No samples, no spread."""
    assert math.isnan(Spread.of(array("q")).p50_s)
