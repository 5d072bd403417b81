#!/usr/bin/env python3
"""Measure a long walk of the emulated Go2 in real time: trips, timing of the loop, memory, the recording.

    python tools/measure_go2_long_walk.py --seconds 600 --transport zenoh --out go2_long_walk.json

The emulator runs in a process of its own, and `deal-hw deploy go2` in its usual three: supervisor, control
and recorder. The requested velocity is that of tools/measure_go2_walk.py, repeated: 2 s standing, then 1 m/s
ahead, 0.5 m/s to the left and a turn of 1 rad/s, 5 s each. The velocity error is by leg odometry and IMU.
Memory is the resident set of each process, every 5 s. The supervisor reads the recording after the walk.
"""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil
from measuring import head, parser, write_document

from deal_hw.data.recording.repair import verify
from deal_hw.drivers.go2.emulator.truth import PROFILES
from deal_hw.workflows.deploy import deploy
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.walk_script import PROFILE, PROFILE_S, Script, write_script
from deal_hw.workflows.running.settings import LegOptions, LinkOptions
from deal_hw.workflows.say import to_stderr

MIB = 2**20
EVERY_S = 5.0
PARTS = ("control_process", "recorder_process")
"""Modules of the run's other processes, for the names of their memory."""


def repeated(seconds: float) -> Script:
    """Return the profile, repeated to a length [s]."""
    rounds = int(-(-seconds // PROFILE_S))
    return tuple((k * PROFILE_S + begin, velocity) for k in range(rounds) for begin, velocity in PROFILE)


class Memory(threading.Thread):
    """Takes the resident set of this process and its children until :meth:`stop`."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._over = threading.Event()
        self.mib: dict[str, list[float]] = {}

    def run(self) -> None:
        """Take values until :meth:`stop`."""
        while not self._over.wait(EVERY_S):
            me = psutil.Process()
            for process in (me, *me.children(recursive=True)):
                try:
                    words, size = " ".join(process.cmdline()), process.memory_info().rss / MIB
                except psutil.Error:
                    continue
                name = next((part for part in PARTS if part in words), "")
                if name or process == me:
                    self.mib.setdefault(name or "supervisor", []).append(round(size, 1))

    def stop(self) -> dict[str, list[float]]:
        """Return the values of each process [MiB]."""
        self._over.set()
        self.join()
        return self.mib


def walked_part(values: Sequence[float], seconds: float) -> list[float]:
    """Return first, middle and last of the memory values during a walk, after its first 10 s [MiB]."""
    part = values[round(10 / EVERY_S) : round(seconds / EVERY_S)] or list(values)
    return [part[0], part[len(part) // 2], part[-1]]


def measure(transport: str, profile: str, seed: int, seconds: float) -> dict[str, Any]:
    """Walk once.

    Args:
        transport: dds or zenoh.
        profile: The emulator's profile.
        seed: Seed of its hidden parameters.
        seconds: Length of the walk [s].
    """
    options = ("--transport", transport, "--profile", profile, "--seed", str(seed))
    with tempfile.TemporaryDirectory() as name, EmulatorProcess("go2", *options) as emulator:
        folder = Path(name)
        script = write_script(folder / "velocity.csv", repeated(seconds))
        memory = Memory()
        memory.start()
        (episode,) = deploy(
            "go2",
            port=emulator.port,
            link=LinkOptions(transport=transport),
            legs=LegOptions(velocity=str(script)),
            seconds=seconds,
            out=folder,
            say=to_stderr,
        ).episodes
        sizes = memory.stop()
        if episode.path is None:
            raise SystemExit("the walk has no recording")
        size, sound = episode.path.stat().st_size, verify(episode.path).sound
    timing = episode.loop_timing
    return {
        "transport": transport,
        "profile": profile,
        "seed": seed,
        "seconds": seconds,
        "outcome": episode.outcome.value,
        "reason": episode.reason,
        "loop_timing": timing.to_json() if timing is not None else None,
        "clipped": episode.clipped,
        "velocity_error_m_s": None if episode.walk is None else episode.walk.velocity_m_s,
        "yaw_error_rad_s": None if episode.walk is None else episode.walk.yaw_rad_s,
        "memory_mib": {name: walked_part(values, seconds) for name, values in sizes.items()},
        "memory_at_the_end_mib": max(sizes["supervisor"]),
        "recording_mib": round(size / MIB, 1),
        "recording_sound": sound,
        "warnings": list(episode.warnings),
    }


def main() -> None:
    """Walk as the command line says; print the row."""
    options = parser(__doc__)
    options.add_argument("--transport", choices=("dds", "zenoh"), default="zenoh")
    options.add_argument("--profile", choices=sorted(PROFILES), default="realistic")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--seconds", type=float, default=600.0)
    args = options.parse_args()
    row = measure(args.transport, args.profile, args.seed, args.seconds)
    print(json.dumps(row, indent=1))
    write_document(args.out, {**head(__file__), "rows": [row]})


if __name__ == "__main__":
    main()
