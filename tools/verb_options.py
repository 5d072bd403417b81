"""Every option of a verb with a value that is not its default, for tests of all options."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal

import tyro

from deal_hw.cli.arguments import CommandLine, options_of
from deal_hw.workflows.kinds import Kinds
from deal_hw.workflows.options import FROM_PYTHON

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
    if isinstance(hint, Kinds):
        for kind in hint.table().values():
            yield from dataclasses_of(kind.settings)
    elif typing.get_origin(hint) in SEVERAL:
        if not {tyro.conf.Suppress, FROM_PYTHON} & set(typing.get_args(hint)[1:]):
            for part in typing.get_args(hint):
                yield from dataclasses_of(part)
    elif isinstance(hint, type) and dataclasses.is_dataclass(hint):
        yield hint
        for inner in typing.get_type_hints(hint, include_extras=True).values():
            yield from dataclasses_of(inner)


def kind_of(config: Any, *words: str) -> Any:
    """Return the settings that words behind a verb are for: those of a kind, or the only ones."""
    if not isinstance(config, Kinds):
        return config
    every = [one for kind in config.table().values() for one in options_of(kind.settings).values()]
    return config.choose(CommandLine(words, every).arguments)[1].settings


def options(config: Any, values: Mapping[str, tuple[str, ...]]) -> Iterator[Option]:
    """Yield every option of a verb's settings, each with a value that is not its default.

    Args:
        config: The settings.
        values: Values of options that are no flags, numbers or choices.

    Raises:
        KeyError: Such an option has no value.
    """
    for settings in dict.fromkeys(dataclasses_of(config)):
        defaults = {entry.name: entry.default for entry in dataclasses.fields(settings)}
        for one in options_of(settings).values():
            if one.positional or one.owner is not settings:
                continue
            words = values.get(one.name)
            if words is None and one.values == 0:
                yield Option(one.name, one.flags[-1:])
                continue
            if words is None:
                words = _other(defaults[one.name], set(one.kinds))
            if words is None:
                raise KeyError(f"{settings.__name__}.{one.name} has no value to try")
            if words:
                yield Option(one.name, (one.flags[0], *words))


def _other(default: Any, kinds: set[Any]) -> tuple[str, ...] | None:
    """Return a number or choice that is not the default."""
    for kind in kinds:
        if typing.get_origin(kind) is Literal:
            return tuple(str(one) for one in typing.get_args(kind) if one != default)[:1]
    if kinds <= {int, float, NoneType}:
        return ("2.5",) if float in kinds else ("2",)
    return None
