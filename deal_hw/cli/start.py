"""The `deal-hw` command in Python: gives an emergency stop real-time priority, then imports the rest.

The script of the command has done so before Python started, where it could. On a busy computer each hundredth
of a second takes several times as long at ordinary priority.
"""

from __future__ import annotations

import os
import sys

from deal_hw.priorities import STOP_PRIORITY


def main() -> int:
    """Run the command and return its exit code."""
    # The name that the user typed, for messages.
    sys.argv[0] = sys.argv[0].removesuffix("-python")
    if sys.argv[1:2] == ["stop"]:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(STOP_PRIORITY))
        except OSError:
            # Not permitted: it works all the same, later on a busy computer.
            pass
    from deal_hw.cli.main import main as run

    return run()
