"""`deal-hw --completion`: what the Tab key offers in bash."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from deal_hw.cli.completion import completion
from deal_hw.cli.main import EXIT_ERROR, main
from deal_hw.cli.verbs import VERBS
from deal_hw.robots import driven_robots

pytestmark = pytest.mark.real_time

ASK = """\
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
_deal_hw
printf '%s\\n' "${COMPREPLY[@]}"
"""
"""Does what bash does on Tab behind these words."""


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the script of bash."""
    path = tmp_path_factory.mktemp("completion") / "deal-hw.bash"
    path.write_text(completion("bash", VERBS), encoding="utf-8")
    return path


def offered(script: Path, folder: Path, *words: str) -> set[str]:
    """Return what bash offers behind `deal-hw WORDS`; the last word is unfinished."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-c", ASK, "ask", str(script), "deal-hw", *words],
        cwd=folder,
        env={"PATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return set(done.stdout.split())


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("cal",), {"calibrate"}),
        (("data", "inf"), {"info"}),
        (("calibrate", "--metho"), {"--method"}),
        (("calibrate", "--model", "rob"), set()),
        (("data", "info", "--js"), {"--json"}),
        (("collect", "cart"), {"cartpole"}),
        (("bench", "fixed"), {"fixed-range"}),
        (("emulate", "cartpole", "--profile", "rea"), {"realistic"}),
        # Nothing of ours fits, so that bash offers files.
        (("calibrate", "rob"), set()),
        (("calibrate", "--data", "a.csv", "rob"), set()),
    ],
)
def test_tab_completes(script: Path, tmp_path: Path, words: tuple[str, ...], expected: set[str]) -> None:
    """Verbs, sub-verbs, options, choices and robots."""
    assert offered(script, tmp_path, *words) == expected


def test_tab_offers_every_verb_and_robot(script: Path, tmp_path: Path) -> None:
    """From the tables, so that a new one is there."""
    assert offered(script, tmp_path, "") >= set(VERBS)
    assert offered(script, tmp_path, "deploy", "") >= set(driven_robots())


def test_bash_offers_files_where_nothing_fits(script: Path) -> None:
    """The registration says so; an empty word in the reply would keep bash from it."""
    text = (
        f'source "{script}"; complete -p deal-hw; COMP_WORDS=(deal-hw calibrate x); COMP_CWORD=2; _deal_hw; '
    )
    done = subprocess.run(
        ["bash", "-c", text + "echo ${#COMPREPLY[@]}"], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["complete -o default -F _deal_hw deal-hw", "0"]


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_takes_the_script(tmp_path: Path) -> None:
    """It defines the same function, and registers it."""
    path = tmp_path / "deal-hw.zsh"
    path.write_text(completion("zsh", VERBS), encoding="utf-8")
    ask = f"source {path}; whence _deal_hw; print $_comps[deal-hw]"
    done = subprocess.run(["zsh", "-f", "-c", ask], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["_deal_hw", "_bash_complete -o default -F _deal_hw"]


@pytest.mark.parametrize("words", [["--completion"], ["--completion", "csh"]])
def test_another_shell_is_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """The message names the shells."""
    assert main(words) == EXIT_ERROR
    assert "give bash or zsh, such as --completion bash" in capsys.readouterr().err
