"""States and types that a robot of ros2_control refuses: names, values, stamps, and other versions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ros2_rig import COMMANDS, Ros2Rig, changed, with_

from deal_hw.drivers.ros2.device import EPOCH_NS
from deal_hw.drivers.ros2.messages import HASHES, JointStates
from deal_hw.errors import (
    ConfigurationError,
    TransportLostError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.transport import Message, TopicEnd


@pytest.fixture(params=COMMANDS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Ros2Rig:
    """A robot with either controller."""
    return Ros2Rig(tmp_path, request.param)


def test_another_type_is_refused(rig: Ros2Rig) -> None:
    """A publisher of another type on the topic is named, with both types as ROS writes them."""
    odd = TopicEnd(who="node /odd", writes=True, type_name="my_msgs::msg::dds_::Joints_")
    rig.know(odd)
    rig.device.freeze(0.0)
    rig.device.tick()
    with pytest.raises(
        WrongDeviceError, match=r"node /odd publishes /joint_states as my_msgs/msg/Joints, not"
    ):
        rig.robot.connect()


def test_humble_has_no_hash(rig: Ros2Rig) -> None:
    """Its word in place of a hash is accepted, and none at all."""
    for text in ("TypeHashNotSupported", ""):
        rig.know(state_hash=text)
        rig.robot.connect()
        rig.robot.disconnect()
    rig.know(state_hash=HASHES["std_msgs::msg::dds_::Float64MultiArray_"])
    with pytest.raises(VersionMismatchError, match="update deal-hw"):
        rig.robot.connect()


def test_a_missing_joint_is_named(tmp_path: Path) -> None:
    """The broadcaster publishes only some of the robot's joints."""

    def half(states: JointStates) -> JointStates:
        return with_(
            states,
            names=states.names[1:],
            position=states.position[1:],
            velocity=states.velocity[1:],
            effort=states.effort[1:],
        )

    rig = changed(tmp_path, half)
    with pytest.raises(WrongDeviceError, match=r"/joint_states has no joint elbow_joint; write the names"):
        rig.robot.connect()


def test_nan_is_named_with_its_joint(tmp_path: Path) -> None:
    """Before a run it is refused, in one it is a fault; the state is not passed on."""
    broken = [True]

    def nan(states: JointStates) -> JointStates:
        position = states.position.copy()
        position[states.names.index("shoulder")] = np.nan if broken[0] else 0.0
        return with_(states, position=position)

    rig = changed(tmp_path, nan)
    with pytest.raises(WrongDeviceError, match="position of joint shoulder is nan"):
        rig.robot.connect()
    broken[0] = False
    rig.robot.connect()
    rig.robot._homed, rig.robot._target = True, np.zeros(2)
    rig.robot.arm(1.0)
    broken[0] = True
    assert rig.pass_time(0.1) == []
    assert "position of joint shoulder is nan" in rig.robot.fault


def test_stamps_that_stand_still_are_no_states(tmp_path: Path) -> None:
    """A publisher that sets no stamp, or a paused simulator."""
    rig = changed(tmp_path, lambda states: with_(states, stamp_ns=0))
    with pytest.raises(TransportTimeoutError, match=r"stamps stand still at 0\.000 s.*header\.stamp"):
        rig.robot.connect()


def test_a_robot_that_freezes_is_silence(rig: Ros2Rig) -> None:
    """Its states cease while it holds its last command: read_state says it."""
    rig.armed()
    rig.device.freeze(0.0)
    rig.pass_time(0.1)
    with pytest.raises(TransportTimeoutError, match="no new state within"):
        rig.robot.read_state(0.5)


def test_a_clock_at_another_pace_is_refused(tmp_path: Path) -> None:
    """A simulator at half the real time."""

    def slow(states: JointStates) -> JointStates:
        return with_(states, stamp_ns=EPOCH_NS + (states.stamp_ns - EPOCH_NS) // 2)

    rig = changed(tmp_path, slow)
    with pytest.raises(WrongDeviceError, match=r"clock runs at 0\.50 times this computer's"):
        rig.robot.connect()


def test_a_clock_that_is_set_ends_a_run(tmp_path: Path) -> None:
    """Forwards it is a fault, backwards the connection counts as lost: all times are in doubt."""
    shift_ns = [0]
    rig = changed(tmp_path, lambda states: with_(states, stamp_ns=states.stamp_ns + shift_ns[0]))
    rig.armed()
    shift_ns[0] = 3_000_000_000
    rig.pass_time(0.1)
    assert "stamps jumped by 3.01 s while 0.01 s passed here" in rig.robot.fault
    shift_ns[0] = 0
    with pytest.raises(TransportLostError, match=r"stamps went back by 3\.0 s"):
        rig.pass_time(0.1)


def test_states_twice_are_counted(tmp_path: Path) -> None:
    """Two publishers of the same joints, or one twice."""
    again: list[Message] = []
    rig = Ros2Rig(tmp_path)
    receive = rig.virtual.receive

    def twice(timeout_s: float) -> Message:
        if again:
            return again.pop()
        again.append(receive(timeout_s))
        return again[0]

    rig.virtual.receive = twice  # type: ignore[method-assign]
    with pytest.raises(WrongDeviceError, match="two programs publish these joints"):
        rig.robot.connect()


def test_fewer_states_than_robot_yaml_says(tmp_path: Path) -> None:
    """Every second state is lost: 50 of 100 a second."""
    count = [0]

    def half(states: JointStates) -> JointStates | None:
        count[0] += 1
        return states if count[0] % 2 else None

    rig = changed(tmp_path, half)
    with pytest.raises(
        ConfigurationError, match=r"50 states a second, robot\.yaml says 100: write state_rate"
    ):
        rig.robot.connect()


def test_lost_states_are_counted(tmp_path: Path) -> None:
    """By the stamps: two missing states are two errors, and the numbers of states have that gap."""
    count = [0]

    def gap(states: JointStates) -> JointStates | None:
        count[0] += 1
        return None if count[0] in (40, 41) else states

    rig = changed(tmp_path, gap)
    rig.robot.connect()
    states = rig.pass_time(0.5)
    assert rig.robot.transport_errors == 2
    assert np.diff([state.sequence for state in states]).max() == 3
