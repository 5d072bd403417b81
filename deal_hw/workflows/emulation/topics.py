"""``deal-hw emulate`` of a robot on a network: how it runs."""

from __future__ import annotations

import contextlib
import gc
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, TypeVar

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.unitree.emulator import DeviceOnTopics
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.robots import robot_entry
from deal_hw.robots.connect import make_topic_transport
from deal_hw.workflows.emulation.common import (
    announced_faults,
    happenings,
    next_line,
    realtime_priority,
    reveal,
    run_until,
)
from deal_hw.workflows.emulation.settings import EmulateOnTopicsSettings, EmulateSettings
from deal_hw.workflows.say import Say, silent

if TYPE_CHECKING:
    from deal_hw.drivers.unitree.emulated_truth import JointTruth

D = TypeVar("D", bound=DeviceOnTopics)
_ANY_PORT = re.compile(r"(?P<host>.*/\[?(?P<address>[^\]]*)\]?):0")


def emulate_on_topics(
    config: EmulateOnTopicsSettings,
    truth: JointTruth,
    make: Callable[[], D],
    stop: threading.Event,
    cut: threading.Event,
    *,
    announce: Say,
    say: Say,
    watch: Callable[[D], AbstractContextManager[Callable[[], None]]] | None = None,
) -> None:
    """Run an emulator until a stop or the given time.

    Args:
        config: What to emulate.
        truth: The robot's hidden parameters.
        make: Makes the device.
        stop: Ends it.
        cut: Cuts the wire.
        announce: Called with the port first, and with the truth at the end.
        say: Called with a summary at the end.
        watch: Yields a function that is called after each step; None for none.
    """
    entry = robot_entry(config.robot)
    own_wire = entry.wire(config.transport or entry.emulated_on[0])
    try:
        device: Any = make()
    except ModuleNotFoundError as error:
        if error.name == "mujoco":
            raise MissingExtraError(error.name, "sim") from error
        raise
    transport = own_wire.name
    port = free_port(config.port or own_wire.emulator_port)
    wire = make_topic_transport(transport, port, MonotonicClock(), config.wire.on(transport))
    emulator = entry.load(own_wire.emulator)(device, wire)
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
                announced_faults(config, transport, port, config.wire.on(transport)),
                happenings(config.events_to, log.requests, log.changes) as tell,
                (watch or _unwatched)(device) as seen,
            ):

                def step() -> bool:
                    if cut.is_set():
                        cut.clear()
                        device.begin_fault("cut")
                    emulator.step()
                    tell()
                    seen()
                    return True

                run_until(step, stop, config.duration_s, config.parent)
        finally:
            emulator.close()
    report = emulator.report()
    reveal(report, announce if config.reveal else silent, config.reveal_to)
    for line in summary(report):
        say(line)


def of_every_robot(config: EmulateSettings) -> dict[str, Any]:
    """Return the faults that every emulated robot has, as its plan names them."""
    names = ("drop", "duplicate", "corrupt", "freeze_after_s", "cut_after_s", "cut_s", "joints")
    return {name: getattr(config, name) for name in names}


@contextlib.contextmanager
def _unwatched(device: Any) -> Iterator[Callable[[], None]]:
    yield lambda: None


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
