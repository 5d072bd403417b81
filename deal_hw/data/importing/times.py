"""Reads dates and times of day, as spreadsheets and loggers write them, in seconds."""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from typing import Final

DAY_S: Final = 86_400
_TIME: Final = re.compile(
    r"(?:(?P<date>\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4})(?:[T ]\s*|:)"
    r"|(?P<days>\d+) days?,? )?"
    r"(?P<hour>\d{1,2}):(?P<minute>[0-5]\d):(?P<second>[0-5]\d|60)(?P<fraction>[.,]\d*)?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>Z|z|UTC|[+-]\d\d:?(?:\d\d)?)?"
)


def is_time(text: str) -> bool:
    """Return whether a text is a time of day, with or without a date."""
    return ":" in text and _TIME.fullmatch(text.strip()) is not None


@dataclass(slots=True)
class FirstDay:
    """The first date in a file, which all its columns of times count from.

    Attributes:
        ordinal: Its number in the calendar; None before there is one.
    """

    ordinal: int | None = None


class Times:
    """Reads the times of one column, in order, in seconds since the midnight before the file's first one.

    A time of day without a date that falls back by more than half a day is one of the next day.
    """

    def __init__(self, first: FirstDay) -> None:
        self._first = first
        self._days, self._last = 0, 0.0
        self._written = ""

    def seconds(self, text: str) -> float:
        """Return a time [s].

        Raises:
            ValueError: It is no time, or its date has two meanings.
        """
        found = _TIME.fullmatch(text.strip())
        if found is None:
            raise ValueError("no time")
        hour = int(found["hour"])
        if found["half"]:
            hour = hour % 12 + (12 if found["half"].lower() == "pm" else 0)
        if hour > 24:
            raise ValueError(f"hour {hour}")
        # Fractions have up to nine digits; whole seconds stay exact beside them.
        fraction = float("0." + (found["fraction"] or ".0")[1:].ljust(1, "0"))
        seconds = hour * 3600 + int(found["minute"]) * 60 + int(found["second"]) - _zone_s(found["zone"])
        days = self._day(found["date"])
        if found["date"] is None:
            self._days += self._last - seconds > DAY_S / 2
            self._last = seconds
            days = self._days + int(found["days"] or 0)
        return days * DAY_S + seconds + fraction

    def _day(self, written: str | None) -> int:
        """Return the number of days since the file's first date."""
        if written is None:
            return 0
        a, b, c = map(int, re.split(r"[-/.]", written))
        if a > 999:
            year, month, day = a, b, c
        elif "." in written or a > 12:
            year, month, day = c, b, a
        else:
            # 03/04/2026 is in March or in April, which only matters where the date changes.
            if b <= 12 and self._written and self._written != written:
                raise ValueError(f"the date {written} may be of two months; write it as 2026-12-31")
            self._written = written
            year, month, day = c, a, b
        ordinal = datetime.date(year, month, day).toordinal()
        if self._first.ordinal is None:
            self._first.ordinal = ordinal
        return ordinal - self._first.ordinal


def _zone_s(zone: str | None) -> int:
    """Return how far a time zone is ahead of UTC [s]."""
    if not zone or zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "").ljust(4, "0")
    return (int(digits[:2]) * 3600 + int(digits[2:]) * 60) * (1 if zone[0] == "+" else -1)
