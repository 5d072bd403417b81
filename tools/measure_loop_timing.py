"""Measure the timing of the control loop in one run against an emulated cart-pole; the report as JSON.

    python tools/measure_loop_timing.py --minutes 10 > loop_timing.json

The whole path is measured: supervisor, control process, recorder, serial line (a pty). With --port the robot
or emulator on that port is used instead of one of our own.

The stall monitor (stall_monitor.py) runs beside it: each overrun beyond a period is listed with the longest
pause of the machine at that time.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from stall_monitor import Account, watch_stalls

from deal_hw.bench.rows import describe_call
from deal_hw.cli.collect import Collect, collect
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.reader import Episode

RATE_HZ = 50.0


@dataclass(frozen=True, kw_only=True)
class MeasureLoopTiming:
    """Measure the timing of the control loop and print it as JSON."""

    minutes: float = 10.0
    """Length of the run [min]."""

    port: str | None = None
    """Port of the robot; by default an emulator is started."""

    profile: Literal["hold", "chirp", "balance"] = "hold"
    """Motion of the robot; balance includes the policy's network."""


_PAUSE_NS = 3_000_000


def _late_cycles(recording: Episode) -> list[tuple[int, int]]:
    """Return each cycle that started a period late or more as (due, started) on the host's clock [ns]."""
    cycles = recording.cycles
    skipped = np.diff(cycles.cycle) - 1
    late = []
    for index in np.flatnonzero(skipped) + 1:
        # The recorded deadline is that of the cycle that ran; skipped cycles were due before it.
        due_s = cycles.deadline_s[index] - skipped[index - 1] / RATE_HZ
        due_ns, start_ns = (
            recording.start_ns + round(float(t) * 1e9) for t in (due_s, cycles.start_s[index])
        )
        late.append((due_ns, start_ns))
    return late


def _judge(overruns: list[tuple[int, int]], seen: Account) -> list[dict[str, Any]]:
    """Return each overrun (due, started) [ns] with the longest pause of any processor during it."""
    return [
        {
            "late_ms": (started - due) * 1e-6,
            "machine_paused_ms": seen.longest_between_ns(due, started) * 1e-6,
        }
        for due, started in overruns
    ]


def measure(config: MeasureLoopTiming) -> dict[str, Any]:
    """Run and return the report, with a description of the machine."""
    load_before = os.getloadavg()
    with tempfile.TemporaryDirectory() as folder, watch_stalls(_PAUSE_NS) as seen, _port(config.port) as port:
        report = collect(
            Collect(
                robot="cartpole",
                port=port,
                dataset=Path(folder),
                motion=config.profile,
                seconds=config.minutes * 60.0,
                quiet=True,
            )
        )
        dataset = Dataset.open(Path(folder), notify=lambda text: None)
        info, recording = dataset.episodes[0], dataset.read(0)
    episode = report.episodes[0]
    return {
        "minutes": config.minutes,
        "outcome": episode.outcome.value,
        "reason": episode.reason,
        "loop_timing": episode.loop_timing.to_json() if episode.loop_timing is not None else None,
        "beyond_period": _judge(_late_cycles(recording), seen),
        "machine_pauses": len(seen.pauses),
        "machine_longest_pause_ms": seen.longest_ns * 1e-6,
        "states_recorded": info.states,
        "cycles_recorded": info.cycles,
        "warnings": list(episode.warnings),
        **describe_call(f"tools/{Path(__file__).name}"),
        "load_before": load_before,
    }


@contextlib.contextmanager
def _port(given: str | None) -> Iterator[str]:
    if given is not None:
        yield given
        return
    command = [sys.executable, "-m", "deal_hw", "emulate", "--nominal", "--profile", "sensor"]
    process = subprocess.Popen([*command, "--parent", str(os.getpid())], stdout=subprocess.PIPE, text=True)
    try:
        # A real device does not pause on a busy machine, so the emulator has a high priority.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(60))
        if process.stdout is None:
            raise RuntimeError("the emulator has no output")
        yield process.stdout.readline().split()[1]
    finally:
        process.terminate()
        process.communicate()


def main() -> None:
    """Measure and print."""
    print(json.dumps(measure(tyro.cli(MeasureLoopTiming)), indent=1))


if __name__ == "__main__":
    main()
