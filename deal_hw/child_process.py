"""What a child process is started with."""

from __future__ import annotations

import os
import sys
from typing import Any


def own_process_group() -> dict[str, Any]:
    """Return the arguments of ``subprocess.Popen`` that put a child into a process group of its own.

    Ctrl-C in the terminal then reaches the parent alone, also while the child's interpreter starts.
    """
    if sys.version_info >= (3, 11):
        return {"process_group": 0}
    return {"preexec_fn": os.setpgrp}
