"""Collecting the tests loads no package that takes long: each process of `make test` would pay for it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = (
    "botorch",
    "cyclonedds",
    "matplotlib",
    "nbformat",
    "rerun",
    "rsl_rl",
    "scipy.ndimage",
    "scipy.signal",
    "scipy.stats",
    "stable_baselines3",
    "tensordict",
    "torch",
)
"""Each of them takes 0.1 s to 2.5 s. With all of them the collection took twice as long."""


@pytest.mark.parametrize("name", HEAVY)
def test_collecting_the_tests_does_not_load(name: str, loaded_by_collection: frozenset[str]) -> None:
    """Import it inside the test or the function that needs it, or through `deal_hw.on_use`.

    Who loads it: `python -X importtime -m pytest --collect-only -q -s tests`. In a run of a part of the tests
    this is true of that part.
    """
    assert name not in loaded_by_collection


def test_a_heavy_import_at_the_top_of_a_test_file_is_found(tmp_path: Path) -> None:
    """The note is taken after the collection: a file that imports one at its top fails the test above."""
    for name in ("conftest.py", "house/test_collection.py"):
        target = tmp_path / name
        target.parent.mkdir(exist_ok=True)
        target.write_text((ROOT / "tests" / name).read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "test_heavy.py").write_text("import scipy.signal\n", encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "does_not_load"]
    done = subprocess.run(
        [*command, "--import-mode=importlib"],
        cwd=tmp_path,
        env={**os.environ, "PYTEST_ADDOPTS": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "[scipy.signal]" in done.stdout and "[scipy.stats]" in done.stdout, done.stdout + done.stderr
    assert "3 failed" in done.stdout, done.stdout
