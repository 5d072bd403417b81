"""The emulated servos of each kind, as an emulated arm uses them."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeAlias

from deal_hw.drivers.servo_arm.families import OFF, ON, Dynamixel, Feetech, LoopGains
from deal_hw.drivers.servo_bus import packets, xl330
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus.emulated_bus import EmulatedBus
from deal_hw.drivers.servo_bus.emulated_servo import OVERLOAD_ERROR, EmulatedServo
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.servo_bus.feetech.emulated_bus import StsBus
from deal_hw.drivers.servo_bus.feetech.emulated_servo import StsServo
from deal_hw.drivers.servo_bus.feetech.packets import BROADCAST, Fault, StsInstruction, encode
from deal_hw.drivers.servo_bus.registers import OperatingMode
from deal_hw.drivers.servo_bus.servos_side import ServosSide
from deal_hw.sim.robots.hardware_section import ServoEntry

_COUNTS_S: Final = 60 / (0.229 * r.PULSES)
"""Units of a velocity register in a tick a second."""


ABSENT, RESTARTS, OVERLOAD = TROUBLES = ("servo absent", "servo restarts", "overload")
"""Faults of a servo, in words."""


class EmulatedJoint(abc.ABC):
    """A servo on a joint: what it was told, and what it measures.

    Attributes:
        servo: The emulated servo.
    """

    servo: EmulatedServo | StsServo

    @property
    @abc.abstractmethod
    def goal(self) -> int:
        """Its goal [ticks]."""

    @property
    @abc.abstractmethod
    def torque(self) -> int:
        """Whether its motor is off, follows the goal or brakes; see :mod:`families`."""

    @property
    @abc.abstractmethod
    def gains(self) -> LoopGains:
        """LoopGains of its position loop."""

    @property
    @abc.abstractmethod
    def share(self) -> float:
        """Its effort limit, as a share of the most."""

    @property
    def stopped(self) -> bool:
        """Whether its own watchdog has stopped it."""
        return False

    @abc.abstractmethod
    def sense(self, ticks: int, ticks_s: float, duty: float) -> None:
        """Set the registers of what it measures.

        Args:
            ticks: Position.
            ticks_s: Velocity [ticks/s].
            duty: Voltage on its motor, as a share of the supply's.
        """

    @abc.abstractmethod
    def begin(self) -> None:
        """Set the goal to the present position, as a servo does that was switched on."""

    @abc.abstractmethod
    def tick(self, now_ns: int, silence_ns: int) -> None:
        """Advance its clock."""

    @property
    @abc.abstractmethod
    def overloaded(self) -> bool:
        """Whether it reports an overload."""

    def trouble(self, now_ns: int) -> str:
        """Return its fault at a time [ns], one of :data:`TROUBLES`; "" for none."""
        if not self.servo.present:
            return ABSENT
        if not self.servo.awake(now_ns):
            return RESTARTS
        return OVERLOAD if self.overloaded else ""

    def restart(self, now_ns: int) -> None:
        """Restart at a time [ns], as after a dip of its supply."""
        self.servo.reboot(now_ns)

    def unplug(self, now_ns: int) -> None:
        """Take its supply and its data away at a time [ns]."""
        self.servo.reboot(now_ns)
        self.servo.present = False

    @abc.abstractmethod
    def overload(self) -> None:
        """Report an overload whose cause stays."""

    @abc.abstractmethod
    def goal_packet(self, ticks: int) -> bytes:
        """Return the packet by which another master writes its goal."""


class DynamixelJoint(EmulatedJoint):
    """An emulated X-series servo.

    Args:
        servo: Its id.
        baud_rate: Rate of the bus.
        model: Its model number.
    """

    servo: EmulatedServo

    def __init__(self, servo: int, baud_rate: int, model: int) -> None:
        self.servo = EmulatedServo(servo, baud_rate, mode=OperatingMode.POSITION, model=model)

    @property
    def goal(self) -> int:
        """Its goal [ticks]."""
        return self.servo.goal_shaft

    @property
    def torque(self) -> int:
        """ON or OFF."""
        return ON if self.servo.get(r.TORQUE_ENABLE) else OFF

    @property
    def gains(self) -> LoopGains:
        """LoopGains of its position loop."""
        block = self.servo.block
        return LoopGains(block.p_gain, block.i_gain, block.d_gain)

    @property
    def share(self) -> float:
        """Goal PWM, as a share of the most."""
        return abs(self.servo.get(r.GOAL_PWM)) / xl330.MOST_PWM

    @property
    def stopped(self) -> bool:
        """Whether Bus Watchdog has stopped it."""
        return self.servo.watchdog_tripped

    def sense(self, ticks: int, ticks_s: float, duty: float) -> None:
        """Set the registers of what it measures."""
        self.servo.sense(ticks, velocity=round(ticks_s * _COUNTS_S), pwm=round(duty * xl330.MOST_PWM))

    def begin(self) -> None:
        """Set the goal to the present position."""
        self.servo.forget_turns()
        self.servo.put(r.GOAL_POSITION, self.servo.block.present_position)

    def tick(self, now_ns: int, silence_ns: int) -> None:
        """Advance its clock and its watchdog."""
        self.servo.tick(now_ns, silence_ns)

    @property
    def overloaded(self) -> bool:
        """Whether it reports an overload."""
        return bool(self.servo.get(r.HARDWARE_ERROR) & OVERLOAD_ERROR)

    def overload(self) -> None:
        """Report an overload; it gives no torque until it restarts."""
        self.servo.fail(OVERLOAD_ERROR)

    def goal_packet(self, ticks: int) -> bytes:
        """Return a sync write of Goal Position."""
        return packets.sync_write(r.GOAL_POSITION, {self.servo.id: ticks})


class StsJoint(EmulatedJoint):
    """An emulated STS servo, with the homing offset 0.

    Args:
        servo: Its id.
        baud_rate: Rate of the bus.
        model: Its model number.
    """

    servo: StsServo

    def __init__(self, servo: int, baud_rate: int, model: int) -> None:
        self.servo = StsServo(servo, baud_rate, model=model)

    @property
    def goal(self) -> int:
        """Its goal [ticks]."""
        return self.servo.goal

    @property
    def torque(self) -> int:
        """ON, OFF or DAMPING."""
        return self.servo.torque_mode

    @property
    def gains(self) -> LoopGains:
        """LoopGains of its position loop."""
        return LoopGains(self.servo.p_gain, self.servo.i_gain, self.servo.d_gain)

    @property
    def share(self) -> float:
        """Torque limit, as a share of the motor's most."""
        return self.servo.torque_limit * f.LOAD_UNIT

    def sense(self, ticks: int, ticks_s: float, duty: float) -> None:
        """Set the registers of what it measures."""
        self.servo.sense(ticks, speed=round(ticks_s), load=round(duty / f.LOAD_UNIT))

    def begin(self) -> None:
        """Set the goal to the present position."""
        self.servo.forget_turns()
        self.servo.put(f.GOAL_POSITION, self.servo.get(f.PRESENT_POSITION))

    def tick(self, now_ns: int, silence_ns: int) -> None:
        """Do nothing: the bus advances its protections, and there is no watchdog."""

    @property
    def overloaded(self) -> bool:
        """Whether it reports an overload."""
        return bool(self.servo.error & Fault.OVERLOAD)

    def overload(self) -> None:
        """Report an overload; it holds with Protective Torque until it restarts."""
        self.servo.fail(Fault.OVERLOAD, lasting=True)

    def goal_packet(self, ticks: int) -> bytes:
        """Return a sync write of Goal Position."""
        goal = f.GOAL_POSITION
        data = bytes([goal.address, goal.size, self.servo.id]) + f.encode(goal, ticks)
        return encode(BROADCAST, StsInstruction.SYNC_WRITE, data)


