"""The fault table of the cart-pole on a virtual clock: each fault in each part of a run, to the nanosecond.

The device's own log of its motor is judged, not deal-hw's report. test_control_faults.py has the same faults,
and those of processes, over a real wire.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from fakes.linear_policy import LinearPolicy, feedback_spec

from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.safety import Safety
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.types import FloatArray

MS = 1_000_000
CYCLE_MS = 20.0
WATCHDOG_MS = 200.0
"""The device stops its motor this long after the last command."""
TICK_MS = 1.0
CYCLES = 100
MOMENTS = {"the first cycle": 0, "the second": 1, "the middle": CYCLES // 2, "the last": CYCLES - 1}


class WatchedWire(VirtualTransport):
    """A virtual wire that notes when the device's motor got and lost its torque [ns]."""

    armed = False

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.changes: list[tuple[int, bool]] = []
        self.deaf = False

    def _run_tick(self, tick_ns: int) -> None:
        super()._run_tick(tick_ns)
        if self.deaf:
            self._queue.clear()
        if self.device.armed != self.armed:  # type: ignore[attr-defined]
            self.armed = not self.armed
            self.changes.append((tick_ns, self.armed))


Act = Callable[[Any, WatchedWire, FloatArray], FloatArray]


@dataclass(frozen=True)
class Fault:
    """What goes wrong as the policy is asked, how the run ends, and the latest end of torque [ms]."""

    act: Act
    outcome: Outcome
    within_ms: float
    confirmed: bool = True


def says_nan(rig: Any, wire: WatchedWire, action: FloatArray) -> FloatArray:
    """A command that is no number."""
    return action * math.nan


def is_late(rig: Any, wire: WatchedWire, action: FloatArray) -> FloatArray:
    """41 ms, where 40 ms are allowed."""
    rig.clock.advance_ns(41 * MS)
    return action


def hangs_a_second(rig: Any, wire: WatchedWire, action: FloatArray) -> FloatArray:
    """Longer than the device's watchdog waits."""
    rig.clock.advance_ns(1000 * MS)
    return action


def raises(rig: Any, wire: WatchedWire, action: FloatArray) -> FloatArray:
    """A bug in the policy."""
    raise ZeroDivisionError("seen in a test")


def is_stopped(rig: Any, wire: WatchedWire, action: FloatArray) -> FloatArray:
    """Ctrl-C."""
    raise KeyboardInterrupt


def loses_the_cable(rig: Any, wire: WatchedWire, action: FloatArray) -> FloatArray:
    """The cable is pulled, and stays so."""
    wire.unplug()
    return action


def loses_the_states(rig: Any, wire: WatchedWire, action: FloatArray) -> FloatArray:
    """Commands go out, and no state comes back."""
    wire.deaf = True
    return action


FAULTS = {
    "the policy answers NaN": Fault(says_nan, Outcome.TRIPPED, 2 * TICK_MS),
    "the policy takes over 40 ms": Fault(is_late, Outcome.TRIPPED, 41 + 2 * TICK_MS),
    "the policy hangs for 1 s": Fault(hangs_a_second, Outcome.TRIPPED, WATCHDOG_MS + TICK_MS),
    "the policy raises": Fault(raises, Outcome.FAILED, 2 * TICK_MS),
    "Ctrl-C": Fault(is_stopped, Outcome.STOPPED, 2 * TICK_MS),
    "the cable is pulled": Fault(loses_the_cable, Outcome.TRIPPED, WATCHDOG_MS + TICK_MS, False),
    # Ages at the cycles after the last state: 20, 40, 60 (allowed), 80 ms.
    "no state comes any more": Fault(loses_the_states, Outcome.TRIPPED, 4 * CYCLE_MS + 2 * TICK_MS, False),
}


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("name", FAULTS)
def test_the_motor_is_off_soon_after_a_fault(rig: Any, name: str, moment: str) -> None:
    """For good, and the run ends as it should, in whatever cycle the fault comes."""
    fault, cycle = FAULTS[name], MOMENTS[moment]
    wire = WatchedWire(rig.device, rig.clock)
    rig.robot = CartpoleRobot(wire, rig.clock)
    begun: list[int] = []

    def disturb(call: int, action: FloatArray) -> FloatArray:
        if call != cycle:
            return action
        begun.append(rig.clock.now_ns())
        return fault.act(rig, wire, action)

    policy = LinearPolicy(feedback_spec(DESCRIPTION), disturb=disturb)
    config = LoopConfig(duration_s=CYCLES * CYCLE_MS * 1e-3)
    behaviour = PolicyBehaviour(policy, DESCRIPTION)
    report = ControlLoop(rig.robot, behaviour, Safety(DESCRIPTION), rig.clock, rig.sink, config).run()
    # What a lost cable hid is run now, without a word of the host.
    wire.plug_in()
    wire.open()
    assert [armed for _, armed in wire.changes] == [True, False]
    took_ms = (wire.changes[-1][0] - begun[0]) / MS
    assert 0 <= took_ms <= fault.within_ms
    # No state is missed where no cycle follows; the robot does not confirm, and the report says so.
    over = cycle == CYCLES - 1 and fault.act is loses_the_states
    assert report.outcome is (Outcome.FINISHED if over else fault.outcome)
    assert report.passive_confirmed == fault.confirmed
    assert len(rig.records) > cycle
