"""Standing up before a behaviour, coming to a stand and lying down after it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.control.process.channel import Outcome
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as GO2
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.motions.posture import PostureBehaviour, PostureConfig
from deal_hw.motions.velocity import FixedVelocity, SlowedVelocity
from deal_hw.types import BodyState, FloatArray, JointCommand, RobotState, Status

REST = (0.0, 1.36, -2.65) * 4
CONFIG = PostureConfig(fold_s=1.0, rise_s=2.0, settle_s=0.5, lie_s=1.0)


@pytest.fixture
def description() -> RobotDescription:
    """The Go2 with a rest pose."""
    return dataclasses.replace(GO2, rest_position=REST)


def at(position: FloatArray, speed: float = 0.0, turn: float = 0.0, battery: float = 0.9) -> RobotState:
    """Return a state: one joint's speed [rad/s], the base's yaw rate [rad/s], the charge."""
    zeros = np.zeros(12)
    body = BodyState(
        orientation=np.array([1.0, 0.0, 0.0, 0.0]),
        angular_velocity=np.array([0.0, 0.0, turn]),
        acceleration=np.array([0.0, 0.0, 9.81]),
        foot_force=np.zeros(4),
        temperature=np.full(12, 30.0),
        lost=np.zeros(12, dtype=np.int64),
        battery=battery,
        voltage=29.5,
        current=1.0,
        sticks=np.zeros(4),
        buttons=-1,
    )
    return RobotState(position, np.eye(12)[3] * speed, zeros, 0, 0, 0, -1, -1, Status.ARMED, body)


class Played:
    """A behaviour, played at 50 Hz: its targets by time, and its end."""

    def __init__(self, behaviour: PostureBehaviour) -> None:
        self.behaviour, self.cycle = behaviour, 0
        self.target: FloatArray = np.zeros(12)

    def to(self, time_s: float, **state: float) -> FloatArray:
        """Play up to a time [s], in the same state; return the target there."""
        while self.cycle <= round(time_s * 50):
            command = self.behaviour.command(at(np.array(REST) + 0.1, **state), self.cycle / 50)
            self.target, self.cycle = command.position_target, self.cycle + 1
        return self.target

    def over_at(self, **state: float) -> float:
        """Play until the end is over; return its time with the last cycle [s]."""
        while not self.behaviour.end.over:
            self.to(self.cycle / 50, **state)
        return self.cycle / 50


def test_it_rises_does_its_work_stands_and_lies_down(description: RobotDescription) -> None:
    """Measured, rest, default, the inner target, default, rest: each reached at its time."""
    pose = np.array(description.default_position) + 0.05
    measured = np.array(REST) + 0.1
    behaviour = PostureBehaviour(HoldBehaviour(description, pose), description, 3.0, CONFIG)
    behaviour.reset()
    # 1 + 2 + 0.5 before, 0.3 to the default pose, 0.3 still, 1 lying down.
    assert behaviour.duration_s == pytest.approx(1.0 + 2.0 + 0.5 + 3.0 + 0.3 + 0.3 + 1.0)
    played = Played(behaviour)
    np.testing.assert_allclose(played.to(0.0), measured)
    # The smooth step 3 s^2 - 2 s^3 is 1/2 at s = 1/2.
    np.testing.assert_allclose(played.to(0.5), measured - 0.05)
    np.testing.assert_allclose(played.to(1.0), REST)
    np.testing.assert_allclose(played.to(3.0), description.default_position)
    np.testing.assert_allclose(played.to(3.4), description.default_position)
    np.testing.assert_allclose(played.to(3.5), pose)
    np.testing.assert_allclose(played.to(6.48), pose)
    assert behaviour.end.steps() == []
    # 0.12 of 0.3 s: s = 0.4, 3 s^2 - 2 s^3 = 0.352.
    np.testing.assert_allclose(played.to(6.62), pose - 0.352 * 0.05)
    np.testing.assert_allclose(played.to(6.8), description.default_position)
    np.testing.assert_allclose(played.to(7.1), description.default_position)
    np.testing.assert_allclose(played.to(7.6), 0.5 * (np.array(description.default_position) + REST))
    assert played.over_at() == pytest.approx(behaviour.duration_s)
    np.testing.assert_allclose(played.to(8.1), REST)
    np.testing.assert_allclose(played.to(9.9), REST)
    assert behaviour.end.steps() == [
        "the time is up",
        "it comes to its default pose",
        "it stands still, and lies down",
    ]
    assert behaviour.end.reason == ""


@pytest.mark.parametrize("moving", [{"speed": -0.51}, {"turn": 0.51}], ids=["joint", "base"])
def test_it_stands_until_it_is_still(description: RobotDescription, moving: dict[str, float]) -> None:
    """0.3 s below 0.5 rad/s, of joints and of the base; the time begins anew with each motion."""
    behaviour = PostureBehaviour(HoldBehaviour(description), description, 0.5, CONFIG)
    played, default = Played(behaviour), np.array(description.default_position)
    # It stands from 4.3 s on.
    played.to(5.0, **moving)
    played.to(5.28)
    played.to(5.3, **moving)
    np.testing.assert_allclose(played.to(5.6), default)
    assert (played.to(5.7) - default)[2] < -0.01
    assert behaviour.end.steps()[-1] == "it stands still, and lies down"


def test_it_lies_down_after_three_seconds_of_motion(description: RobotDescription) -> None:
    """A robot that never comes to rest is not held stiff for ever; the recording says how fast it was."""
    behaviour = PostureBehaviour(HoldBehaviour(description), description, 0.5, CONFIG)
    played = Played(behaviour)
    assert behaviour.longest_s == pytest.approx(behaviour.duration_s + 2.7)
    assert played.over_at(speed=0.9) == pytest.approx(behaviour.longest_s)
    assert behaviour.end.steps()[-1] == "after 3 s it still moves at 0.90 rad/s; it lies down"


def test_a_policy_is_slowed_before_it_ends(description: RobotDescription) -> None:
    """From its velocity to zero in 0.8 s, 0.2 s at zero; the source is not asked meanwhile."""
    asked: list[float] = []

    class Source:
        def velocity(self, state: RobotState, time_s: float) -> FloatArray:
            asked.append(time_s)
            return np.array([0.4, 0.0, -0.8])

    class Walk(HoldBehaviour):
        def command(self, state: RobotState, time_s: float) -> JointCommand:
            seen.append((time_s, *slowed.velocity(state, time_s)))
            return super().command(state, time_s)

    seen: list[tuple[float, ...]] = []
    slowed = SlowedVelocity(Source())
    behaviour = PostureBehaviour(Walk(description), description, 1.0, CONFIG, slowed=slowed)
    played = Played(behaviour)
    assert played.over_at() == pytest.approx(3.5 + 1.0 + 0.8 + 0.2 + 0.3 + 0.3 + 1.0)
    assert max(asked) == pytest.approx(0.98)
    by_time = {round(time_s, 2): (x, yaw) for time_s, x, _, yaw in seen}
    assert by_time[0.98] == (0.4, -0.8)
    assert by_time[1.4] == pytest.approx((0.2, -0.4))
    assert by_time[1.8] == pytest.approx((0.0, 0.0))
    assert max(by_time) == pytest.approx(1.98)


@pytest.mark.parametrize(
    ("asked_s", "over_s"),
    # While it rises it lies down at once; later it comes to a stand first: 0.3 + 0.3 s.
    [(0.5, 0.5 + 1.0), (2.0, 2.0 + 1.0), (5.0, 5.0 + 0.6 + 1.0)],
    ids=["folding", "rising", "at work"],
)
def test_an_end_may_be_asked_for_earlier(
    description: RobotDescription, asked_s: float, over_s: float
) -> None:
    """From the last target, without a step."""
    behaviour = PostureBehaviour(HoldBehaviour(description), description, 60.0, CONFIG)
    played = Played(behaviour)
    before = played.to(asked_s - 0.02)
    behaviour.end.request("ended by a key")
    behaviour.end.request("a second reason")
    assert np.abs(played.to(asked_s) - before).max() < 0.05
    assert played.over_at() == pytest.approx(over_s)
    assert behaviour.end.reason == "ended by a key"


@pytest.mark.parametrize("battery", [0.151, float("nan")])
def test_a_battery_that_suffices_or_is_unknown_ends_nothing(battery: float) -> None:
    """15 % is halfway between 10 %, which trips, and 20 %, which is needed to arm."""
    behaviour = PostureBehaviour(HoldBehaviour(DRIVER), DRIVER, 60.0, CONFIG)
    Played(behaviour).to(10.0, battery=battery)
    assert behaviour.end.reason == ""


def test_a_low_battery_ends_as_planned() -> None:
    """While its motors still have power."""
    behaviour = PostureBehaviour(HoldBehaviour(DRIVER), DRIVER, 60.0, CONFIG)
    played = Played(behaviour)
    played.to(4.98)
    assert played.over_at(battery=0.14) == pytest.approx(5.0 + 0.6 + 1.0)
    assert behaviour.end.reason.startswith("the battery is at 14 %, below 15 %: the robot lies down")


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
    played = Played(behaviour)
    assert np.isnan(played.to(4.48)).all()
    np.testing.assert_allclose(played.to(4.5), description.default_position)
    np.testing.assert_allclose(played.to(4.7), description.default_position)


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


@pytest.mark.parametrize(
    ("seed", "velocity", "seconds"),
    [pytest.param(None, (0.4, 0.0, 0.0), 3.0, marks=pytest.mark.slow), (0, (0.0, 0.3, 0.0), 1.66)],
    ids=["ahead", "left"],
)
def test_a_walk_ends_standing(seed: int | None, velocity: tuple[float, ...], seconds: float) -> None:
    """The shipped policy on the emulated robot: left in mid-stride, it tipped over as it lay down."""
    pytest.importorskip("mujoco")
    pytest.importorskip("onnxruntime")
    from deal_hw.drivers.go2.emulator.truth import draw_truth, nominal_truth
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.workflows.emulation.virtual_go2 import walk
    from deal_hw.workflows.shipped import required_policy

    truth = nominal_truth("realistic") if seed is None else draw_truth("realistic", seed)
    policy = OnnxPolicy(required_policy("go2"))
    done = walk(truth, policy, FixedVelocity(velocity), seconds, record=False)
    assert (done.report.outcome, done.report.reason) == (Outcome.FINISHED, "the run is over")
    assert done.tilt.max() < 0.4
