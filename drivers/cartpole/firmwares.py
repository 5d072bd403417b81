"""The emulated cart-poles, by what runs their firmware."""

from __future__ import annotations

from deal_hw.drivers.cartpole.device import CartpoleDevice
from deal_hw.drivers.cartpole.truth import Truth
from deal_hw.errors import UnknownNameError

FIRMWARES = ("python", "host")
"""In Python with a float servo; the C core compiled for this host."""


def device_of(truth: Truth, firmware: str = "python") -> CartpoleDevice:
    """Return an emulated device with this firmware.

    Raises:
        UnknownNameError: There is no such firmware.
        ConfigurationError: A compiler is missing, or refuses the sources.
    """
    match firmware:
        case "python":
            return CartpoleDevice(truth)
        case "host":
            from deal_hw.drivers.cartpole.host_firmware import HostFirmware

            return CartpoleDevice(truth, firmware=HostFirmware.of)
    raise UnknownNameError("firmware", firmware, FIRMWARES)
