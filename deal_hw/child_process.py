"""Options for starting a child process."""

from __future__ import annotations

import os
import sys
from typing import Any


def own_process_group() -> dict[str, Any]:
    """Return the arguments of ``subprocess.Popen`` that put a child into its own process group.

    Ctrl-C in the terminal then reaches only the parent, even while the child's interpreter starts.
    """
    if sys.version_info >= (3, 11):
        return {"process_group": 0}
    return {"preexec_fn": os.setpgrp}
