"""The cart-pole on two servos: another program on their bus, and a second servo of one id."""

from __future__ import annotations

import pytest
from dynamixel_rig import Wire

from deal_hw.control.safety.passive import make_passive
from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.drivers.servo_bus.other_master import OtherMaster
from deal_hw.drivers.servo_bus.packets import sync_write
from deal_hw.drivers.servo_bus.registers import GOAL_POSITION, TORQUE_ENABLE
from deal_hw.errors import SafetyError


def write_beside(wire: Wire, rate_hz: float) -> None:
    """Let another program send the belt servo to one place, again and again."""
    packet = sync_write(GOAL_POSITION, {wire.cart.id: wire.cart.get(GOAL_POSITION) + 200})
    faults = BusFaults(foreign_rate_hz=rate_hz)
    wire.device._other = OtherMaster(packet, wire.device.bus, faults, wire.clock.now_ns())


@pytest.mark.parametrize(("rate_hz", "most_ms"), [(200.0, 40), (60.0, 60)])
def test_another_programs_goals_are_named(rate_hz: float, most_ms: int) -> None:
    """By the second one that shows; then the motor is made passive, and stays so."""
    wire = Wire()
    robot = wire.armed()
    wire.run(5)
    write_beside(wire, rate_hz)
    start_ns = wire.clock.now_ns()
    while not robot.fault:
        wire.run(1)
        assert wire.clock.now_ns() - start_ns <= most_ms * 1_000_000
    assert robot.fault.startswith("another program commands this bus: servo 1 (belt) has the goal ")
    assert make_passive(robot, wire.clock)
    assert not wire.cart.get(TORQUE_ENABLE)


def test_another_program_is_named_while_homing() -> None:
    """And not as a rail of another length."""
    wire = Wire(cart_zero=None)
    wire.robot.connect()
    write_beside(wire, 60.0)
    with pytest.raises(SafetyError, match=r"another program commands this bus: servo 1 \(belt\)"):
        wire.robot.home(20.0)


@pytest.mark.parametrize("servo", [1, 2])
@pytest.mark.parametrize("fast", [True, False])
def test_a_second_servo_of_one_id_is_named_in_a_run(servo: int, fast: bool) -> None:
    """In 80 ms, as an absent one; no state has what the two answer together."""
    wire = Wire()
    wire.device.bus.fast_read = fast
    robot = wire.armed()
    wire.run(5)
    wire.device.servos.append(wire.device.servos[servo - 1].twin())
    start_ns = wire.clock.now_ns()
    states = []
    while not robot.fault:
        states += wire.run(1)
        assert wire.clock.now_ns() - start_ns <= 80_000_000
    part = "belt" if servo == 1 else "pole"
    assert robot.fault.startswith(f"two servos answer as id {servo} ({part}), or its plug is loose")
    assert not states
