"""What `deal-hw doctor` tells of a G1, on a fake robot in virtual time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fakes.g1 import FakeG1Bench

from deal_hw.drivers.g1.doctor import G1Doctor
from deal_hw.drivers.g1.joints import JOINTS_29
from deal_hw.drivers.transports import topics
from deal_hw.findings import Finding, Severity


def findings(wire: FakeG1Bench) -> list[Finding]:
    """Return what the doctor finds in one second; not one command is sent."""
    found = list(G1Doctor(wire.topics, wire.clock, 1.0).run())
    assert wire.device.received == [] and set(wire.device.asked) <= {1001}
    return found


def one(found: list[Finding], words: str) -> Finding:
    """Return the finding with these words."""
    (hit,) = [finding for finding in found if words in finding.seen]
    return hit


def test_a_sound_robot_on_its_crane() -> None:
    """Version, temperatures, rate, level; its own controller is active, and the crane comes first."""
    found = findings(FakeG1Bench())
    version = one(found, "mode_machine 5: 29 joints, revision 1.0; here it is robot `g1`")
    assert version.severity is Severity.OK
    assert one(found, "500 states a second").severity is Severity.OK
    assert one(found, "hottest casing 35 °C, hottest winding 50 °C").severity is Severity.OK
    (mode,) = [finding for finding in found if finding.code == "services"]
    assert mode.seen == "own controller 'ai' is active"
    assert mode.severity is Severity.NOTE and "crane first" in mode.do
    assert all(finding.severity is not Severity.FAIL for finding in found)


@pytest.mark.parametrize(
    ("machine", "severity", "words"),
    [
        (4, Severity.OK, "robot `g1_23dof`"),
        (6, Severity.FAIL, "waist locked"),
        (99, Severity.FAIL, "unknown"),
    ],
)
def test_each_version_is_named(machine: int, severity: Severity, words: str) -> None:
    """Of any version, the doctor says which robot it is here."""
    wire = FakeG1Bench()
    wire.device.machine = machine
    assert one(findings(wire), f"mode_machine {machine}").severity is severity
    assert words in one(findings(wire), f"mode_machine {machine}").seen


@pytest.mark.parametrize(
    ("changes", "words", "severity"),
    [
        ({"error": np.eye(29, dtype=np.int64)[3] * 0x20}, "left_knee_joint 0x20", Severity.FAIL),
        ({"winding": np.full(29, 101)}, "hottest winding 101", Severity.WARN),
        ({"casing": np.full(29, 71)}, "hottest casing 71", Severity.WARN),
        ({"orientation": np.array([0.8, 0.6, 0.0, 0.0])}, "leans by 74 degrees", Severity.WARN),
    ],
)
def test_what_is_wrong_has_a_remedy(changes: dict[str, Any], words: str, severity: Severity) -> None:
    """Errors of motors, heat, a robot that hangs askew."""
    wire = FakeG1Bench()
    wire.device.changes = changes
    finding = one(findings(wire), words)
    assert finding.severity is severity and finding.do
    assert JOINTS_29[3] == "left_knee_joint"


def test_a_go2_in_its_place_is_named() -> None:
    """States of 1180 bytes: no state of a G1, take robot go2."""
    wire = FakeG1Bench()
    wire.topics.tamper = lambda topic, payload: [payload[:1180]] if topic == topics.LOW_STATE else [payload]
    finding = one(findings(wire), "are no G1 states")
    assert finding.severity is Severity.FAIL and "`go2`" in finding.do


def test_another_commander_is_a_failure() -> None:
    """After the release nobody else may command the motors."""
    wire = FakeG1Bench()
    wire.device.mode = ""
    for k in range(50):
        wire.topics.say(topics.LOW_COMMAND, wire.device._own, 0.01 * k)
    found = list(G1Doctor(wire.topics, wire.clock, 1.0).run())
    assert one(found, "another program commands the motors").severity is Severity.FAIL
