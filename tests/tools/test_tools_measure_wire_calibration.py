"""Calibrations over wires: medians over runs, failed runs counted, errors over the serial one's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from measure_wire_calibration import VIRTUAL_WIRE_S, measure, table, virtual_wire

from deal_hw.clock import Clock
from deal_hw.drivers.cartpole.chips.device import TICK_NS
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.robot import Robot
from deal_hw.sim.recordings.episode import align
from deal_hw.transport import Message, Transport
from deal_hw.workflows.emulation.virtual import demonstrate
from deal_hw.workflows.running.plan import RunPlan


def row(transport: str, error_percent: float) -> dict[str, Any]:
    """Return a row of a run that went through."""
    return {
        "transport": transport,
        "error": "",
        "error_percent": error_percent,
        "median_percent": 0.5,
        "interval_percent": 1.5,
        "coverage90": 0.875,
    }


def test_medians_and_their_share_of_serial() -> None:
    """Serial 1, 2 and 4 % and CAN 3 and 5 %: medians 2 and 4, twice serial; the failed run is counted."""
    rows = [*(row("serial", e) for e in (1.0, 4.0, 2.0)), row("can", 3.0), row("can", 5.0)]
    failed = {"transport": "can", "error": "TransportLostError: gone"}
    lines = table([*rows, failed, {"transport": "odrive", "error": "no"}]).splitlines()
    assert lines[2:] == [
        "| serial | 3 | 2.00 | 1.00 | 0.50 | 1.50 | 0.88 |",
        "| can | 2, 1 failed | 4.00 | 2.00 | 0.50 | 1.50 | 0.88 |",
        "| odrive | 0, 1 failed | | | | | |",
    ]


def test_what_goes_wrong_is_kept_in_the_row() -> None:
    """An emulator that refuses its profile leaves a row that says so."""
    found = measure("serial", "nosuch", 1)
    assert found["error"] and "nosuch" in found["error"] and "error_percent" not in found


@pytest.mark.slow
@pytest.mark.real_time
def test_a_row_holds_what_calibration_found() -> None:
    """A whole row over a real emulator: right to 20 % in the median, every parameter with its interval."""
    found = measure("can", "ideal", 1)
    assert found["error"] == "" and len(found["parameters"]) == 9
    assert found["median_percent"] < 20 and 0 <= found["coverage90"] <= 1
    assert all(v["low"] < v["estimate"] < v["high"] for v in found["parameters"].values())


class NotedTransport(VirtualTransport):
    """A virtual wire that notes the tick in which the device handles each message."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.handled: list[int] = []

    def send(self, message: Message) -> None:
        """Note the device's next tick."""
        super().send(message)
        self.handled.append(self.device.device_ns // TICK_NS)


@pytest.mark.parametrize("transport", ["serial", "can", "odrive"])
def test_the_time_from_stamp_to_arrival_is_what_the_device_sees(transport: str) -> None:
    """Every command of a recording arrives as many ticks after its stamp as the tool adds to the truth."""
    virtual = virtual_wire(transport, draw_truth("sensor", 0, range_ratio=5.0))
    wires: list[NotedTransport] = []

    def noted(_: Transport, clock: Clock) -> Robot:
        wires.append(NotedTransport(virtual.device, clock))
        return made(wires[-1], clock)

    made, virtual.robot = virtual.robot, noted
    plan = RunPlan(robot="cartpole", motion="chirp", seconds=2.0)
    run, _ = demonstrate(virtual, plan, attempts=1)
    episode = align(run.trajectory, virtual.description)
    steps = np.flatnonzero(np.any(np.diff(episode.target, axis=0) != 0, axis=1)) + 1
    stamped = run.first_tick + episode.origin + steps
    late = {min(handled - tick for handled in wires[-1].handled if handled >= tick) for tick in stamped}
    assert len(stamped) > 20
    assert late == {round(1e3 * VIRTUAL_WIRE_S.get(transport, 0.0))}
