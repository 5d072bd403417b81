"""The command itself: its help, its table of verbs, its exit codes and what it loads."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro

from deal_hw.cli import main as cli
from deal_hw.cli.verbs import JOBS, Verb
from deal_hw.errors import ConfigurationError, MissingExtraError, PortNotFoundError, UnknownNameError
from deal_hw.install import install_line
from deal_hw.workflows.kinds import sub_verbs

ROOT = Path(__file__).resolve().parents[2]
WIRES_AND_SIMULATORS = (
    "can",
    "cantools",
    "cyclonedds",
    "dynamixel_easy_sdk",
    "dynamixel_sdk",
    "mujoco",
    "onnxruntime",
    "rerun",
    "scipy",
    "serial",
    "torch",
    "zenoh",
)
HEAVY = ("numpy", "rich", "tyro", *WIRES_AND_SIMULATORS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of the verb that the tests put into the table."""

    count: int = 1
    """How often."""


@pytest.fixture
def add_verb(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that puts a verb named `probe` into the table, carried out by the given function."""

    def add(function: Callable[[Settings], object], config: object = Settings, extra: str = "") -> None:
        module = types.ModuleType("probe_module")
        module.__dict__.update(Probe=config, probe=function)
        monkeypatch.setitem(sys.modules, "probe_module", module)
        verb = Verb(
            module="probe_module",
            config="Probe",
            function="probe",
            help="probe",
            example="probe",
            extra=extra,
        )
        monkeypatch.setattr(cli, "VERBS", {**cli.VERBS, "probe": verb})

    return add


def test_help_teaches_the_jobs_first(capsys: pytest.CaptureFixture[str]) -> None:
    """The help names every verb with a line that runs; the five jobs come first, in the order of the loop."""
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, verb in cli.VERBS.items():
        assert f"  {name} " in text
        assert f"deal-hw {verb.example}\n" in text
    places = [text.index(f"\n  {name} ") for name in cli.VERBS]
    assert places == sorted(places)
    assert list(JOBS) == ["collect", "calibrate", "train", "deploy", "inspect"]
    assert max(map(len, text.splitlines())) <= 120


def test_no_arguments_show_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    """`deal-hw` alone prints the help."""
    assert cli.main([]) == 0
    assert capsys.readouterr().out == cli.help_text() + "\n"


def test_unknown_verb_lists_the_verbs_and_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    """A mistyped verb gives one line with the known verbs and the nearest one."""
    assert cli.main(["calibrat"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == (
        "deal-hw: error: unknown verb 'calibrat'; known: collect, calibrate, train, deploy, inspect, demo, "
        "design-excitation, emulate, bridge, keys, robot, policy, data, replay, stop, doctor, bench; "
        "did you mean 'calibrate'?\n"
    )


def test_unlike_verb_suggests_nothing() -> None:
    """Where no verb is near, none is suggested."""
    with pytest.raises(UnknownNameError, match=r"bench$"):
        cli.find("xyzzy")


@pytest.mark.parametrize(
    ("result", "code"),
    [(None, 0), (3, 3), (0, 0), (True, 0), ({"report": 1}, 0), (types.SimpleNamespace(exit_code=3), 3)],
)
def test_exit_code_is_the_verbs_or_zero(add_verb: Callable[..., None], result: object, code: int) -> None:
    """A verb returns an exit code, or a report that may name one; a report that does not means success."""
    add_verb(lambda settings: result)
    assert cli.main(["probe"]) == code


def test_settings_reach_the_verb(add_verb: Callable[..., None]) -> None:
    """The options are parsed into the verb's dataclass."""
    seen: list[Settings] = []
    add_verb(seen.append)
    assert cli.main(["probe", "--count", "7"]) == 0
    assert seen == [Settings(count=7)]


def test_kinds_of_settings_give_sub_verbs(add_verb: Callable[..., None]) -> None:
    """The word names the kind, and is no part of its settings."""

    @dataclass(frozen=True)
    class Info:
        """Tell."""

        path: tyro.conf.Positional[Path]

    @dataclass(frozen=True)
    class Repair:
        """Mend."""

        path: tyro.conf.Positional[Path]

    seen: list[object] = []
    add_verb(seen.append, config=sub_verbs(info=Info, repair=Repair))
    assert cli.main(["probe", "repair", "somewhere"]) == 0
    assert seen == [Repair(path=Path("somewhere"))]


def test_bad_option_exits_with_two(add_verb: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    """An option that does not parse is refused before the verb runs."""
    add_verb(lambda settings: pytest.fail("the verb ran"))
    assert cli.main(["probe", "--count", "many"]) == 2
    assert "--count: 'many' is no whole number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (PortNotFoundError("no port /dev/x; plug it in"), "no port /dev/x; plug it in"),
        (
            FileNotFoundError(2, "No such file or directory", "a.mcap"),
            "[Errno 2] No such file or directory: 'a.mcap'",
        ),
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device"),
    ],
)
def test_expected_error_is_one_line(
    add_verb: Callable[..., None], capsys: pytest.CaptureFixture[str], error: Exception, line: str
) -> None:
    """Errors of deal-hw and refusals of the system end in one line and exit code 2."""

    def fail(settings: Settings) -> None:
        raise error

    add_verb(fail)
    assert cli.main(["probe"]) == 2
    assert capsys.readouterr().err == f"deal-hw: error: {line}\n"


