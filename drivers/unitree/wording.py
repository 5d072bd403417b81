"""What messages of the shared parts say of one kind of robot."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Wording:
    """Parts of messages that differ between robots.

    Attributes:
        name: The robot, as messages begin.
        free: How to free the robot from its own controller by hand, as a request.
        quiet: How to make it harmless by hand, as a request.
        off: How to switch its own controller off, with the beginning "if it is".
    """

    name: str
    free: str
    quiet: str
    off: str
