"""Findings of checks, each with its remedy."""

from __future__ import annotations

import enum
from dataclasses import asdict, dataclass
from typing import Any


class Level(enum.Enum):
    """Severity of a finding."""

    OK = "ok"
    NOTE = "note"
    """Worth knowing; nothing to do."""
    WARN = "warn"
    """Works, but not as well as possible."""
    FAIL = "fail"
    """Does not work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding.

    Attributes:
        area: The checked area, such as "scheduling".
        level: Its severity.
        message: The finding, one sentence.
        remedy: What to do; "" if nothing is wrong.
    """

    area: str
    level: Level
    message: str
    remedy: str = ""

    @classmethod
    def judged(cls, area: str, wrong: bool, message: str, remedy: str) -> Finding:
        """Return a warning with its remedy where something is wrong, else the same message as OK."""
        return cls(area, Level.WARN, message, remedy) if wrong else cls(area, Level.OK, message)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**asdict(self), "level": self.level.value}
