"""Every option of a verb with a value that is not its default, for tests of all options."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal

import tyro

SEVERAL = (Annotated, UnionType, typing.Union)


@dataclass(frozen=True)
class Option:
    """An option as it is typed.

    Attributes:
        name: The field.
        words: Flag and values.
    """

    name: str
    words: tuple[str, ...]

    @property
    def flag(self) -> str:
        """The name as it is typed."""
        return "--" + self.name.replace("_", "-")


def dataclasses_of(hint: Any) -> Iterator[type[Any]]:
    """Yield the dataclasses in a type, those inside them included, but none that no option reaches."""
    if typing.get_origin(hint) in SEVERAL:
        if tyro.conf.Suppress not in typing.get_args(hint)[1:]:
            for part in typing.get_args(hint):
                yield from dataclasses_of(part)
    elif isinstance(hint, type) and dataclasses.is_dataclass(hint):
        yield hint
        for inner in typing.get_type_hints(hint, include_extras=True).values():
            yield from dataclasses_of(inner)


def sub_verb(config: Any, name: str) -> Any:
    """Return the settings of a verb's sub-verb; of a verb without sub-verbs its own."""
    for part in typing.get_args(config) if typing.get_origin(config) in SEVERAL else ():
        if any(getattr(mark, "name", "") == name for mark in typing.get_args(part)[1:]):
            return part
    return config


def options(config: Any, values: Mapping[str, tuple[str, ...]]) -> Iterator[Option]:
    """Yield every option of a verb's settings, each with a value that is not its default.

    Args:
        config: The settings.
        values: Values of options that are no flags, numbers or choices.

    Raises:
        KeyError: Such an option has no value.
    """
    for settings in dataclasses_of(config):
        hints = typing.get_type_hints(settings, include_extras=True)
        for entry in dataclasses.fields(settings):
            hint = hints[entry.name]
            marks = typing.get_args(hint)[1:] if typing.get_origin(hint) is Annotated else ()
            kinds = set(_kinds(hint))
            if any(dataclasses.is_dataclass(kind) for kind in kinds) or tyro.conf.Positional in marks:
                continue
            flag = Option(entry.name, ()).flag
            words = values.get(entry.name)
            if words is None and kinds == {bool}:
                yield Option(entry.name, (f"--no-{flag[2:]}" if entry.default is True else flag,))
                continue
            if words is None:
                words = _other(entry.default, kinds)
            if words is None:
                raise KeyError(f"{settings.__name__}.{entry.name} has no value to try")
            if words:
                yield Option(entry.name, (flag, *words))


def _other(default: Any, kinds: set[Any]) -> tuple[str, ...] | None:
    """Return a number or choice that is not the default."""
    for kind in kinds:
        if typing.get_origin(kind) is Literal:
            return (str(next(one for one in typing.get_args(kind) if one != default)),)
    if kinds <= {int, float, NoneType}:
        return ("2.5",) if float in kinds else ("2",)
    return None


def _kinds(hint: Any) -> Iterator[Any]:
    origin = typing.get_origin(hint)
    if origin is Annotated:
        yield from _kinds(typing.get_args(hint)[0])
    elif origin in SEVERAL:
        for part in typing.get_args(hint):
            yield from _kinds(part)
    else:
        yield hint
