"""What `tools/structure.py` counts, on a small tree that was counted by hand."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest
import structure
from import_graph import Import, circles, imports, levels

PYPROJECT = """
[tool.setuptools.package-dir]
"deal_hw" = "deal_hw"
"deal_hw.calib" = "calib"
"deal_hw.calib.fit" = "calib/fit"
"""

TREE = {
    "pyproject.toml": PYPROJECT,
    "deal_hw/__init__.py": "",
    "deal_hw/errors.py": "X = 1\n\n# A comment.\n",
    "deal_hw/cli/__init__.py": "",
    "deal_hw/cli/calibrate.py": "from deal_hw.cli.run import go\n",
    "deal_hw/cli/run.py": "def go():\n    from deal_hw.calib import pipeline\n",
    "calib/__init__.py": '"""Calibration."""\n',
    "calib/pipeline.py": (
        "from deal_hw.calib.fit.solver import solve_it\nTABLE = {'far': 'deal_hw.calib.far:Far'}\n"
    ),
    "calib/far.py": "from .noise import STD_M, Noise\nTWICE = STD_M * 2\n",
    "calib/noise.py": (
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from deal_hw.calib.far import Far\n"
        "STD_M = 0.01\nQUIET = True\nlow, HIGH = 1, -2.5\nGRID = {'a': (1, 2), 'b': (3, STD_M)}\nNAME = 'x'\n"
    ),
    "calib/fit/__init__.py": "",
    "calib/fit/solver.py": (
        "from deal_hw.calib.fit.steps import step\n"
        "def solve_it(x, cost):\n"
        "    for _ in range(9):\n"
        "        moved = step(x)\n"
        "        if cost(moved) > cost(x):\n"
        "            break\n"
        "        x = moved\n"
        "    return x\n"
        "def plain(rows):\n    return [step(row) for row in rows]\n"
        "def once(x):\n    return step(x)\n"
    ),
    "calib/fit/steps.py": (
        "import numpy as np\nfrom deal_hw import errors\nDAMPINGS = 10.0 ** np.arange(3)\n"
        "def step(x):\n    return np.linalg.solve(np.eye(2), x)\n"
    ),
    "tools/one.py": "a = 1\nb = 2\n",
}
SETTINGS = {
    "calib/effort.py": (
        "from dataclasses import dataclass, replace\nfrom functools import partial\nLIMIT = 3\n"
        "@dataclass(frozen=True)\nclass FitSettings:\n    steps: int = 3\n"
        "    reach: float = 1.0\n    far: int = 2\n"
        "@dataclass(frozen=True)\nclass LongSettings(FitSettings):\n    late: bool = False\n"
        "@dataclass(frozen=True)\nclass FixedSettings:\n    share: float = 0.5\n"
        "@dataclass(frozen=True)\nclass ShownOptions:\n    shown: int = 1\n"
        "@dataclass(frozen=True)\nclass ReadSettings:\n    read: int = 1\n"
        "@dataclass(frozen=True)\nclass TableConfig:\n    rate: float = 1.0\n    rest: float = 1.0\n"
        "class Trainer:\n    config = TableConfig\n"
        "TASKS = {'one': {'rate': 2.0}, 'rest': 3}\n"
        "def read(values):\n    return from_values(ReadSettings, values)\n"
        "class Settings:\n    pass\n"
        "FIXED = FixedSettings()\nlong = partial(LongSettings, late=True)\n"
    ),
    "deal_hw/cli/effort.py": (
        "from dataclasses import dataclass\nfrom deal_hw.calib.effort import ShownOptions\n"
        "@dataclass\nclass Effort:\n    rules: ShownOptions\n"
    ),
    "tests/test_effort.py": (
        "from deal_hw.calib import effort\n"
        "def test_it(monkeypatch):\n"
        "    monkeypatch.setattr(effort, 'LIMIT', 1)\n    monkeypatch.setattr(os, 'CDLL', print)\n"
        "    monkeypatch.setattr('deal_hw.calib.effort.FitSettings', None)\n"
        "    effort.LongSettings(4)\n"
    ),
    "tools/try_effort.py": "def far(x: FitSettings):\n    return replace(x, far=1)\n",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a checkout with the small tree in it."""
    for name, text in TREE.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


