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
    """Numbers samples on a regular grid of time, in whole units such as milliseconds.

    A host that polls is early or late by some tenths of a millisecond. The calibration needs samples at
    regular times. So the driver extrapolates each sample to the nearest point of the grid with its measured
    velocity, over the time that :meth:`place` returns.

    Args:
        period: Period of the grid, in the unit of all times.
    """

    def __init__(self, period: int) -> None:
        self._period = period
        self._point: int | None = None
        self.number = -1
        """Number of the newest sample."""

    def begin(self) -> None:
        """Begin a new grid at the next sample; the numbers continue."""
        self._point = None

    def place(self, time: int) -> int | None:
        """Return the time from a sample to its grid point; None if that point already has a sample.

        Args:
            time: Time of the sample.
        """
        if self._point is None:
            self._point = time
            self.number += 1
            return 0
        steps = round((time - self._point) / self._period)
        if steps < 1:
            return None
        self._point += steps * self._period
        self.number += steps
        return self._point - time
