"""The virtual wire of topics, and the Go2's driver on it against the emulated robot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import draw_truth
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.errors import ConfigurationError, TransportLostError, TransportTimeoutError
from deal_hw.testing.robot_suite import default_command
from deal_hw.transport import Message
from deal_hw.types import Status

MS = 1_000_000


class Parrot:
    """A device that ticks every millisecond, says "tock" on every third tick and repeats what it hears."""

    def __init__(self) -> None:
        self.device_ns = 0
        self._heard: list[tuple[str, bytes]] = []

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        self._heard.append(("echo", payload + b"@" + str(stamp_ns).encode()))

    def tick(self) -> list[tuple[str, bytes]]:
        out, self._heard = self._heard, []
        if self.device_ns % (3 * MS) == 0:
            out.append(("clock", b"tock"))
        self.device_ns += MS
        return out


@pytest.fixture
def wire() -> VirtualTopics:
    """A wire with a parrot at its end, at 100 ms on the clock."""
    made = VirtualTopics(Parrot(), VirtualClock(100 * MS))
    made.declare(publish=["say"], subscribe=["echo", "clock"])
    return made


def test_waiting_moves_the_clock_to_the_message(wire: VirtualTopics) -> None:
    """The next tock is at 103 ms, the one after at 106; nothing comes in between."""
    with wire:
        assert wire.receive(0.01) == Message("clock", b"tock", 103 * MS)
        with pytest.raises(TransportTimeoutError, match=r"nothing arrived within 0\.002 s"):
            wire.receive(0.002)
        assert wire.receive(0.002).stamp_ns == 106 * MS


def test_what_is_sent_is_heard_in_the_next_tick(wire: VirtualTopics) -> None:
    """The stamp is the sender's; topics that are not declared are refused."""
    with wire:
        wire.send(Message("say", b"hello", 0))
        assert wire.receive(0.01) == Message("echo", b"hello@100000000", 101 * MS)
        with pytest.raises(ConfigurationError, match="topic 'shout' is not declared"):
            wire.send(Message("shout", b"", 0))


def test_only_subscribed_topics_come() -> None:
    """A host that did not ask for the clock does not get it."""
    wire = VirtualTopics(Parrot(), VirtualClock())
    wire.declare(publish=["say"], subscribe=["echo"])
    with wire, pytest.raises(TransportTimeoutError):
        wire.receive(0.02)
    assert wire.writers("echo") == ()


def test_a_closed_or_cut_wire_is_lost(wire: VirtualTopics) -> None:
    """Before opening, after closing and once unplugged every call is an error."""
    with pytest.raises(TransportLostError, match="not open"):
        wire.receive(0.0)
    wire.open()
    wire.close()
    with pytest.raises(TransportLostError, match="not open"):
        wire.send(Message("say", b"", 0))
    wire.open()
    wire.unplug()
    with pytest.raises(TransportLostError, match="vanished"):
        wire.receive(0.0)
    with pytest.raises(TransportLostError, match="unplugged"):
        wire.open()


def armed(profile: str) -> tuple[Go2Device, Go2Robot]:
    """Return an emulated robot, and its driver: connected, homed and armed."""
    clock = VirtualClock(10**9)
    device = Go2Device(draw_truth(profile, 2))
    robot = Go2Robot(VirtualTopics(device, clock), clock)
    robot.connect()
    robot.home(15.0)
    robot.arm(1.0)
    return device, robot


def test_the_driver_stands_the_emulated_robot_up() -> None:
    """Connect, release, arm, ease to the default pose, hold, damp: over the robot's own messages."""
    device, robot = armed("realistic")
    assert device.sport_name == ""
    state = robot.read_state(0.1)
    first, goal = state.position, np.array(robot.description.default_position)
    command = default_command(robot)
    for step in range(125):
        target = first + (goal - first) * min(1.0, step / 75)
        robot.send_command(dataclasses.replace(command, position_target=target))
        for _ in range(10):
            state = robot.read_state(0.1)
            robot.repeat()
    assert device.base_height > 0.2
    assert state.command_sequence == 124
    robot.passive()
    seen = (robot.read_state(0.1) for _ in range(500))
    assert any(not state.status & Status.ARMED for state in seen)
    assert device.log.changes[-1][2] == "damping"


def test_the_driver_notices_that_sport_mode_returns() -> None:
    """Its commands on rt/lowcmd are somebody else's: a fault."""
    device, robot = armed("ideal")
    assert robot.fault == ""
    device.begin_fault("sport")
    for _ in range(5):
        robot.read_state(0.1)
    assert "another program commands the robot's motors" in robot.fault
