"""What a check found: of a computer, a robot, a recording or a calibration."""

from __future__ import annotations

import enum
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ParamSpec, TypeVar

from deal_hw.errors import short

Arguments = ParamSpec("Arguments")
Found = TypeVar("Found")
Otherwise = TypeVar("Otherwise")


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


@dataclass(frozen=True, slots=True)
class SafeChecks:
    """Runs checks of a result that is there already: one that fails is named, and the result stands.

    Attributes:
        failed: Why checks failed, by their names.
    """

    failed: dict[str, str] = field(default_factory=dict)

    def run(
        self,
        name: str,
        otherwise: Otherwise,
        check: Callable[Arguments, Found],
        *arguments: Arguments.args,
        **named: Arguments.kwargs,
    ) -> Found | Otherwise:
        """Return what a check of these arguments returns; where it raises, note why, return ``otherwise``."""
        try:
            return check(*arguments, **named)
        except Exception as err:
            self.failed[name] = reason_of(err)
            return otherwise

    @property
    def alarms(self) -> tuple[Finding, ...]:
        """An alarm for each failed check."""
        return tuple(
            Finding.alarm(
                f"The check of {name} failed: {why}.",
                "It says nothing of this result, neither good nor bad.",
                "Use the result without it, and report this line.",
            )
            for name, why in self.failed.items()
        )


def reason_of(err: Exception) -> str:
    """Return an error as text: its kind, its message, and where it came from."""
    frames = traceback.extract_tb(err.__traceback__)
    at = f" ({frames[-1].filename.rpartition('/')[2]}, line {frames[-1].lineno})" if frames else ""
    said = short(err).rstrip(".")
    return f"{type(err).__name__}{said and f': {said}'}{at}"


def worst(findings: Sequence[Finding]) -> Severity:
    """Return the worst severity; that of no finding is OK."""
    order = list(Severity)
    return max((finding.severity for finding in findings), key=order.index, default=Severity.OK)
