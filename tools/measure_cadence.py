"""Measure the control cadence: one run of N minutes against an emulated cart-pole, the report as JSON.

    python tools/measure_cadence.py --minutes 10 > cadence.json

The whole path is measured: supervisor, control process, recorder, serial line (a pty). With --port the robot
or emulator on that port is used instead of one of our own.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from deal_hw.cli.collect import Collect, collect
from deal_hw.data.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class MeasureCadence:
    """Measure the control cadence and print it as JSON."""

    minutes: float = 10.0
    """Length of the run [min]."""

    port: str | None = None
    """Where the robot is; by default an emulator is started."""

    profile: Literal["hold", "chirp", "balance"] = "hold"
    """What the robot does meanwhile; balance includes the policy's network."""


def measure(config: MeasureCadence) -> dict[str, Any]:
    """Run and return the report with the machine it was measured on."""
    load_before = os.getloadavg()
    with tempfile.TemporaryDirectory() as folder, _port(config.port) as port:
        report = collect(
            Collect(
                robot="cartpole", port=port, dataset=Path(folder), profile=config.profile,
                seconds=config.minutes * 60.0, quiet=True,
            )
        )  # fmt: skip
        info = Dataset.open(Path(folder), notify=lambda text: None).episodes[0]
    episode = report.episodes[0]
    return {
        "minutes": config.minutes,
        "outcome": episode.outcome.value,
        "reason": episode.reason,
        "cadence": episode.cadence.to_json() if episode.cadence is not None else None,
        "states_recorded": info.states,
        "cycles_recorded": info.cycles,
        "warnings": list(episode.warnings),
        "machine": {
            "processors": os.cpu_count(),
            "kernel": platform.release(),
            "python": platform.python_version(),
            "load_before": load_before,
            "load_after": os.getloadavg(),
        },
    }


@contextlib.contextmanager
def _port(given: str | None) -> Iterator[str]:
    if given is not None:
        yield given
        return
    command = [sys.executable, "-m", "deal_hw.cli.emulate", "--nominal", "--profile", "sensor"]
    process = subprocess.Popen([*command, "--parent", str(os.getpid())], stdout=subprocess.PIPE, text=True)
    try:
        # A device does not stand still because the machine is busy; an emulator should not either.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(60))
        if process.stdout is None:
            raise RuntimeError("the emulator has no output")
        yield process.stdout.readline().split()[1]
    finally:
        process.terminate()
        process.communicate()


if __name__ == "__main__":
    print(json.dumps(measure(tyro.cli(MeasureCadence)), indent=1))
