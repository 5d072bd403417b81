"""The tool that measures how long verbs live after a signal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.real_time

TOOL = Path(__file__).parents[2] / "tools" / "measure_interrupts.py"


def test_a_reader_that_has_read_enough_ends_it_without_a_traceback(tmp_path: Path) -> None:
    """As with ``| head``."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, str(TOOL), str(tmp_path), "--runs", "0"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (-signal.SIGPIPE, "")
