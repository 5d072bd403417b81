"""What `deal-hw doctor` prints on healthy and on sick set-ups, as files: tests/cli/doctor_snapshots.

After a change that is meant, run this file's tests with DEAL_HW_WRITE_SNAPSHOTS=1.
"""

from __future__ import annotations

import os
import platform
import resource
import sys
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fakes.go2 import STIFF
from fakes.unitree_mujoco import UnitreeMujoco

from deal_hw.cli.main import main
from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth as nominal_cartpole
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import nominal_truth
from deal_hw.drivers.transports import interfaces, topics
from deal_hw.drivers.transports.dds_discovery import DdsEndpoint, DdsPeer, DdsSurvey
from deal_hw.drivers.transports.dds_types import COMPLETE, UINT8
from deal_hw.drivers.transports.interfaces import Interface
from deal_hw.drivers.transports.virtual_topics import TopicCore, VirtualTopics
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.robot import Robot
from deal_hw.testing.faults import FaultRates, FaultyTransport, FrameFaults
from deal_hw.transport import TopicTransport
from deal_hw.workflows.doctor import can, examine, machine

pytestmark = pytest.mark.real_time

FOLDER = Path(__file__).parent / "doctor_snapshots"
LO = Interface("lo", ("127.0.0.1",), up=True, carrier=True, multicast=False, loopback=True)
CABLE = Interface("enp2s0", ("192.168.123.99",), up=True, carrier=True, multicast=True, loopback=False)
NO_CABLE = Interface("enp2s0", ("192.168.123.99",), up=True, carrier=False, multicast=True, loopback=False)
LOW_STATE = topics.TYPES[topics.LOW_STATE]
Tamper = Callable[[str, bytes], Iterable[bytes]]


class Wire(VirtualTopics):
    """A wire with what others do on it, and DDS's discovery of them."""

    tamper: Tamper = staticmethod(lambda topic, payload: (payload,))
    foreign: str = ""

    def survey(self) -> DdsSurvey:
        """Return the robot, and a foreign program that declares octets as uint8."""
        peers = [
            DdsPeer(uuid.UUID(int=1), "Cyclone DDS", "ubuntu", "basic_service", 421, ("192.168.123.161",))
        ]
        ends = [
            DdsEndpoint(uuid.UUID(int=2), topics.LOW_STATE, LOW_STATE, COMPLETE[LOW_STATE], True, peers[0])
        ]
        complaints: list[str | None] = []
        if self.foreign:
            peers.append(
                DdsPeer(uuid.UUID(int=3), "Cyclone DDS", "desk", self.foreign, 77, ("192.168.123.7",))
            )
            command = topics.TYPES[topics.LOW_COMMAND]
            ends.append(
                DdsEndpoint(uuid.UUID(int=4), topics.LOW_COMMAND, command, UINT8[command], True, peers[1])
            )
            complaints = [end.complaint(topics.TYPES[end.topic]) for end in ends]
        return DdsSurvey(tuple(peers), tuple(ends), tuple(text for text in complaints if text))

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return the foreign program, which writes commands."""
        return (self.foreign,) if self.foreign and topic == topics.LOW_COMMAND else ()

    def _run_tick(self, tick_ns: int) -> None:
        for topic, payload in self.device.tick():
            for arrived in self.tamper(topic, payload):
                self._arrive(topic, arrived, tick_ns)
        if self.foreign:
            self._arrive(topics.LOW_COMMAND, STIFF, tick_ns)


class Hasty:
    """A core whose clock runs a tenth fast: eleven ticks in the time of ten."""

    def __init__(self, device: TopicCore) -> None:
        self._device, self._ticks = device, 0

    @property
    def device_ns(self) -> int:
        """Time at which the next tick runs [ns]."""
        return self._ticks * 1_000_000

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Pass a message on."""
        self._device.receive(topic, payload, stamp_ns)

    def tick(self) -> list[tuple[str, bytes]]:
        """Run a tick, and the eleventh with the tenth."""
        self._ticks += 1
        return [message for _ in range(1 + (self._ticks % 10 == 0)) for message in self._device.tick()]


def go2(
    core: Callable[[Go2Device], TopicCore] = lambda device: device, **changes: Any
) -> Callable[..., Wire]:
    """Return what makes the wire of a lying, ideal Go2 with a remote and without sport mode."""

    def make(clock: VirtualClock) -> Wire:
        wire = Wire(core(Go2Device(nominal_truth("ideal"), sport="", remote=())), clock)
        for name, value in changes.items():
            setattr(wire, name, value)
        return wire

    return make


def other_rule(topic: str, payload: bytes) -> list[bytes]:
    """Change the head of a state, as another firmware would make it."""
    return [payload[:4] + b"\xfe\xee" + payload[6:]] if topic == topics.LOW_STATE else [payload]


