"""The bench of the Go2's wire: its counting, its settings, and short runs of both processes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from fakes.waiting import PATIENCE_S, until
from go2_transport_sides import Arrivals, mark, read_mark
from hypothesis import given
from hypothesis import strategies as st
from measure_go2_transport import TransportBench, bench_transport, lines, main, summary

from deal_hw.drivers.transports.topics import LOW_COMMAND, LOW_STATE
from deal_hw.errors import ConfigurationError, TransportError
from deal_hw.transport import WireOptions

pytestmark = pytest.mark.real_time

SPREAD = {"p50_s": 0.001, "p99_s": 0.002, "max_s": 0.003}


@given(st.sampled_from([LOW_COMMAND, LOW_STATE]), st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1))
def test_a_mark_is_read_back_from_a_message_of_the_right_size(topic: str, number: int, sent_ns: int) -> None:
    """812 and 1180 bytes with the header of little-endian CDR, as the DDS transport wants them."""
    message = mark(topic, number, sent_ns)
    assert len(message) == {LOW_COMMAND: 812, LOW_STATE: 1180}[topic]
    assert message[:4] == b"\x00\x01\x00\x00"
    assert read_mark(topic, message) == (number, sent_ns)


def test_arrivals_count_gaps_disorder_and_age() -> None:
    """Of 1 to 7, numbers 2, 3 and 6 never come, 4 comes twice, 1 comes again late; hellos do not count."""
    arrivals = Arrivals()
    for number, age_ms in ((0, 0), (1, 1), (4, 2), (4, 2), (5, 150), (1, 3), (7, 1)):
        arrivals.note(number, 1_000_000_000, 1_000_000_000 + age_ms * 1_000_000)
    assert (arrivals.count, arrivals.newest, arrivals.disordered, arrivals.stale) == (4, 7, 2, 1)
    assert list(arrivals.gaps) == [2, 2, 6, 1]
    age = arrivals.to_json()["age"]
    assert (age["p50_s"], age["max_s"]) == (0.0015, 0.15)


def controller_values(frozen: bool) -> dict[str, object]:
    """Return what a controller with 1000 commands measured."""
    part = {
        "cycle_delay": SPREAD,
        "work": SPREAD,
        "send": SPREAD,
        "state_age": SPREAD,
        "cycles_without_link": 0,
    }
    return {
        "loop_timing": {"period": SPREAD, "lateness": SPREAD, "skipped_periods": 0},
        "period_error": SPREAD,
        "quiet": part,
        "frozen": part if frozen else None,
        "sent": 1000,
        "states": {
            "count": 990,
            "newest": 1000,
            "disordered": 0,
            "stale": 0,
            "gaps": [101, 10],
            "age": SPREAD,
        },
        "states_touched": [100, 250],
        "cpu_share": 0.1,
        "scheduling": "default",
        "warnings": ["w"],
    }


def robot_values() -> dict[str, object]:
    """Return what a robot measured that missed commands 90-109, 200-399 and 900."""
    gaps = [90, 20, 200, 200, 900, 1]
    commands = {"count": 779, "newest": 1000, "disordered": 0, "stale": 3, "gaps": gaps, "age": SPREAD}
    return {
        "loop_timing": {},
        "sent": 1000,
        "commands": commands,
        "cpu_share": 0.2,
        "scheduling": "default",
        "warnings": ["w"],
    }


def test_losses_around_a_freeze_are_counted_apart() -> None:
    """Frozen at cycle 100, settled at 400: 100-109 and 200-399 are its fault, 210 of 221."""
    settings = TransportBench(rate=100.0, seconds=10.0, freeze_at=1.0, freeze_s=1.0)
    row = summary(settings, controller_values(True), robot_values())
    assert row["commands"]["lost_around_freeze"] == 10 + 200
    assert row["commands"]["lost"] == 221 - 210
    assert row["states"]["lost_around_freeze"] == 10
    assert row["states"]["lost"] == 0
    text = "\n".join(lines(row))
    assert "longest delay 3.00 ms: NOT kept the limit of 2 ms" in text
    assert text.count("warning: w") == 1


def test_without_a_freeze_every_loss_counts() -> None:
    """221 of 1000 commands."""
    row = summary(TransportBench(seconds=10.0, rate=100.0), controller_values(False), robot_values())
    assert (row["commands"]["lost"], row["commands"]["lost_around_freeze"]) == (221, 0)
    assert row["commands"]["lost_percent"] == pytest.approx(22.1)
    assert row["frozen"] is None
    assert "frozen" not in "\n".join(lines(row))


@pytest.mark.parametrize(
    "values",
    [{"rate": 0.0}, {"seconds": -1.0}, {"freeze_at": 0.0}, {"freeze_at": 19.5}, {"rate": float("nan")}],
)
def test_settings_that_make_no_run_are_refused(values: dict[str, float]) -> None:
    """A freeze lies inside the run."""
    with pytest.raises(ConfigurationError, match="--"):
        TransportBench(**values)  # type: ignore[arg-type]


def test_a_run_over_zenoh_counts_every_message(tmp_path: Path) -> None:
    """Half a second at 200 Hz with a freeze in the middle; the machine stands beside the figures."""
    out = tmp_path / "zenoh.json"
    arguments = "--transport zenoh --seconds 0.8 --rate 200 --freeze-at 0.3 --freeze-s 0.1 --quiet".split()
    # Exit code 1: a busy machine wakes up later than the limit allows.
    assert main([*arguments, "--out", str(out)]) in {0, 1}
    values = json.loads(out.read_text())
    assert values["machine"]["processors"] > 0
    (row,) = values["rows"]
    commands = row["commands"]
    assert commands["sent"] == 160
    assert commands["arrived"] + commands["lost"] + commands["lost_around_freeze"] <= 160
    assert commands["arrived"] > 80
    assert row["states"]["arrived"] > 80
    assert row["commands"]["disordered"] == row["states"]["disordered"] == 0
    assert row["frozen"]["cycles"] + row["cycle_delay"]["max_s"] > 0


def test_a_run_over_dds_counts_every_message() -> None:
    """The same two processes on the other wire, in a domain of their own."""
    pytest.importorskip("cyclonedds")
    settings = TransportBench(
        transport="dds", seconds=0.5, rate=200.0, wire=WireOptions(domain=77), quiet=True
    )
    assert bench_transport(settings) == 0


def test_a_side_that_fails_is_quoted() -> None:
    """An end point beyond this machine is refused by the process that would listen there."""
    settings = TransportBench(transport="zenoh", port="tcp/192.0.2.1:7447", seconds=1.0, quiet=True)
    with pytest.raises(TransportError, match=r"the robot's process failed: .*--insecure"):
        bench_transport(settings)


def test_ctrl_c_leaves_no_process_behind() -> None:
    """The tool ends with the code of an interrupt, and so do both sides."""
    tool = Path(__file__).resolve().parents[2] / "tools/measure_go2_transport.py"
    command = [sys.executable, str(tool), *"--transport zenoh --seconds 60".split()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as bench:
        try:
            tool_process = psutil.Process(bench.pid)
            until(lambda: len(tool_process.children()) == 2, "both sides are started")
            children = tool_process.children()
            bench.send_signal(signal.SIGINT)
            _, errors = bench.communicate(timeout=PATIENCE_S)
        finally:
            bench.kill()
    assert bench.returncode == 130, errors
    # One that was just being started learns of it at the end of its imports.
    _, alive = psutil.wait_procs(children, timeout=PATIENCE_S)
    assert not alive
