"""An emulated ODrive and pole encoder on a CAN bus, with the mechanics of the emulated cart-pole behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from deal_hw.drivers.cartpole.chips.controller import Controller, Firmware, Mode
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice, EmulatedDevice
from deal_hw.drivers.cartpole.chips.firmwares import CAN_FIRMWARES, usable_firmware
from deal_hw.drivers.cartpole.chips.host_firmware import CanHostFirmware, settings_of
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.emulator.can_emulator import SECOND_DEVICE, adapter_emulator
from deal_hw.drivers.cartpole.emulator.faults import CanFaults, Hazards
from deal_hw.drivers.cartpole.emulator.odrive_drive import OdriveFirmware
from deal_hw.drivers.cartpole.emulator.odrive_endpoints import ENABLE_WATCHDOG, WATCHDOG_TIMEOUT
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, unique_id
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import Angle, CanLink
from deal_hw.drivers.cartpole.wire.odrive_link import ENCODER_KIND, OdriveSettings
from deal_hw.errors import UnknownNameError
from deal_hw.testing.pseudo_terminal import PseudoTerminal

_SERIES = 0x3854_0000_0000
"""Upper bits of the emulated drives' serial numbers."""


class PoleEncoder(Controller):
    """The pole encoder node's firmware in Python, as the C core has it: a cart-pole without a motor.

    Args:
        servo: Never used.
        unique_id: Serial number.
        link: The node's side of the bus.
    """

    def __init__(self, servo: Servo, unique_id: int, link: CanLink) -> None:
        super().__init__(servo, unique_id, lambda: 0, link)
        self._wire = link

    def handle(self, message: protocol.AnyMessage, motor: Motor) -> protocol.AnyMessage | None:
        """Handle one message; return the answer, or None."""
        answer = super().handle(message, motor)
        return replace(answer, kind=ENCODER_KIND) if isinstance(answer, protocol.Info) else answer

    def report(self, reading: Reading) -> bytes:
        """Return the frames of the tick that :meth:`control` ran last."""
        s = self.state(reading)
        return self._wire.encode(
            Angle(s.sequence, s.device_us & 0xFFFF_FFFF, s.pole_urad, s.pole_urad_s, s.status)
        )

    def _act(self, request: protocol.Arm | protocol.Stop | protocol.Home, motor: Motor) -> protocol.Result:
        if isinstance(request, protocol.Arm) and self.mode is not Mode.HOMING:
            return protocol.Result.NOT_HOMED
        return super()._act(request, motor)


def odrive_device(
    truth: CartpoleTruth,
    parts: OdriveSettings,
    version: int = 1,
    identity: int = 0,
    firmware: str = "python",
) -> CartpoleDevice:
    """Return an emulated ODrive with a pole encoder; its bytes are CAN frames.

    Args:
        truth: Its hidden parameters.
        parts: Numbers and mechanics of the parts.
        version: Of the encoder's protocol.
        identity: Changes the encoder's serial number.
        firmware: Of the encoder: "python", "host" for the C core, or "auto".

    Raises:
        ConfigurationError: A compiler is missing.
        UnknownNameError: There is no such firmware on CAN.
    """
    number = unique_id(truth) ^ identity
    match usable_firmware(firmware):
        case "python":
            servo = Servo(truth.parameters, 1 / DESCRIPTION.device_rate_hz)
            link = CanLink(parts.encoder, version, number, device=True)
            encoder: Firmware = PoleEncoder(servo, number, link)
        case "host":
            settings = settings_of(truth, 0)
            settings.unique_id = number
            encoder = CanHostFirmware(settings, lambda: 0, parts.encoder, version, encoder=True)
        case _:
            raise UnknownNameError("firmware on CAN", firmware, CAN_FIRMWARES)

    def drive(truth: CartpoleTruth, mechanics: Mechanics) -> Firmware:
        return OdriveFirmware(truth, parts, encoder, mechanics.command_delay, _SERIES | number & 0xFFFF_FFFF)

    return CartpoleDevice(truth, firmware=drive)


def odrive_emulator(
    truth: CartpoleTruth, *, link: Path | None, hazards: Hazards, firmware: str = "auto"
) -> PseudoTerminal:
    """Return an emulated ODrive and pole encoder behind a serial CAN adapter; node is the drive's.

    Raises:
        ConfigurationError: The encoder's firmware needs a compiler, which is missing.
    """
    faults = hazards.can
    parts = OdriveSettings(drive=faults.node)
    identities = (0, SECOND_DEVICE) if faults.duplicate_node else (0,)
    devices: list[EmulatedDevice] = [
        odrive_device(truth, parts, faults.dbc_version, identity, firmware) for identity in identities
    ]
    settings = [f"enable_watchdog={ENABLE_WATCHDOG}", f"watchdog_timeout={WATCHDOG_TIMEOUT}"]
    settings += [f"node={faults.node}"]
    settings += [f"bitrate={faults.bitrate}"] if faults.bitrate != CanFaults().bitrate else []
    return adapter_emulator(
        devices, link=link, hazards=hazards, port=lambda path: f"{path}?{'&'.join(settings)}"
    )
