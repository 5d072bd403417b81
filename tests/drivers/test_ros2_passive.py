"""Which pose a robot of ros2_control holds when it is passive, and what ends its arming."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ros2_rig import COMMANDS, Ros2Rig

from deal_hw.drivers.ros2.messages import decode_point, decode_positions
from deal_hw.errors import SafetyError
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.types import FloatArray


@pytest.fixture(params=COMMANDS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Ros2Rig:
    """A robot of each kind of command."""
    return Ros2Rig(tmp_path, request.param)


def last_sent(rig: Ros2Rig) -> FloatArray:
    """Return the newest target on the wire, in the order of the controller, (A,) [rad]."""
    payload = [message.payload for message in rig.robot.take_wire() if message.channel == "tx"][-1]
    trajectory = rig.section.command == "trajectory"
    return np.array(decode_point(payload).position if trajectory else decode_positions(payload))


def test_a_reading_out_of_range_is_no_pose_to_hold(rig: Ros2Rig) -> None:
    """A joint cannot be there, so the last target stays: else the arm would be driven towards the reading."""
    rig.armed()
    rig.run(60, target=0.4)
    faults = JointFaults(faulty_joint="shoulder", out_of_range_after_s=0.0)
    rig.device.joint_faults.give(faults, rig.device.device_ns)
    assert np.abs(rig.pass_time(0.05)[-1].position).max() > 3.0
    for _ in range(20):
        rig.robot.passive()
        rig.pass_time(0.05)
    np.testing.assert_allclose(last_sent(rig), 0.4, atol=0.05)
    np.testing.assert_allclose(rig.true_position(), 0.4, atol=0.1)


def test_after_another_program_the_robot_is_held_where_that_left_it(rig: Ros2Rig) -> None:
    """Not where it was before: it would jump back when the other one ends."""
    rig.armed()
    rig.run(30)
    topic, payload = rig.device.command_aside(0.2)
    for _ in range(30):
        rig.device.receive(topic, payload, rig.clock.now_ns())
        rig.virtual.publish(topic, payload)
        rig.pass_time(0.03)
        rig.robot.passive()
    left = rig.true_position()
    assert np.abs(left).max() > 0.15
    for _ in range(20):
        rig.pass_time(0.05)
        rig.robot.passive()
        np.testing.assert_allclose(rig.true_position(), left, atol=0.05)
    np.testing.assert_allclose(last_sent(rig)[np.argsort(rig.robot._order)], left, atol=0.05)


def test_who_takes_over_holds_one_pose(rig: Ros2Rig) -> None:
    """The last commands of the process that died came before its own, so they do not overrule it."""
    rig.armed()
    rig.run(6, target=1.0)
    rig.virtual.publish(*rig.device.command_aside(0.2))
    rig.pass_time(0.01)
    rig.robot.take_wire()
    for _ in range(8):
        rig.robot.passive()
        rig.pass_time(0.05)
    sent = {message.payload for message in rig.robot.take_wire() if message.channel == "tx"}
    assert len(sent) == 1


def test_a_controller_that_goes_off_while_the_robot_is_armed_ends_the_arming(rig: Ros2Rig) -> None:
    """The manager says it once, between homing and the first command."""
    rig.robot.connect()
    rig.robot.home(20.0)
    rig.device.switch(active=False)
    with pytest.raises(SafetyError, match="is inactive"):
        rig.robot.arm(1.0)
    with pytest.raises(SafetyError, match="not armed"):
        rig.run(1)
