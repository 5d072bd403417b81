"""The cart-pole of parts: an ODrive on the belt and a pole encoder node, on one CAN bus."""

from __future__ import annotations

from typing import Any

from deal_hw.clock import Clock
from deal_hw.drivers.cartpole.can_link import accept
from deal_hw.drivers.cartpole.can_robot import CanFrames
from deal_hw.drivers.cartpole.odrive_link import OdriveLink, OdriveSettings
from deal_hw.drivers.cartpole.robot import CartpoleRobot
from deal_hw.drivers.transports.can_bus import CanAddress
from deal_hw.drivers.transports.can_transport import open_can
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.transport import Transport


class OdriveRobot(CartpoleRobot):
    """A cart-pole with an ODrive; the drive's own watchdog is used where its setting's numbers are given.

    Args:
        transport: A stream of CAN frames.
        clock: The clock of the transport's stamps.
        settings: How the parts are joined.
    """

    def __init__(self, transport: Transport, clock: Clock, settings: OdriveSettings) -> None:
        super().__init__(transport, clock, link=lambda: OdriveLink(settings, clock))
        # Without the drive's watchdog it holds its last command for ever, and the operator is told so.
        self.watchdog_s = settings.watchdog_s if settings.enable_watchdog else 0.0  # type: ignore[misc]


def odrive_settings(port: str) -> OdriveSettings:
    """Return what a port says of the parts.

    Raises:
        ConfigurationError: The port means nothing.
    """
    address = CanAddress.parse(port)
    given: dict[str, Any] = {
        "drive": address.node, "encoder": address.encoder, "enable_watchdog": address.enable_watchdog,
        "watchdog_timeout": address.watchdog_timeout,
        "metres_per_turn": None if address.mm_per_turn is None else address.mm_per_turn / 1e3,
        "torque_constant": None if address.kv is None else 8.27 / address.kv,
    }  # fmt: skip
    return OdriveSettings(**{name: value for name, value in given.items() if value is not None})


def odrive_robot(port: str, clock: Clock, fd: int | None = None, *, can_send: bool = True) -> OdriveRobot:
    """Return a cart-pole with an ODrive; nothing is opened yet.

    Args:
        port: Such as ``can0?node=0&encoder=2&enable_watchdog=437&watchdog_timeout=438``.
        clock: Gives the stamps.
        fd: Descriptor of a serial adapter that a parent process opened.
        can_send: False for a robot that is only listened to.

    Raises:
        ConfigurationError: The port means nothing.
    """
    settings = odrive_settings(port)
    frames = CanFrames(open_can(port, clock, accept(settings.drive, settings.encoder), fd))
    return OdriveRobot(frames if can_send else listen_only(frames), clock, settings)
