"""``deal-hw emulate go2``: how it runs."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.drivers.go2.emulator.faults import FaultPlan
from deal_hw.errors import ConfigurationError, shown
from deal_hw.motions.scores.velocity_error import Track
from deal_hw.reading import reading
from deal_hw.robots import robot_entry
from deal_hw.workflows.emulation.common import choose_truth
from deal_hw.workflows.emulation.settings import EmulateGo2Settings
from deal_hw.workflows.emulation.topics import emulate_on_topics, of_every_robot
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.drivers.go2.emulator.device import Go2Device
    from deal_hw.drivers.unitree.emulated_quadruped import QuadrupedTruth

TRACK_COLUMNS = ("time_s", "x", "y", "heading")
TRACK_NS = 10_000_000


def emulate_go2(
    config: EmulateGo2Settings, stop: threading.Event, cut: threading.Event, *, announce: Say, say: Say
) -> None:
    """Run the emulator until a stop or the given time; arguments as for :func:`emulate_on_topics`."""
    truth = _truth(config)

    def watch(device: Go2Device) -> AbstractContextManager[Callable[[], None]]:
        return tracking(config.go2.track_to, device, config.go2.tick_start_ms)

    emulate_on_topics(
        config, truth, lambda: _device(config, truth), stop, cut, announce=announce, say=say, watch=watch
    )


@contextlib.contextmanager
def tracking(path: Path | None, device: Go2Device, tick_start_ms: int) -> Iterator[Callable[[], None]]:
    """Yield a function that appends the base's position to a file, at a fixed rate.

    Args:
        path: The file; None for none.
        device: The robot.
        tick_start_ms: Its clock at device time 0 [ms].
    """
    if path is None:
        yield lambda: None
        return
    due_ns = device.device_ns
    with path.open("w", encoding="utf-8", buffering=1) as file:
        file.write(",".join(TRACK_COLUMNS) + "\n")

        def track() -> None:
            nonlocal due_ns
            if device.device_ns >= due_ns:
                due_ns = device.device_ns + TRACK_NS
                x, y, _ = device.base_position
                time_s = device.device_ns * 1e-9 + tick_start_ms * 1e-3
                file.write(f"{time_s:.3f},{x:.5f},{y:.5f},{device.heading:.5f}\n")

        yield track


def read_track(path: Path) -> Track:
    """Return the track that :func:`tracking` wrote, on the robot's clock.

    Raises:
        ConfigurationError: The file contains something else.
    """
    with reading(path, "an emulated base's track", "--track-to writes one", error=ConfigurationError):
        head, *lines = path.read_text(encoding="utf-8").splitlines()
        if head != ",".join(TRACK_COLUMNS):
            raise ConfigurationError(f"the first line is {shown(head)}, expected {','.join(TRACK_COLUMNS)}")
        # The emulator may still be writing the last line.
        rows = np.array([[float(part) for part in line.split(",")] for line in lines[:-1]])
        return Track(rows[:, 0], rows[:, 1:3], rows[:, 3])


def _truth(config: EmulateGo2Settings) -> QuadrupedTruth:
    from deal_hw.drivers.unitree.emulated_quadruped import DEFAULT_RANGE_RATIO

    entry = robot_entry(config.robot)
    kind: type[QuadrupedTruth] = entry.load(entry.truth)
    return choose_truth(config, kind.nominal, kind.draw, kind.from_json, DEFAULT_RANGE_RATIO)


def _device(config: EmulateGo2Settings, truth: QuadrupedTruth) -> Go2Device:
    from deal_hw.drivers.go2.emulator.device import Go2Device
    from deal_hw.drivers.go2.emulator.remote_script import read_remote_script
    from deal_hw.sim.legged.terrain import Terrain

    own = config.go2
    plan = FaultPlan(**of_every_robot(config), **asdict(own.faults))
    if own.no_remote and own.remote_script is not None:
        raise ConfigurationError("--no-remote and --remote-script exclude each other")
    if own.on_stand and own.terrain:
        raise ConfigurationError(
            "--on-stand and --terrain exclude each other: a robot on a stand has no floor"
        )
    script = () if own.remote_script is None else read_remote_script(own.remote_script)
    return Go2Device(
        truth,
        on_stand=own.on_stand,
        start=own.start,
        sport="" if own.sport == "off" else own.sport,
        sport_on_wire=not own.sport_silent,
        plan=plan,
        remote=None if own.no_remote else script,
        tick_ms=own.tick_start_ms,
        terrain=Terrain.parse(own.terrain),
    )
