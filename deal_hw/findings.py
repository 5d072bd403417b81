"""What an examination found: each finding with its remedy."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any


class Level(enum.Enum):
    """How bad a finding is."""

    OK = "ok"
    NOTE = "note"
    """Worth knowing; nothing to do."""
    WARN = "warn"
    """Works, but worse than it could."""
    FAIL = "fail"
    """Does not work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding.

    Attributes:
        area: What was looked at, such as "scheduling".
        level: How bad it is.
        message: What was found, one sentence.
        remedy: What to do; "" where nothing is wrong.
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
