"""The cart-pole of parts: an ODrive on the belt and a pole encoder node, on one CAN bus."""

from __future__ import annotations

from typing import ClassVar, Final

from deal_hw.clock import Clock
from deal_hw.drivers.cartpole.robots.can_robot import CanFrames
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire.can_link import accept
from deal_hw.drivers.cartpole.wire.odrive_link import WATCHDOG_S, OdriveLink, OdriveSettings
from deal_hw.drivers.transports.can_bus import take_settings
from deal_hw.drivers.transports.can_transport import open_can
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.transport import Transport

_LOWEST: Final = {
    "node": 0,
    "encoder": 1,
    "mm_per_turn": 1,
    "kv": 1,
    "enable_watchdog": 1,
    "watchdog_timeout": 1,
}
"""Settings that a port may give, and the lowest value of each."""


class OdriveRobot(CartpoleRobot):
    """A cart-pole with an ODrive; the drive's own watchdog is used where its setting's numbers are given.

    Args:
        transport: A stream of CAN frames.
        clock: The clock of the transport's stamps.
        settings: Numbers and mechanics of the parts.
    """

    stopped_by: ClassVar[str] = "the power supply of its drive"

    def __init__(self, transport: Transport, clock: Clock, settings: OdriveSettings) -> None:
        super().__init__(transport, clock, link=lambda: OdriveLink(settings, clock))
        # Without its watchdog the drive holds its last command for ever; the operator gets a warning.
        self.watchdog_s = WATCHDOG_S if settings.enable_watchdog else 0.0  # type: ignore[misc]


def odrive_settings(port: str) -> tuple[str, OdriveSettings]:
    """Return the bus of a port, and the settings of the parts in it.

    Args:
        port: Such as ``can0?node=5&mm_per_turn=60&kv=150``: numbers on the bus, travel of the cart for one
            turn of the motor [mm], the motor's constant [rev/min/V], numbers of the drive's watchdog
            settings.

    Raises:
        ConfigurationError: The port is not valid.
    """
    bus, given = take_settings(port, _LOWEST)
    settings = OdriveSettings()
    return bus, OdriveSettings(
        drive=given.get("node", settings.drive),
        encoder=given.get("encoder", settings.encoder),
        metres_per_turn=given["mm_per_turn"] / 1e3 if "mm_per_turn" in given else settings.metres_per_turn,
        torque_constant=8.27 / given["kv"] if "kv" in given else settings.torque_constant,
        enable_watchdog=given.get("enable_watchdog", 0),
        watchdog_timeout=given.get("watchdog_timeout", 0),
    )


def odrive_bus(port: str) -> tuple[str, tuple[int, int]]:
    """Return the bus of a port, and the numbers of drive and encoder on it.

    Raises:
        ConfigurationError: The port is not valid.
    """
    bus, settings = odrive_settings(port)
    return bus, (settings.drive, settings.encoder)


def odrive_robot(port: str, clock: Clock, fd: int | None = None, *, can_send: bool = True) -> OdriveRobot:
    """Return a cart-pole with an ODrive; nothing is opened yet.

    Args:
        port: Such as ``can0?node=0&encoder=2&enable_watchdog=437&watchdog_timeout=438``.
        clock: Gives the stamps.
        fd: Descriptor of a serial adapter that a parent process opened.
        can_send: False for a robot that is only listened to.

    Raises:
        ConfigurationError: The port is not valid.
    """
    bus, settings = odrive_settings(port)
    frames = CanFrames(open_can(bus, clock, accept(settings.drive, settings.encoder), fd))
    return OdriveRobot(frames if can_send else listen_only(frames), clock, settings)
