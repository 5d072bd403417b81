"""Real-time priorities (SCHED_FIFO) of the processes of a run and beside it, a higher one first."""

from __future__ import annotations

from typing import Final

FIFO_PRIORITY: Final = 50
"""Of the control process."""
SUPERVISOR_PRIORITY: Final = FIFO_PRIORITY + 1
"""Above the control process, since it must be able to kill one that blocks a processor."""
TRANSPORT_PRIORITY: Final = FIFO_PRIORITY - 10
"""Of the supervisor's transport threads, because damping must be sent on a busy machine, too."""
STOP_PRIORITY: Final = FIFO_PRIORITY - 5
"""Of ``deal-hw stop``: below the two processes that make a robot passive, and above all else, since it must
reach them. Until it has asked them to end, it computes for 0.1 s, and transport threads may wait so long. The
number also stands in the script of the command, ``deal_hw/cli/deal-hw``."""
