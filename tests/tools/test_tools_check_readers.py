"""The samples that other people's programs read, and those programs that the tests have at hand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import check_readers
import pytest

HERE = ("mcap", "onnx", "mujoco", "rerun", "environments")
"""Their packages come with the extras; LeRobot's, Foxglove's and mjlab's do not."""


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the samples once."""
    folder = tmp_path_factory.mktemp("samples")
    check_readers.make_samples(folder)
    return folder


def test_each_reader_has_its_script() -> None:
    """And something to read."""
    for reader in check_readers.READERS:
        assert (check_readers.SCRIPTS / reader.script).is_file()
        assert reader.inputs


@pytest.mark.slow
def test_every_input_is_among_the_samples(samples: Path) -> None:
    """No reader asks for what is not written."""
    for reader in check_readers.READERS:
        assert all((samples / name).exists() for name in reader.inputs)


@pytest.mark.slow
@pytest.mark.parametrize("name", HERE)
def test_readers_at_hand_pass(samples: Path, name: str) -> None:
    """What the tool runs in environments of their own runs here, too."""
    (reader,) = [reader for reader in check_readers.READERS if reader.name == name]
    for given in reader.inputs:
        call = [sys.executable, str(check_readers.SCRIPTS / reader.script), str(samples / given)]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_program_that_is_not_there_and_one_that_fails_are_said(samples: Path, tmp_path: Path) -> None:
    """A row that fails says why, and the others still run."""
    absent = check_readers.Reader(
        name="absent", packages=("no-such-package",), script="read_mcap.py", inputs=("policy.onnx",)
    )
    (found,) = check_readers.check(absent, samples, tmp_path, ["--no-index"])
    assert not found.passed and "not installed" in found.words
    wrong = check_readers.Reader(name="wrong", packages=(), script="read_mcap.py", inputs=("policy.onnx",))
    (found,) = check_readers.check(wrong, samples, tmp_path, [])
    assert not found.passed and found.versions.startswith("gymnasium")
