"""Checks that all settings share: ranges of numbers, choices, and options without effect.

A number of a settings dataclass carries its range in its type::

    seconds: Annotated[float, Range(0.1, 3600, "s")] = 4.0

and :func:`check_ranges`, called in ``__post_init__``, refuses a number outside its range, and a name that is
none of a ``Literal``. The command line and Python thus refuse the same values with the same words. A test
checks that every number of every verb has a range.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from deal_hw.errors import ConfigurationError, UnknownNameError, short, shown


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


@dataclass(frozen=True, slots=True)
class Only:
    """Marks an option, or a group of options, of some robots or benches only.

    The help shows the option if one of these names is on the command line. For other names the settings, or
    the verb, refuse it.

    Attributes:
        names: Names of robots or benches.
    """

    names: tuple[str, ...]


CARTPOLE = Only(("cartpole",))
GO2 = Only(("go2", "go2_on_stand"))
OWN_ROBOT = Only(("robot.yaml",))


P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")

File = Path | str
"""A file or folder, by its path."""
Seed = Annotated[int, Range(0, 2**32 - 1)]
Threads = Annotated[int | None, Range(1, 1024)]
RunSeconds = Annotated[float, Range(0.02, 3600, "s")]
Share = Annotated[float, Range(0, 1)]
Ratio = Range(1.001, 1000)
"""Of a search range: from nominal / range_ratio to nominal * range_ratio."""


class Checked:
    """A settings dataclass with no checks beside its ranges."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_ranges(self)


def option(name: str) -> str:
    """Return a field's name as on the command line."""
    return "--" + name.replace("_", "-")


def check_ranges(settings: Any) -> None:
    """Check the numbers and choices of a settings dataclass against their types.

    Raises:
        ConfigurationError: A number is outside its range, or is not a number; the message names option, value
            and range.
        UnknownNameError: A name is none of the choices.
    """
    for name, hint in get_type_hints(type(settings), include_extras=True).items():
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


def given(settings: Any, default: Any, names: Iterable[str] | None = None) -> list[str]:
    """Return the options that differ from their defaults, those of groups included.

    Args:
        settings: A settings dataclass.
        default: The same dataclass without options.
        names: The fields to compare; all by default.
    """
    fields = [f.name for f in dataclasses.fields(settings)] if names is None else names
    found: list[str] = []
    for name in fields:
        value, usual = getattr(settings, name), getattr(default, name)
        if dataclasses.is_dataclass(value):
            found += given(value, usual)
        elif value != usual:
            found.append(option(name))
    return found


def refuse(options: Iterable[str], reason: str) -> None:
    """Refuse options that would have no effect.

    Args:
        options: The given options.
        reason: When they have an effect, or what to use instead.

    Raises:
        ConfigurationError: At least one option was given.
    """
    if found := list(options):
        raise ConfigurationError(f"{', '.join(found)} would have no effect: {reason}")


def refuse_others(settings: Any, verb: str, name: str) -> None:
    """Refuse options that are marked as :class:`Only` for other robots or benches.

    Args:
        settings: A settings dataclass, or a marked group inside it.
        verb: The verb, as on the command line.
        name: The robot or bench.

    Raises:
        ConfigurationError: Such an option was given.
    """
    hints = get_type_hints(type(settings), include_extras=True)
    found: dict[Only, list[str]] = {}
    for entry in dataclasses.fields(settings):
        factory = entry.default_factory
        default = SimpleNamespace(
            **{entry.name: entry.default if factory is dataclasses.MISSING else factory()}
        )
        for only in (part for part in get_args(hints[entry.name])[1:] if isinstance(part, Only)):
            if name not in only.names:
                found.setdefault(only, []).extend(given(settings, default, [entry.name]))
    for only, names in found.items():
        refuse(names, f"only {' and '.join(f'`{verb} {other}`' for other in only.names)} can use that")


def from_settings(settings: Callable[P, S]) -> Callable[[Callable[[S], R]], Callable[P, R]]:
    """Let a function of settings take them as arguments, with the same checks as the verb.

    Args:
        settings: The settings' class; the function gets its signature, and refuses unknown names by
            :class:`UnknownNameError`. The function's attribute ``settings`` is the class, for the reference.
    """
    signature = inspect.signature(settings)

    def with_arguments(function: Callable[[S], R]) -> Callable[P, R]:
        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in kwargs:
                if name not in signature.parameters:
                    raise UnknownNameError(f"argument of {function.__name__}", name, signature.parameters)
            return function(settings(*args, **kwargs))

        del call.__wrapped__
        call.__signature__ = signature  # type: ignore[attr-defined]
        call.settings = settings  # type: ignore[attr-defined]
        return call

    return with_arguments
