"""The stall monitor: what it says of an interval, and that it watches."""

from __future__ import annotations

import os
import select
import subprocess
from typing import Any

import pytest
from fakes.waiting import PATIENCE_S
from measure_go2_transport import TransportBench, lines, summary
from stall_monitor import Account, Pause, watch_stalls

from deal_hw.errors import ConfigurationError

pytestmark = pytest.mark.real_time

MS = 1_000_000
POPEN = subprocess.Popen


def test_time_outside_pauses_is_counted() -> None:
    """0 to 20 ms, pauses 2-5 and 4-8 on two processors and 18-30: awake for 20 - 6 - 2 = 12 ms."""
    seen = Account([Pause(0, 18 * MS, 30 * MS), Pause(1, 4 * MS, 8 * MS), Pause(0, 2 * MS, 5 * MS)])
    assert seen.awake_ns(0, 20 * MS) == 12 * MS
    assert seen.awake_ns(9 * MS, 11 * MS) == 2 * MS
    assert seen.awake_ns(3 * MS, 4 * MS) == 0
    assert Account().awake_ns(5, 9) == 4


def test_the_longest_pause_that_touches_an_interval() -> None:
    """Touching counts with its whole length; what ended before does not count."""
    seen = Account([Pause(0, 0, 5 * MS), Pause(1, 6 * MS, 8 * MS)])
    assert (seen.longest_ns, seen.longest_between_ns(5 * MS, 7 * MS)) == (5 * MS, 2 * MS)
    assert seen.longest_between_ns(20 * MS, 30 * MS) == 0
    assert Account().longest_ns == 0


def test_a_late_cycle_that_the_machine_slept_through_is_not_held_against_the_wire() -> None:
    """10 ms late, 9.5 of them in a pause: half a millisecond counts, shown as 1 ms, the least."""
    spread = {"p50_s": 1e-4, "p99_s": 1e-3, "max_s": 0.01}
    part = {
        "cycle_delay": spread,
        "work": spread,
        "send": spread,
        "state_age": spread,
        "cycles_without_link": 0,
        "late": [100 * MS, 110 * MS],
    }
    stream = {"count": 1, "newest": 1, "disordered": 0, "stale": 0, "gaps": [], "age": spread}
    controller = {
        "loop_timing": {"period": spread, "lateness": spread, "skipped_periods": 0},
        "period_error": spread,
        "quiet": {**part, "late": []},
        "frozen": part,
        "sent": 1,
        "states": stream,
        "states_touched": [0, 0],
        "cpu_share": 0.1,
        "scheduling": "default",
        "warnings": [],
        "account": Account([Pause(0, 100 * MS, 109 * MS + MS // 2)]),
    }
    robot = {"sent": 1, "commands": stream, "cpu_share": 0.1, "scheduling": "default", "warnings": []}
    settings = TransportBench(seconds=10.0, freeze_at=1.0)
    row = summary(settings, controller, robot)
    assert row["frozen"]["awake_delay_s"] == pytest.approx(1e-3)
    assert "longest delay while the machine ran 1.00 ms: kept" in "\n".join(lines(row))
    row = summary(settings, {**controller, "account": Account()}, robot)
    assert row["frozen"]["awake_delay_s"] == pytest.approx(0.01)
    assert "10.00 ms: NOT kept" in "\n".join(lines(row))


def test_each_processor_is_watched_until_the_block_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """With no least length every wake-up is a pause: all processors are received, in order."""
    begun: list[subprocess.Popen[str]] = []

    def start(*arguments: Any, **options: Any) -> subprocess.Popen[str]:
        begun.append(POPEN(*arguments, **options))
        return begun[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    try:
        with watch_stalls(-1) as seen:
            for monitor in begun:
                assert monitor.stdout is not None
                assert select.select([monitor.stdout], [], [], PATIENCE_S)[0], "it reports no pause"
    except ConfigurationError:
        pytest.skip("SCHED_FIFO is refused here")
    assert {pause.processor for pause in seen.pauses} == os.sched_getaffinity(0)
    assert all(pause.until_ns >= pause.from_ns for pause in seen.pauses)
