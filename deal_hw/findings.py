"""Findings of checks, each with its remedy."""

from __future__ import annotations

import enum
from dataclasses import dataclass
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

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "area": self.area,
            "level": self.level.value,
            "message": self.message,
            "remedy": self.remedy,
        }
