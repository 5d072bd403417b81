"""An emulated cart-pole on a serial port: ``deal-hw emulate cartpole``."""

from __future__ import annotations

from pathlib import Path

from deal_hw.drivers.cartpole.chips.firmwares import device_of
from deal_hw.drivers.cartpole.emulator.faults import Hazards
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.testing.pseudo_terminal import PseudoTerminal


def serial_emulator(
    truth: CartpoleTruth, *, link: Path | None, hazards: Hazards, firmware: str = "auto"
) -> PseudoTerminal:
    """Return an emulated cart-pole with a serial port.

    Raises:
        ConfigurationError: Its firmware needs a compiler, which is missing.
    """
    device = device_of(truth, firmware)
    device.break_joints(hazards.joints)
    return PseudoTerminal(device, link, hazards)
