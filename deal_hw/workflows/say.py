"""How a workflow tells its user something while it runs: it calls what it was given with a sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable

Say = Callable[[str], None]
"""Called with a sentence for the user."""


def silent(text: str) -> None:
    """Say nothing."""


def aloud(text: str) -> None:
    """Say it on standard error."""
    print(text, file=sys.stderr)
