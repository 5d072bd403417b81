"""`deal-hw doctor` on CAN: adapters, a silent bus, foreign nodes, a wrong number."""

from __future__ import annotations

import itertools
import json
import subprocess

import can
import pytest

from deal_hw.cli.doctor import KINDS as DOCTOR
from deal_hw.cli.doctor import doctor
from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.drivers.cartpole.emulator.can_emulator import can_devices
from deal_hw.drivers.cartpole.emulator.faults import CanFaults
from deal_hw.drivers.cartpole.emulator.slcan_adapter import SlcanAdapter
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.transports.can_transport import open_can
from deal_hw.drivers.transports.slcan_transport import SlcanTransport
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.findings import Severity
from deal_hw.workflows.doctor import can as doctor_can
from deal_hw.workflows.doctor.can import listen_to_bus
from deal_hw.workflows.emulation.process import EmulatorProcess

pytestmark = pytest.mark.real_time

CHANNELS = (f"doctor{number}" for number in itertools.count())


def test_a_silent_bus_is_told_with_what_to_check() -> None:
    """Nobody sends: power, bit rate, wires, termination."""
    (finding,) = listen_to_bus(open_can(f"virtual:{next(CHANNELS)}"), MonotonicClock(), 0.01, 1)
    assert finding.severity is Severity.WARN
    assert "no frame" in finding.seen
    assert "120 ohm" in finding.do


def test_foreign_nodes_and_a_wrong_number_are_told() -> None:
    """Node 3 sends, node 1 does not."""
    channel = next(CHANNELS)
    transport = open_can(f"virtual:{channel}")
    transport.open()
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as far:
        for _ in range(5):
            far.send(can.Message(arbitration_id=3 << 5, is_extended_id=False, data=b"12345678"))
        findings = {f.seen: f for f in listen_to_bus(transport, MonotonicClock(), 0.05, 1)}
    # 5 frames of 111 bits in 50 ms are 11 100 bit/s, 2 % of 500 kbit/s.
    assert f"virtual:{channel}: 100 frames a second at 500000 bit/s, at least 2% of 500000 bit/s" in findings
    assert "other nodes on the bus: 3 (100 frames a second)" in findings
    missing = findings["no frame from node 1; received: 3"]
    assert missing.do.endswith(f"virtual:{channel}?node=NUMBER")


def test_a_bus_that_nobody_acknowledges_is_told() -> None:
    """An adapter at the wrong bit rate hears nothing and is driven off the bus by what it sends."""
    clock = VirtualClock()
    faults = CanFaults(bitrate=1_000_000)
    port = VirtualTransport(SlcanAdapter(can_devices(nominal_truth("ideal"), faults), faults), clock)
    (finding,) = listen_to_bus(SlcanTransport("slcan:x", clock, serial=port), clock, 0.5, 1)
    assert finding.severity is Severity.WARN
    assert "at 500000 bit/s" in finding.seen


@pytest.mark.parametrize(
    ("details", "level", "words"),
    [
        ({"state": "STOPPED"}, Severity.WARN, "up type can bitrate"),
        ({"state": "BUS-OFF", "restart_ms": 0}, Severity.WARN, "termination"),
        ({"state": "ERROR-ACTIVE", "restart_ms": 0}, Severity.NOTE, "restart-ms 100"),
        ({"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 500000}}, Severity.OK, ""),
        ({}, Severity.OK, ""),
    ],
)
def test_links_are_judged_by_what_ip_tells(
    monkeypatch: pytest.MonkeyPatch, details: dict[str, object], level: Severity, words: str
) -> None:
    """State, bit rate and whether it comes back after bus-off."""
    links = [{"ifname": "can0", "linkinfo": {"info_data": details}}]
    done = subprocess.CompletedProcess([], 0, stdout=json.dumps(links))
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: done)
    monkeypatch.setattr(doctor_can, "can_links", lambda: ["can0"])
    monkeypatch.setattr("shutil.which", lambda name: "/sbin/ip")
    finding = next(iter(doctor_can.list_adapters()))
    assert finding.severity is level
    assert words in finding.do
    assert ("500000 bit/s" in finding.seen) == ("bittiming" in details)


@pytest.mark.parametrize("printed", ["", "not JSON", "[1]", '{"a": 1}'])
def test_whatever_ip_says_is_survived(monkeypatch: pytest.MonkeyPatch, printed: str) -> None:
    """Another version of it, or none."""
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: subprocess.CompletedProcess([], 0, stdout=printed))
    monkeypatch.setattr(doctor_can, "can_links", lambda: ["can0"])
    assert next(iter(doctor_can.list_adapters())).severity is Severity.OK


def test_the_emulated_cart_pole_on_can_is_well() -> None:
    """Bus, robot, states and link, as a user runs it."""
    with EmulatorProcess("cartpole", "--transport", "can", "--profile", "ideal", "--nominal") as emulator:
        report = doctor(DOCTOR.settings(robot="cartpole", transport="can", port=emulator.port, seconds=0.5))
    reported = {f.code: f for f in report.findings if f.code in ("can", "link", "states")}
    assert set(reported) == {"can", "link", "states"}
    assert all(f.severity is Severity.OK for f in reported.values())
    assert "frames a second at 500000 bit/s" in reported["can"].seen
