"""Wait for another process or thread that gives no event: the only place of the tests that sleeps."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 120.0
"""Only a hung process takes this long: ten other programs at once make a start last ten times as long [s]."""
_POLL_S = 0.01


def until(ready: Callable[[], object], what: str, patience_s: float = PATIENCE_S) -> None:
    """Return as soon as something is so.

    Args:
        ready: Tells whether it is.
        what: What it is, for the message.
        patience_s: The longest wait [s].

    Raises:
        TimeoutError: It never was.
    """
    end_s = time.monotonic() + patience_s
    while not ready():
        if time.monotonic() > end_s:
            raise TimeoutError(f"after {patience_s:g} s not yet: {what}")
        time.sleep(_POLL_S)
