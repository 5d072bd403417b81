"""The largest values that a quantity of a robot has: one table, for all files that hold such numbers.

A number beyond them is a slip of the pen, a wrong unit or an attack, and arithmetic with it overflows. The
bounds lie far beyond any robot, so that no honest file meets them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from deal_hw.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Bound:
    """What a quantity may be.

    Attributes:
        unit: Its unit.
        most: Largest amount, in the unit.
        why: What real robots have, and so the reason.
        signed: Whether it may be below 0.
    """

    unit: str
    most: float
    why: str
    signed: bool = True

    @property
    def least(self) -> float:
        """Least value, in the unit."""
        return -self.most if self.signed else 0.0

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g}{_after(self.unit)}"

    def holds(self, value: float) -> bool:
        """Return whether a value is inside; NaN is not."""
        return self.least <= value <= self.most


_BOUNDS: Final = (
    Bound("rad", 1e5, "a wheel at 100 rad/s turns so far in 17 minutes; limbs turn a few times"),
    Bound("m", 1e4, "rails and gantries have some 100 m"),
    Bound("rad/s", 1e4, "the fastest joints of robots have 100 rad/s, a motor's own rotor 3000"),
    Bound("m/s", 1e3, "the fastest linear drives have 20 m/s"),
    Bound("N·m", 1e7, "the strongest robot arms have 1e4, the slew drive of an excavator 1e6"),
    Bound("N", 1e8, "a hydraulic cylinder has 1e6"),
    Bound("N·m/rad", 1e9, "stiff drives have 1e5; 1 mrad of 1e9 is more than any torque above"),
    Bound("N/m", 1e10, "as above, for a slide: steel rods of robots have 1e8"),
    Bound("N·m·s/rad", 1e8, "a tenth of a second of the stiffness"),
    Bound("N·s/m", 1e9, "as above, for a slide"),
    Bound("kg", 1e6, "a large excavator, all of it", signed=False),
    Bound("kg·m²", 1e6, "a rotor of 1 kg·m² behind a gear of 1000", signed=False),
    Bound("s", 1e3, "delays and lags of robots are below 1 s", signed=False),
    Bound("Hz", 1e6, "the current loops of motors run at 100 kHz", signed=False),
)
BOUNDS: Final[Mapping[str, Bound]] = MappingProxyType({bound.unit: bound for bound in _BOUNDS})
"""The bound of each unit."""
SENSOR: Final[Mapping[str, Bound]] = MappingProxyType(
    {
        "rad": Bound("rad", 2 * math.pi, "noise or steps of more than a turn measure nothing", signed=False),
        "m": Bound("m", 10.0, "so far off are satellite receivers", signed=False),
    }
)
"""The bound of noise and steps of a position sensor, by its unit."""
_OTHER: Final = 1e12
"""Largest amount of a quantity whose unit is not in the table, such as a factor."""


def bound_of(unit: str) -> Bound:
    """Return the bound of a quantity; of an unknown unit a wide one."""
    return BOUNDS.get(unit) or Bound(unit, _OTHER, "factors and powers of speeds")


def check_amount(what: str, value: float, unit: str) -> None:
    """Check that a quantity is physically possible.

    Args:
        what: Its name for the message.
        value: Its value.
        unit: Its unit.

    Raises:
        ConfigurationError: It is not; the message says what is allowed.
    """
    bound = bound_of(unit)
    if not bound.holds(value):
        allowed = f"up to {bound.most:g}{_after(unit)}" if value > bound.most else str(bound)
        raise ConfigurationError(f"{what} is {value:g}{_after(unit)}; allowed: {allowed} ({bound.why})")


def _after(unit: str) -> str:
    return "" if unit == "-" else f" {unit}"
