"""``deal-hw bridge``: the program on the Go2's own computer, between its DDS and a network."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.claim import LocalClaim
from deal_hw.control.process.realtime import priority
from deal_hw.drivers.go2.bridge.bridge import COMMANDS, READABLE, Go2Bridge
from deal_hw.drivers.go2.bridge.config import BridgeConfig
from deal_hw.drivers.transports.dds_transport import DdsTransport
from deal_hw.drivers.transports.zenoh_access import access_settings
from deal_hw.drivers.transports.zenoh_session import check_security, parse_endpoints
from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
from deal_hw.errors import UnknownNameError
from deal_hw.priorities import FIFO_PRIORITY
from deal_hw.ranges import Checked, Range
from deal_hw.robots.connect import claim_name
from deal_hw.signals import reason, taken
from deal_hw.transport import WireOptions
from deal_hw.workflows.emulation.common import run_until
from deal_hw.workflows.emulation.topics import free_port
from deal_hw.workflows.options import given, refuse

ROBOTS = ("go2",)
LOOPBACK_PORT = 7447
SWITCH_S = 0.0005


@dataclass(frozen=True, kw_only=True)
class Bridge(Checked):
    """Carry a Go2's messages between its DDS and Zenoh, admit one controller, and damp the robot without one.

    Runs on the robot's own computer until Ctrl-C, or any other signal that ends a program. It damps the robot
    first.
    """

    robot: tyro.conf.Positional[str]
    """The robot: go2."""

    port: str
    """Network interface of the robot's DDS, by name or address, such as eth0."""

    listen: str = ""
    """End point for clients, such as tls/192.168.1.20:7447. By default only this computer can reach it:
    tls/127.0.0.1:7447, or tcp/127.0.0.1:7447 without certificates."""

    controllers: tuple[str, ...] = ("controller",)
    """Names in the certificates that may command the robot."""

    observers: tuple[str, ...] = ("observer",)
    """Names in the certificates that may only read."""

    ca: Path | None = None
    """The authority that signed the certificates (PEM); `deal-hw keys` makes all these files."""

    certificate: Path | None = None
    """The robot's certificate (PEM)."""

    key: Path | None = None
    """Its private key (PEM)."""

    insecure: bool = False
    """Allow plain TCP beyond this computer. Everybody who reaches the port may then command the robot."""

    domain: Annotated[int, Range(0, 232)] = 0
    """DDS domain."""

    state_check: Literal["strict", "length"] = "strict"
    """How to check the robot's state messages: strict (length, head and checksum), or length alone, for other
    firmware."""

    rules: tyro.conf.OmitArgPrefixes[BridgeConfig] = field(default_factory=BridgeConfig)
    """Which commands are admitted, and when the robot is damped."""

    duration_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Stop after this time [s]; without it, at Ctrl-C."""

    parent: Annotated[int | None, Range(1, 2**22)] = None
    """Stop when the process with this id is no longer the parent. For programs that start a bridge."""

    @property
    def end_point(self) -> str:
        """The end point at which clients connect."""
        return self.listen or f"{'tls' if self.certificate else 'tcp'}/127.0.0.1:{LOOPBACK_PORT}"


def bridge(config: Bridge) -> int:
    """Serve until a signal or the time given; return the exit status.

    The first line on standard output is ``port END-POINT``.

    Raises:
        UnknownNameError: There is no bridge for the robot.
        ConfigurationError: The end point and the certificates do not fit.
        TransportError: One of the networks cannot be joined, or another bridge runs there.
    """
    if config.robot not in ROBOTS:
        raise UnknownNameError("robot with a bridge", config.robot, ROBOTS)
    stop, signals = threading.Event(), list[int]()

    def signalled(number: int) -> None:
        signals.append(number)
        stop.set()

    with taken(signalled):
        port = free_port(config.end_point)
        clock = MonotonicClock()
        options = WireOptions(domain=config.domain)
        with LocalClaim(f"bridge of go2, {claim_name('dds', config.port, options)}"):
            made = Go2Bridge(
                DdsTransport(config.port, clock, options),
                _network(config, port),
                clock,
                config.rules,
                state_check=config.state_check,
                tell=_tell,
            )
            # Threads of the transports inherit the priority of the moment when they are opened.
            with priority(FIFO_PRIORITY, children=True, lock=True), _switching():
                if os.sched_getscheduler(0) != os.SCHED_FIFO:
                    _tell("warning: real-time priority was refused; damping may be late under load")
                made.open()
                try:
                    print(f"port {port}", flush=True)

                    def step() -> bool:
                        made.step()
                        return True

                    run_until(step, stop, config.duration_s, config.parent)
                finally:
                    made.close()
    if signals:
        _tell(f"the bridge ended: {reason(signals[0])}")
    for line in summary(made):
        print(line, file=sys.stderr)
    return 0


@contextlib.contextmanager
def _switching() -> Iterator[None]:
    """Let the interpreter switch threads sooner; by default one may keep the other waiting for 5 ms."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _network(config: Bridge, port: str) -> ZenohTransport:
    options = WireOptions(
        listen=True, insecure=config.insecure, ca=config.ca, certificate=config.certificate, key=config.key
    )
    settings: Mapping[str, Any] = {}
    endpoints = parse_endpoints(port)
    # Before the robot's side is opened, and the robot perhaps damped.
    check_security(endpoints, options)
    if any(end.protocol == "tls" for end in endpoints):
        settings = access_settings(config.controllers, config.observers, write=COMMANDS, read=READABLE)
    else:
        default = Bridge(robot=config.robot, port=config.port)
        named = given(config, default, ("controllers", "observers"))
        refuse(named, f"{port} has no TLS, so the bridge sees no certificates; listen on tls/")
    return ZenohTransport(port, MonotonicClock(), options, settings)


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def summary(made: Go2Bridge) -> list[str]:
    """Return a summary of the run as text."""
    judge = made.admission
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(judge.refused.items()))
    return [
        f"bridge: {made.counts['rt/lowstate']} states and {judge.admitted} commands passed, {made.unsent} "
        f"messages not sent; the latest check for silence was {made.latest_ns / 1e6:.1f} ms late; refused: "
        f"{kinds or 'none'}" + (f" (the last: {judge.last_refusal})" if kinds else "")
    ]
