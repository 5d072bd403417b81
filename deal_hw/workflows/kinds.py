"""The kinds of a verb's input, such as its robots: each has its own settings, with the options that apply.

An option that does not apply to a kind is no field of its settings. So nobody has to refuse it, on the
command line or in Python.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.ranges import hints_of


@dataclass(frozen=True, slots=True)
class InputKind:
    """One kind of a verb's input.

    Attributes:
        settings: Its settings: a frozen dataclass that holds the options that apply, and no other.
        help: One line; by default the first line of the settings' docstring.
        usage: What names this kind behind the verb, such as ``--model robot.xml``; by default its own name.
        example: Working arguments of this kind behind the verb; None: the verb's own example shows it.
    """

    settings: type[Any]
    help: str = ""
    usage: str = ""
    example: str | None = None

    @property
    def compound(self) -> bool:
        """Whether a word and an option name it together, as in ``robot.yaml --simulated``."""
        return " " in self.usage and not self.usage.startswith("-")


class KindTable(Mapping[str, InputKind]):
    """Kinds by name that are made when they are asked for: to list all robots loads all plug-ins.

    Args:
        names: Returns all names, in the order of the help.
        make: Returns the kind of a name; None if there is none.
    """

    def __init__(self, names: Callable[[], Iterable[str]], make: Callable[[str], InputKind | None]) -> None:
        self._names, self._make = names, make

    def __getitem__(self, name: str) -> InputKind:
        found = self._make(name)
        if found is None:
            raise KeyError(name)
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self._names())

    def __len__(self) -> int:
        return sum(1 for _ in self._names())


@dataclass(frozen=True, slots=True)
class Arguments:
    """What was given to a verb, before its kind and so its settings are known.

    Attributes:
        first: The first argument that is no option; None without one. A path is text on the command line.
        options: The other values by field name. On the command line they are text, a flag is True, and what
            is given several values is a list.
    """

    first: Any = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def first_argument(arguments: Arguments) -> str:
    """Return the kind where the first argument names it; empty if none is given."""
    return "" if arguments.first is None else str(arguments.first)


@dataclass(frozen=True, kw_only=True)
class Kinds:
    """The kinds of a verb's input. A verb takes one of them, and its settings have that kind's type.

    Attributes:
        noun: What a kind is, such as "robot"; for messages.
        table: Returns the kinds by name, in the order of the help. A function, since plug-ins add robots.
        find: Returns the name of the kind from the arguments; by default the first argument is the name.
            Empty if the arguments name none. It may raise a DealHwError that tells more than "unknown robot".
            It must not fail because a file is absent: return the kind that will report it.
        doubt: Returns why ``find`` could only guess, such as a file that is not there; empty if it knew. It
            comes before what is wrong with the options, which may fit another kind.
        argument: The field that takes the first argument. Empty if that only names the kind, as in
            ``deal-hw data info DIR``; it is then no part of the settings.
    """

    noun: str
    table: Callable[[], Mapping[str, InputKind]]
    find: Callable[[Arguments], str] = first_argument
    doubt: Callable[[Arguments], str] = lambda arguments: ""
    argument: str = ""

    def choose(self, arguments: Arguments) -> tuple[str, InputKind]:
        """Return the kind that the arguments name, and its name.

        Raises:
            UnknownNameError: There is no such kind.
            MissingKindError: The arguments name none.
        """
        name, table = self.find(arguments), self.table()
        if name in table:
            return name, table[name]
        if not name:
            words = ", ".join(kind.usage if kind.compound else word for word, kind in table.items())
            raise MissingKindError(f"name the {self.noun}: {words}")
        raise UnknownNameError(self.noun, name, table)

    def settings(self, *values: Any, **named: Any) -> Any:
        """Return settings of the kind that the arguments name, as Python gives them.

        Raises:
            UnknownNameError: There is no such kind, or it has no such argument.
            TypeError: An argument is missing.
        """
        return self.make("settings", *values, **named)

    def make(self, function: str, *values: Any, **named: Any) -> Any:
        """Return settings, as :meth:`settings`; messages name the function that was called."""
        options = dict(named)
        first = values[0] if values else options.pop(self.argument, None)
        arguments = Arguments(first, options)
        try:
            kind, chosen = self.choose(arguments)
        except MissingKindError:
            raise TypeError(f"{function}(): missing a required argument: {self.argument!r}") from None
        signature = inspect.signature(chosen.settings)
        for name in named:
            if name not in signature.parameters:
                error = self._unknown(f"{function} {kind}".rstrip(), chosen.settings, name, function)
                error.args = (self.doubted(arguments, str(error)),)
                raise error
        try:
            signature.bind(*values, **named)
        except TypeError as error:
            raise TypeError(f"{function}(): {error}") from None
        fitting = {name: _fitting(chosen.settings, name, value) for name, value in named.items()}
        return chosen.settings(*values, **fitting)

    def doubted(self, arguments: Arguments, message: str) -> str:
        """Return what is wrong with the options, after the reason why their kind may be another one."""
        reason = self.doubt(arguments)
        return f"{reason}; {message}" if reason else message

    def having(self, name: str) -> list[str]:
        """Return the kinds with a field of that name, in a group of options, too."""
        found: list[tuple[str, Any]] = [(kind, entry.settings) for kind, entry in self.table().items()]
        return [kind for kind, settings in found if name in field_names(settings)]

    def _unknown(self, shown: str, settings: type[Any], name: str, function: str) -> UnknownNameError:
        error = UnknownNameError(f"argument of {shown}", name, inspect.signature(settings).parameters)
        if group := _in_group(settings, name):
            error.args = (f"{error}; did you mean {group}?",)
        elif others := self.having(name):
            error.args = (f"{error}; {listed(f'{function} {other}' for other in others)} {has(others)} it",)
        return error

    def with_options(self, extra: type[Any]) -> Kinds:
        """Return the same kinds with more options.

        Args:
            extra: A frozen dataclass whose fields all have defaults. A field of the same name takes the place
                of the kind's own.
        """
        more: Any = extra
        joined = functools.partial(_joined, more)

        def table() -> Mapping[str, InputKind]:
            kinds = self.table()
            own: dict[str, Any] = {name: kind.settings for name, kind in kinds.items()}
            return {
                name: dataclasses.replace(kind, settings=joined(own[name])) for name, kind in kinds.items()
            }

        return dataclasses.replace(self, table=table)


def fitting(table: Mapping[str, InputKind], options: Iterable[str]) -> str:
    """Return the first kind that has all these options; empty if none has."""
    wanted = set(options)
    found: list[tuple[str, Any]] = [(name, kind.settings) for name, kind in table.items()]
    return next((name for name, settings in found if wanted <= field_names(settings)), "")


class MissingKindError(ConfigurationError):
    """The arguments name no kind."""


def sub_verbs(**kinds: type[Any] | InputKind) -> Kinds:
    """Return the kinds of a verb with sub-verbs, such as ``deal-hw data info``."""
    table = {name: kind if isinstance(kind, InputKind) else InputKind(kind) for name, kind in kinds.items()}
    return Kinds(noun="sub-verb", table=lambda: table)


def one_kind(settings: Any) -> Kinds:
    """Return the one kind of a verb whose settings are the same for every input."""
    table = {"": InputKind(settings)}
    return Kinds(noun="", table=lambda: table, find=lambda arguments: "")


def has(names: list[str]) -> str:
    """Return the verb for one thing or several."""
    return "has" if len(names) == 1 else "have"


def listed(names: Iterator[str]) -> str:
    """Return names as code, in a sentence."""
    *most, last = (f"`{name}`" for name in names)
    return f"{', '.join(most)} and {last}" if most else last


def groups(hint: Any) -> Iterator[type[Any]]:
    """Yield the dataclasses in a field's type."""
    if get_origin(hint) in (Annotated, UnionType, Union):
        for part in get_args(hint):
            yield from groups(part)
    elif isinstance(hint, type) and dataclasses.is_dataclass(hint):
        yield hint


