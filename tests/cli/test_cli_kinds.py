"""Kinds of a verb's input: each has its own options, on the command line and in Python."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pytest

import deal_hw
from deal_hw.cli import main as cli
from deal_hw.cli.completion import completion
from deal_hw.cli.parsing import example_of
from deal_hw.cli.verbs import Verb
from deal_hw.errors import UnknownNameError
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds
from deal_hw.workflows.options import FROM_PYTHON, from_settings


@dataclass(frozen=True, kw_only=True)
class Legs:
    """Legs."""

    stride: float = 0.3
    """Length of a step [m]."""


@dataclass(frozen=True, kw_only=True)
class Moves:
    """Move a robot."""

    robot: str = field(kw_only=False)
    """The robot."""

    speed: float = 1.0
    """Speed [m/s]."""

    way: tuple[float, ...] = ()
    """Places to go to [m]."""

    say: Annotated[Callable[[str], None], FROM_PYTHON] = print
    """Called with messages."""


@dataclass(frozen=True, kw_only=True)
class Walks(Moves):
    """Move a robot with legs."""

    legs: Legs = field(default_factory=Legs)
    """Its legs."""

    gentle: bool = True
    """Set the feet down slowly."""


@dataclass(frozen=True, kw_only=True)
class Follows(Moves):
    """Move a robot of a file."""

    port: str
    """Its port."""


TABLE = {
    "cart": InputKind(Moves),
    "dog": InputKind(Walks, "a robot with legs"),
    "file": InputKind(Follows, usage="ROBOT.yaml"),
}


def find(arguments: Arguments) -> str:
    """Return the kind of a robot."""
    name = str(arguments.first or "")
    return "file" if name.endswith(".yaml") or "port" in arguments.options else name


KINDS = Kinds(noun="robot", argument="robot", table=lambda: TABLE, find=find)


@dataclass(frozen=True, kw_only=True)
class Quiet:
    """What only the command line has."""

    quiet: bool = False
    """Print nothing."""


@from_settings(KINDS)
def move(settings: Any) -> Any:
    """Move."""
    return settings


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The verb `move`; what it was called with."""
    module, called = types.ModuleType("move_module"), list[Any]()
    module.__dict__.update(KINDS=KINDS.with_options(Quiet), move=called.append)
    monkeypatch.setitem(sys.modules, "move_module", module)
    entry = Verb(
        module="move_module", config="KINDS", function="move", help="move a robot", example="move cart"
    )
    monkeypatch.setattr(cli, "VERBS", {"move": entry})
    return called


