"""Two clocks against each other, from messages that come late, never early."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.data.checks.clock_rate import judge_clock
from deal_hw.findings import Severity

S = 1_000_000_000


def judged(
    drift: float, seconds: float = 3.0, *, seed: int = 0, tick_ns: int = 1_000_000
) -> tuple[Severity, str]:
    """Return what is reported of 500 states a second whose clock drifts, with delays of 0.2 to 20 ms."""
    rng = np.random.default_rng(seed)
    true_ns = (np.arange(0.0, seconds, 0.002) * S).astype(np.int64)
    host_ns = true_ns + (2e5 + rng.exponential(2e6, true_ns.size).clip(max=2e7)).astype(np.int64)
    device_ns = (true_ns * (1.0 + drift)).astype(np.int64) // tick_ns * tick_ns
    found = judge_clock(host_ns, device_ns)
    return found.severity, found.do


@pytest.mark.parametrize(
    ("drift", "level"),
    [
        (0.0, Severity.OK),
        (1e-4, Severity.OK),
        (-4e-4, Severity.OK),
        (3e-3, Severity.WARN),
        (-3e-3, Severity.WARN),
        (8e-3, Severity.WARN),
        (0.0955, Severity.FAIL),
        (-0.02, Severity.FAIL),
        (0.012, Severity.FAIL),
    ],
)
def test_drift_has_its_level_and_remedy(drift: float, level: Severity) -> None:
    """Beyond 0.1 % a warning, beyond 1 % a failure; both say what to do."""
    found, remedy = judged(drift)
    assert found is level and bool(remedy) == (level is not Severity.OK)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.5, 10.0))
def test_delays_are_no_drift(seed: int, seconds: float) -> None:
    """However late messages come, and however short it was listened."""
    assert judged(0.0, seconds, seed=seed)[0] is Severity.OK


def test_nothing_to_compare() -> None:
    """One state, or all at once."""
    assert judge_clock(np.array([5]), np.array([5])).severity is Severity.NOTE
    assert judge_clock(np.array([5, 5]), np.array([5, 6])).severity is Severity.NOTE
