"""How the command begins: an emergency stop gets real-time priority first, and loads little."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from deal_hw.cli import start
from deal_hw.cli.parsing import read_settings
from deal_hw.cli.plain_words import plain_settings
from deal_hw.cli.verbs import VERBS
from deal_hw.priorities import FIFO_PRIORITY, STOP_PRIORITY, TRANSPORT_PRIORITY
from deal_hw.workflows.kinds import sub_verbs
from deal_hw.workflows.stopping.settings import STOP

PLAIN = (
    ["go2"],
    ["cartpole", "--port", "/dev/ttyUSB0"],
    ["cartpole", "--port=/dev/ttyUSB0", "--transport", "can"],
    ["go2_on_stand", "--port", "enp2s0", "--seconds", "3", "--domain", "7"],
    ["go2", "--port", "lo", "--state-check", "length", "--simulator", "unitree_mujoco"],
    ["g1", "--port", "tls/robot:7447", "--transport", "zenoh", "--ca", "ca.pem", "--insecure"],
    ["b2", "--port", "x", "--certificate", "None"],
    ["h1", "--port", "x", "--listen", "--mode", "peer"],
    ["so101", "--port", "-1", "--seconds", "1e1"],
    ["robot.yaml", "--port", "can0", "--transport", "dds"],
)
"""Command lines that are read without the parser."""
FOR_THE_PARSER: tuple[list[str], ...] = (
    [],
    ["--help"],
    ["go2", "--help"],
    ["--port", "x", "go2"],
    ["go3"],
    ["go2", "b2"],
    ["go2", "--prot", "x"],
    ["go2", "--port"],
    ["go2", "--port", "x", "--port", "y"],
    ["go2", "--port", "x", "--seconds", "soon"],
    ["go2", "--port", "x", "--seconds", "0"],
    ["go2", "--port", "x", "--transport", "serial"],
    ["go2", "--seconds", "3"],
    ["cartpole", "--port", "x", "--domain", "7"],
)
"""Requests for help, mistakes, and what is not certain."""


@pytest.mark.parametrize("words", PLAIN, ids=" ".join)
def test_a_simple_line_means_what_the_parser_reads(words: Sequence[str]) -> None:
    """The parser takes 0.2 s to load; `stop` acts before."""
    found = plain_settings(STOP, words)
    assert found is not None
    assert found == read_settings("stop", VERBS["stop"], STOP, words)


@pytest.mark.parametrize("words", FOR_THE_PARSER, ids=" ".join)
def test_all_else_is_left_to_the_parser(words: Sequence[str]) -> None:
    """It explains what is wrong."""
    assert plain_settings(STOP, words) is None


def test_values_that_are_more_than_a_word_are_left_to_the_parser() -> None:
    """Such as several numbers in one option."""
    from deal_hw.cli.verbs import VERBS
    from deal_hw.workflows.deploy import DEPLOY

    words = ["go2", "--port", "x", "--policy", "walk.onnx", "--velocity", "0.1"]
    assert plain_settings(DEPLOY, words) in (None, read_settings("deploy", VERBS["deploy"], DEPLOY, words))
    assert plain_settings(sub_verbs(), ["info"]) is None


def test_stop_loads_little_until_the_runs_are_asked() -> None:
    """Neither numpy nor the parser, no reader of files and no list of plug-ins; each takes 0.02 to 0.2 s."""
    code = (
        "import sys\n"
        "import deal_hw.workflows.stopping.robot as robot\n"
        "from deal_hw.cli.main import main\n"
        "heavy = ('numpy', 'tyro', 'pydantic', 'yaml', 'mcap', 'zenoh', 'cyclonedds', 'importlib.metadata')\n"
        "def find_runs():\n"
        "    print([name for name in heavy if name in sys.modules])\n"
        "    return []\n"
        "robot.find_runs = find_runs\n"
        "for words in (['go2'], ['go2_on_stand'], ['robot.yaml'], ['so101', '--seconds', '10']):\n"
        "    main(['stop', *words])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]"] * 4, done.stderr


@pytest.mark.parametrize(("verb", "asked"), [("stop", True), ("--version", False)])
def test_an_emergency_stop_asks_for_real_time_first(
    verb: str, asked: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Below the two processes that make a robot passive; a refusal changes nothing."""
    seen: list[tuple[int, int, int]] = []

    def refuse(pid: int, policy: int, parameters: os.sched_param) -> None:
        seen.append((pid, policy, parameters.sched_priority))
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    # As its process ends, the command ignores Ctrl-C; the process of the tests goes on.
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    monkeypatch.setattr(sys, "argv", ["deal-hw", verb])
    assert start.main() == (2 if asked else 0)
    assert "name the robot" in capsys.readouterr().err or not asked
    assert seen == [(0, os.SCHED_FIFO, STOP_PRIORITY)] * asked
    assert TRANSPORT_PRIORITY < STOP_PRIORITY < FIFO_PRIORITY


COMMAND = Path(start.__file__).with_name("deal-hw")


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The command beside its Python part, as pip installs them; `chrt` and that part print what they get."""
    bins = tmp_path / "bin"
    bins.mkdir()
    shutil.copy(COMMAND, bins)
    for name, exit_code in (("deal-hw-python", 7), ("chrt", 1)):
        (bins / name).write_text(f'#!/bin/sh\necho "{name} $*" >> {tmp_path}/called\nexit {exit_code}\n')
        (bins / name).chmod(0o755)
    return bins


def called(command: Sequence[str | Path], bins: Path) -> list[str]:
    """Run the command; return what it called, the number of its own process as PID."""
    search = f"{bins}:{os.environ['PATH']}"
    with subprocess.Popen(command, env={**os.environ, "PATH": search}) as process:
        assert process.wait(60) == 7, "the exit code is that of the Python part"
    return (bins.parent / "called").read_text().replace(str(process.pid), "PID").splitlines()


def test_an_emergency_stop_has_real_time_priority_before_python_starts(installed: Path) -> None:
    """A refusal changes nothing: `chrt` fails here."""
    assert called([installed / "deal-hw", "stop", "go2", "--port", "a b"], installed) == [
        f"chrt -f -p {STOP_PRIORITY} PID",
        "deal-hw-python stop go2 --port a b",
    ]


@pytest.mark.parametrize("words", [[], ["collect", "stop"]])
def test_other_verbs_keep_the_priority_of_the_terminal(words: Sequence[str], installed: Path) -> None:
    """And without a verb, too."""
    assert called([installed / "deal-hw", *words], installed) == [f"deal-hw-python {' '.join(words)}"]


def test_the_command_finds_its_python_part_behind_a_link(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As pipx makes it; and where the shell got no path."""
    (installed.parent / "deal-hw").symlink_to(installed / "deal-hw")
    assert called([installed.parent / "deal-hw", "doctor"], installed) == ["deal-hw-python doctor"]
    (installed.parent / "called").unlink()
    monkeypatch.chdir(installed)
    assert called(["sh", "deal-hw", "doctor"], installed) == ["deal-hw-python doctor"]


def test_all_ways_to_call_begin_there() -> None:
    """The installed command, and `python -m deal_hw`."""
    root = Path(__file__).resolve().parents[2]
    settings = (root / "pyproject.toml").read_text()
    assert 'deal-hw-python = "deal_hw.cli.start:main"' in settings
    assert 'script-files = ["deal_hw/cli/deal-hw"]' in settings
    assert "from deal_hw.cli.start import main" in (root / "deal_hw/__main__.py").read_text()
