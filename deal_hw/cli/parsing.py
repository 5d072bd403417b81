"""Makes settings from a command line, and the help pages of a verb."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import shutil
import textwrap
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from deal_hw.cli.arguments import CommandLine, check, is_positional, options_of
from deal_hw.cli.verbs import Verb
from deal_hw.documentation import with_places
from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.ranges import option
from deal_hw.workflows.kinds import InputKind, Kinds, MissingKindError, one_kind
from deal_hw.workflows.options import FROM_PYTHON, OneWord

HELP_ALL = "--help-all"
_HELP_WORDS = ("-h", "--help", HELP_ALL)

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
"""Options are named without their group. A field that only Python can set has no option."""


class Rules:
    """Parser rules for settings, beyond their types.

    Files and folders, which Python may also name by a string, are paths. The settings themselves refuse wrong
    choices, with the same words as from Python. An option that is off by default has one flag, one that is on
    has two. A help page names rare options without explaining them.

    Args:
        helps: Whether a help page is made.
        common: Fields that the page explains; all where empty.
        without: A field that the page leaves out, since the usage line has its value.
    """

    def __init__(self, *, helps: bool = False, common: Collection[str] = (), without: str = "") -> None:
        self._without = without
        self._common = common
        self._helps = helps
        self._no_options: list[Any] = []
        self._asks_others = False
        self.rare: list[str] = []
        """Options that the help page only names."""
        self.registry = ConstructorRegistry()
        self.registry.primitive_rule(_choice)
        self.registry.primitive_rule(_path)
        self.registry.primitive_rule(_number)
        self.registry.struct_rule(self._struct)

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
        marks += [_one_word(part) for part in parts[1:] if isinstance(part, OneWord)]
        if FROM_PYTHON in parts[1:]:
            marks.append(tyro.conf.Suppress)
            self._no_options += [kind for kind in parts if dataclasses.is_dataclass(kind)]
        elif field.name == self._without and self._helps:
            marks.append(tyro.conf.Suppress)
            field = dataclasses.replace(field, default=Path() if parts[0] is Path else "")
        elif is_positional(owner, field.name, field.type):
            marks += [tyro.conf.Positional]
            marks[0] = tyro.conf.arg(metavar=field.name.upper(), help_behavior_hint=_default)
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


def _one_word(mark: OneWord) -> PrimitiveConstructorSpec[tuple[Any, ...]]:
    """Return the parser's rule for values in one word, separated by commas."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=mark.metavar,
        instance_from_str=lambda words: mark.parse(words[0]),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [
            ",".join(f"{one:g}" if isinstance(one, float) else str(one) for one in value)
        ],
    )


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


def read_settings(
    name: str,
    verb: Verb,
    config: Any,
    arguments: Sequence[str],
    explain: Callable[[Sequence[str]], None] | None = None,
) -> Any:
    """Return a verb's settings from its command-line arguments.

    Args:
        name: The verb's name.
        verb: The verb.
        config: Its settings, or their kinds.
        arguments: The words behind the verb.
        explain: Called with the words before they are refused; it may raise a better explanation.

    Raises:
        DealHwError: The arguments do not parse, or a setting refuses its value.
        SystemExit: The arguments ask for help; it was printed.
    """
    kinds = config if isinstance(config, Kinds) else one_kind(config)
    words = [word for word in arguments if word not in _HELP_WORDS]
    helps = len(words) < len(arguments)
    every = [one for kind in kinds.table().values() for one in options_of(kind.settings).values()]
    given = CommandLine(words, every)
    if helps and not words and kinds.noun:
        _print_and_exit(kinds_page(name, verb, kinds))
    try:
        word, chosen = kinds.choose(given.arguments)
    except MissingKindError as error:
        if helps:
            _print_and_exit(kinds_page(name, verb, kinds))
        example = f"example: deal-hw {verb.example}; all options: deal-hw {name} --help"
        raise ConfigurationError(f"`deal-hw {name}`: {error}; {example}") from None
    except ConfigurationError:
        if explain is not None:
            explain(words)
        raise
    line = f"deal-hw {name} {chosen.usage or word}".rstrip()
    if kinds.noun and not kinds.argument:
        words.remove(given.positional[0])
    if helps:
        without = "" if chosen.usage else kinds.argument
        common = () if HELP_ALL in arguments else verb.common
        _print_help(verb, chosen, line, example_of(name, verb, chosen), common, without)

    def having(field: str) -> list[str]:
        return [
            f"{name} {kind.usage or one}"
            for one, kind in kinds.table().items()
            if field in options_of(kind.settings)
        ]

    try:
        check(line, words, chosen.settings, having)
    except ConfigurationError as error:
        if explain is not None:
            explain(words)
        page = f"{line} {HELP_ALL if verb.common else '--help'}"
        message = kinds.doubted(given.arguments, str(error))
        raise ConfigurationError(f"{message}; all options: {page}") from None
    several = [entry.name for _, entry, _ in given.given if entry is not None and entry.values is None]
    if len(set(several)) < len(several):
        words = CommandLine(words, options_of(chosen.settings).values()).collected
    return _parsed(chosen.settings, words, line)


def _print_and_exit(page: str) -> NoReturn:
    print(page)
    raise SystemExit(0)


def _parsed(settings: type[Any], words: Sequence[str], line: str) -> Any:
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            return tyro.cli(settings, prog=line, args=words, config=CONFIG, registry=Rules().registry)
    except SystemExit as stop:
        # The parser catches what the settings refuse, and keeps it as the cause.
        cause: BaseException | None = stop
        while cause is not None and not isinstance(cause, DealHwError):
            cause = cause.__context__
        if cause is not None:
            raise cause from None
        raise ConfigurationError(
            f"`{' '.join(words)}` cannot be understood behind `{line}`; options: {line} --help"
        ) from None


def example_of(name: str, verb: Verb, kind: InputKind) -> str:
    """Return a working command line of one kind of a verb's input."""
    return f"deal-hw {verb.example}" if kind.example is None else f"deal-hw {name} {kind.example}".rstrip()


def _print_help(
    verb: Verb, kind: InputKind, line: str, example: str, common: Collection[str], without: str
) -> NoReturn:
    """Print the options of one kind of a verb's input."""
    rules = Rules(helps=True, common=common, without=without)
    text = inspect.cleandoc(kind.settings.__doc__ or "") or f"{verb.help[:1].upper()}{verb.help[1:]}."
    text = f"{text}\n\nExample:  {example}"
    with contextlib.suppress(SystemExit):
        tyro.cli(
            kind.settings,
            prog=line,
            description=text,
            args=["--help"],
            config=CONFIG,
            registry=rules.registry,
        )
    if rules.rare:
        print(rarely_needed(rules.rare, line))
    raise SystemExit(0)


def kinds_page(name: str, verb: Verb, kinds: Kinds) -> str:
    """Return the help of a verb without a kind: the kinds, and how to see the options of one."""
    rows = [
        (
            f"deal-hw {name} {kind.usage or word}".rstrip(),
            kind.help or (kind.settings.__doc__ or "").partition("\n")[0],
        )
        for word, kind in kinds.table().items()
    ]
    width = max(len(usage) for usage, _ in rows)
    lines = [f"{verb.help[:1].upper()}{verb.help[1:]}.", "", f"Example:  deal-hw {verb.example}", ""]
    lines += [f"usage: deal-hw {name} {kinds.noun.upper()} [options]", ""]
    lines += [f"  {usage:<{width}}  {text}".rstrip() for usage, text in rows]
    lines += ["", f"Options: one of these lines with --help, such as  {rows[-1][0]} --help"]
    return "\n".join(lines)
