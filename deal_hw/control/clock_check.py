"""Whether a device's clock runs as fast as this computer's."""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.findings import Finding, Level
from deal_hw.types import IntArray

WARN_SHARE: Final = 1e-3
FAIL_SHARE: Final = 1e-2
"""A quartz is right to 1e-4. A clock that is off by this share makes speeds and latencies wrong by it."""
RESOLUTION_S: Final = 1e-3


def judge_clock(host_ns: IntArray, device_ns: IntArray) -> Finding:
    """Return what two clocks say of each other.

    Messages come late, never early: the fastest of the first quarter is compared with that of the last.

    Args:
        host_ns: When messages arrived, by our clock, (N,) [ns].
        device_ns: When they were made, by the device's, (N,) [ns].
    """
    delay_ns = host_ns - device_ns
    quarter = max(len(host_ns) // 4, 1)
    first = int(np.argmin(delay_ns[:quarter]))
    last = len(host_ns) - quarter + int(np.argmin(delay_ns[-quarter:]))
    span_s = float(host_ns[last] - host_ns[first]) * 1e-9
    if span_s <= 0:
        return Finding("states", Level.NOTE, "too few states to compare the robot's clock with ours")
    drift = float(device_ns[last] - device_ns[first]) * 1e-9 / span_s - 1.0
    text = f"robot's clock against ours: {drift * 100:+.2f} %"
    sure = abs(drift) - RESOLUTION_S / span_s
    if sure > FAIL_SHARE:
        return Finding(
            "states",
            Level.FAIL,
            f"{text}; at most 1 % is usable",
            "is it a simulator that does not keep real time? Give it a faster computer or real-time "
            "priority; recordings made like this give wrong speeds and latencies",
        )
    if sure > WARN_SHARE:
        return Finding(
            "states",
            Level.WARN,
            f"{text}; a sound clock is right to 0.01 %",
            "listen longer (--seconds 30); if it stays, a calibrated latency will be wrong",
        )
    return Finding("states", Level.OK, text)
