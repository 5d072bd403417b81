"""Pacing on absolute deadlines, and the report on its regularity."""

from __future__ import annotations

import contextlib
import math
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.clock import Clock
from deal_hw.errors import ConfigurationError
from deal_hw.schema import from_values, plain


@dataclass(frozen=True, slots=True)
class Spread:
    """Median, 99th percentile and maximum of a set of durations [s]; NaN for an empty set."""

    p50_s: float
    p99_s: float
    max_s: float

    @classmethod
    def of(cls, samples_ns: array[int]) -> Spread:
        """Return the spread of samples in ns."""
        if not samples_ns:
            return cls(float("nan"), float("nan"), float("nan"))
        values = np.array(samples_ns) * 1e-9
        return cls(*(round(float(v), 9) for v in (*np.percentile(values, (50, 99)), values.max())))


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopTimingReport:
    """How regular the cycles of a run were.

    Attributes:
        rate_hz: The requested rate [Hz].
        cycles: Cycles run.
        period: Time from one cycle's start to the next.
        lateness: Time from a cycle's deadline to its start.
        overruns: Cycles that started more than a tenth of a period late.
        overruns_beyond_period: Of these, cycles that started a whole period late or more.
        skipped_periods: Deadlines passed over because of that.
        state_age: Age of the newest state when the command was computed.
        sections: Time spent in each part of a cycle.
        states: State samples received.
        cycles_without_state: Cycles in which no new state had arrived.
        losses: Records that the recorder refused.
        transport_errors: Corrupt frames and gaps in the state's sequence numbers.
        scheduling: What the operating system granted.
    """

    rate_hz: float
    cycles: int
    period: Spread
    lateness: Spread
    overruns: int
    overruns_beyond_period: int
    skipped_periods: int
    state_age: Spread
    sections: dict[str, Spread] = field(default_factory=dict)
    states: int = 0
    cycles_without_state: int = 0
    losses: int = 0
    transport_errors: int = 0
    scheduling: str = "default"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; None for a value that was never measured."""
        values: dict[str, Any] = plain(self)
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> LoopTimingReport:
        """Return the report that :meth:`to_json` wrote; errors as :func:`deal_hw.schema.from_values`."""

        def numbers(part: Any) -> Any:
            if isinstance(part, Mapping):
                return {key: numbers(value) for key, value in part.items()}
            return math.nan if part is None else part

        return from_values(cls, numbers(values))

    def lines(self) -> list[str]:
        """Return the report as lines for a person."""

        def ms(spread: Spread) -> str:
            return f"{spread.p50_s * 1e3:.2f} / {spread.p99_s * 1e3:.2f} / {spread.max_s * 1e3:.2f} ms"

        return [
            f"cycles      {self.cycles} at {self.rate_hz:g} Hz, scheduling {self.scheduling}",
            f"period      {ms(self.period)} (p50 / p99 / max)",
            f"lateness    {ms(self.lateness)}",
            f"overruns    {self.overruns}, beyond one period {self.overruns_beyond_period}",
            f"state age   {ms(self.state_age)}",
            f"states      {self.states}, cycles without {self.cycles_without_state}",
            f"transport   {self.transport_errors} errors",
            f"losses      {self.losses} records refused by the recorder",
        ]


class LoopTiming:
    """Paces a loop on absolute deadlines: lateness does not accumulate, lost periods are skipped.

    Call :meth:`begin` once a cycle, after :attr:`deadline_ns`; the first call sets the grid of deadlines.
    """

    def __init__(self, clock: Clock, rate_hz: float) -> None:
        if not rate_hz > 0:
            raise ConfigurationError(f"a loop rate of {rate_hz!r} Hz: give a rate above 0 Hz")
        self._clock = clock
        self._rate_hz = rate_hz
        self._period_ns = round(1e9 / rate_hz)
        self._first_ns: int | None = None
        self._start_ns = 0
        self._index = -1
        self._skipped = 0
        self._periods = array("q")
        self._lateness = array("q")
        self._ages = array("q")
        self._sections: dict[str, array[int]] = {}

    @property
    def period_ns(self) -> int:
        """Nominal period [ns]."""
        return self._period_ns

    @property
    def deadline_ns(self) -> int:
        """Deadline of the next cycle [ns]; before the first one the current time."""
        if self._first_ns is None:
            return self._clock.now_ns()
        return self._first_ns + (self._index + 1) * self._period_ns

    @property
    def next_index(self) -> int:
        """Number of the next cycle on the grid, unless it starts late."""
        return self._index + 1

    def begin(self) -> tuple[int, int]:
        """Wait for the deadline, start a cycle and return its number on the grid and its deadline [ns]."""
        due = self.deadline_ns
        self._clock.sleep_until_ns(due)
        now = self._clock.now_ns()
        if self._first_ns is None:
            self._first_ns = due = now
        else:
            self._periods.append(now - self._start_ns)
        late = now - due
        self._lateness.append(late)
        skipped = late // self._period_ns
        self._skipped += skipped
        self._index += 1 + skipped
        self._start_ns = now
        return self._index, due + skipped * self._period_ns

    @property
    def late_ns(self) -> int:
        """How late the last cycle started, against the first deadline that it missed [ns]."""
        return self._lateness[-1]

    def note_state_age(self, age_ns: int) -> None:
        """Note the age of the newest state when a command was computed [ns]."""
        self._ages.append(age_ns)

    @contextlib.contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Time one part of the cycle."""
        begun = self._clock.now_ns()
        try:
            yield
        finally:
            self._sections.setdefault(name, array("q")).append(self._clock.now_ns() - begun)

    def report(self, **counts: Any) -> LoopTimingReport:
        """Return the report; ``counts`` are the fields that the loop counts itself."""
        lateness = np.array(self._lateness, dtype=np.int64)
        return LoopTimingReport(
            rate_hz=self._rate_hz,
            cycles=len(self._lateness),
            period=Spread.of(self._periods),
            lateness=Spread.of(self._lateness),
            overruns=int((lateness > self._period_ns // 10).sum()),
            overruns_beyond_period=int((lateness >= self._period_ns).sum()),
            skipped_periods=self._skipped,
            state_age=Spread.of(self._ages),
            sections={name: Spread.of(samples) for name, samples in self._sections.items()},
            **counts,
        )
