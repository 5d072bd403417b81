"""Makes a command line from settings: values from arguments, and a help page for the named robot."""

from __future__ import annotations

import dataclasses
import re
import shutil
import textwrap
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from deal_hw.documentation import with_places
from deal_hw.errors import ConfigurationError
from deal_hw.ranges import option
from deal_hw.workflows.options import OWN_ROBOT, Only

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
"""Options are named without their group, and what only Python can give is no option."""


class Rules:
    """Parser rules for settings, beyond their types.

    Files and folders, which Python may also name by a string, are paths. The settings themselves refuse wrong
    choices, with the same words as from Python. An option that is off by default has one flag, one that is on
    has two. A help page hides options of other robots or benches; they are still parsed, so that the settings
    can refuse them. It names rare options without explaining them.

    Args:
        words: The arguments, which may contain --help, and name a robot or a bench.
        common: Fields that --help explains; all where empty.
        choices: Whether the parser knows the choices, to complete them; it then refuses others by itself.
    """

    def __init__(
        self, words: Sequence[str] = (), common: Collection[str] = (), *, choices: bool = False
    ) -> None:
        self._named = set(words)
        self._common = common
        self._helps = bool({"-h", "--help"} & self._named)
        if any(word.endswith((".yaml", ".yml")) for word in words):
            self._named |= set(OWN_ROBOT.names)
        self._no_options: list[Any] = []
        self._asks_others = False
        self.hidden: set[str] = set()
        """Names whose own options were not shown."""
        self.rare: list[str] = []
        """Options that the help page only names."""
        self.registry = ConstructorRegistry()
        if not choices:
            self.registry.primitive_rule(_choice)
        self.registry.primitive_rule(_path)
        self.registry.primitive_rule(_number)
        self.registry.struct_rule(self._struct)

    def hides(self, hint: Any) -> set[str]:
        """Return the names that an option type is for, if the page hides it; else nothing."""
        names = {name for part in get_args(hint)[1:] if isinstance(part, Only) for name in part.names}
        return names if self._helps and not self._named & names else set()

    def _struct(self, info: StructTypeInfo) -> StructConstructorSpec | None:
        if self._asks_others or not dataclasses.is_dataclass(info.type):
            return None
        self._asks_others = True
        try:
            found = ConstructorRegistry.get_struct_spec(info)
        finally:
            self._asks_others = False
        if not isinstance(found, StructConstructorSpec):
            # A default of another type, which the parser's own rule handles.
            return None
        return dataclasses.replace(
            found, fields=tuple(self._field(field, info.type) for field in found.fields)
        )

    def _field(self, field: StructFieldSpec, owner: Any) -> StructFieldSpec:
        parts = get_args(field.type) if get_origin(field.type) is Annotated else (field.type,)
        marks: list[Any] = [tyro.conf.arg(metavar=_metavar(field.name, parts), help_behavior_hint=_default)]
        if others := self.hides(field.type):
            marks.append(tyro.conf.Suppress)
            self.hidden |= others
            self._no_options += [kind for kind in parts if dataclasses.is_dataclass(kind)]
        elif self._helps and self._is_rare(field.name, parts, owner):
            marks.append(tyro.conf.Suppress)
            self.rare += [flag] if (flag := option(field.name)) not in self.rare else []
        if field.default is False:
            marks.append(tyro.conf.FlagCreatePairsOff)
        text = field.helptext() if callable(field.helptext) else field.helptext
        annotated = (field.type, *marks)
        kind: Any = Annotated[annotated]
        return dataclasses.replace(
            field, type=kind, helptext=with_places(" ".join(text.split())) if text else text
        )

    def _is_rare(self, name: str, parts: tuple[Any, ...], owner: Any) -> bool:
        groups = [kind for kind in (parts[0], *get_args(parts[0])) if dataclasses.is_dataclass(kind)]
        if owner in self._no_options or tyro.conf.Suppress in parts[1:]:
            # What is inside a group without options is none, either.
            self._no_options += groups
            return False
        if tyro.conf.Positional in parts[1:] or groups or get_origin(parts[0]) is Callable:
            return False
        return bool(self._common) and name not in self._common


def rarely_needed(rare: Sequence[str], line: str) -> str:
    """Return the end of a help page: options that it only names.

    Args:
        rare: The options.
        line: The command whose help page explains them.
    """
    width = min(shutil.get_terminal_size().columns, 100)
    text = f"Rarely needed (explained by {line} --help-all): {', '.join(rare)}"
    return textwrap.fill(text, width, break_on_hyphens=False, break_long_words=False)


def _metavar(name: str, parts: tuple[Any, ...]) -> str | None:
    """Return the help page's placeholder of a value; None: the parser's own."""
    if tyro.conf.Positional in parts[1:]:
        return name.upper()
    kinds = set(get_args(parts[0])) if get_origin(parts[0]) in (Union, UnionType) else set()
    # An optional file, which Python may also name by a string.
    kinds -= {str} if Path in kinds else set()
    if NoneType not in kinds or len(kinds) != 2:
        return None
    (kind,) = kinds - {NoneType}
    if get_origin(kind) is Literal:
        return f"{{{','.join(map(str, get_args(kind)))}}}"
    return "True|False" if kind is bool else str(getattr(kind, "__name__", kind)).upper()


def _default(label: str) -> str:
    """Return the help page's text on a default; empty for a default that is empty or off."""
    if label == "True":
        return "(on by default)"
    return "" if label in ("", "''", "None", "False") else f"(default: {label})"


def _choice(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[str] | None:
    choices = get_args(info.type)
    if get_origin(info.type) is not Literal or not all(isinstance(one, str) for one in choices):
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(choices)}}}",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    )


def _path(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path | str | None] | None:
    optional = info.type == Path | str | None
    if not optional and info.type != Path | str:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: None if optional and words[0] == "None" else Path(words[0]),
        is_instance=lambda value: isinstance(value, Path | str) or (optional and value is None),
        str_from_instance=lambda value: [str(value)],
    )


def _number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[float | None] | None:
    """Parse a number; the parser's own rule reports a wrong optional one twice, as None and as a number."""
    if info.type not in (int, float, int | None, float | None):
        return None
    kind: type[int] | type[float] = int if info.type in (int, int | None) else float
    optional = info.type is not kind

    def read(words: list[str]) -> float | None:
        if optional and words[0] == "None":
            return None
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"{words[0]!r} is no {'whole ' if kind is int else ''}number") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: (optional and value is None) or isinstance(value, int | float),
        str_from_instance=lambda value: [str(value)],
    )


def unparsed(printed: str, line: str, example: str, *, shortened: bool) -> ConfigurationError:
    """Return the parser's error as one line.

    Args:
        printed: What the parser printed: a title, the error, mostly an explanation, and the help page; rules
            lie between them.
        line: The command without its arguments, such as `deal-hw collect`.
        example: Working arguments, the verb included.
        shortened: Whether --help explains the common options only.
    """
    _, *parts, page = (" ".join(part.split()) for part in re.split("-{10,}", printed))
    page = "deal-hw" + page.partition("deal-hw")[2]
    parts = [part.removeprefix("Argument helptext: ").removesuffix(".") for part in parts]
    if page == f"{line} --help":
        # The example of a verb with sub-verbs is not one of each sub-verb.
        parts.append(f"example: deal-hw {example}")
    return ConfigurationError("; ".join([*parts, f"all options: {page}{'-all' * shortened}"]))
