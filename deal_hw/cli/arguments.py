"""Reads a command line by the options of a verb: which kind of input it names, and what is wrong with it.

The parser prints a box around an error, for people. So everything that it would refuse is found here before.
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import itertools
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from deal_hw.errors import ConfigurationError, short
from deal_hw.ranges import hints_of, once_a_class, option
from deal_hw.workflows.kinds import Arguments, groups, has, listed
from deal_hw.workflows.options import FROM_PYTHON, OneWord

BOOLEANS = ("True", "False")


@dataclass(frozen=True, slots=True)
class Option:
    """An option or argument of a verb.

    Attributes:
        name: The field.
        owner: The settings with that field.
        kinds: Types of its value; of each value, if there may be several.
        values: How many values it takes; 0 for a flag, None for any number.
        row: Types of the values of an entry, where each has several: a name and two numbers. Empty otherwise.
        required: Whether it must be given.
        positional: Whether it is an argument without a name.
        on: Whether it is a flag that is on by default, which ``--no-NAME`` switches off.
    """

    name: str
    owner: type[Any]
    kinds: tuple[Any, ...]
    values: int | None
    row: tuple[type, ...]
    required: bool
    positional: bool
    on: bool

    @property
    def flags(self) -> tuple[str, ...]:
        """The words that give it; none for an argument."""
        if self.positional:
            return ()
        flag = option(self.name)
        return (flag, f"--no-{flag[2:]}") if self.on else (flag,)

    @property
    def shown(self) -> str:
        """Its name in messages."""
        return self.name.upper() if self.positional else option(self.name)

    @property
    def choices(self) -> tuple[str, ...]:
        """The names that it takes; empty if it takes others."""
        found = [one for kind in self.kinds if get_origin(kind) is Literal for one in get_args(kind)]
        return BOOLEANS if bool in self.kinds and self.values else tuple(map(str, found))

    def check(self, values: Sequence[str]) -> None:
        """Refuse values of the wrong type or number; the settings check ranges and choices.

        Raises:
            ConfigurationError: A value is no number, or neither True nor False, or an entry lacks one.
        """
        if self.row and len(values) % len(self.row):
            raise ConfigurationError(
                f"{self.shown} takes {len(self.row)} values each, and {short(' '.join(values))!r} is "
                f"{len(values)}; {self.meaning}"
            )
        for number, value in enumerate(values):
            self._check(value, (self.row[number % len(self.row)],) if self.row else self.kinds)

    def _check(self, value: str, allowed: Sequence[Any]) -> None:
        if NoneType in allowed and value == "None":
            return
        kinds = set(allowed) - {NoneType}
        wrong = ""
        if kinds == {bool} and value not in BOOLEANS:
            wrong = "is neither True nor False"
        elif kinds <= {int, float}:
            try:
                (float if float in kinds else int)(value)
            except ValueError:
                wrong = "is no number" if float in kinds else "is no whole number"
        if wrong:
            raise ConfigurationError(f"{self.shown}: {short(value)!r} {wrong}; {self.meaning}")

    @property
    def meaning(self) -> str:
        """What it is, for the end of a message."""
        return f"{self.shown} is: {_meaning(self.owner, self.name)}".rstrip(". ")


@once_a_class
def options_of(settings: Any) -> Mapping[str, Option]:
    """Return the options and arguments of settings by field name, those of groups included."""
    found: dict[str, Option] = {}
    hints = hints_of(settings)
    for entry in dataclasses.fields(settings):
        hint = hints[entry.name]
        kinds = tuple(_kinds(hint))
        if not is_option(hint):
            continue
        if inner := list(groups(hint)):
            for group in inner:
                found |= options_of(group)
            continue
        tuples = [kind for kind in kinds if get_origin(kind) is tuple]
        count: int | None = 0 if kinds == (bool,) else 1
        row: tuple[type, ...] = ()
        for several in tuples:
            parts = get_args(several)
            endless = parts[-1] is Ellipsis
            count = None if endless or count is None else len(parts)
            kinds = tuple(_kinds(parts[0])) if endless or len(set(parts)) == 1 else (str,)
            if get_origin(parts[0]) is tuple:
                kinds, row = (str,), get_args(parts[0])
        if any(isinstance(mark, OneWord) for mark in get_args(hint)[1:]):
            # It has a parser of its own, such as for several numbers in one word.
            kinds, count, row = (str,), 1, ()
        missing = dataclasses.MISSING
        found[entry.name] = Option(
            name=entry.name,
            owner=settings,
            kinds=kinds,
            values=count,
            row=row,
            required=entry.default is missing and entry.default_factory is missing,
            positional=is_positional(settings, entry.name, hint),
            on=count == 0 and entry.default is True,
        )
    return MappingProxyType(found)


def is_positional(owner: Any, name: str, hint: Any) -> bool:
    """Return whether a field is an argument without a name: marked so, or not keyword-only."""
    fields: Mapping[str, Any] = getattr(owner, "__dataclass_fields__", {})
    if _is_marked(hint, "Positional"):
        return True
    return name in fields and not fields[name].kw_only and any(one.kw_only for one in fields.values())


def is_option(hint: Any) -> bool:
    """Return whether the command line has a field: not one that only Python can give."""
    marks = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    return (
        not _is_marked(hint, "Suppress")
        and FROM_PYTHON not in marks
        and not any(get_origin(kind) is Callable for kind in _kinds(hint))
    )


def _is_marked(hint: Any, mark: str) -> bool:
    """Return whether a field has a mark of the parser, which is then loaded; an urgent verb loads it not."""
    marks = sys.modules.get("tyro.conf")
    return marks is not None and getattr(marks, mark) in get_args(hint)[1:]


def _kinds(hint: Any) -> Iterator[Any]:
    """Yield the types that a field takes."""
    if get_origin(hint) is Annotated:
        yield from _kinds(get_args(hint)[0])
    elif get_origin(hint) in (UnionType, Union):
        for part in get_args(hint):
            yield from _kinds(part)
    else:
        yield hint


def _meaning(owner: type[Any], name: str) -> str:
    """Return a field's description on one line, from the sources."""
    return next((text for part in owner.__mro__ if (text := _meanings(part).get(name))), "")


