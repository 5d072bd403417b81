"""Measure the Go2's bridge: its added latency, and its time to damping after a fault.

Run it as ``python tools/measure_bridge.py --out FILE.json``. All processes run on this machine, so that their
monotonic clock is the same.

``latency``: a controller and a robot exchange 500 commands and states a second over TLS: through the
bridge (with DDS behind it), and without it on each of the two wires. ``cut``: robot and bridge run in a
network namespace, and its interface goes down in a command stream. The time from there to the first damping
at the robot counts, beside a stall monitor of the bridge's priority. ``restart``: the bridge is killed with
SIGKILL in a command stream and started again. ``refuse``: replayed commands and a second controller beside
the first.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import tyro
from bridge_client import BridgeClient
from bridge_rig import BridgeRig, bridge_process, make_keys, wire
from measuring import head, write_document
from side_process import SideProcess
from stall_monitor import watch_stalls

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.go2.bridge.config import BridgeConfig
from deal_hw.errors import DealHwError, TransportError
from deal_hw.priorities import FIFO_PRIORITY
from deal_hw.ranges import Checked, Range
from deal_hw.transport import WireOptions
from deal_hw.workflows.emulation.topics import free_port

SIDES: Final = Path(__file__).with_name("bridge_sides.py")
HOSTS: Final = "10.97.43.1", "10.97.43.2"
"""Addresses of the pair of interfaces: this side, and that in the namespace."""
_CLONE_NEWNET, _SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x40000000, 0x8913, 0x8914, 0x1
_PAUSE_NS: Final = 500_000
_START_S: Final = 30.0
ACTS: Final = ("latency", "cut", "restart", "refuse")


@dataclass(frozen=True, kw_only=True)
class MeasureBridge(Checked):
    """Measure the Go2's bridge on this machine."""

    acts: tuple[str, ...] = ACTS
    """Measurements: latency, cut (needs root), restart, refuse."""

    seconds: Annotated[float, Range(1, 3600, "s")] = 30.0
    """Length of each latency measurement [s]."""

    cuts: Annotated[int, Range(1, 1000)] = 20
    """Number of cuts of the link."""

    restarts: Annotated[int, Range(1, 100)] = 5
    """Number of kills of the bridge."""

    domain: Annotated[int, Range(0, 232)] = 77
    """DDS domain."""

    out: Path | None = None
    """Write the result to this JSON file."""


def main(arguments: list[str] | None = None) -> int:
    config = tyro.cli(MeasureBridge, description=__doc__, args=arguments)
    result: dict[str, Any] = {}
    try:
        for act in config.acts:
            with tempfile.TemporaryDirectory() as folder:
                result[act] = MEASURES[act](config, Path(folder))
            print(f"{act:<9} {json.dumps(result[act])}", flush=True)
    except DealHwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    write_document(config.out, {**head(__file__), **result})
    return 0


# Latency.


def latency(config: MeasureBridge, folder: Path) -> dict[str, Any]:
    """Return the spread of one-way times for the bridge and for each wire alone."""
    make_keys(folder / "keys", "127.0.0.1")
    rows = {}
    for path in ("bridge", "zenoh", "dds"):
        rows[path] = _latency(path, config, folder / "keys")
    for way in ("commands", "states"):
        through, alone = rows["bridge"][way], rows["zenoh"][way]
        rows[f"added_to_{way}"] = {k: round(through[k] - alone[k], 4) for k in ("p50_ms", "p99_ms")}
    return rows


def _latency(path: str, config: MeasureBridge, keys: Path) -> dict[str, Any]:
    end_point = free_port("tls/127.0.0.1:0")
    with contextlib.ExitStack() as running:
        robot_wire = "dds" if path in ("bridge", "dds") else "zenoh"
        robot = running.enter_context(_side("robot", robot_wire, end_point, config, keys))
        if path == "bridge":
            running.enter_context(bridge_process(keys, config.domain, end_point))
        client_wire = "dds" if path == "dds" else "zenoh"
        controller = running.enter_context(_side("controller", client_wire, end_point, config, keys))
        near = controller.result(config.seconds + 60.0)
        robot.stop()
        far = robot.result(20.0)
    return {
        "commands": _one_way(near["sent"], far["heard"]),
        "states": _one_way(far["sent"], near["heard"]),
        "scheduling": near["scheduling"],
    }


