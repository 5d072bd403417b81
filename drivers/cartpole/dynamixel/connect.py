"""Makes a cart-pole on two servos from a --port text."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from deal_hw.clock import Clock
from deal_hw.documentation import page
from deal_hw.drivers.cartpole.dynamixel.robot import DynamixelCartpole
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import ConfigurationError
from deal_hw.reading import read_json
from deal_hw.schema import from_values
from deal_hw.transport import Transport

SETTINGS_FILE = "settings"


def parse_port(port: str) -> tuple[str, DynamixelSettings]:
    """Return the path and the settings in a port such as ``/dev/ttyUSB0?cart_id=3&settings=servos.json``.

    Values in the port override those in the file.

    Raises:
        ConfigurationError: A setting is unknown or wrong, or the file cannot be read.
    """
    path, _, query = port.partition("?")
    try:
        given = dict(parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query)))
    except ValueError as error:
        raise ConfigurationError(
            f"port {port!r}: write settings after the ? as name=value, joined by &"
        ) from error
    values: dict[str, Any] = {}
    if (file := given.pop(SETTINGS_FILE, None)) is not None:
        values = read_json(
            Path(file),
            dict[str, Any],
            "settings of the servos",
            f"{page('how-to/dynamixel.md')} shows one",
            error=ConfigurationError,
        )
    values |= {name: _value(text) for name, text in given.items()}
    try:
        return path, from_values(DynamixelSettings, values)
    except ConfigurationError as error:
        raise ConfigurationError(f"port {port!r}: {error}") from error


def dynamixel_robot(
    port: str, clock: Clock, fd: int | None = None, *, can_send: bool = True
) -> DynamixelCartpole:
    """Return a cart-pole on two servos; nothing is opened yet.

    Args:
        port: Path of the serial port, with settings after a ``?``.
        clock: Gives the stamps.
        fd: Descriptor of the port that a parent process opened.
        can_send: False for a robot that is only listened to; ``connect`` then refuses.

    Raises:
        ConfigurationError: The port is invalid.
    """
    path, settings = parse_port(port)
    link: Transport
    if fd is None:
        link = SerialTransport(path, settings.baud_rate, clock)
    else:
        link = SerialTransport.from_fd(fd, clock, path, settings.baud_rate)
    return DynamixelCartpole(link if can_send else listen_only(link), clock, settings)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
