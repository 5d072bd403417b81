"""Plug-ins: robots and transports of other distributions; a bad one is one line, and the others work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.robots import API_VERSION, built_in
from deal_hw.robots.entry import RobotEntry, TransportEntry
from deal_hw.robots.registry import ROBOT_GROUP, TRANSPORT_GROUP, Registry

ENTRY = """
from deal_hw.robots.entry import RobotEntry
ENTRY = RobotEntry(name={name!r}, api_version={version}, description="nowhere:FACTS", spaces="nowhere:X")
"""
GOOD = ENTRY.format(name="good", version=API_VERSION)


def install(
    folder: Path, distribution: str, point: str, module: str, text: str, group: str = ROBOT_GROUP
) -> None:
    """Write a distribution with one module and one entry point, as pip leaves them."""
    (folder / f"{module}.py").write_text(text, encoding="utf-8")
    info = folder / f"{distribution}-1.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.5\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{point} = {module}:ENTRY\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of installed packages with one good plug-in."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    install(tmp_path, "good_robot", "good", "plug_in_good", GOOD)
    for name in [name for name in sys.modules if name.startswith("plug_in_")]:
        monkeypatch.delitem(sys.modules, name)
    return tmp_path


def table() -> Registry[RobotEntry]:
    """Return the table as a new process reads it."""
    return Registry("robot", ROBOT_GROUP, RobotEntry, built_in.ROBOTS)


BAD = [
    ("missing", "import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'"),
    ("broken", "def f(:", "plug_in_bad:ENTRY cannot be imported: SyntaxError"),
    ("raising", "raise RuntimeError('two\\nlines')", "RuntimeError: two lines"),
    ("empty", "", "cannot be imported: AttributeError"),
    (
        "newer",
        ENTRY.format(name="newer", version=API_VERSION + 1),
        f"its entry declares API version {API_VERSION + 1}, and this deal-hw has version {API_VERSION}",
    ),
    ("other", "class ENTRY: api_version = 1", "is a type, expected a RobotEntry"),
    ("renamed", ENTRY.format(name="else", version=1), "its entry has the name 'else'"),
    ("cartpole", ENTRY.format(name="cartpole", version=1), "deal-hw has a robot of this name"),
    ("good", ENTRY.format(name="good", version=1), "has a robot of this name; uninstall one of the two"),
]


@pytest.mark.parametrize(("point", "text", "words"), BAD, ids=[point for point, *_ in BAD])
def test_a_bad_plug_in_is_one_line_and_the_others_work(site: Path, point: str, text: str, words: str) -> None:
    """The line names the plug-in and the reason; built-in robots and the good plug-in are there."""
    install(site, "other_robot", point, "plug_in_bad", text)
    robots = table()
    (problem,) = [one.problem for one in robots.plug_ins() if one.problem]
    assert words in problem and "\n" not in problem
    assert problem.startswith(f"plug-in robot {point!r} (") and ") is left out: " in problem
    names = [entry.name for entry in robots.entries()]
    assert names == [*(entry.name for entry in built_in.ROBOTS), "good"]
    found = robots.find("good")
    assert found is not None and found.origin == "good_robot 1.5"
    assert robots.find("cartpole") is built_in.CARTPOLE
    if point not in ("cartpole", "good"):
        with pytest.raises(ConfigurationError) as caught:
            robots.find(point)
        assert str(caught.value) == problem


def test_a_built_in_robot_loads_no_plug_in(site: Path) -> None:
    """Nor does a list of the names: a control process must not wait for the code of others."""
    robots = table()
    assert robots.find("go2") is built_in.GO2
    assert "good" in robots.names()
    assert "plug_in_good" not in sys.modules
    robots.find("good")
    assert "plug_in_good" in sys.modules


def test_a_part_that_does_not_load_is_one_line(site: Path) -> None:
    """The entry is fine, and its driver is not."""
    found = table().find("good")
    assert found is not None
    with pytest.raises(ConfigurationError, match=r"'good' \(good_robot 1\.5\): nowhere:FACTS cannot be"):
        found.model_description()


def test_a_transport_has_the_same_rules(site: Path) -> None:
    """A taken name, and one that works."""
    text = (
        "from deal_hw.robots.entry import TransportEntry\n"
        "ENTRY = TransportEntry(name='{}', api_version=1, transport='nowhere:X')\n"
    )
    install(site, "pigeon", "pigeon", "plug_in_pigeon", text.format("pigeon"), TRANSPORT_GROUP)
    install(site, "my_serial", "serial", "plug_in_serial", text.format("serial"), TRANSPORT_GROUP)
    found = Registry("transport", TRANSPORT_GROUP, TransportEntry, built_in.TRANSPORTS)
    assert found.names() == ("serial", "can", "dds", "zenoh", "pigeon")
    assert {one.name: bool(one.problem) for one in found.plug_ins()} == {"pigeon": False, "serial": True}


def test_the_command_names_a_bad_plug_in_once(site: Path) -> None:
    """On standard error beside a verb's own messages, and by doctor among its findings."""
    install(site, "other_robot", "newer", "plug_in_bad", ENTRY.format(name="newer", version=7))
    run = [sys.executable, "-m", "deal_hw"]
    verb = ["emulate", "cartpole", "--nominal", "--firmware", "python", "--duration-s", "0"]
    emulated = subprocess.run([*run, *verb], capture_output=True, text=True, timeout=120)
    assert emulated.stderr.count("declares API version 7") == 1
    assert emulated.returncode == 0 and emulated.stdout.startswith("port /dev/pts/")
    checked = subprocess.run([*run, "doctor"], capture_output=True, text=True, timeout=120)
    # Doctor breaks long lines.
    shown = " ".join(checked.stdout.split())
    assert shown.count("declares API version 7") == 1 and "plug-in" not in checked.stderr
    assert "robot good (good_robot 1.5)" in shown
