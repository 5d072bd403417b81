"""Two emulated servos on a pseudo-terminal: ``deal-hw emulate cartpole --transport dynamixel``."""

from __future__ import annotations

import termios
from pathlib import Path
from typing import Final

from deal_hw.drivers.cartpole.dynamixel.device import DynamixelDevice
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.emulator.faults import Hazards
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.servo_bus.registers import BAUD_RATES
from deal_hw.testing.pseudo_terminal import PseudoTerminal

_SPEEDS: Final = {
    code: rate for rate in BAUD_RATES if (code := getattr(termios, f"B{rate}", None)) is not None
}
_OUTPUT_SPEED = 5


class ServoEmulator(PseudoTerminal):
    """Runs servos behind a pty; they receive noise if the host's port has another baud rate.

    Args:
        device: The servos.
        link: A symbolic link to make to the port; None for none.
        hazards: Faults on purpose.
    """

    def __init__(
        self, device: DynamixelDevice, link: Path | None = None, hazards: Hazards | None = None
    ) -> None:
        super().__init__(device, link, hazards)
        self._servos = device

    def _read(self, wait_s: float) -> bytes:
        data = super()._read(wait_s)
        if data:
            speed = termios.tcgetattr(self._master)[_OUTPUT_SPEED]
            self._servos.bus.host_baud_rate = _SPEEDS.get(speed, 0)
        return data


def dynamixel_emulator(truth: CartpoleTruth, *, link: Path | None, hazards: Hazards) -> ServoEmulator:
    """Return an emulated cart-pole on two servos."""
    settings = DynamixelSettings(baud_rate=hazards.servo.servo_baud_rate)
    device = DynamixelDevice(truth, settings, hazards.servo)
    device.break_joints(hazards.joints)
    return ServoEmulator(device, link, hazards)
