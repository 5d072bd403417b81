"""The emulated cart-poles, by what runs their firmware."""

from __future__ import annotations

from deal_hw.drivers.cartpole.avr_device import AvrDevice
from deal_hw.drivers.cartpole.device import CartpoleDevice, EmulatedDevice
from deal_hw.drivers.cartpole.host_firmware import HostFirmware
from deal_hw.drivers.cartpole.truth import CartpoleTruth
from deal_hw.errors import UnknownNameError

FIRMWARES = ("python", "host", "avr")
"""In Python with a float servo; the C core compiled for this host; the chip's image under simavr."""


def device_of(truth: CartpoleTruth, firmware: str = "python") -> EmulatedDevice:
    """Return an emulated device with this firmware.

    Raises:
        UnknownNameError: There is no such firmware.
        ConfigurationError: A compiler or simavr is missing, or the sources are refused.
    """
    match firmware:
        case "python":
            return CartpoleDevice(truth)
        case "host":
            return CartpoleDevice(truth, firmware=HostFirmware.of)
        case "avr":
            return AvrDevice(truth)
    raise UnknownNameError("firmware", firmware, FIRMWARES)
