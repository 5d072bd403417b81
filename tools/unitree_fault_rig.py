"""Common part of the fault tables of robots of Unitree: wires, the emulator's log, a second controller."""

from __future__ import annotations

import abc
import time
from collections.abc import Mapping
from typing import Any, ClassVar

from fault_rig import Rig

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.transports.topics import LOW_COMMAND
from deal_hw.drivers.unitree.command_log import DAMPING, OFF, STIFF
from deal_hw.robots.connect import make_topic_transport
from deal_hw.transport import Message, WireOptions

DOMAIN = 91
"""The first job's DDS domain, which no real robot uses."""
REQUEST = "motion_switcher"
"""The first entry of a run in the emulator's log."""


class UnitreeRig(Rig, abc.ABC):
    """An emulated robot of Unitree on DDS or Zenoh."""

    wires = ("zenoh", "dds")
    active = frozenset({STIFF})
    inactive = frozenset({DAMPING, OFF})
    types: ClassVar[Mapping[str, str]] = {}
    """Types of topics that have another type than the Go2's."""

    @abc.abstractmethod
    def stiff_command(self) -> bytes:
        """Return another program's command: a pose, with torque."""

    def emulator_options(self) -> list[str]:
        """Listen at a free port, or in a domain that no real robot uses."""
        where = ["--port", "tcp/127.0.0.1:0"]
        if self.wire == "dds":
            where = ["--port", "lo", "--domain", self.domain]
        return ["--transport", self.wire, *where, "--profile", "sensor", "--nominal"]

    @property
    def domain(self) -> str:
        """Its DDS domain."""
        return str(DOMAIN + self.slot)

    def wire_arguments(self) -> list[str]:
        """Return the arguments of a run for its wire."""
        return ["--transport", self.wire, *(["--domain", self.domain] if self.wire == "dds" else [])]

    def changes(self, report: Mapping[str, Any]) -> list[tuple[int, str]]:
        """Kinds of commands that the robot received."""
        return [(ns, kind) for _, ns, kind in report["commands"]["changes"]]

    def untouched(self, report: Mapping[str, Any]) -> str:
        """Neither commands nor requests to its services."""
        commands, requests = report["commands"]["accepted"], len(report["commands"]["requests"])
        if commands or requests or not report["sport"]:
            return f"{commands} commands, {requests} requests, own mode {report['sport'] or 'released'}"
        return ""

    def by_itself(self, report: Mapping[str, Any]) -> int:
        """The emulator's own faults."""
        faults = report["commands"]["faults"]
        return int(faults[0]["begin_host_ns"]) if faults else -1


def second_controller(rig: Rig) -> None:
    """Another program sends stiff commands, too."""
    assert isinstance(rig, UnitreeRig)
    options = WireOptions(domain=int(rig.domain)) if rig.wire == "dds" else WireOptions()
    transport = make_topic_transport(rig.wire, rig.port, MonotonicClock(), options)
    transport.name_types(rig.types)
    transport.declare(publish=[LOW_COMMAND])
    payload = rig.stiff_command()
    with transport:
        time.sleep(0.5)
        rig.fault()
        for _ in range(25):
            transport.send(Message(LOW_COMMAND, payload, MonotonicClock().now_ns()))
            time.sleep(0.01)
