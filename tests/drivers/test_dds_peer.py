"""Our DDS meets a true Cyclone DDS 0.10.2, the version the robot runs: nobody crashes, nothing is garbled."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.go2 import FakeGo2

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.transports.dds_transport import DdsTransport
from deal_hw.drivers.transports.dds_types import COMPLETE, MINIMAL
from deal_hw.drivers.transports.topics import LOW_COMMAND, LOW_STATE, TYPES
from deal_hw.transport import Message, WireOptions

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="pip install 'deal-hw[dds]'"),
]

MESSAGES = 300


class Running:
    """A running peer; after the block, what it printed."""

    def __init__(self) -> None:
        self.report: dict[str, Any] = {}
        self.warnings = ""
        self.returncode: int | None = None


@contextmanager
def running(peer: Path, *arguments: object) -> Iterator[Running]:
    """Run the peer during a block, then end it by SIGTERM and read its report."""
    process = subprocess.Popen(
        [peer, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    reported = Running()
    try:
        yield reported
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        printed, reported.warnings = process.communicate(timeout=20)
        reported.returncode = process.returncode
        if printed:
            reported.report = json.loads(printed)


def test_idlc_0102_gives_our_type_hashes(dds_peer: Path) -> None:
    """Types written in IDL and hashed by the robot's version of Cyclone are those we declare in Python."""
    reported = subprocess.run([dds_peer, "hashes"], capture_output=True, text=True, check=True).stdout
    assert [line.split() for line in reported.splitlines()] == [
        [name, MINIMAL[name], COMPLETE[name]] for name in MINIMAL
    ]


def test_a_0102_robot_and_we_exchange_commands_and_states(dds_peer: Path, dds_domain: int) -> None:
    """It takes our commands with a right CRC, and its states decode; it sees no warning and ends well."""
    wire = DdsTransport("lo", MonotonicClock(), WireOptions(domain=dds_domain))
    wire.declare(publish=[LOW_COMMAND], subscribe=[LOW_STATE])
    encoder, values = LowCommandEncoder(), np.linspace(-1.0, 1.0, 12)
    ticks: list[int] = []
    with wire, running(dds_peer, "robot", dds_domain, 60) as robot:
        while len(ticks) < MESSAGES:
            state = decode_low_state(wire.receive(10.0).payload)
            ticks.append(state.tick_ms)
            command = LowCommand(values, values, np.full(12, 60.0), np.full(12, 5.0), values)
            wire.send(Message(LOW_COMMAND, encoder.encode(command), 0))
        (writer,) = wire.writers(LOW_STATE)
        survey = wire.survey()
    assert robot.returncode == 0
    assert robot.warnings == ""
    assert robot.report["version"] == "0.10.2"
    assert robot.report["received"] > MESSAGES // 10
    assert (robot.report["bad_crc"], robot.report["bad_head"]) == (0, 0)
    assert ticks == sorted(set(ticks))
    assert "Cyclone DDS" in writer
    assert "go2_peer" in writer
    assert {end.type_hash for end in survey.endpoints if end.topic in TYPES} == {
        COMPLETE[TYPES[LOW_COMMAND]],
        COMPLETE[TYPES[LOW_STATE]],
    }
    assert survey.complaints == ()


def test_a_0102_user_and_we_as_robot_exchange_commands_and_states(dds_peer: Path, dds_domain: int) -> None:
    """The other way round, as our emulator serves a client of the vendor's SDK."""
    wire = DdsTransport("127.0.0.1", MonotonicClock(), WireOptions(domain=dds_domain))
    wire.declare(publish=[LOW_STATE], subscribe=[LOW_COMMAND])
    fake, received = FakeGo2(), 0
    with wire, running(dds_peer, "user", dds_domain, 60) as user:
        while received < MESSAGES:
            command = decode_low_command(wire.receive(10.0).payload)
            assert command.stiffness.max() == 0.0
            received += 1
            fake.tick_ms = 2 * received
            wire.send(Message(LOW_STATE, encode_low_state(fake.state()), 0))
    assert user.returncode == 0
    assert user.warnings == ""
    assert user.report["received"] > MESSAGES // 10
    assert (user.report["bad_crc"], user.report["bad_head"]) == (0, 0)