@pytest.mark.parametrize(
    ("line", "kind", "values"),
    [
        ("cart --speed 2", Moves, {"speed": 2.0, "quiet": False}),
        ("--speed 2 cart", Moves, {"speed": 2.0}),
        (
            "--quiet dog --stride=0.1 --no-gentle",
            Walks,
            {"quiet": True, "legs": Legs(stride=0.1), "gentle": False},
        ),
        ("a.yaml --port p", Follows, {"robot": "a.yaml", "port": "p"}),
        ("cart --way 1 -2.5 --quiet", Moves, {"way": (1.0, -2.5)}),
    ],
)
def test_the_words_choose_the_settings(
    line: str, kind: type[Any], values: dict[str, Any], verb: list[Any]
) -> None:
    """Wherever the kind stands among the options."""
    assert cli.main(["move", *line.split()]) == 0
    (settings,) = verb
    assert isinstance(settings, kind) and isinstance(settings, Quiet)
    assert {name: getattr(settings, name) for name in values} == values


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "`deal-hw move`: name the robot: cart, dog, file; example: deal-hw move cart"),
        ("cat", "unknown robot 'cat'; known: cart, dog, file"),
        (
            "cart --stride 1",
            "--stride: `deal-hw move cart` has no such option; `move dog` has it; all options:",
        ),
        ("cart --no-gentle", "--no-gentle: `deal-hw move cart` has no such option; `move dog` has it; all"),
        (
            "cart --sped 1",
            "--sped: `deal-hw move cart` has no such option; did you mean --speed? --speed is: Spe",
        ),
        ("a.yaml", "`deal-hw move ROBOT.yaml` needs --port; --port is: Its port; all options: deal-hw move"),
        (
            "cart --speed",
            "--speed needs a value; --speed is: Speed [m/s]; all options: deal-hw move cart --help",
        ),
        ("cart --speed fast", "--speed: 'fast' is no number; --speed is: Speed [m/s]; all options:"),
        ("cart --way", "--way needs a value; --way is: Places to go to [m]; all options:"),
        ("dog --quiet=yes", "--quiet takes no value, and 'yes' was given; all options:"),
        ("cart dog", "`deal-hw move cart` takes no 'dog' there; options begin with --; all options:"),
        ("cart --say x", "--say: `deal-hw move cart` has no such option; did you mean --way?"),
    ],
)
def test_what_cannot_be_is_one_line(
    line: str, message: str, verb: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """What was given, what is allowed, where to read more; nothing of the parser's own."""
    assert cli.main(["move", *line.split()]) == cli.EXIT_ERROR
    printed = capsys.readouterr()
    assert printed.err.startswith(f"deal-hw: error: {message}") and printed.err.count("\n") == 1
    assert not printed.out and not verb


def test_help_lists_the_kinds_and_then_the_options_of_one(
    verb: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing of other kinds, and nothing that only Python can give."""
    pages = []
    for words in (["--help"], ["cart", "--help"], ["--help", "dog"]):
        with pytest.raises(SystemExit) as stop:
            cli.main(["move", *words])
        assert not stop.value.code
        pages.append(capsys.readouterr().out)
    plain, cart, dog = pages
    assert "  deal-hw move cart        Move a robot.\n" in plain and "a robot with legs" in plain
    assert (
        "deal-hw move ROBOT.yaml  Move a robot of a file." in plain
        and "deal-hw move ROBOT.yaml --help" in plain
    )
    assert "--speed" in cart and "--stride" not in cart and "--say" not in cart and "ROBOT" not in cart
    assert "--stride" in dog and "--gentle, --no-gentle" in dog and "--quiet" in dog


def kinds_of_verbs() -> Iterator[tuple[str, str]]:
    """Yield each verb with kinds, and each of its kinds."""
    for name, verb in cli.VERBS.items():
        kinds = getattr(importlib.import_module(verb.module), verb.config)
        if isinstance(kinds, Kinds):
            yield from ((name, kind) for kind in kinds.table())


@pytest.mark.parametrize(("name", "kind"), [*kinds_of_verbs()])
def test_the_help_of_a_kind_shows_an_example_of_that_kind(
    name: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It parses, as settings of that kind, and its own help page shows it."""
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "runs/mine/dataset" / "robot" / "files.json"
    own.parent.mkdir(parents=True)
    own.touch()
    verb = cli.VERBS[name]
    entry = getattr(importlib.import_module(verb.module), verb.config).table()[kind]
    line = example_of(name, verb, entry)
    settings, _ = cli.parse(name, line.split()[2:])
    assert type(settings) is entry.settings
    with pytest.raises(SystemExit):
        cli.main([*line.split()[1:], "--help"])
    # Without a kind the page lists all of them, this one included.
    assert (f"Example:  {line}\n" if kind else f"  {line} ") in capsys.readouterr().out


def test_a_file_that_is_not_there_is_named_before_the_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its kind is not known, so the options may be right."""
    recording, dataset = str(tmp_path / "nothere.mcap"), str(tmp_path / "dataset")
    for words in (["replay", recording], ["calibrate", dataset, "--columns", "x.yaml"]):
        assert cli.main(words) == cli.EXIT_ERROR
    replayed, calibrated = capsys.readouterr().err.splitlines()
    assert f"error: {recording} cannot be read: there is no such file; `deal-hw replay" in replayed
    assert f"error: {dataset} does not exist; --columns: `deal-hw calibrate dataset` has no" in calibrated
    with pytest.raises(UnknownNameError, match=r"nothere\.mcap cannot be read.*; unknown argument of replay"):
        deal_hw.replay(recording, hand_back=True)
    with pytest.raises(UnknownNameError, match="dataset does not exist; unknown argument of calibrate"):
        deal_hw.calibrate(dataset=dataset, columns="x.yaml")


def test_python_takes_the_same_kinds() -> None:
    """One function; unknown names are refused with those of this kind and with the kinds that have them."""
    assert move("dog", legs=Legs(stride=0.2)).legs.stride == 0.2
    assert type(move(robot="cart", way=(1.0,))) is Moves
    with pytest.raises(
        UnknownNameError,
        match=r"unknown argument of move cart 'gentle'; known: robot, speed, way, say; `move dog` has it",
    ):
        move("cart", gentle=False)
    with pytest.raises(UnknownNameError, match=r"did you mean legs=Legs\(stride=\.\.\.\)\?$"):
        move("dog", stride=0.2)
    with pytest.raises(UnknownNameError, match="unknown robot 'cat'; known: cart, dog, file"):
        move("cat")
    with pytest.raises(TypeError, match=r"move\(\): missing a required argument: 'robot'"):
        move()
    with pytest.raises(TypeError, match=r"move\(\): missing a required (keyword-only )?argument: 'port'"):
        move("a.yaml")
    parameters = inspect.signature(move).parameters
    assert next(iter(parameters)) == "robot" and {"gentle", "port", "speed"} <= set(parameters)


def test_the_completion_knows_the_options_of_each_kind(verb: list[Any]) -> None:
    """Behind a path, which is no kind's name, those of all kinds."""
    lines = [line.strip() for line in completion("bash", cli.VERBS).splitlines()]
    assert 'move) kinds="cart dog file" ;;' in lines
    assert 'move:cart) options="--speed --way --quiet" ;;' in lines
    assert 'move:dog) options="--speed --way --stride --gentle --no-gentle --quiet" ;;' in lines
    assert 'move:*) options="--speed --way --quiet --stride --gentle --no-gentle --port" ;;' in lines


def test_more_options_may_replace_an_option() -> None:
    """As `train` does: on the command line its distribution is a file."""

    @dataclass(frozen=True, kw_only=True)
    class File:
        way: Path = Path("a")

    made = KINDS.with_options(File).settings("cart")
    assert isinstance(made, Moves) and dataclasses.asdict(made)["way"] == Path("a")