@functools.cache
def field_names(settings: Any) -> frozenset[str]:
    """Return the names of all fields of settings, those of groups included."""
    names: set[str] = set()
    hints = hints_of(settings)
    for name in (entry.name for entry in dataclasses.fields(settings)):
        names.add(name)
        inner: list[Any] = list(groups(hints[name]))
        names = names.union(*map(field_names, inner))
    return frozenset(names)


@functools.cache
def _joined(extra: Any, settings: Any) -> type[Any]:
    body = {"__doc__": settings.__doc__, "__module__": settings.__module__}
    return dataclasses.make_dataclass(
        settings.__name__, (), bases=(extra, settings), namespace=body, frozen=True, kw_only=True
    )


def _fitting(settings: Any, name: str, value: Any) -> Any:
    """Return an argument; another group of options becomes the group that the settings take.

    Raises:
        ConfigurationError: It gives an option that this group does not have.
    """
    wanted: Any = settings.__dataclass_fields__[name].default_factory
    if not (
        isinstance(wanted, type) and dataclasses.is_dataclass(wanted) and dataclasses.is_dataclass(value)
    ):
        return value
    given: Any = type(value)
    if given is wanted:
        return value
    usual = given()
    values = {one.name: getattr(value, one.name) for one in dataclasses.fields(value)}
    changed = {one: new for one, new in values.items() if new != getattr(usual, one)}
    known = [one.name for one in dataclasses.fields(wanted)]
    if foreign := ", ".join(one for one in changed if one not in known):
        raise ConfigurationError(
            f"{name}={given.__name__}({foreign}=...): {wanted.__name__} goes there, with {', '.join(known)}"
        )
    return wanted(**changed)


def _in_group(settings: Any, name: str) -> str:
    """Return how Python gives an option that is in a group of options; empty if no group has it."""
    for entry in dataclasses.fields(settings):
        group = entry.default_factory
        if dataclasses.is_dataclass(group) and name in {inner.name for inner in dataclasses.fields(group)}:
            return f"{entry.name}={getattr(group, '__name__', '')}({name}=...)"
    return ""


def signature_of(kinds: Kinds) -> inspect.Signature:
    """Return a signature with the arguments of all kinds; the first argument may stand without its name."""
    found: dict[str, inspect.Parameter] = {}
    entries = [entry.settings for entry in kinds.table().values()]
    for settings in entries:
        for name, parameter in inspect.signature(settings).parameters.items():
            required = parameter.default is inspect.Parameter.empty
            everywhere = all(name in inspect.signature(other).parameters for other in entries)
            if required and not everywhere:
                parameter = parameter.replace(default=None)
            kept = found.get(name, parameter)
            found[name] = parameter if kept.default is inspect.Parameter.empty else kept
    ordered = sorted(found.values(), key=lambda parameter: (parameter.kind, parameter.name != kinds.argument))
    return inspect.Signature(ordered)