EmulatedArm: TypeAlias = tuple[Sequence[EmulatedJoint], ServosSide[Any]]


def dynamixel_arm(servos: Sequence[ServoEntry], baud_rate: int) -> EmulatedArm:
    """Return emulated X-series servos and their side of the bus; without a model each is an XL330-M077."""
    numbers = {name: number for number, name in Dynamixel.models.items()}
    joints = [DynamixelJoint(one.id, baud_rate, numbers[one.model or "xl330-m077"]) for one in servos]
    return joints, EmulatedBus([joint.servo for joint in joints], lambda: None, lambda: False)


def feetech_arm(servos: Sequence[ServoEntry], baud_rate: int) -> EmulatedArm:
    """Return emulated STS servos and their side of the bus; without a model each is an STS3215."""
    numbers = {name: number for number, name in Feetech.models.items()}
    joints = [StsJoint(one.id, baud_rate, numbers[one.model or "sts3215"]) for one in servos]
    return joints, StsBus([joint.servo for joint in joints], lambda: None, lambda: False)


EMULATED: Final[Mapping[str, Callable[[Sequence[ServoEntry], int], EmulatedArm]]] = {
    "dynamixel": dynamixel_arm,
    "feetech": feetech_arm,
}
"""Makes emulated servos, in the given order, and their bus, by the bus in robot.yaml."""
