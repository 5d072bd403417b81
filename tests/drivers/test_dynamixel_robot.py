"""The cart-pole on two Dynamixel servos: the robot contract on the emulated bus, and what is its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.passive import make_passive
from deal_hw.drivers.cartpole.dynamixel.device import OVERLOAD, DynamixelDevice
from deal_hw.drivers.cartpole.dynamixel.emulated_servo import EmulatedServo
from deal_hw.drivers.cartpole.dynamixel.registers import (
    BAUD_RATE,
    BUS_WATCHDOG,
    DRIVE_MODE,
    GOAL_POSITION,
    HARDWARE_ERROR,
    ID,
    MODEL_NUMBER,
    OPERATING_MODE,
    POSITION_P_GAIN,
    PRESENT_POSITION,
    STATUS_RETURN_LEVEL,
    TORQUE_ENABLE,
    Register,
)
from deal_hw.drivers.cartpole.dynamixel.robot import DynamixelCartpole
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.truth import nominal_truth
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import (
    ConfigurationError,
    SafetyError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.testing.faults import FaultRates, FaultyTransport, FrameFaults
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Transport
from deal_hw.types import RobotState, Status


class OneBadAnswer(FrameFaults):
    """Corrupts exactly the next answer when told to."""

    def __init__(self) -> None:
        super().__init__(FaultRates(), np.random.default_rng(0), None)
        self.pending = False

    def apply(self, data: bytes) -> bytes:
        """Flip bits in the middle."""
        if self.pending:
            self.pending = False
            return data[:20] + bytes([data[20] ^ 0x55]) + data[21:]
        return data


class Wire:
    """An emulated cart-pole on two servos, its driver, and everything between them."""

    def __init__(
        self,
        wrap: Callable[[Transport], Transport] = lambda transport: transport,
        profile: str = "ideal",
        device: DynamixelSettings | None = None,
        **settings: Any,
    ) -> None:
        self.clock = VirtualClock()
        made = DynamixelSettings(**settings)
        self.device = DynamixelDevice(nominal_truth(profile), device or made)
        self.virtual = VirtualTransport(self.device, self.clock)
        self.robot = DynamixelCartpole(wrap(self.virtual), self.clock, made)

    @property
    def cart(self) -> EmulatedServo:
        """The belt servo."""
        return self.device.servos[0]

    @property
    def pole(self) -> EmulatedServo:
        """The pole servo."""
        return self.device.servos[1]

    def armed(self) -> DynamixelCartpole:
        """Return the driver, connected, homed and armed, after its first command."""
        self.robot.connect()
        self.robot.home(20.0)
        self.robot.arm(1.0)
        self.robot.send_command(default_command(self.robot))
        return self.robot

    def run(self, cycles: int, target: float = 0.0) -> list[RobotState]:
        """Command and read as the control loop does; return the states."""
        states = []
        for _ in range(cycles):
            deadline_ns = self.clock.now_ns() + 20_000_000
            self.robot.send_command(default_command(self.robot, target))
            while True:
                try:
                    states.append(self.robot.read_state((deadline_ns - self.clock.now_ns()) / 1e9))
                except TransportTimeoutError:
                    break
        return states


def middle(device_seed: int = 0) -> int:
    """Return where the belt servo of an emulated cart-pole reads the middle, as a user would write it down."""
    wire = Wire()
    wire.robot.connect()
    wire.robot.home(20.0)
    return wire.robot._zero % 4096


class TestDynamixelCartpole(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        fault = OneBadAnswer()
        wire = Wire(lambda t: FaultyTransport(t, received=fault), cart_zero=middle())
        foreign, newer, silent = Wire(), Wire(), Wire()
        foreign.cart.put(MODEL_NUMBER, 350)
        newer.pole.protocol = 1
        for servo in silent.device.servos:
            servo.present = False

        def corrupt() -> None:
            fault.pending = True

        return RobotBench(
            robot=wire.robot,
            foreign=foreign.robot,
            newer=newer.robot,
            silent=silent.robot,
            unplug=wire.virtual.unplug,
            corrupt=corrupt,
        )