@pytest.fixture
def counted(tree: Path) -> dict[str, Any]:
    """Return the counts of the small tree."""
    return structure.count(tree)


def test_lines(counted: dict[str, Any]) -> None:
    """Blank lines and comments count; tools are shown beside."""
    # calib: 1 + 2 (pipeline) + 2 (far) + 8 (noise) + 12 (solver) + 5 (steps) = 30; deal_hw: 3 + 1 + 2 = 6.
    assert counted["lines_by_package"] == {
        "calib": 13,
        "calib/fit": 17,
        "deal_hw": 3,
        "deal_hw/cli": 3,
    }
    assert counted["summary"]["calib/ lines"] == 30
    assert counted["summary"]["product lines"] == 36
    assert counted["summary"]["lines of tools/"] == 2


def test_rooms(counted: dict[str, Any]) -> None:
    """A sub-package is one room; text is no edge, a type checker's import is one; __init__ is no room."""
    assert counted["rooms"] == {"far": ["noise"], "fit": [], "noise": ["far"], "pipeline": ["fit"]}
    assert counted["summary"]["calib/ edges between rooms"] == 3
    # far and noise are a circle of two; pipeline stands on fit.
    assert counted["summary"]["calib/ levels"] == 2
    assert counted["circles_of_rooms"] == [["far", "noise"]]


def test_circles_with_and_without_type_checking(counted: dict[str, Any]) -> None:
    """The one circle of modules is closed by an import for type checkers."""
    assert counted["circles"] == [["deal_hw.calib.far", "deal_hw.calib.noise"]]
    assert counted["circles_without_types"] == []


def test_closure(counted: dict[str, Any]) -> None:
    """Imports in functions are followed; at load nothing of calib is; by tables everything is."""
    target = ["deal_hw.calib.fit.solver", "deal_hw.calib.fit.steps", "deal_hw.calib.pipeline"]
    assert counted["closure"] == {
        "target": target,
        "at_load": [],
        "with_tables": sorted([*target, "deal_hw.calib.far", "deal_hw.calib.noise"]),
    }


def test_numeric_constants(counted: dict[str, Any]) -> None:
    """Numbers, containers of numbers, and what is computed from them; neither bools nor texts."""
    found = {(row["file"], row["name"]): row["literal"] for row in counted["numeric_constants"]}
    assert found == {
        ("calib/far.py", "TWICE"): False,
        ("calib/fit/steps.py", "DAMPINGS"): False,
        ("calib/noise.py", "GRID"): False,
        ("calib/noise.py", "HIGH"): True,
        ("calib/noise.py", "STD_M"): True,
        ("calib/noise.py", "low"): True,
    }
    assert counted["summary"]["calib/ numeric module constants, UPPER_CASE"] == 5


def test_least_squares_candidates(counted: dict[str, Any]) -> None:
    """A loop that solves by an imported step is found, and so is a comprehension; one call alone is not."""
    found = [(row["function"], row["accepting"]) for row in counted["least_squares_candidates"]]
    assert found == [("calib/fit/solver.py:plain", False), ("calib/fit/solver.py:solve_it", True)]


