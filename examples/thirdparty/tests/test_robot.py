"""The driver against the emulated device: deal-hw's contract of a robot, and what is its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from deal_hw_bench_cartpole import protocol
from deal_hw_bench_cartpole.device import Device, Truth
from deal_hw_bench_cartpole.protocol import Command
from deal_hw_bench_cartpole.robot import BenchCartpole

from deal_hw.clock import VirtualClock
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Transport
from deal_hw.types import Status


class Bench:
    """An emulated device, its driver, and the wire between them, in virtual time."""

    def __init__(self, wrap: Callable[[Transport], Transport] = lambda link: link, **truth: Any) -> None:
        self.clock = VirtualClock()
        self.device = Device(Truth(**truth))
        self.wire = VirtualTransport(self.device, self.clock)
        self.robot = BenchCartpole(wrap(self.wire), self.clock)

    def armed(self) -> BenchCartpole:
        self.robot.connect()
        self.robot.home(5.0)
        self.robot.arm(1.0)
        return self.robot


def fake(answer: bytes) -> BenchCartpole:
    clock = VirtualClock()
    return BenchCartpole(VirtualTransport(FakeDevice(answer), clock), clock)


class TestBenchCartpole(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        fault = OneBadFrame(10)
        made = Bench(lambda link: FaultyTransport(link, received=fault))
        return RobotBench(
            robot=made.robot,
            foreign=fake(b"GRBL 1.1 ['$' for help]\r\n"),
            newer=fake(protocol.frame(Command.PING) + protocol.frame(Command.STATE, bytes(41))),
            silent=fake(b""),
            unplug=made.wire.unplug,
            corrupt=fault.corrupt_next,
        )


@pytest.mark.parametrize("length", [31, 36, 40])
def test_every_firmware_is_driven(length: int) -> None:
    """Later firmware needs a switch before it obeys, and earlier firmware does not know it."""
    bench = Bench(state_length=length)
    robot = bench.armed()
    start = bench.device.position[0]
    robot.send_command(default_command(robot, target=0.5))
    for _ in range(10):
        state = robot.read_state(1.0)
    assert bench.device.position[0] > start + 0.01
    assert state.effort[0] == pytest.approx(0.5 * 1.77, rel=1e-3)


def test_a_hanging_pole_is_at_pi_wherever_its_encoder_is_mounted() -> None:
    """Homing measures it, also from a swing; the track's centre is zero."""
    bench = Bench(hanging=937.0, start_m=0.04, start_rad=0.1)
    robot = bench.armed()
    found = [robot.read_state(1.0).position for _ in range(60)]
    assert abs(np.mean(found, axis=0)[1] - math.pi) < 0.02
    assert abs(found[-1][0] - bench.device.position[0]) < 2e-3


def test_the_new_centre_is_no_motion() -> None:
    """Calibrating moves the origin, and the next speed does not see that."""
    robot = Bench(start_m=0.05).robot
    robot.connect()
    robot.home(5.0)
    assert abs(robot.read_state(1.0).velocity[0]) < 0.2


def test_full_turns_go_on() -> None:
    """The angle does not jump where the encoder's circle closes."""
    bench = Bench()
    robot = bench.armed()
    bench.device._data.qvel[1] = 15.0
    angles = [robot.read_state(1.0).position[1] for _ in range(50)]
    assert np.abs(np.diff(angles)).max() < 0.5
    assert angles[-1] - angles[0] > 2 * math.pi


def test_old_firmware_gets_no_command_after_passive() -> None:
    """It has no switch, so the driver keeps the command back; the next arming lets it pass again."""
    bench = Bench()
    robot = bench.armed()
    robot.send_command(default_command(robot, target=1.0))
    robot.passive()
    robot.send_command(default_command(robot, target=1.0))
    while robot.read_state(1.0).status & Status.ARMED:
        pass
    assert robot.read_state(1.0).effort[0] == 0.0
    assert robot.last_sequence == 0
    robot.arm(1.0)
    robot.send_command(default_command(robot, target=1.0))
    assert robot.last_sequence == 1
