"""A path that only listens: nothing in a dry run holds a way to send, proven by wires that count."""

from __future__ import annotations

import pytest

from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import PassiveConfig, make_passive
from deal_hw.control.safety.safety import Safety
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import nominal_truth as go2_truth
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.listen_only import ListenOnly, ListenOnlyTopics, listen_only
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import SafetyError, TransportTimeoutError, UnknownNameError
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.robot import Robot
from deal_hw.robots.connect import adopt_robot, make_robot
from deal_hw.transport import Message, Transport

pytestmark = pytest.mark.real_time

S = 10**9


class Counting:
    """A robot on a virtual wire that counts what it is sent; reached over a path that only listens."""

    def __init__(self, name: str) -> None:
        self.clock = VirtualClock(S)
        self.sent = 0
        self.device = (
            Go2Device(go2_truth("ideal")) if name == "go2" else CartpoleDevice(nominal_truth("ideal"))
        )
        wire: Transport
        if isinstance(self.device, Go2Device):
            wire = VirtualTopics(self.device, self.clock)
        else:
            wire = VirtualTransport(self.device, self.clock)
        send = wire.send

        def count(message: Message) -> None:
            self.sent += 1
            send(message)

        wire.send = count  # type: ignore[method-assign]
        path = listen_only(wire)
        self.robot: Robot = (
            Go2Robot(path, self.clock)
            if isinstance(path, ListenOnlyTopics)
            else CartpoleRobot(path, self.clock)
        )

    def run(self, dry_run: bool) -> Outcome:
        """Run the loop for a short while."""
        description = self.robot.description
        loop = ControlLoop(
            self.robot,
            HoldBehaviour(description),
            Safety(description),
            self.clock,
            lambda record: True,
            LoopConfig(duration_s=0.4, dry_run=dry_run, hand_back=True, passive=PassiveConfig(timeout_s=0.2)),
        )
        return loop.run().outcome


@pytest.mark.parametrize("name", ["cartpole", "go2"])
def test_a_dry_run_reads_states_and_sends_not_one_message(name: str) -> None:
    """Connecting, a run, its end: no hello, no request, no command, no damping."""
    robot = Counting(name)
    assert robot.run(dry_run=True) is Outcome.FINISHED
    assert robot.sent == 0


@pytest.mark.parametrize("name", ["cartpole", "go2"])
def test_nobody_else_can_send_over_that_path_either(name: str) -> None:
    """A loop without that option, and a supervisor's passive command: refused before the wire."""
    robot = Counting(name)
    assert robot.run(dry_run=False) is Outcome.FAILED
    robot.robot.connect()
    assert not make_passive(robot.robot, robot.clock, PassiveConfig(timeout_s=0.2))
    assert robot.sent == 0


def test_the_path_is_otherwise_the_inner_one() -> None:
    """Opening, hearing, opening again, closing; sending says why not."""
    clock = VirtualClock(S)
    inner = VirtualTopics(Go2Device(go2_truth("ideal")), clock)
    path = listen_only(inner)
    assert isinstance(path, ListenOnlyTopics) and not path.can_send and inner.can_send
    assert path.port == "virtual"
    path.declare(publish=[topics.LOW_COMMAND], subscribe=[topics.LOW_STATE])
    with path:
        assert path.receive(0.1).channel == topics.LOW_STATE
        path.reopen()
        assert path.receive(0.1).channel == topics.LOW_STATE
        assert path.writers(topics.LOW_COMMAND) == ()
        with pytest.raises(
            SafetyError, match=r"virtual: this run only listens \(--dry-run\), so it cannot send"
        ):
            path.send(Message(topics.LOW_COMMAND, b"", 0))
    assert inner._publish == frozenset()


def test_a_cartpole_that_says_nothing_is_not_there() -> None:
    """Without a hello, a state is what shows that a device is there."""
    clock = VirtualClock(S)
    device = CartpoleDevice(nominal_truth("ideal"))
    tick = device.tick
    device.tick = lambda: tick()[:0]  # type: ignore[method-assign]
    robot = CartpoleRobot(ListenOnly(VirtualTransport(device, clock)), clock)
    with pytest.raises(TransportTimeoutError, match="no state within 1 s"):
        robot.connect()


def test_robots_are_made_so_that_they_can_only_listen() -> None:
    """Over a port of its own and over an inherited descriptor."""
    clock = MonotonicClock()
    for robot in (
        make_robot("cartpole", "serial", "/dev/ttyNOPE", clock, can_send=False),
        make_robot("go2", "zenoh", "tcp/127.0.0.1:1", clock, can_send=False),
        adopt_robot("cartpole", "serial", 99, clock, can_send=False),
    ):
        assert robot._transport.can_send is False  # type: ignore[attr-defined]
    assert make_robot("go2", "zenoh", "tcp/127.0.0.1:1", clock)._transport.can_send  # type: ignore[attr-defined]
    with pytest.raises(UnknownNameError):
        make_robot("nobody", "serial", "x", clock, can_send=False)
