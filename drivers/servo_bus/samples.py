"""Numbers a servo's samples at the description's state rate, by the servo's own clock."""

from __future__ import annotations

from deal_hw.drivers.servo_bus.registers import TICK_PERIOD_MS


class TickClock:
    """Unwraps Realtime Tick, which starts again every 32.8 s, and notices a servo that restarted.

    Attributes:
        restarted: Whether the servo restarted: its clock once differed from this computer's by more than
            allowed. Stays True.

    Args:
        tolerance_ms: Allowed difference between the two clocks' steps from sample to sample [ms].
        drift: Additional allowed difference, as a share of the time between two samples.
    """

    def __init__(self, tolerance_ms: float = 500.0, drift: float = 0.02) -> None:
        self.restarted = False
        self._tolerance_ms, self._drift = tolerance_ms, drift
        self._last: tuple[int, int, int] | None = None

    def read(self, tick_ms: int, host_ns: int) -> int:
        """Return the servo's time since its first sample [ms]; over a restart, by this computer's clock.

        Args:
            tick_ms: Realtime Tick of the servo [ms].
            host_ns: This computer's time of the request [ns].
        """
        time_ms = 0
        if self._last is not None:
            last_tick, last_ns, last_ms = self._last
            host_ms = (host_ns - last_ns) / 1e6
            # The number of wrap-arounds that fits this computer's clock best.
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
    calibration needs samples at regular times. So the driver extrapolates each sample to the nearest point of
    the grid with its measured velocity, over the time that :meth:`place` returns.

    Args:
        period_ms: Period of the grid [ms].
    """

    def __init__(self, period_ms: int) -> None:
        self._period_ms = period_ms
        self._point_ms: int | None = None
        self.number = -1
        """Number of the newest sample."""

    def begin(self) -> None:
        """Begin a new grid at the next sample; the numbers continue."""
        self._point_ms = None

    def place(self, time_ms: int) -> int | None:
        """Return the time from a sample to its grid point [ms]; None if that point already has a sample.

        Args:
            time_ms: Servo time of the sample [ms].
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
