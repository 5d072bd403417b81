"""Standing up before a behaviour and lying down after it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.control.behaviours import HoldBehaviour
from deal_hw.control.posture import PostureBehaviour, PostureConfig
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as GO2
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray, RobotState, Status

REST = (0.0, 1.36, -2.65) * 4
CONFIG = PostureConfig(fold_s=1.0, rise_s=2.0, settle_s=0.5, lie_s=1.0)


@pytest.fixture
def description() -> RobotDescription:
    """The Go2 with a rest pose."""
    return dataclasses.replace(GO2, rest_position=REST)


def at(position: FloatArray) -> RobotState:
    zeros = np.zeros(12)
    return RobotState(position, zeros, zeros, 0, 0, 0, -1, -1, Status.ARMED)


def test_it_rises_does_its_work_and_lies_down(description: RobotDescription) -> None:
    """Measured, rest, default, the inner target, rest: each reached at its time, halfway at half its time."""
    pose = np.array(description.default_position) + 0.05
    measured = np.array(REST) + 0.1
    behaviour = PostureBehaviour(HoldBehaviour(description, pose), description, 3.0, CONFIG)
    behaviour.reset()
    assert behaviour.duration_s == pytest.approx(1.0 + 2.0 + 0.5 + 3.0 + 1.0)

    def target(time_s: float) -> FloatArray:
        return behaviour.command(at(measured), time_s).position_target

    np.testing.assert_allclose(target(0.0), measured)
    # The smooth step 3 s^2 - 2 s^3 is 1/2 at s = 1/2.
    np.testing.assert_allclose(target(0.5), measured - 0.05)
    np.testing.assert_allclose(target(1.0), REST)
    np.testing.assert_allclose(target(3.0), description.default_position)
    np.testing.assert_allclose(target(3.4), description.default_position)
    np.testing.assert_allclose(target(3.5), pose)
    np.testing.assert_allclose(target(6.49), pose)
    np.testing.assert_allclose(target(7.0), 0.5 * (pose + REST))
    np.testing.assert_allclose(target(7.5), REST)
    np.testing.assert_allclose(target(99.0), REST)


def test_the_inner_behaviour_sees_its_own_time(description: RobotDescription) -> None:
    """Its clock starts when it begins, not when the robot stands up."""
    seen = []

    class Watch(HoldBehaviour):
        def command(self, state, time_s):  # type: ignore[no-untyped-def]
            seen.append(time_s)
            return super().command(state, time_s)

    behaviour = PostureBehaviour(Watch(description), description, 1.0, CONFIG)
    for time_s in (0.0, 3.5, 4.0, 4.6):
        behaviour.command(at(np.array(REST)), time_s)
    np.testing.assert_allclose(seen, [0.0, 0.5])


def test_it_lies_down_from_the_last_target_that_was_a_number(description: RobotDescription) -> None:
    """A target that is not finite is passed on for the safety module, and forgotten."""
    pose = np.full(12, np.nan)
    behaviour = PostureBehaviour(HoldBehaviour(description, pose), description, 1.0, CONFIG)
    behaviour.command(at(np.array(REST)), 0.0)
    assert np.isnan(behaviour.command(at(np.array(REST)), 3.6).position_target).all()
    np.testing.assert_allclose(
        behaviour.command(at(np.array(REST)), 4.5).position_target, description.default_position
    )


def test_a_robot_without_a_rest_pose_is_refused() -> None:
    """There is nothing to stand up from."""
    with pytest.raises(ConfigurationError, match="no rest pose"):
        PostureBehaviour(HoldBehaviour(CARTPOLE), CARTPOLE, 1.0, CONFIG)


@pytest.mark.parametrize("name", ["fold_s", "rise_s", "settle_s", "lie_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, 0.19, 60.0, float("nan")])
def test_times_have_limits(name: str, value: float) -> None:
    """A movement in no time would be a jump."""
    with pytest.raises(ConfigurationError, match=name):
        PostureConfig(**{name: value})
