"""Settings and faults of an emulated cart-pole's wire; the command line has the first two as options."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.ranges import Checked, Range
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.testing.pseudo_terminal import PortFaults


@dataclass(frozen=True, slots=True, kw_only=True)
class CanFaults(Checked):
    """An emulated CAN bus and its faults, whose times count from the first arming of the motor."""

    node: Annotated[int, Range(0, 62)] = 1
    """CAN: number of the device on the bus; 0, the factory number, for an ODrive alone."""

    bitrate: Literal[125000, 250000, 500000, 800000, 1000000] = 500000
    """CAN: bit rate of the bus; a host with another rate receives nothing."""

    bus_off_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """CAN: the adapter's controller goes bus-off after this time [s]."""

    bus_off_s: Annotated[float, Range(0, 1e7, "s")] = 1.0
    """CAN: how long the bus stays off, even if it is opened again [s]."""

    tx_full_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """CAN: the adapter's transmit buffer is full after this time [s]."""

    tx_full_s: Annotated[float, Range(0, 1e7, "s")] = 1.0
    """CAN: how long the transmit buffer is full [s]."""

    lost_node_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """CAN: the device's wire to the bus breaks after this time [s]; the adapter stays."""

    no_acknowledge: bool = False
    """CAN: no node acknowledges the host's frames."""

    duplicate_node: bool = False
    """CAN: a second device has the same number."""

    dbc_version: Annotated[int, Range(1, 255)] = 1
    """CAN: version of the protocol that the device speaks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoFaults(BusFaults):
    """Emulated Dynamixel servos and their faults, whose times count from the first arming of the motor.

    The faulty servo is that of the belt.
    """

    servo_baud_rate: Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000] = 1000000
    """Dynamixel: baud rate of both servos; a port with another rate does not reach them."""

    servo_duplicate_id: bool = False
    """Dynamixel: both servos have id 1."""

    servo_wrong_mode: bool = False
    """Dynamixel: the belt servo is in velocity mode."""

    servo_protocol: Literal[1, 2] = 2
    """Dynamixel: protocol of the pole servo."""

    servo_reboot_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Dynamixel: the belt servo restarts after this time [s]."""

    servo_overload_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Dynamixel: the belt servo switches itself off by overload after this time [s]."""

    servo_absent_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Dynamixel: the pole servo stops answering after this time [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hazards(PortFaults):
    """Faults that the emulator makes, of its port and of its wire.

    Attributes:
        can: A CAN bus and its faults.
        servo: Dynamixel servos and their faults.
        joints: Faults of the joints.
    """

    can: CanFaults = CanFaults()
    servo: ServoFaults = ServoFaults()
    joints: JointFaults = field(default_factory=JointFaults)
