"""The tool that measures how long verbs live after a signal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from measure_interrupts import sound

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


def test_a_verb_that_was_refused_is_no_sound_run() -> None:
    """It had ended before the signal, as a verb that was done."""
    done = {
        "signal": "SIGINT",
        "took_s": 0.0,
        "exit_code": 0,
        "ended_before": True,
        "processes_left": 0,
        "broken_files": [],
    }
    assert sound(done) and not sound({**done, "exit_code": 2})
