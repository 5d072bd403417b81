"""From a servo's clock to the description's state rate: when a sample was taken, and which one it is."""

from __future__ import annotations

from deal_hw.drivers.cartpole.dynamixel.registers import TICK_PERIOD_MS


class TickClock:
    """Unwraps Realtime Tick, which starts again every 32.8 s, and notices a servo that restarted.

    Attributes:
        restarted: Whether the servo restarted: its clock was not where this computer's says. Stays so.

    Args:
        tolerance_ms: How far the two clocks may part between two samples [ms].
        drift: And how much of the time between them.
    """

    def __init__(self, tolerance_ms: float = 500.0, drift: float = 0.02) -> None:
        self.restarted = False
        self._tolerance_ms, self._drift = tolerance_ms, drift
        self._last: tuple[int, int, int] | None = None

    def read(self, tick_ms: int, host_ns: int) -> int:
        """Return the servo's time since its first sample here [ms]; over a restart this computer's goes on.

        Args:
            tick_ms: What the servo says.
            host_ns: When it was asked [ns].
        """
        time_ms = 0
        if self._last is not None:
            last_tick, last_ns, last_ms = self._last
            host_ms = (host_ns - last_ns) / 1e6
            # The whole turns that fit this computer's clock best.
            step = (tick_ms - last_tick) % TICK_PERIOD_MS
            step += TICK_PERIOD_MS * round((host_ms - step) / TICK_PERIOD_MS)
            if abs(step - host_ms) > self._tolerance_ms + self._drift * host_ms:
                self.restarted = True
                step = round(host_ms)
            time_ms = last_ms + step
        self._last = (tick_ms, host_ns, time_ms)
        return time_ms


class SampleGrid:
    """Numbers samples on a regular grid of the servo's time.

    A host that polls is early or late by some tenths of a millisecond, and ticks are whole milliseconds. The
    calibrator compares samples at regular times, so each is moved to the nearest point of the grid, along its
    measured velocity, by what :meth:`place` returns.

    Args:
        period_ms: Of the grid [ms].
    """

    def __init__(self, period_ms: int) -> None:
        self._period_ms = period_ms
        self._point_ms: int | None = None
        self.number = -1
        """The newest sample's."""

    def begin(self) -> None:
        """Let the next sample be a point of a new grid; numbers go on."""
        self._point_ms = None

    def place(self, time_ms: int) -> int | None:
        """Return how long after a sample its point is [ms]; None: that point has a sample already.

        Args:
            time_ms: The servo's time when it was taken [ms].
        """
        if self._point_ms is None:
            self._point_ms = time_ms
            self.number += 1
            return 0
        steps = round((time_ms - self._point_ms) / self._period_ms)
        if steps < 1:
            return None
        self._point_ms += steps * self._period_ms
        self.number += steps
        return self._point_ms - time_ms
