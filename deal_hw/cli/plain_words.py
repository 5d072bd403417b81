"""Reads a simple command line without the parser, for a verb that must act at once.

To load the parser takes 0.2 s of processor time. Only what is certain is read here: the input first, then
options with one value each, or flags. For all else, such as a request for help or a mistake, nothing is
returned; the parser then reads it, and explains what is wrong.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_origin

from deal_hw.cli.arguments import CommandLine, Option, check, options_of
from deal_hw.errors import DealHwError
from deal_hw.ranges import hints_of
from deal_hw.workflows.kinds import Arguments, Kinds, groups


def plain_settings(kinds: Kinds, words: Sequence[str]) -> Any | None:
    """Return a verb's settings from its command-line arguments; None where the parser must read them.

    Args:
        kinds: The kinds of the verb, whose first argument names the input.
        words: The words behind the verb.
    """
    if not words or words[0].startswith("-"):
        return None
    try:
        _, chosen = kinds.choose(Arguments(words[0]))
        options = options_of(chosen.settings)
        check("", words, chosen.settings, lambda name: [])
        given = CommandLine(words, options.values())
        values: dict[str, Any] = {kinds.argument: words[0]}
        for flag, entry, text in given.given:
            if entry is None or entry.name in values:
                return None
            values[entry.name] = _value(entry, flag, text)
        return _made(chosen.settings, values)
    except (DealHwError, _NotPlainError):
        return None


class _NotPlainError(Exception):
    """A value that is more than a word, a number or a path."""


def _value(entry: Option, flag: str, text: Sequence[str]) -> Any:
    kinds = set(entry.kinds)
    if kinds == {bool} and entry.values == 0:
        return not flag.startswith("--no-")
    if entry.values != 1:
        raise _NotPlainError
    if NoneType in kinds and text[0] == "None":
        return None
    (kind,) = (
        found if len(found := kinds - {NoneType} - ({str} if Path in kinds else set())) == 1 else (None,)
    )
    if kind in (str, int, float, Path):
        return kind(text[0])
    if get_origin(kind) is Literal and text[0] in entry.choices:
        return text[0]
    raise _NotPlainError


def _made(settings: type[Any], values: Mapping[str, Any]) -> Any:
    """Return settings, and those of its groups of options that have a value."""
    named: dict[str, Any] = {}
    hints = hints_of(settings)
    for entry in dataclasses.fields(settings):
        if entry.name in values:
            named[entry.name] = values[entry.name]
        for group in groups(hints[entry.name]):
            if values.keys() & options_of(group).keys():
                named[entry.name] = _made(group, values)
    return settings(**named)
