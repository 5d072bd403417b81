"""What a check found: of a computer, a robot, a recording or a calibration."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass


class Severity(str, enum.Enum):
    """Severity of a finding, the least first."""

    OK = "ok"
    NOTE = "note"
    """Worth knowing; nothing to do."""
    WARN = "warn"
    """Works, but not as well as possible."""
    FAIL = "fail"
    """Does not work, or cannot be used."""

    def __str__(self) -> str:
        """Return the value, as for a plain text."""
        return str(self.value)


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding. Documents have their own shapes of it: each writer chooses the keys.

    Attributes:
        code: What was checked or suspected, such as "scheduling", "gaps" or "backlash"; "" for an alarm
            without a name.
        severity: Its severity.
        seen: What was seen, with numbers and units.
        do: What to do; "" if nothing is wrong.
        means: What it means; "" where that is plain.
        subject: What it is about, such as joints, the clearest first.
    """

    code: str
    severity: Severity
    seen: str
    do: str = ""
    means: str = ""
    subject: tuple[str, ...] = ()

    @classmethod
    def judged(cls, code: str, wrong: bool, seen: str, do: str) -> Finding:
        """Return a warning with its remedy where something is wrong, else the same sentence as OK."""
        return cls(code, Severity.WARN, seen, do) if wrong else cls(code, Severity.OK, seen)

    @classmethod
    def alarm(cls, seen: str, means: str, do: str) -> Finding:
        """Return a reason to distrust a result.

        Raises:
            ValueError: One of the three parts is missing.
        """
        if not all(part.strip() for part in (seen, means, do)):
            raise ValueError(
                "an alarm has three parts: what was seen, what it means, what to do; "
                f"got {(seen, means, do)!r}"
            )
        return cls("", Severity.WARN, seen, do, means)

    @property
    def message(self) -> str:
        """All its parts in one line."""
        text = self.seen
        for part in filter(None, (self.means, self.do)):
            text += f" {part}" if text.endswith(".") else f"; {part}"
        return text

    def __str__(self) -> str:
        """Return all its parts in one line."""
        return self.message


def worst(findings: Sequence[Finding]) -> Severity:
    """Return the worst severity; that of no finding is OK."""
    order = list(Severity)
    return max((finding.severity for finding in findings), key=order.index, default=Severity.OK)