def cartpole(drop: float = 0.0) -> Callable[[VirtualClock], Robot]:
    """Return what makes a cart-pole on a cable that loses a share of the frames."""

    def make(clock: VirtualClock) -> Robot:
        faults = FrameFaults(FaultRates(drop=drop), np.random.default_rng(0))
        wire = FaultyTransport(
            VirtualTransport(CartpoleDevice(nominal_cartpole("ideal")), clock), faults, clock=clock
        )
        return CartpoleRobot(wire, clock)

    return make


@dataclass(frozen=True, kw_only=True)
class SetUp:
    """A computer, a robot and the command line that looks at both."""

    line: str
    code: int
    wire: Callable[[VirtualClock], TopicTransport] = field(default_factory=go2)
    robot: Callable[[VirtualClock], Robot] = field(default_factory=cartpole)
    network: tuple[Interface, ...] = (LO, CABLE)
    rights: bool = True


SET_UPS = {
    "healthy_go2": SetUp(line="doctor go2 --port enp2s0", code=0),
    "healthy_cartpole": SetUp(line="doctor cartpole --port /dev/ttyUSB0", code=0),
    "sick_other_firmware": SetUp(line="doctor go2 --port enp2s0", code=1, wire=go2(tamper=other_rule)),
    "sick_cable": SetUp(
        line="doctor go2 --port enp2s0",
        code=1,
        wire=go2(tamper=lambda topic, payload: ()),
        network=(LO, NO_CABLE),
    ),
    "sick_clock": SetUp(line="doctor go2 --port enp2s0", code=1, wire=go2(Hasty)),
    "sick_second_program": SetUp(line="doctor go2 --port enp2s0", code=1, wire=go2(foreign="python3")),
    "sick_simulator_unnamed": SetUp(
        line="doctor go2 --port lo",
        code=1,
        wire=lambda clock: VirtualTopics(UnitreeMujoco(np.array(DRIVER.rest_position)), clock),
    ),
    "sick_serial_cable": SetUp(
        line="doctor cartpole --port /dev/ttyUSB0", code=0, robot=cartpole(0.2), rights=False
    ),
}


@pytest.fixture
def computer(monkeypatch: pytest.MonkeyPatch) -> Callable[[SetUp], None]:
    """Return what turns this computer into another, with its robot in virtual time."""

    def become(set_up: SetUp) -> None:
        clock = VirtualClock()
        files = {
            "rmem_max": "4194304" if set_up.rights else "120000",
            "current_clocksource": "tsc",
        }
        for owner, name, value in (
            (platform, "python_version", lambda: "3.11.9"),
            (platform, "system", lambda: "Linux"),
            (platform, "release", lambda: "6.8.0"),
            (platform, "machine", lambda: "x86_64"),
            (os, "cpu_count", lambda: 8),
            (os, "getloadavg", lambda: (0.5, 0.5, 0.5)),
            (os, "sched_getaffinity", lambda _: set(range(8))),
            (machine, "_version", lambda name: "1.2.3"),
            (machine, "_gpu", lambda: ()),
            (machine, "_may_use_fifo", lambda: set_up.rights),
            (machine, "_user", lambda: "ada"),
            (machine, "_read", lambda path: files.get(path.rpartition("/")[2], "")),
            (os, "geteuid", lambda: 1000),
            (resource, "getrlimit", lambda which: (1 << 30, 0) if set_up.rights else (8 << 20, 0)),
            (time, "get_clock_info", lambda name: SimpleNamespace(resolution=1e-9)),
            (can, "list_adapters", lambda: iter(())),
            (interfaces, "list_interfaces", lambda: set_up.network),
            (examine, "MonotonicClock", lambda: clock),
            (examine, "make_topic_transport", lambda *arguments: set_up.wire(clock)),
            (examine, "make_robot", lambda *arguments: set_up.robot(clock)),
        ):
            monkeypatch.setattr(owner, name, value)
        monkeypatch.setattr(sys, "platform", "linux")
        monkeypatch.setenv("COLUMNS", "100")

    return become


@pytest.mark.parametrize("name", SET_UPS)
def test_what_the_doctor_prints(
    name: str, computer: Callable[[SetUp], None], capsys: pytest.CaptureFixture[str]
) -> None:
    """Each finding with its remedy, the worst of them at the end, and the exit code."""
    set_up = SET_UPS[name]
    computer(set_up)
    code = main(set_up.line.split())
    reported = capsys.readouterr()
    text = f"$ deal-hw {set_up.line}\n{reported.out}{reported.err}exit code {code}\n"
    file = FOLDER / f"{name}.txt"
    if os.environ.get("DEAL_HW_WRITE_SNAPSHOTS"):
        file.write_text(text, encoding="utf-8")
    assert text == file.read_text(encoding="utf-8")
    assert code == set_up.code


def test_every_snapshot_has_its_set_up() -> None:
    """None is left behind."""
    assert {file.stem for file in FOLDER.glob("*.txt")} == set(SET_UPS)
