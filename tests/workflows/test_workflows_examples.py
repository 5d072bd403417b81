"""The examples run as they are, and are short enough to read at once."""

from __future__ import annotations

import functools
import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import render_notebook

import deal_hw
from deal_hw.errors import InsufficientDataError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCRIPTS: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "calibrate_from_arrays": ([], ("shoulder", "calibrated.xml")),
    "cartpole_loop": (["--steps", "1200"], ("cart.mass", "deployed: ", "truth")),
    "make_crane": (["crane"], ("crane/crane.xml", "crane/other.csv")),
    "compare_models": ([], ("nominal: position error", "calibrated: position error", "compare.rrd")),
}
"""Script -> arguments, and what it must print at its end."""
SHORT: dict[str, Any] = {"refine": False, "population": 20, "generations": 3}
"""A calibration that ends at once, for a script in real time, for which other such tests have to wait."""
IN_REAL_TIME = ("cartpole_loop", "compare_models")
"""Scripts that emulate a robot as a process and command it."""
NOTEBOOK = EXAMPLES / "hidden_payload.ipynb"
EXECUTE = """
import sys
import nbformat
from nbclient import NotebookClient

notebook = nbformat.read(sys.argv[1], as_version=4)
nbformat.validate(notebook)
NotebookClient(notebook, kernel_name="python3", timeout=300).execute()
nbformat.write(notebook, sys.argv[2])
"""
"""In a process of its own: the client leaves sockets to the garbage collector."""


def test_every_example_is_tried() -> None:
    """No script or notebook without its test, and none longer than forty lines."""
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SCRIPTS)
    assert list(EXAMPLES.glob("*.ipynb")) == [NOTEBOOK]
    for name in SCRIPTS:
        assert len((EXAMPLES / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= 40


def run(script: Path, tries: int = 3) -> None:
    """Run a script; again where this computer paused so long that the safety filter ended a recording."""
    try:
        runpy.run_path(str(script), run_name="__main__")
    except InsufficientDataError as error:
        if tries == 1 or "too short" not in str(error):
            raise
        run(script, tries - 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.real_time] if name in IN_REAL_TIME else [], id=name)
        for name in SCRIPTS
    ],
)
def test_a_script_runs(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It reaches its end and shows what it is about."""
    arguments, words = SCRIPTS[name]
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    if name == "compare_models":  # cartpole_loop deploys a policy, for which the verdict counts.
        monkeypatch.setattr(deal_hw, "calibrate", functools.partial(deal_hw.calibrate, **SHORT))
    run(EXAMPLES / f"{name}.py")
    reported = capsys.readouterr().out
    assert all(word in reported for word in words), reported


def outputs_of(notebook: Path) -> list[dict[str, Any]]:
    """Return what the cells of a notebook show."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [output for cell in cells if cell["cell_type"] == "code" for output in cell["outputs"]]


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    """The payload is found; the intervals hold the truth; a figure is drawn; no outputs are committed."""
    assert not any(outputs_of(NOTEBOOK))
    done = tmp_path / "done.ipynb"
    words = [sys.executable, "-c", EXECUTE, str(NOTEBOOK), str(done)]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    subprocess.run(words, check=True, cwd=tmp_path, env=environment, capture_output=True, timeout=400)
    outputs = outputs_of(done)
    shown = ["".join(output.get("data", {}).get("text/html", "")) for output in outputs]
    assert any("<td>hand.mass</td>" in html and "green" in html for html in shown)
    (table,) = ("".join(output["text"]) for output in outputs if output.get("name") == "stdout")
    rows = {line.split()[0]: line.split() for line in table.splitlines()[1:]}
    mass = rows["hand.mass"]
    assert float(mass[2]) == pytest.approx(0.35, abs=0.002) and mass[-1] == "inside"
    assert sum(row[-1] == "inside" for row in rows.values()) >= 4 and len(rows) == 5
    assert any("image/png" in output.get("data", {}) for output in outputs)


def test_the_notebooks_page_has_its_code() -> None:
    """After a change of the notebook: python tools/render_notebook.py."""
    page = render_notebook.PAGE.read_text(encoding="utf-8")
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"]).strip()
        assert (render_notebook.code_block(source) if cell["cell_type"] == "code" else source) in page