@once_a_class
def _meanings(settings: Any) -> dict[str, str]:
    """Return the descriptions of a class's own fields; empty if it has no source."""
    try:
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(settings))).body
    except (OSError, TypeError):
        return {}
    found: dict[str, str] = {}
    for line, text in itertools.pairwise(tree.body if isinstance(tree, ast.ClassDef) else []):
        value = text.value if isinstance(text, ast.Expr) else None
        if (
            isinstance(line, ast.AnnAssign)
            and isinstance(value, ast.Constant)
            and isinstance(value.value, str)
        ):
            found.setdefault(getattr(line.target, "id", ""), " ".join(value.value.split()))
    return found


def _is_option_word(word: str) -> bool:
    """Return whether a word is an option, and not a value such as -1."""
    return word.startswith("--") or (word.startswith("-") and word[1:2].isalpha())


class CommandLine:
    """The words behind a verb, by the options of its kinds.

    Args:
        words: The words.
        known: The options that its kinds have together, by field name.
    """

    def __init__(self, words: Sequence[str], known: Iterable[Option]) -> None:
        flags = {flag: one for one in known for flag in one.flags}
        self.positional: list[str] = []
        self.given: list[tuple[str, Option | None, list[str]]] = []
        """Each option word, what it is (None if unknown), and its values, in order."""
        room: int | None = 0
        for word in words:
            name, equals, value = word.partition("=")
            if _is_option_word(word):
                entry = flags.get(name.replace("_", "-"))
                self.given.append((name, entry, [value] if equals else []))
                room = 0 if equals else 1 if entry is None else entry.values
            elif room is None or room > 0:
                self.given[-1][2].append(word)
                room = None if room is None else room - 1
            else:
                self.positional.append(word)

    @property
    def arguments(self) -> Arguments:
        """What was given, to find the kind by."""
        options: dict[str, Any] = {}
        for flag, entry, values in self.given:
            if entry is not None:
                value: Any = values if entry.values is None or entry.values > 1 else "".join(values)
                options[entry.name] = (not flag.startswith("--no-")) if entry.values == 0 else value
        return Arguments(self.positional[0] if self.positional else None, options)

    @property
    def collected(self) -> list[str]:
        """The words, with the values of an option that takes any number behind its first word.

        ``--range a 1 2 --range b 3 4`` names two ranges. The parser would take the last one alone.
        """
        endless: dict[str, list[str]] = {}
        found: list[list[str]] = [self.positional]
        for flag, entry, values in self.given:
            if entry is None or entry.values is not None:
                found.append([f"{flag}={values[0]}"] if len(values) == 1 else [flag, *values])
            elif entry.name in endless:
                endless[entry.name] += values
            else:
                endless[entry.name] = [flag, *values]
                found.append(endless[entry.name])
        return [word for words in found for word in words]


