"""The settings of an emulated ODrive that RxSdo frames read, write and call.

ODrive publishes the numbers of a firmware's settings as ``flat_endpoints.json``; they differ between firmware
versions. The emulated drive has its own numbers, in the same file format: :func:`flat_endpoints`.
"""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple

FIRMWARE: Final = (0, 6, 11)
HARDWARE: Final = (4, 4, 58)
"""Product line, version and variant of an ODrive Pro."""
ENABLE_WATCHDOG, WATCHDOG_TIMEOUT = 437, 438
"""Numbers of the emulated drive's settings; a real one's are in its firmware's flat_endpoints.json."""
SAVE, ERASE, REBOOT, CLEAR_ERRORS, ADC_VOLTAGE = range(5)
"""Functions, by the numbers that the emulated drive gives them."""
_FORMAT: Final = {"bool": "<?", "uint8": "<B", "uint32": "<I", "float": "<f"}


class DriveSetting(NamedTuple):
    """One setting or measurement.

    Attributes:
        number: Its number.
        kind: Its type: bool, uint8, uint32 or float.
        writable: Whether a host may write it.
    """

    number: int
    kind: str
    writable: bool

    def pack(self, value: float) -> bytes:
        """Return a value as the four bytes of an answer."""
        return struct.pack(_FORMAT[self.kind], value).ljust(4, b"\0")

    def unpack(self, data: bytes) -> float | None:
        """Return the value at the beginning of some bytes; None if there are too few."""
        layout = struct.Struct(_FORMAT[self.kind])
        return None if len(data) < layout.size else float(layout.unpack_from(data)[0])


def _numbered(first: int, writable: bool, **kinds: str) -> dict[str, DriveSetting]:
    names = {name.replace("__", "."): kind for name, kind in kinds.items()}
    return {name: DriveSetting(first + k, kind, writable) for k, (name, kind) in enumerate(names.items())}


ENDPOINTS: Final[dict[str, DriveSetting]] = {
    **_numbered(
        100,
        False,
        vbus_voltage="float",
        ibus="float",
        axis0__active_errors="uint32",
        axis0__disarm_reason="uint32",
        axis0__current_state="uint8",
        axis0__pos_estimate="float",
        axis0__vel_estimate="float",
    ),
    **_numbered(
        400,
        True,
        axis0__controller__config__control_mode="uint8",
        axis0__controller__config__input_mode="uint8",
        axis0__controller__config__pos_gain="float",
        axis0__controller__config__vel_gain="float",
        axis0__controller__config__vel_integrator_gain="float",
        axis0__controller__config__vel_integrator_limit="float",
        axis0__controller__config__vel_limit="float",
        axis0__config__motor__current_soft_max="float",
        axis0__config__motor__torque_constant="float",
        axis0__config__can__node_id="uint32",
    ),
    "axis0.config.enable_watchdog": DriveSetting(ENABLE_WATCHDOG, "bool", True),
    "axis0.config.watchdog_timeout": DriveSetting(WATCHDOG_TIMEOUT, "float", True),
}
"""Settings and measurements of the emulated drive, by the names of ODrive's reference."""
_FUNCTIONS: Final[dict[str, tuple[int, list[tuple[str, str]], list[tuple[str, str]]]]] = {
    "save_configuration": (SAVE, [], [("success", "bool")]),
    "erase_configuration": (ERASE, [], []),
    "reboot": (REBOOT, [], []),
    "clear_errors": (CLEAR_ERRORS, [], []),
    "get_adc_voltage": (ADC_VOLTAGE, [("gpio", "uint32")], [("voltage", "float")]),
}


def flat_endpoints() -> dict[str, Any]:
    """Return the content of the emulated drive's ``flat_endpoints.json``."""
    listed: dict[str, Any] = {
        name: {"id": e.number, "type": e.kind, "access": "rw" if e.writable else "r"}
        for name, e in ENDPOINTS.items()
    }
    for name, (number, inputs, outputs) in _FUNCTIONS.items():
        listed[name] = {
            "id": number,
            "type": "function",
            "inputs": [{"name": n, "type": t} for n, t in inputs],
            "outputs": [{"name": n, "type": t} for n, t in outputs],
        }
    version = ".".join(map(str, FIRMWARE))
    return {"fw_version": version, "hw_version": ".".join(map(str, HARDWARE)), "endpoints": listed}
