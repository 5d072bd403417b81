"""How a child process starts, and how it ends with its parent."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Any

_PR_SET_PDEATHSIG = 1


def own_process_group() -> dict[str, Any]:
    """Return the arguments of ``subprocess.Popen`` that put a child into its own process group.

    Ctrl-C in the terminal then reaches only the parent, even while the child's interpreter starts.
    """
    if sys.version_info >= (3, 11):
        return {"process_group": 0}
    return {"preexec_fn": os.setpgrp}


def signal_at_end_of_parent(parent_pid: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel send this process a signal when its parent ends, however it ends.

    Only the signal's number is reliable: with several threads in the parent, the end of the one that started
    this process sends it, and ``getppid`` still names the parent.

    Args:
        parent_pid: The parent's process id, as the parent gave it.
        number: The signal.

    Raises:
        ProcessLookupError: The parent has already ended.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    # The parent may have died before the call above; then no signal ever comes.
    if os.getppid() != parent_pid:
        raise ProcessLookupError(f"the parent process {parent_pid} has ended")