@pytest.mark.parametrize(("arguments", "variable"), [(["--traceback", "probe"], ""), (["probe"], "1")])
def test_traceback_on_request(
    add_verb: Callable[..., None], monkeypatch: pytest.MonkeyPatch, arguments: list[str], variable: str
) -> None:
    """Both the option and the variable let the error through."""

    def fail(settings: Settings) -> None:
        raise PortNotFoundError("no port")

    add_verb(fail)
    monkeypatch.setenv(cli.TRACEBACK_VARIABLE, variable)
    with pytest.raises(PortNotFoundError):
        cli.main(arguments)


def test_bug_is_not_hidden(add_verb: Callable[..., None]) -> None:
    """An unexpected error keeps its traceback."""

    def fail(settings: Settings) -> None:
        raise ZeroDivisionError

    add_verb(fail)
    with pytest.raises(ZeroDivisionError):
        cli.main(["probe"])


def test_interrupt_exits_with_130(add_verb: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    """Ctrl-C ends without a traceback and with the code that shells expect."""

    def stop(settings: Settings) -> None:
        raise KeyboardInterrupt

    add_verb(stop)
    assert cli.main(["probe"]) == 130
    assert capsys.readouterr().err == "deal-hw: interrupted\n"


@pytest.mark.parametrize(
    ("arguments", "unbuffered"), [(["--help"], ""), (["data", "--help"], ""), (["data", "--help"], "1")]
)
def test_reader_that_left_ends_it_quietly(arguments: list[str], unbuffered: str) -> None:
    """A closed pipe, as behind ``| head``, gives 128 + SIGPIPE, no message and no traceback."""
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, "-m", "deal_hw.cli.main", *arguments]
    try:
        done = subprocess.run(
            words,
            stdout=write,
            stderr=subprocess.PIPE,
            check=False,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        )
    finally:
        os.close(write)
    assert (done.returncode, done.stderr) == (cli.EXIT_PIPE, b"")


@pytest.mark.parametrize("how", ["closed", "no reader"])
@pytest.mark.parametrize(
    ("arguments", "code"), [(["--help"], 0), (["nosuch"], 2), (["calibrate", "d", "--latency", "12"], 2)]
)
def test_an_error_output_that_nobody_reads_changes_nothing(
    arguments: list[str], code: int, how: str, tmp_path: Path
) -> None:
    """`2>&-`, or a reader of stderr that has left: the same exit code and the same output."""
    words = [sys.executable, "-m", "deal_hw.cli.main", *arguments]
    before = subprocess.run(words, capture_output=True, check=False)
    if how == "closed":
        quoted = " ".join(map(shlex.quote, words))
        done = subprocess.run(["sh", "-c", f"exec {quoted} 2>&-"], stdout=subprocess.PIPE, check=False)
    else:
        read, write = os.pipe()
        os.close(read)
        try:
            done = subprocess.run(words, stdout=subprocess.PIPE, stderr=write, check=False)
        finally:
            os.close(write)
    assert (done.returncode, done.stdout) == (before.returncode, before.stdout) == (code, before.stdout)


def test_no_file_gets_the_number_of_a_closed_output() -> None:
    """A file that is opened later must not get the text of an error."""
    code = (
        "import os, sys; from deal_hw.cli.main import main; main(['--version']);"
        "sys.exit(os.open(os.devnull, os.O_RDONLY))"
    )
    quoted = " ".join(map(shlex.quote, [sys.executable, "-c", code]))
    done = subprocess.run(["sh", "-c", f"exec {quoted} 2>&-"], stdout=subprocess.PIPE, check=False)
    assert done.returncode >= 3


