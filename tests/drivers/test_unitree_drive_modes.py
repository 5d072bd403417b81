"""A robot of Unitree says of each motor whether it is on; one that goes off ends the run, and is named."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.go2 import FakeBench

from deal_hw.drivers.unitree.drive_modes import OFF_STATES
from deal_hw.types import RobotState, Status

CALF = 2


def modes(off: int | None = None, on: int = 1) -> np.ndarray:
    values = np.full(12, on, np.int64)
    if off is not None:
        values[off] = 0
    return values


def run_with(first: np.ndarray, then: np.ndarray, states: int) -> tuple[str, RobotState]:
    """Arm a robot that reports the first modes, let it report the second ones; return fault and state."""
    wire = FakeBench(mode="")
    wire.device.changes["mode"] = first
    robot = wire.armed()
    for _ in range(5):
        robot.read_state(1.0)
    wire.device.changes["mode"] = then
    state = [robot.read_state(1.0) for _ in range(states)][-1]
    return robot.fault, state


@pytest.mark.parametrize("on", [0x01, 0x0A])
def test_a_motor_that_goes_off_ends_the_run(on: int) -> None:
    """Both modes of Unitree's motors count as on; the joint's name is in the message."""
    fault, state = run_with(modes(on=on), modes(CALF, on), OFF_STATES + 5)
    assert "'FL_calf_joint' is off (mode 0)" in fault
    assert Status.FAULT in state.status


def test_a_few_odd_states_are_no_reason() -> None:
    """One byte that is wrong for less than 20 ms."""
    fault, state = run_with(modes(), modes(CALF), OFF_STATES - 3)
    assert fault == "" and Status.FAULT not in state.status


def test_who_never_fills_the_byte_in_is_not_judged() -> None:
    """A program that plays a robot and reports 0 throughout."""
    fault, _ = run_with(modes(on=0), modes(on=0), 3 * OFF_STATES)
    assert fault == ""


def test_a_new_run_begins_anew() -> None:
    """The fault belongs to the run in which it came."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    robot.read_state(1.0)
    wire.device.changes["mode"] = modes(CALF)
    for _ in range(OFF_STATES + 5):
        robot.read_state(1.0)
    assert robot.fault
    robot.passive()
    wire.device.changes["mode"] = modes()
    robot.home(4.0)
    robot.arm(1.0)
    robot.read_state(1.0)
    assert robot.fault == ""
