"""Table of emulated cart-poles: what runs the firmware of each."""

from __future__ import annotations

from deal_hw.drivers.cartpole.chips.avr_device import AvrDevice
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice, EmulatedDevice
from deal_hw.drivers.cartpole.chips.host_firmware import HostFirmware, library
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.errors import ConfigurationError, UnknownNameError

FIRMWARES = ("auto", "host", "python", "avr")
"""What runs the firmware of an emulated cart-pole.

"host" is the C core, compiled for this computer. "python" is the same in Python, with floats in the servo.
"avr" is the chip's image under simavr. "auto" is "host" if the core can be compiled, otherwise "python".
"""
CAN_FIRMWARES = ("auto", "host", "python")
"""The same for an emulated cart-pole on CAN; not "avr": the ATmega328P has no CAN controller."""


def usable_firmware(firmware: str) -> str:
    """Return the firmware that "auto" stands for on this host; others as given."""
    if firmware != "auto":
        return firmware
    try:
        library()
    except ConfigurationError:
        return "python"
    return "host"


def device_of(truth: CartpoleTruth, firmware: str = "auto") -> EmulatedDevice:
    """Return an emulated device with this firmware.

    Raises:
        UnknownNameError: There is no such firmware.
        ConfigurationError: A compiler or simavr is missing, or the sources are refused.
    """
    match usable_firmware(firmware):
        case "python":
            return CartpoleDevice(truth)
        case "host":
            return CartpoleDevice(truth, firmware=HostFirmware.of)
        case "avr":
            return AvrDevice(truth)
    raise UnknownNameError("firmware", firmware, FIRMWARES)
