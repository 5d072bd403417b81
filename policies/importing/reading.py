"""Values of a side file or of metadata, checked one by one: a wrong one is named with what is allowed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from deal_hw.errors import ConfigurationError, shown
from deal_hw.reading import number, object_of
from deal_hw.schema import either


def section(values: Any, what: str, known: Iterable[str], needed: Iterable[str] = ()) -> Mapping[str, Any]:
    """Return a section of a file with its keys checked: an unknown key could change the meaning of others.

    Raises:
        ConfigurationError: It is no section, has an unknown key, or lacks one.
    """
    found = object_of(values, what)
    allowed = sorted(known)
    for key in found:
        if key not in allowed:
            raise ConfigurationError(
                f"{what}: key {shown(key)} is unknown; known are {either(allowed)}; it may change what the "
                "policy means, so remove it only if it does not"
            )
    for key in needed:
        if found.get(key) is None:
            raise ConfigurationError(f"{what}: {key} is missing")
    return found


def row(values: Any, what: str, length: int) -> tuple[float, ...]:
    """Return a list of finite numbers; one number stands for all.

    Raises:
        ConfigurationError: It is something else, or has another length.
    """
    if isinstance(values, int | float) and not isinstance(values, bool):
        return (number(values, what),) * length
    if not isinstance(values, list | tuple):
        raise ConfigurationError(f"{what} must be a list of {length} numbers, got {shown(values)}")
    if len(values) != length:
        raise ConfigurationError(f"{what} has {len(values)} numbers; {length} belong there")
    return tuple(number(value, f"{what}[{i}]") for i, value in enumerate(values))


def span(values: Any, what: str) -> tuple[float, float]:
    """Return a pair of numbers, the lowest first; errors as :func:`row`."""
    low, high = row(values if isinstance(values, list | tuple) else None, what, 2)
    if low > high:
        raise ConfigurationError(f"{what} goes from {low:g} down to {high:g}; the lowest comes first")
    return low, high


def whole(value: Any, what: str, low: int, high: int) -> int:
    """Return a whole number in [low, high].

    Raises:
        ConfigurationError: It is something else.
    """
    found = number(value, what, low, high)
    if found != math.floor(found):
        raise ConfigurationError(f"{what} must be a whole number, got {shown(value)}")
    return int(found)


def flag(value: Any, what: str) -> bool:
    """Return a truth value.

    Raises:
        ConfigurationError: It is something else.
    """
    if not isinstance(value, bool):
        raise ConfigurationError(f"{what} must be true or false, got {shown(value)}")
    return value


def motor_names(values: Any, what: str, motors: Sequence[str], robot: str) -> tuple[str, ...]:
    """Return the joints of a list of motor numbers, in its order.

    Raises:
        ConfigurationError: A number is no motor's or comes twice, or the motors' order is not known.
    """
    if not isinstance(values, list | tuple) or not values:
        raise ConfigurationError(f"{what} must be a list of motor numbers, got {shown(values)}")
    if not motors:
        raise ConfigurationError(
            f"{what} has numbers of motors, whose joints are not known for robot {robot!r}; name its joints "
            "in the order of the vendor's motor numbers: --motors NAME,NAME,..."
        )
    found = [whole(v, f"{what}[{i}]", 0, len(motors) - 1) for i, v in enumerate(values)]
    for number_, count in ((n, found.count(n)) for n in found):
        if count > 1:
            raise ConfigurationError(f"{what}: motor {number_} comes {count} times; each has one joint")
    return tuple(motors[n] for n in found)
