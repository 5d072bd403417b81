"""An emulated cart-pole on two Dynamixel servos for tests, in virtual time."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.dynamixel.device import DynamixelDevice
from deal_hw.drivers.cartpole.dynamixel.robot import DynamixelCartpole
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.servo_bus.emulated_servo import EmulatedServo
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.testing.robot_suite import arm, default_command, run_cycles
from deal_hw.transport import Transport
from deal_hw.types import RobotState


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
        if "cart_zero" not in settings:
            settings["cart_zero"] = middle()
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
        arm(self.robot)
        return self.robot

    def run(self, cycles: int, target: float = 0.0) -> list[RobotState]:
        """Command and read as the control loop does; return the states."""
        return run_cycles(self.robot, self.clock, cycles, default_command(self.robot, target))


@functools.cache
def middle() -> int:
    """Return where the emulated belt servo reads the middle, as a user would write it down."""
    wire = Wire(cart_zero=None)
    wire.robot.connect()
    wire.robot.home(20.0)
    return wire.robot._zero % 4096