def test_settings_and_who_sets_them(tree: Path) -> None:
    """A keyword, a value in order, `replace`, an option, text and a table set a field; a default does not."""
    for name, text in SETTINGS.items():
        (tree / name).parent.mkdir(exist_ok=True)
        (tree / name).write_text(text, encoding="utf-8")
    counted = structure.count(tree)
    assert {row["class"]: row["fields"] for row in counted["settings"]} == {
        "FitSettings": {"steps": ["tests"], "reach": [], "far": ["tools"]},
        "LongSettings": {"late": ["product"]},
        "FixedSettings": {"share": []},
        "ShownOptions": {"shown": ["command line"]},
        "ReadSettings": {"read": ["text"]},
        "TableConfig": {"rate": ["product"], "rest": []},
    }
    assert counted["summary"]["calib/ settings classes that nobody gives an argument"] == 1
    assert counted["summary"]["calib/ settings fields that nobody sets"] == 3
    assert counted["replaced_by_tests"] == [
        "tests/test_effort.py:3 effort.LIMIT",
        "tests/test_effort.py:5 deal_hw.calib.effort.FitSettings",
    ]


def test_init_that_is_imported_from_is_a_room(tree: Path) -> None:
    """A name that a room takes from the folder itself hides no edge."""
    (tree / "calib/__init__.py").write_text("from deal_hw.calib.pipeline import TABLE\n", encoding="utf-8")
    (tree / "calib/far.py").write_text("from deal_hw.calib import TABLE, noise\n", encoding="utf-8")
    rooms = structure.count(tree)["rooms"]
    assert rooms["__init__"] == ["pipeline"]
    assert rooms["far"] == ["__init__", "noise"]


def test_other_folder_and_written_file(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder inside deal_hw can be named without it; --json is read back by --compare."""
    out = tree / "old.json"
    assert structure.main(["--root", str(tree), "--folder", "cli", "--json", str(out)]) == 0
    found = json.loads(out.read_text(encoding="utf-8"))
    assert found["rooms"] == {"calibrate": ["run"], "run": []}
    assert found["argv"][0] == "tools/structure.py" and "git_commit" in found["machine"]
    assert str(tree) not in out.read_text(encoding="utf-8")
    (tree / "deal_hw/errors.py").write_text("X = 1\n" * 21, encoding="utf-8")
    capsys.readouterr()
    assert structure.main(["--root", str(tree), "--folder", "cli", "--compare", str(out)]) == 0
    (line,) = [text for text in capsys.readouterr().out.splitlines() if text.startswith("product lines")]
    # 36 lines before; 3 of them became 21.
    assert line.split() == ["product", "lines", "36", "54", "1.50"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--folder", "nowhere"], "there is no package in folder 'nowhere'"),
        (["--verb", "nothing"], "no verb 'nothing'"),
        (["--compare", "pyproject.json"], "is no file of --json"),
    ],
)
def test_what_cannot_be_counted(
    tree: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    """A wrong name is one line and exit code 2."""
    (tree / "pyproject.json").write_text('{"format": "other"}', encoding="utf-8")
    arguments = [str(tree / word) if word.endswith(".json") else word for word in arguments]
    assert structure.main(["--root", str(tree), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_imports_by_when() -> None:
    """Each kind of import is found once, with when it happens."""
    source = (
        "import a.b\n"
        "from . import c\n"
        "def f(x=__import__('d')):\n"
        "    import e\n"
        "    return importlib.import_module('g.h')\n"
        "class K:\n    import i\n"
        "TEXT = 'deal_hw.x:Y'\n"
    )
    assert list(imports(ast.parse(source))) == [
        Import(1, "a.b"),
        Import(2, ".", ("c",)),
        Import(3, "d", (), "call", by_call=True),
        Import(4, "e", (), "call"),
        Import(5, "g.h", (), "call", by_call=True),
        Import(7, "i"),
        Import(8, "deal_hw.x", (), "text"),
    ]


def test_levels_and_circles_of_a_graph() -> None:
    """A chain of three whose middle is a circle of two stands four high."""
    graph = {
        "a": frozenset({"b"}),
        "b": frozenset({"c", "d"}),
        "c": frozenset({"b"}),
        "d": frozenset[str](),
    }
    assert circles(graph) == [["b", "c"]]
    assert levels(graph) == 4
