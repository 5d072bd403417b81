"""An emulated cart-pole on a CAN bus, behind an emulated serial adapter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from deal_hw.drivers.cartpole.chips.controller import Controller, Firmware
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice, EmulatedDevice
from deal_hw.drivers.cartpole.chips.firmwares import CAN_FIRMWARES, usable_firmware
from deal_hw.drivers.cartpole.chips.host_firmware import CanHostFirmware, settings_of
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.emulator.faults import CanFaults, Hazards
from deal_hw.drivers.cartpole.emulator.slcan_adapter import SlcanAdapter
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, unique_id
from deal_hw.drivers.cartpole.wire.can_link import NODE, CanLink
from deal_hw.errors import UnknownNameError
from deal_hw.testing.pseudo_terminal import PseudoTerminal

SECOND_DEVICE: Final = 0x5EC0_0000
"""Changes the serial number of a second device under the same number."""


def can_device(
    truth: CartpoleTruth, node: int = NODE, version: int = 1, identity: int = 0, firmware: str = "python"
) -> CartpoleDevice:
    """Return an emulated cart-pole whose bytes are CAN frames.

    Args:
        truth: Its hidden parameters.
        node: Its number.
        version: Version of the protocol that it speaks.
        identity: Changes its serial number.
        firmware: "python", "host" for the C core, or "auto".

    Raises:
        ConfigurationError: The node's number is outside the range, or a compiler is missing.
        UnknownNameError: There is no such firmware on CAN.
    """
    number = unique_id(truth) ^ identity
    link = CanLink(node, version, number, device=True)

    def python(truth: CartpoleTruth, mechanics: Mechanics) -> Firmware:
        servo = Servo(truth.parameters, mechanics.timestep_s)
        return Controller(servo, number, mechanics.command_delay, link)

    def core(truth: CartpoleTruth, mechanics: Mechanics) -> Firmware:
        settings = settings_of(truth, 0)
        settings.unique_id = number
        return CanHostFirmware(settings, mechanics.command_delay, node, version)

    match usable_firmware(firmware):
        case "python":
            return CartpoleDevice(truth, firmware=python)
        case "host":
            return CartpoleDevice(truth, firmware=core)
    raise UnknownNameError("firmware on CAN", firmware, CAN_FIRMWARES)


def can_devices(truth: CartpoleTruth, faults: CanFaults, firmware: str = "python") -> list[EmulatedDevice]:
    """Return the cart-pole on a bus, and the additional devices of its faults."""
    identities = (0, SECOND_DEVICE) if faults.duplicate_node else (0,)
    return [can_device(truth, faults.node, faults.dbc_version, identity, firmware) for identity in identities]


def adapter_emulator(
    devices: list[EmulatedDevice],
    *,
    link: Path | None,
    hazards: Hazards,
    port: Callable[[str], str] = lambda path: path,
) -> PseudoTerminal:
    """Return an emulated serial CAN adapter with devices on its bus.

    Args:
        devices: Devices on the bus; the first is the cart-pole itself.
        link: A symbolic link to make to the port.
        hazards: Faults on purpose.
        port: Converts the path to a host's ``--port``.
    """
    for device in devices:
        device.break_joints(hazards.joints)
    return PseudoTerminal(
        SlcanAdapter(devices, hazards.can), link, hazards, port=lambda path: port(f"slcan:{path}")
    )


def can_emulator(
    truth: CartpoleTruth, *, link: Path | None, hazards: Hazards, firmware: str = "auto"
) -> PseudoTerminal:
    """Return an emulated cart-pole on a CAN bus behind a serial adapter.

    Raises:
        ConfigurationError: Its firmware needs a compiler, which is missing.
    """
    faults = hazards.can
    settings = [f"bitrate={faults.bitrate}"] if faults.bitrate != CanFaults().bitrate else []
    settings += [f"node={faults.node}"] if faults.node != NODE else []
    query = "?" + "&".join(settings) if settings else ""
    return adapter_emulator(
        can_devices(truth, faults, firmware), link=link, hazards=hazards, port=lambda path: path + query
    )
