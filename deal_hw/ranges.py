"""Checks that all settings share: ranges of numbers, and choices.

A number of a settings dataclass carries its range in its type::

    seconds: Annotated[float, Range(0.1, 3600, "s")] = 4.0

and :func:`check_ranges`, called in ``__post_init__``, refuses a number outside its range, and a name that is
none of a ``Literal``. The command line and Python thus refuse the same values with the same words. A test
checks that every number of every verb has a range.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from deal_hw.errors import ConfigurationError, UnknownNameError, short, shown

R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Range:
    """Allowed values of a number, or of each number of a tuple.

    Attributes:
        low: Least value.
        high: Greatest value.
        unit: As messages write it.
    """

    low: float
    high: float
    unit: str = ""

    def check(self, option: str, value: Any) -> None:
        """Check a value. None (not given) and text pass.

        Raises:
            ConfigurationError: A number is outside the range, or is not a number.
        """
        if isinstance(value, tuple):
            for part in value:
                self.check(option, part)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            # Written so that NaN, for which every comparison is false, is refused, too.
            if not self.low <= value <= self.high:
                raise ConfigurationError(f"{option} {short(repr(value), 30)}{self._unit}: allowed are {self}")

    @property
    def _unit(self) -> str:
        return f" {self.unit}" if self.unit else ""

    def __str__(self) -> str:
        if self.unit == "s" and self.high < 1:
            return f"{1e3 * self.low:.12g} to {1e3 * self.high:.12g} ms"
        return f"{self.low:.12g} to {self.high:.12g}{self._unit}"


class Checked:
    """A settings dataclass with no checks beside its ranges."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_ranges(self)


def option(name: str) -> str:
    """Return a field's name as on the command line."""
    return "--" + name.replace("_", "-")


def once_a_class(read: Callable[[Any], R]) -> Callable[[Any], R]:
    """Keep what a function reads from a class; `functools.cache` alone forgets the type of the argument."""
    return functools.cache(read)


@once_a_class
def hints_of(settings: Any) -> dict[str, Any]:
    """Return the types of a class's fields; to make them of the text of annotations takes milliseconds."""
    return get_type_hints(settings, include_extras=True)


def check_ranges(settings: Any) -> None:
    """Check the numbers and choices of a settings dataclass against their types.

    Raises:
        ConfigurationError: A number is outside its range, or is not a number; the message names option, value
            and range.
        UnknownNameError: A name is none of the choices.
    """
    for name, hint in hints_of(type(settings)).items():
        value = getattr(settings, name)
        kinds = set(_kinds(hint))
        if get_origin(hint) is Annotated:
            for allowed in (extra for extra in get_args(hint)[1:] if isinstance(extra, Range)):
                allowed.check(option(name), value)
                _check_number(option(name), value, kinds, allowed)
        choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
        if choices and value is not None and value not in choices:
            raise UnknownNameError(name.replace("_", " "), str(value), map(str, choices))


def _check_number(option: str, value: Any, kinds: set[Any], allowed: Range) -> None:
    """Refuse a value that is no number, which only Python can pass."""
    if isinstance(value, str | Path):
        fine = bool({str, Path} & kinds)
    elif isinstance(value, float):
        fine = float in kinds
    else:
        fine = value is not None or NoneType in kinds
    if not fine:
        number = "number" if float in kinds else "whole number"
        raise ConfigurationError(f"{option} {shown(value)} is no {number}: allowed are {allowed}")


def _kinds(hint: Any) -> Iterator[Any]:
    """Yield the types that a hint names: the members of unions and of tuples."""
    if get_origin(hint) is Annotated:
        yield from _kinds(get_args(hint)[0])
    elif get_origin(hint) in (UnionType, Union, tuple):
        for part in get_args(hint):
            yield from _kinds(part)
    else:
        yield hint
