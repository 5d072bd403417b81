"""``deal-hw emulate go2``: how it runs."""

from __future__ import annotations

import contextlib
import gc
import re
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.go2.emulator.faults import FaultPlan
from deal_hw.errors import ConfigurationError, MissingExtraError, shown
from deal_hw.motions.scores.velocity_error import Track
from deal_hw.reading import reading
from deal_hw.robots import robot_entry
from deal_hw.robots.connect import make_topic_transport
from deal_hw.workflows.emulation.common import (
    choose_truth,
    happenings,
    next_line,
    realtime_priority,
    reveal,
    run_until,
)
from deal_hw.workflows.emulation.settings import EmulateGo2Settings
from deal_hw.workflows.say import Say, silent

if TYPE_CHECKING:
    from deal_hw.drivers.go2.emulator.device import Go2Device
    from deal_hw.drivers.go2.emulator.truth import Go2Truth

TRACK_COLUMNS = ("time_s", "x", "y", "heading")
TRACK_NS = 10_000_000
_ANY_PORT = re.compile(r"(?P<host>.*/\[?(?P<address>[^\]]*)\]?):0")


def emulate_go2(
    config: EmulateGo2Settings, stop: threading.Event, cut: threading.Event, *, announce: Say, say: Say
) -> None:
    """Run the emulator until a stop or the given time.

    Args:
        config: What to emulate.
        stop: Ends it.
        cut: Cuts the wire.
        announce: Called with the port first, and with the truth at the end.
        say: Called with a summary at the end.
    """
    entry = robot_entry(config.robot)
    own_wire = entry.wire(config.transport or entry.emulated_on[0])
    try:
        Go2Emulator = entry.load(own_wire.emulator)
    except ModuleNotFoundError as error:
        if error.name == "mujoco":
            raise MissingExtraError(error.name, "sim") from error
        raise
    truth = _truth(config)
    device = _device(config, truth)
    transport = own_wire.name
    port = free_port(config.port or own_wire.emulator_port)
    wire = make_topic_transport(transport, port, MonotonicClock(), config.wire.on(transport))
    emulator = Go2Emulator(device, wire)
    gc.collect()
    gc.freeze()
    # Threads of the transport inherit the priority of the moment when it is opened.
    with realtime_priority():
        try:
            emulator.open()
            announce(f"port {port}")
            announce(f"profile {truth.profile}, seed {truth.seed}, on {transport}; Ctrl-C ends")
            announce(next_line(config, port))

            log = device.log
            with (
                happenings(config.events_to, log.requests, log.changes) as tell,
                tracking(config.go2.track_to, device, config.go2.tick_start_ms) as track,
            ):

                def step() -> bool:
                    if cut.is_set():
                        cut.clear()
                        device.begin_fault("cut")
                    emulator.step()
                    tell()
                    track()
                    return True

                run_until(step, stop, config.duration_s, config.parent)
        finally:
            emulator.close()
    report = emulator.report()
    reveal(report, announce if config.reveal else silent, config.reveal_to)
    for line in summary(report):
        say(line)


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


def summary(report: dict[str, Any]) -> list[str]:
    """Return a summary of the run as text."""
    commands = report["commands"]
    lines = [
        f"emulator: {report['device_ms'] / 1e3:.1f} s, {report['sent']['rt/lowstate']} states sent, "
        f"{report['late_ticks']} ticks late (worst {report['latest_ms']:.1f} ms), {report['slips']} stalls, "
        f"{report['unsent']} messages not sent",
        f"commands: {commands['accepted']} taken, {commands['refused']} refused"
        + (f" (the last: {commands['last_refusal']})" if commands["refused"] else "")
        + f", the last kind: {commands['last_kind'] or 'none'}; sport mode: {report['sport'] or 'released'}",
    ]
    for fault in commands["faults"]:
        damped = fault["first_damping_ms"]
        after = "no damping since" if damped is None else f"damping {damped - fault['begin_ms']} ms later"
        lines.append(f"fault {fault['name']} at {fault['begin_ms'] / 1e3:.3f} s: {after}")
    return lines


def free_port(port: str) -> str:
    """Return the port, its number 0 replaced by that of a free TCP port."""
    found = _ANY_PORT.fullmatch(port)
    if found is None:
        return port
    address = found["address"]
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
        try:
            probe.bind((address, 0))
        except OSError as error:
            raise ConfigurationError(f"port {port!r}: {error}") from error
        return f"{found['host']}:{probe.getsockname()[1]}"


def _truth(config: EmulateGo2Settings) -> Go2Truth:
    from deal_hw.drivers.go2.emulator.truth import DEFAULT_RANGE_RATIO, Go2Truth, draw_truth, nominal_truth

    return choose_truth(config, nominal_truth, draw_truth, Go2Truth.from_json, DEFAULT_RANGE_RATIO)


def _device(config: EmulateGo2Settings, truth: Go2Truth) -> Go2Device:
    from deal_hw.drivers.go2.emulator.device import Go2Device
    from deal_hw.drivers.go2.emulator.remote_script import read_remote_script

    own = config.go2
    plan = FaultPlan(
        drop=config.drop,
        duplicate=config.duplicate,
        corrupt=config.corrupt,
        freeze_after_s=config.freeze_after_s,
        cut_after_s=config.cut_after_s,
        cut_s=config.cut_s,
        **asdict(own.faults),
    )
    if own.no_remote and own.remote_script is not None:
        raise ConfigurationError("--no-remote and --remote-script exclude each other")
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
    )
