"""Compares the rate of a device's clock with that of this computer's."""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.findings import Finding, Severity
from deal_hw.types import IntArray

WARN_SHARE: Final = 1e-3
FAIL_SHARE: Final = 1e-2
"""Largest relative clock error without a finding. A quartz is correct to 1e-4; speeds and latencies are wrong
by the same share as the clock."""
RESOLUTION_S: Final = 1e-3


def judge_clock(host_ns: IntArray, device_ns: IntArray) -> Finding:
    """Return the finding on the rate difference of two clocks.

    Messages arrive late, never early. The fastest message of the first quarter is therefore compared with
    that of the last.

    Args:
        host_ns: Arrival times of messages by our clock, (N,) [ns].
        device_ns: Their times by the device's clock, (N,) [ns].
    """
    delay_ns = host_ns - device_ns
    quarter = max(len(host_ns) // 4, 1)
    first = int(np.argmin(delay_ns[:quarter]))
    last = len(host_ns) - quarter + int(np.argmin(delay_ns[-quarter:]))
    span_s = float(host_ns[last] - host_ns[first]) * 1e-9
    if span_s <= 0:
        return Finding("states", Severity.NOTE, "too few states to compare the robot's clock with ours")
    drift = float(device_ns[last] - device_ns[first]) * 1e-9 / span_s - 1.0
    text = f"rate of the robot's clock against ours: {drift * 100:+.2f} %"
    sure = abs(drift) - RESOLUTION_S / span_s
    if sure > FAIL_SHARE:
        return Finding(
            "states",
            Severity.FAIL,
            f"{text}; at most 1 % can be used",
            "recordings would have wrong speeds and latencies; if it is a simulator slower than real time, "
            "give it a faster computer or real-time priority",
        )
    if sure > WARN_SHARE:
        return Finding(
            "states",
            Severity.WARN,
            f"{text}; a good clock is correct to 0.01 %",
            "listen longer (--seconds 30); if the difference stays, a calibrated latency will be wrong",
        )
    return Finding("states", Severity.OK, text)
