"""Emulated robots of Unitree that begin alike: the second begins at the first one's rest, and moves alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from deal_hw.drivers.b2.emulator import B2Truth
from deal_hw.drivers.g1.emulator.device import G1Device
from deal_hw.drivers.g1.emulator.truth import draw_truth as draw_g1
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import draw_truth as draw_go2
from deal_hw.drivers.h1.emulator import H1Device, H1Truth
from deal_hw.drivers.unitree import emulated_device
from deal_hw.sim.legged.simulation import LeggedSimulation

TICKS = 60
ROBOTS: dict[str, Callable[[int], Any]] = {
    "go2 lies": lambda seed: Go2Device(draw_go2("realistic", seed), start="lying"),
    "go2 stands": lambda seed: Go2Device(draw_go2("realistic", seed), start="standing"),
    "b2": lambda seed: Go2Device(B2Truth.draw("realistic", seed)),
    "h1": lambda seed: H1Device(H1Truth.draw("sensor", seed)),
    "g1": lambda seed: G1Device(draw_g1("sensor", seed)),
}


@pytest.mark.parametrize("make", ROBOTS.values(), ids=ROBOTS)
def test_robots_that_begin_alike_settle_once(
    make: Callable[[int], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every message is the same, and another seed's robot has a rest of its own."""
    rests: dict[Any, Any] = {}
    steps = 0
    step = LeggedSimulation.step

    def counted(sim: LeggedSimulation, effort: Any) -> None:
        nonlocal steps
        steps += 1
        step(sim, effort)

    monkeypatch.setattr(emulated_device, "_RESTS", rests)
    monkeypatch.setattr(LeggedSimulation, "step", counted)
    counts, sent, ends = [], [], []
    for seed in (3, 3, 4):
        steps = 0
        device = make(seed)
        sent.append(device.advance_to(TICKS * 10**6))
        ends.append(device.true_position)
        counts.append(steps)
    assert counts[1] == TICKS + 1 and counts[0] == counts[2] > 1000
    assert sent[0] == sent[1] != sent[2]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert len(rests) == 2


def test_the_oldest_rest_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bench of many robots keeps a few."""
    rests: dict[Any, Any] = {}
    monkeypatch.setattr(emulated_device, "_RESTS", rests)
    monkeypatch.setattr(emulated_device, "_MOST_RESTS", 2)
    for seed in (1, 2, 3):
        ROBOTS["h1"](seed)
    newest = list(rests)[-1]
    ROBOTS["h1"](1)
    assert len(rests) == 2 and newest in rests