@contextlib.contextmanager
def _side(name: str, link: str, end_point: str, config: MeasureBridge, keys: Path) -> Iterator[SideProcess]:
    options = WireOptions(domain=config.domain)
    if link == "zenoh":
        own = wire(keys, name)
        options = WireOptions(listen=name == "robot", ca=own.ca, certificate=own.certificate, key=own.key)
    orders = {
        "transport": link,
        "port": end_point if link == "zenoh" else "lo",
        "wire": options.to_json(),
        "seconds": config.seconds,
        "parent_pid": os.getpid(),
    }
    with SideProcess(SIDES, name, orders) as process:
        process.expect("ready", _START_S)
        yield process


def _one_way(sent: Mapping[str, int], received: Mapping[str, int]) -> dict[str, Any]:
    """Return statistics of the times from sending to arrival, and the number of lost messages."""
    ages_ms = np.array([received[number] - sent[number] for number in received if number in sent]) * 1e-6
    first, last = min(map(int, received)), max(map(int, received))
    lost = sum(1 for number in sent if first <= int(number) <= last and number not in received)
    p50, p99 = np.percentile(ages_ms, (50, 99))
    return {
        "p50_ms": round(float(p50), 4),
        "p99_ms": round(float(p99), 4),
        "max_ms": round(float(ages_ms.max()), 4),
        "messages": len(ages_ms),
        "lost": lost,
    }


# Faults.


def cut(config: MeasureBridge, folder: Path) -> dict[str, Any]:
    """Return the times to damping after the interface of the bridge's computer goes down."""
    name = f"go2-{os.getpid()}"
    times: list[tuple[int, int]] = []
    with (
        watch_stalls(_PAUSE_NS, priority=FIFO_PRIORITY) as seen,
        _namespace(name) as (prefix, switch),
        BridgeRig(folder, config.domain, address=HOSTS[1], prefix=prefix) as rig,
    ):
        for _ in range(config.cuts):
            with BridgeClient(rig.port, rig.options("controller")) as client:
                client.take_over()
                reported = rig.commands()
                cut_ns = MonotonicClock().now_ns()
                switch(False)
                rig.await_commands([*reported, "damping"])
                times.append((cut_ns, rig.reported()[-1][0]))
                switch(True)
        _, printed = rig.bridge.stop()
    delays = sorted((damped - cut) * 1e-6 for cut, damped in times)
    return {
        "how": "interface of a network namespace set down (SIOCSIFFLAGS)",
        "limit_ms": 1e3 * BridgeConfig().command_age_s,
        **_spread(delays),
        "longest_five_ms": [round(delay, 2) for delay in delays[-5:]],
        "longest_without_the_machines_pauses_ms": round(
            max(seen.awake_ns(*each) for each in times) * 1e-6, 2
        ),
        "bridge_said": printed.splitlines()[-1][:300],
    }


@contextlib.contextmanager
def _namespace(name: str) -> Iterator[tuple[list[str], Callable[[bool], None]]]:
    """Yield a prefix that runs a command in a new network namespace, and a switch of its interface."""
    near, far = f"v{os.getpid()}a", f"v{os.getpid()}b"

    def ip(*words: str) -> None:
        subprocess.run(["ip", *words], check=True, capture_output=True)

    ip("netns", "add", name)
    try:
        ip("link", "add", near, "type", "veth", "peer", "name", far)
        ip("link", "set", far, "netns", name)
        ip("address", "add", f"{HOSTS[0]}/30", "dev", near)
        ip("-n", name, "address", "add", f"{HOSTS[1]}/30", "dev", far)
        ip("link", "set", near, "up")
        ip("-n", name, "link", "set", "lo", "up")
        ip("-n", name, "link", "set", far, "up")
        with _socket_inside(name) as inside:
            yield ["ip", "netns", "exec", name], lambda up: _set_up(inside, far, up)
    finally:
        with contextlib.suppress(subprocess.CalledProcessError):
            ip("link", "delete", near)
        ip("netns", "delete", name)


