"""Run folders say what was run with what."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from deal_hw.data.files import write_json
from deal_hw.data.run_folder import RunFolder
from deal_hw.errors import DatasetError


def test_run_json_says_what_was_run(tmp_path: Path) -> None:
    """Command line, settings, seeds, versions and times are there; the folders exist."""
    run = RunFolder(tmp_path / "runs" / "demo")
    with run:
        run.start({"profile": "sensor"}, {"emulator": 3}, argv=["deal-hw", "demo"])
        assert run.read()["status"] == "running"
        run.write("summary.json", {"a": 1})
    values = run.read()
    assert values["status"] == "finished"
    assert values["argv"] == ["deal-hw", "demo"]
    assert values["settings"] == {"profile": "sensor"}
    assert values["seeds"] == {"emulator": 3}
    assert values["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert values["versions"]["deal-hw"]
    assert values["start_utc"] <= values["end_utc"]
    assert values["processors"] >= 1
    assert all(folder.is_dir() for folder in (run.dataset, run.calibration, run.policies))
    assert json.loads(run.summary.read_text()) == {"a": 1}


@pytest.mark.parametrize(
    ("error", "status"), [(ValueError("bad"), "failed"), (KeyboardInterrupt(), "interrupted")]
)
def test_run_that_ends_badly_says_so(tmp_path: Path, error: BaseException, status: str) -> None:
    """An exception and Ctrl-C leave their mark in run.json."""
    run = RunFolder(tmp_path / "demo")
    with pytest.raises(type(error)), run:
        run.start({}, {})
        raise error
    assert run.read()["status"] == status


def test_unusable_folders_are_said(tmp_path: Path) -> None:
    """A folder that cannot be made, and one that is no run, are errors with their paths."""
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="cannot be made"):
        RunFolder(tmp_path / "file" / "demo").start({}, {})
    with pytest.raises(DatasetError, match=r"run\.json cannot be read: .*; name a run's folder"):
        RunFolder(tmp_path).read()


def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    """Values that are not JSON do not cost what was there, and leave nothing beside it."""
    path = tmp_path / "a.json"
    write_json(path, {"old": 1})
    with pytest.raises(TypeError):
        write_json(path, {"new": object()})
    assert json.loads(path.read_text()) == {"old": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_data_loads_nothing_heavy() -> None:
    """The whole data package imports without mujoco, torch, scipy and rerun."""
    code = (
        "import sys, pkgutil, importlib, deal_hw.data as d\n"
        "[importlib.import_module(m.name) for m in pkgutil.walk_packages(d.__path__, 'deal_hw.data.')]\n"
        "import deal_hw.cli.data\n"
        "from deal_hw.data.run_folder import versions; versions()\n"
        "print(sorted({'mujoco', 'torch', 'scipy', 'rerun', 'onnxruntime'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