def test_an_error_is_one_bounded_line(
    add_verb: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    """A message with text from a file has no control characters, one line, and a limited length."""

    def fail(settings: Settings) -> None:
        raise ConfigurationError("a\nb \x1b[31m" + "x" * 10**6)

    add_verb(fail)
    assert cli.main(["probe"]) == 2
    reported = capsys.readouterr().err
    assert (
        reported.startswith("deal-hw: error: a b ?[31mxxx")
        and reported.count("\n") == 1
        and len(reported) < 2100
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_verb_by_its_own_way_out(
    number: signal.Signals, add_verb: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    """The verb leaves its blocks, so its child processes end; afterwards the handlers are as before."""
    left = []

    def work(settings: Settings) -> None:
        try:
            os.kill(os.getpid(), number)
        finally:
            left.append(True)

    add_verb(work)
    before = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
    assert cli.main(["probe"]) == cli.EXIT_INTERRUPTED
    assert left and capsys.readouterr().err == "deal-hw: interrupted\n"
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == before


def test_an_interrupt_that_a_loading_library_swallows_is_one_all_the_same(
    add_verb: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    """Numpy's compiled module makes "initialization failed" of it; without a signal that stays an error."""

    def load(settings: Settings) -> None:
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        raise ImportError("initialization failed")

    add_verb(load)
    assert cli.main(["probe"]) == cli.EXIT_INTERRUPTED
    assert capsys.readouterr().err == "deal-hw: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_after_the_end_changes_nothing() -> None:
    """From the verb's last word to the end of the process, SIGINT no longer decides about the exit code."""
    code = (
        "import atexit, os, signal, sys; from deal_hw.cli import main as cli;"
        "sys.argv = ['deal-hw', '--version'];"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT)); sys.exit(cli.main())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("arguments", [["--version"], ["probe"]])
def test_the_end_of_the_process_looks_for_no_garbage(arguments: list[str]) -> None:
    """A training that was interrupted spent 5 to 10 s on it, on a busy computer."""
    code = (
        "import atexit, gc, sys; from deal_hw.cli import main as cli;"
        f"sys.argv = ['deal-hw', *{arguments!r}];"
        "atexit.register(lambda: print(gc.get_freeze_count() > 1000)); sys.exit(cli.main())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1] == "True"


def test_broken_pipe_of_a_robot_is_told(
    add_verb: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    """A pipe that broke elsewhere, while the output is read, is an error like any other."""

    def fail(settings: Settings) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    add_verb(fail)
    assert cli.main(["probe"]) == 2
    assert capsys.readouterr().err == "deal-hw: error: [Errno 32] Broken pipe\n"


def test_missing_package_names_the_extra(add_verb: Callable[..., None]) -> None:
    """A package that an extra brings is asked for by that extra's name."""

    def load(settings: Settings) -> None:
        raise ModuleNotFoundError("No module named 'torch.nn'", name="torch.nn")

    add_verb(load, extra="calib")
    with pytest.raises(
        MissingExtraError, match=r"torch is not installed.*" + re.escape(install_line("calib"))
    ):
        cli.run("probe", [])


def test_missing_module_of_ours_is_a_bug(add_verb: Callable[..., None]) -> None:
    """A missing module of deal_hw itself is not reported as a missing extra."""

    def load(settings: Settings) -> None:
        raise ModuleNotFoundError("No module named 'deal_hw.nothing'", name="deal_hw.nothing")

    add_verb(load)
    with pytest.raises(ModuleNotFoundError) as caught:
        cli.run("probe", [])
    assert not isinstance(caught.value, MissingExtraError)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["nonsense"]])
def test_start_loads_nothing_heavy(arguments: list[str]) -> None:
    """Help, version and a mistyped verb load neither numpy nor any verb, and so start at once."""
    code = (
        f"import sys, json\nfrom deal_hw.cli.main import main\nmain({arguments!r})\n"
        f"loaded = [name for name in sys.modules if name in {HEAVY!r} or name.startswith('deal_hw.')]\n"
        "print(json.dumps(loaded), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    loaded = json.loads(done.stderr.splitlines()[-1])
    assert sorted(loaded) == [
        "deal_hw.cli",
        "deal_hw.cli.main",
        "deal_hw.cli.verbs",
        "deal_hw.documentation",
        "deal_hw.errors",
        "deal_hw.install",
        "deal_hw.version",
    ]


@pytest.mark.parametrize("name", ["collect", "deploy", "doctor", "emulate", "replay"])
def test_help_of_a_verb_loads_no_wire_and_no_simulator(name: str) -> None:
    """The help shows a robot's options without loading the packages that reach or simulate it."""
    code = (
        "import contextlib, sys, json\nfrom deal_hw.cli.main import main\n"
        f"with contextlib.suppress(SystemExit): main([{name!r}, '--help'])\n"
        f"print(json.dumps([name for name in {WIRES_AND_SIMULATORS!r} if name in sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert "usage: " in done.stdout
    assert json.loads(done.stdout.splitlines()[-1]) == []


@pytest.mark.parametrize("name", cli.VERBS)
def test_example_of_each_verb_parses(name: str) -> None:
    """Each verb loads, and the line that the help shows for it is accepted."""
    example = shlex.split(cli.VERBS[name].example)
    assert example[0] == name
    _, function = cli.parse(name, example[1:])
    assert callable(function)


def commands_in_docs() -> list[str]:
    """Return every complete `deal-hw VERB ...` line in the code blocks of the README and the docs."""
    texts = [
        # A backslash at its end continues a line.
        re.sub(r"\\\n\s*", " ", path.read_text(encoding="utf-8"))
        for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    ]
    lines = [
        line for text in texts for line in re.findall(r"^(?: {4,}|\$ )(deal-hw [a-z].*)$", text, flags=re.M)
    ]
    return sorted({line.partition("#")[0].strip() for line in lines if " | " not in line})


@pytest.mark.parametrize("command", commands_in_docs())
def test_command_in_docs_parses(command: str) -> None:
    """Each command of the README and the docs is accepted."""
    _, name, *arguments = shlex.split(command)
    cli.parse(name, arguments)