@contextlib.contextmanager
def _socket_inside(name: str) -> Iterator[socket.socket]:
    """Yield a socket that belongs to a namespace, to ask for changes of its interfaces without a delay."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open("/proc/thread-self/ns/net") as here, open(f"/run/netns/{name}") as there:
        if libc.setns(there.fileno(), _CLONE_NEWNET) != 0:
            raise TransportError(f"the namespace cannot be entered: {os.strerror(ctypes.get_errno())}")
        try:
            inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        finally:
            libc.setns(here.fileno(), _CLONE_NEWNET)
    with inside:
        yield inside


def _set_up(inside: socket.socket, interface: str, up: bool) -> None:
    request = struct.pack("16sH22x", interface.encode(), 0)
    (flags,) = struct.unpack_from("H", fcntl.ioctl(inside, _SIOCGIFFLAGS, request), 16)
    flags = flags | _IFF_UP if up else flags & ~_IFF_UP
    fcntl.ioctl(inside, _SIOCSIFFLAGS, struct.pack("16sH22x", interface.encode(), flags))


def restart(config: MeasureBridge, folder: Path) -> dict[str, Any]:
    """Return the times to damping after a killed bridge is restarted, and the commands that it admitted."""
    delays: list[float] = []
    refused = admitted = 0
    with BridgeRig(folder, config.domain) as rig:
        for _ in range(config.restarts):
            with BridgeClient(rig.port, rig.options("controller")) as client:
                client.take_over()
                reported = rig.commands()
                rig.kill_bridge()
                client.status = {}
                begun_ns = MonotonicClock().now_ns()
                rig.start_bridge()
                rig.await_commands([*reported, "damping"])
                delays.append((rig.reported()[-1][0] - begun_ns) * 1e-6)
                client.hear(lambda: client.status.get("refused", {}).get("handover", 0) > 100)
                refused += client.status["refused"]["handover"]
                admitted += client.status["admitted"]
                rig.await_commands([*reported, "damping"])
    return {
        "from": "start of the new process to the first damping at the robot",
        **_spread(delays),
        "old_stream_refused": refused,
        "old_stream_admitted": admitted,
    }


def refuse(config: MeasureBridge, folder: Path) -> dict[str, Any]:
    """Return the refusals while a controller runs undisturbed."""
    with BridgeRig(folder, config.domain) as rig:
        options = rig.options("controller")
        # Opened before the first one commands, because a handshake would delay the threads of this process.
        with BridgeClient(rig.port, options) as client, BridgeClient(rig.port, options) as second:
            client.take_over()
            reported = rig.commands()

            def refused(*kinds: str) -> int:
                return sum(client.status["refused"].get(kind, 0) for kind in kinds)

            second.hear(lambda: second.frame is not None)
            second.repeat(second.damping(), lambda: second.states > 500)
            client.hear(lambda: refused("holder") > 500)
            second.repeat(b"", lambda: True)
            command, old = client.pose(), client.echoes.next()

            def replay() -> bool:
                client.send(command, old)
                return refused("sequence", "age") > 200

            client.hear(replay)
            undisturbed = client.in_charge and rig.commands() == reported
            return {"refused": client.status["refused"], "controller_undisturbed": undisturbed}


def _spread(delays_ms: list[float]) -> dict[str, Any]:
    values = np.array(delays_ms)
    return {
        "times": len(values),
        "least_ms": round(float(values.min()), 2),
        "median_ms": round(float(np.median(values)), 2),
        "longest_ms": round(float(values.max()), 2),
    }


MEASURES: Final = {"latency": latency, "cut": cut, "restart": restart, "refuse": refuse}


if __name__ == "__main__":
    sys.exit(main())
