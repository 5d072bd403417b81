"""The arms whose bus is measured are arms that the driver drives, with 14 joints as with 6."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from measure_arm_bus import ARMS, RATE_HZ, Arm, write_arm

from deal_hw.clock import VirtualClock
from deal_hw.drivers.servo_arm.emulator import arm_device
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.file_description import file_description
from deal_hw.sim.robots.robot_file import read_robot_file
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space
from deal_hw.testing.robot_suite import arm as arm_robot
from deal_hw.testing.robot_suite import default_command, run_cycles

TOO_SLOW = Arm("dynamixel", 14, 1_000_000)


def driven(folder: Path, arm: Arm) -> tuple[ServoArm, VirtualClock]:
    """Return the driver of an emulated arm, not connected, in virtual time."""
    file = read_robot_file(write_arm(folder, arm))
    assert file.servo_bus is not None
    description = file_description(file, folder / "arm.xml")
    space, clock = default_space(description), VirtualClock()
    values = {**space.known, **{p.name: p.nominal for p in space.parameters}}
    truth = SimulatedTruth(parameters=values, latency_s=0.0, seed=0)
    device = arm_device(file.servo_bus, description, space, truth, noisy=False)
    transport = VirtualTransport(device, clock)
    return ServoArm(transport, clock, description, file.servo_bus, FAMILIES[arm.bus]()), clock


@pytest.mark.parametrize("arm", [arm for arm in ARMS if arm != TOO_SLOW], ids=str)
def test_an_arm_is_driven_at_the_measured_rate(tmp_path: Path, arm: Arm) -> None:
    """A state of all joints with every command, 20 ms apart, and none is missed."""
    robot, clock = driven(tmp_path, arm)
    arm_robot(robot)
    states = run_cycles(robot, clock, 20, default_command(robot, 0.1))
    assert len(states) in (20, 21) and robot.transport_errors == 0
    assert {state.position.size for state in states} == {arm.joints}
    assert set(np.diff([state.device_ns for state in states[1:]])) == {round(1e9 / RATE_HZ)}


def test_the_rate_that_is_too_slow_is_refused(tmp_path: Path) -> None:
    """What one state and a command of 14 Dynamixel servos take at 1 Mbit/s."""
    robot, _ = driven(tmp_path, TOO_SLOW)
    with pytest.raises(ConfigurationError, match=r"14 servos and a command take 12\.\d ms, more than half"):
        robot.connect()
