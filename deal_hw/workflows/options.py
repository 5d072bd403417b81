"""Marks of settings, refusals of options without effect, and settings as arguments."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, ParamSpec, TypeVar, overload

from deal_hw.errors import ConfigurationError
from deal_hw.ranges import Range, option
from deal_hw.workflows.kinds import Kinds, one_kind, signature_of


@dataclass(frozen=True)
class OneWord:
    """Marks an option whose values are one word of the command line, separated by commas.

    Attributes:
        parse: Returns the values of the word.
        metavar: How the help names the word.
    """

    parse: Callable[[str], tuple[Any, ...]]
    metavar: str


FROM_PYTHON = "from Python"
"""Marks a field that is no option: only Python can give it."""

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")

File = Path | str
"""A file or folder, by its path."""
MOST_SEEDS: Final = 10_000
"""Most seeds of one range."""

SEEDS: Final = Range(0, 2**32 - 1 - MOST_SEEDS)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text such as ``"0,3,1000-1009"``.

    Raises:
        ConfigurationError: It is not such a text.
    """
    seeds: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        try:
            ends = int(first), int(last if dash else first)
        except ValueError as err:
            raise ConfigurationError(
                f"--seeds {text!r}: give numbers and ranges, such as 0,1 or 1000-1009"
            ) from err
        SEEDS.check("--seeds", ends)
        Range(ends[0], ends[0] + MOST_SEEDS).check("--seeds", ends[1])
        seeds += range(ends[0], ends[1] + 1)
    return tuple(seeds)


Seed = Annotated[int, Range(0, 2**32 - 1)]
Seeds = Annotated[tuple[int, ...], SEEDS, OneWord(parse_seeds, "SEEDS")]
Threads = Annotated[int | None, Range(1, 1024)]
RunSeconds = Annotated[float, Range(0.02, 3600, "s")]
RayPlace = str | None
"""Where tasks run: local, local:N, HOST:PORT or auto; None for this process."""
Share = Annotated[float, Range(0, 1)]
Ratio = Range(1.001, 1000)
"""Of a search range: from nominal / range_ratio to nominal * range_ratio."""


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


@overload
def from_settings(settings: Kinds) -> Callable[[Callable[[Any], R]], Callable[..., R]]: ...


@overload
def from_settings(settings: Callable[P, S]) -> Callable[[Callable[[S], R]], Callable[P, R]]: ...


def from_settings(settings: Any) -> Any:
    """Let a function of settings take them as arguments, with the same checks as the verb.

    Args:
        settings: The settings' class, or the kinds of a verb, from which the arguments choose one. The
            function gets the signature (of all kinds together), and refuses unknown names by
            :class:`UnknownNameError`. Its attribute ``settings`` is the class or the kinds.
    """
    signature = signature_of(settings) if isinstance(settings, Kinds) else inspect.signature(settings)

    kinds = settings if isinstance(settings, Kinds) else one_kind(settings)

    def with_arguments(function: Callable[[Any], R]) -> Callable[..., R]:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> R:
            return function(kinds.make(function.__name__, *args, **kwargs))

        del call.__wrapped__
        call.__signature__ = signature  # type: ignore[attr-defined]
        call.settings = settings  # type: ignore[attr-defined]
        return call

    return with_arguments
