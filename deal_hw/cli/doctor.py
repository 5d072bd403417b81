"""``deal-hw doctor``: what is wrong with this computer, the link and the robot, and what to do about it."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from deal_hw.cli.doctor_machine import examine_machine
from deal_hw.cli.options import Range, check_ranges
from deal_hw.clock import MonotonicClock
from deal_hw.drivers import TOPIC_TRANSPORTS, default_transport, make_topic_transport
from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.findings import Finding, Level
from deal_hw.transport import WireOptions

_MARKS = {Level.OK: "ok  ", Level.NOTE: "note", Level.WARN: "WARN", Level.FAIL: "FAIL"}


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Find out what is wrong with this computer, the link and the robot; sends no command to a motor.

    Without a robot only this computer is examined.
    """

    robot: tyro.conf.Positional[str] = ""
    """The robot to listen to, such as go2."""

    port: str = ""
    """Where it is: a network interface (dds) or an endpoint (zenoh)."""

    transport: str = ""
    """How it is reached; by default the robot's usual way."""

    seconds: Annotated[float, Range(0.5, 600, "s")] = 3.0
    """How long to listen to the robot [s]."""

    wire: tyro.conf.OmitArgPrefixes[WireOptions] = field(default_factory=WireOptions)
    """More about a network."""

    json: Path | None = None
    """Write the findings to this file."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if bool(self.robot) != bool(self.port):
            raise ConfigurationError(
                "name a robot and its port, such as `deal-hw doctor go2 --port enp2s0`, or neither"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorReport:
    """What was found.

    Attributes:
        findings: All findings, in the order of the examination.
    """

    findings: tuple[Finding, ...]

    @property
    def exit_code(self) -> int:
        """For the shell: 0, or 1 where something does not work."""
        return int(any(finding.level is Level.FAIL for finding in self.findings))


def doctor(config: Doctor) -> DoctorReport:
    """Examine and print as it goes.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: The robot has no checks of its own.
    """
    found: list[Finding] = []
    area = ""
    for finding in _examine(config):
        if finding.area != area:
            area = finding.area
            print(area)
        print(f"  {_MARKS[finding.level]}  {finding.message}", flush=True)
        if finding.remedy:
            print(f"        -> {finding.remedy}")
        found.append(finding)
    report = DoctorReport(findings=tuple(found))
    if config.json is not None:
        rows: list[dict[str, Any]] = [finding.to_json() for finding in found]
        config.json.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    worst = [level for level in (Level.FAIL, Level.WARN) if any(f.level is level for f in found)]
    print("all is well" if not worst else f"worst: {worst[0].value}", file=sys.stderr)
    return report


def _examine(config: Doctor) -> Iterator[Finding]:
    yield from examine_machine()
    yield from _interfaces(config.port)
    if not config.robot:
        return
    name = config.transport or default_transport(config.robot)
    if name not in TOPIC_TRANSPORTS:
        raise ConfigurationError(
            f"`doctor` can listen to robots on a network ({', '.join(TOPIC_TRANSPORTS)}), not over {name}; "
            "`deal-hw deploy --dry-run` checks the link to this one"
        )
    from deal_hw.drivers.go2.checkup import Checkup

    clock = MonotonicClock()
    try:
        link = make_topic_transport(name, config.port, clock, config.wire)
        yield from Checkup(link, clock, config.seconds).run()
    except DealHwError as error:
        yield Finding("link", Level.FAIL, str(error))


def _interfaces(port: str) -> Iterator[Finding]:
    from deal_hw.drivers.transports.interfaces import list_interfaces

    for interface in list_interfaces():
        level, remedy = Level.OK, ""
        if port in (interface.name, *interface.addresses) and not interface.carrier:
            level, remedy = Level.FAIL, "is the cable in, and is the robot switched on?"
        elif not interface.multicast and not interface.loopback and interface.up:
            level = Level.WARN
            remedy = f"DDS finds its peers by multicast: ip link set {interface.name} multicast on"
        yield Finding("interfaces", level, str(interface), remedy)
