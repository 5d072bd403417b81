"""What every verb's settings share: ranges of numbers, and options that have no effect where they are given.

A number of a settings dataclass carries its range in its type::

    seconds: Annotated[float, Range(0.1, 3600, "s")] = 4.0

and :func:`check_ranges`, called in ``__post_init__``, refuses what lies outside. A test sweeps over all
verbs, so a number without a range does not pass.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from deal_hw.errors import ConfigurationError, short


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
        """Check a value; None is one that was not given, and text is not looked at.

        Raises:
            ConfigurationError: A number lies outside, or is none.
        """
        if isinstance(value, tuple):
            for part in value:
                self.check(option, part)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            # Whatever compares with nothing (NaN) lies outside, too.
            if not self.low <= value <= self.high:
                raise ConfigurationError(f"{option} {short(repr(value), 30)}{self._unit}: allowed are {self}")

    @property
    def _unit(self) -> str:
        return f" {self.unit}" if self.unit else ""

    def __str__(self) -> str:
        if self.unit == "s" and self.high < 1:
            return f"{1e3 * self.low:.12g} to {1e3 * self.high:.12g} ms"
        return f"{self.low:.12g} to {self.high:.12g}{self._unit}"


Seed = Annotated[int, Range(0, 2**32 - 1)]
Threads = Annotated[int | None, Range(1, 1024)]
RunSeconds = Annotated[float, Range(0.02, 3600, "s")]
Share = Annotated[float, Range(0, 1)]
Ratio = Range(1.001, 1000)
"""Of a search range: from nominal / range_ratio to nominal * range_ratio."""


class Checked:
    """A settings dataclass without checks of its own beside its ranges."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_ranges(self)


def option(name: str) -> str:
    """Return a field's name as it is typed."""
    return "--" + name.replace("_", "-")


def check_ranges(settings: Any) -> None:
    """Check the numbers of a settings dataclass against the ranges in their types.

    Raises:
        ConfigurationError: One lies outside; the message names option, value and range.
    """
    for name, allowed in ranges(type(settings)):
        allowed.check(option(name), getattr(settings, name))


def ranges(settings: type[Any]) -> Iterator[tuple[str, Range]]:
    """Yield the fields of a settings dataclass that have a range."""
    for name, hint in get_type_hints(settings, include_extras=True).items():
        if get_origin(hint) is Annotated:
            for extra in get_args(hint)[1:]:
                if isinstance(extra, Range):
                    yield name, extra


def given(settings: Any, default: Any, names: Iterable[str] = ()) -> list[str]:
    """Return the options that differ from their defaults.

    Args:
        settings: A settings dataclass.
        default: The same as it is without options.
        names: The fields to look at; all by default.
    """
    fields = tuple(names) or [f.name for f in dataclasses.fields(settings)]
    return [option(name) for name in fields if getattr(settings, name) != getattr(default, name)]


def refuse(options: Iterable[str], reason: str) -> None:
    """Refuse options that would be ignored.

    Args:
        options: Those that were given.
        reason: Where they have an effect, or what to use instead.

    Raises:
        ConfigurationError: There is one.
    """
    if found := list(options):
        raise ConfigurationError(f"{', '.join(found)} would have no effect: {reason}")