def check(line: str, words: Sequence[str], settings: type[Any], others: Callable[[str], list[str]]) -> None:
    """Refuse words that the parser would refuse, each by one line.

    Args:
        line: The command without its options, such as ``deal-hw collect go2``.
        words: The words behind it.
        settings: The settings to make of them.
        others: Returns the commands whose kinds have an option, by its field name.

    Raises:
        ConfigurationError: An option is unknown or lacks a value, a value is no number, or one is missing.
    """
    options = options_of(settings)
    given = CommandLine(words, options.values())
    for flag, entry, values in given.given:
        if entry is None:
            raise ConfigurationError(_unknown(line, flag, values, options, others))
        if entry.values == 0 and values:
            raise ConfigurationError(f"{flag} takes no value, and {short(values[0])!r} was given")
        wanted = "a value" if entry.values in (1, None) else f"{entry.values} values"
        if entry.values != 0 and len(values) < (1 if entry.values is None else entry.values):
            raise ConfigurationError(f"{flag} needs {wanted}; {entry.meaning}")
        entry.check(values)
    arguments = [one for one in options.values() if one.positional]
    room = sum(len(given.positional) if one.values is None else 1 for one in arguments)
    if len(given.positional) > room:
        extra = " ".join(short(word) for word in given.positional[room:])
        raise ConfigurationError(f"`{line}` takes no {extra!r} there; options begin with --")
    named = {entry.name for _, entry, _ in given.given if entry is not None}
    for number, one in enumerate(arguments):
        if one.required and number >= len(given.positional):
            raise ConfigurationError(f"`{line}` needs {one.shown}; {one.meaning}")
    for one in options.values():
        if one.required and not one.positional and one.name not in named:
            raise ConfigurationError(f"`{line}` needs {one.shown}; {one.meaning}")


def _unknown(
    line: str,
    flag: str,
    values: Sequence[str],
    options: Mapping[str, Option],
    others: Callable[[str], list[str]],
) -> str:
    """Return the message on an unknown option: which kinds have it, or which option has a similar name."""
    flag = flag.replace("_", "-")
    plain = flag.removeprefix("--")
    found = others(plain.replace("-", "_")) or others(plain.removeprefix("no-").replace("-", "_"))
    text = f"{short(flag)}: `{line}` has no such option"
    if found:
        return f"{text}; {listed(iter(found))} {has(found)} it"
    flags = {name: one for one in options.values() for name in one.flags}
    near = difflib.get_close_matches(flag, flags, n=1, cutoff=0.7)
    return f"{text}; did you mean {near[0]}? {flags[near[0]].meaning}" if near else text
