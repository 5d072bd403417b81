"""Behaviours: targets computed by hand, randomness that repeats."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from fakes.linear_policy import LinearPolicy, feedback_spec

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError, DatasetError, PolicyError, PolicyMismatchError
from deal_hw.motions.behaviours import HoldBehaviour, PolicyBehaviour, ReplayBehaviour
from deal_hw.motions.excitation.behaviours import (
    ChirpBehaviour,
    ChirpConfig,
    RichBehaviour,
    RichConfig,
    Segment,
)
from deal_hw.motions.excitation.centring import Centring
from deal_hw.types import FloatArray, RobotState, Status, Trajectory

SPEC = feedback_spec(DESCRIPTION)
NOWHERE = RobotState(np.zeros(2), np.zeros(2), np.zeros(2), 0, 0, 0, -1, -1, Status.ARMED)


def at(cart: float, pole: float = 0.0) -> RobotState:
    """Return a state at rest."""
    return dataclasses.replace(NOWHERE, position=np.array([cart, pole]))


def targets(behaviour: Any, seconds: float = 4.0) -> FloatArray:
    """Return the targets of a run at 50 Hz, (T,)."""
    return np.array(
        [behaviour.command(NOWHERE, k / 50).position_target[0] for k in range(round(seconds * 50))]
    )


def test_policy_target_is_default_plus_scaled_action() -> None:
    """Cart at 0.1 m, pole at 0.02 rad: 1.65 * 0.1 + 1.04 * 0.02 = 0.1858 m, an action of 0.7432."""
    behaviour = PolicyBehaviour(LinearPolicy(SPEC), DESCRIPTION)
    command = behaviour.command(at(0.1, 0.02), 0.0)
    assert behaviour.action is not None
    assert behaviour.action[0] == pytest.approx(0.7432, abs=1e-6)
    assert command.position_target[0] == pytest.approx(0.1858, abs=1e-6)
    assert (command.stiffness[0], command.damping[0]) == (80.0, 8.0)
    assert (command.effort_limit[0], command.speed_limit[0]) == (4.0, 1.0)


def test_actions_are_clipped_and_nan_passes_through() -> None:
    """3 becomes 1, that is 0.25 m; NaN stays NaN for the safety filter to see."""
    behaviour = PolicyBehaviour(
        LinearPolicy(SPEC, disturb=lambda k, a: np.array([(3.0, math.nan)[k]])), DESCRIPTION
    )
    assert behaviour.command(NOWHERE, 0.0).position_target[0] == 0.25
    assert math.isnan(behaviour.command(NOWHERE, 0.02).position_target[0])


def test_policy_for_another_robot_is_refused() -> None:
    """The message names the field."""
    spec = dataclasses.replace(SPEC, robot="go2", control_rate_hz=100.0)
    with pytest.raises(PolicyMismatchError, match=r"robot: policy has 'go2'.*control_rate_hz"):
        PolicyBehaviour(LinearPolicy(spec), DESCRIPTION)


def test_policy_with_an_action_of_another_shape_is_refused() -> None:
    """One joint, two actions: broadcasting would hide it."""
    behaviour = PolicyBehaviour(LinearPolicy(SPEC, disturb=lambda k, a: np.zeros(2)), DESCRIPTION)
    with pytest.raises(PolicyError, match=r"shape \(2,\), expected \(1,\)"):
        behaviour.command(NOWHERE, 0.0)


def test_policy_reset_forgets_past_actions() -> None:
    """After a reset, an observed last action is 0 again."""
    term = dataclasses.replace(SPEC.observation[0], quantity="action", delay=1)
    # Observed: cart position, its velocity, the pole's velocity, the last action in the place of the pole's
    # angle.
    spec = dataclasses.replace(SPEC, observation=(SPEC.observation[0], term, *SPEC.observation[2:]))
    behaviour = PolicyBehaviour(LinearPolicy(spec), DESCRIPTION)
    first = behaviour.command(at(0.1), 0.0).position_target[0]
    second = behaviour.command(at(0.1), 0.02).position_target[0]
    behaviour.reset()
    # The first target is 1.65 * 0.1 = 0.165, an action of 0.66: observed, it adds 1.04 * 0.66 * 0.25 ...
    # clipped at 0.25.
    assert first == pytest.approx(0.165, abs=1e-6)
    assert second == 0.25
    assert behaviour.command(at(0.1), 0.0).position_target[0] == first


def test_rich_balances_first_then_holds_random_set_points() -> None:
    """1.6 s of the policy, then steps within 0.12 m, each held for 0.1 to 0.3 s rounded up to cycles."""
    config = RichConfig(balance_s=1.6, amplitude=0.12, hold_s=(0.1, 0.3), segments=())
    behaviour = RichBehaviour(DESCRIPTION, PolicyBehaviour(LinearPolicy(SPEC), DESCRIPTION), config, seed=7)
    states = [at(0.05)] * 80
    balancing = [behaviour.command(s, k / 50).position_target[0] for k, s in enumerate(states)]
    assert balancing == pytest.approx([1.65 * 0.05] * 80, abs=1e-6)
    assert behaviour.action is not None
    steps = np.array([behaviour.command(NOWHERE, k / 50).position_target[0] for k in range(80, 200)])
    assert behaviour.action is None
    assert np.abs(steps).max() <= 0.12
    changes = np.flatnonzero(np.diff(steps))
    holds = np.diff(changes)
    assert 8 <= changes.size <= 24
    assert holds.min() >= 5 and holds.max() <= 15


def test_rich_repeats_itself_by_seed() -> None:
    """Same seed, same set-points, also after a reset; another seed, others."""
    config = RichConfig(balance_s=0.0)
    behaviour = RichBehaviour(DESCRIPTION, None, config, seed=1)
    first = targets(behaviour)
    behaviour.reset()
    assert (targets(behaviour) == first).all()
    assert (targets(RichBehaviour(DESCRIPTION, None, config, seed=1)) == first).all()
    assert (targets(RichBehaviour(DESCRIPTION, None, config, seed=2)) != first).any()


def test_rich_segments_scale_gains_and_limits() -> None:
    """Half the stiffness (40) and limits (2, 0.5) and twice the damping (16) in the second half."""
    half = Segment(start=0.5, stop=1.0, stiffness=0.5, damping=2.0, effort_limit=0.5, speed_limit=0.5)
    behaviour = RichBehaviour(DESCRIPTION, None, RichConfig(balance_s=0.0, segments=(half,)), seed=0)
    before, after = behaviour.command(NOWHERE, 1.98), behaviour.command(NOWHERE, 2.0)
    assert (before.stiffness[0], before.damping[0], before.effort_limit[0], before.speed_limit[0]) == (
        80,
        8,
        4,
        1,
    )
    assert (after.stiffness[0], after.damping[0], after.effort_limit[0], after.speed_limit[0]) == (
        40,
        16,
        2,
        0.5,
    )


def test_balancing_keeps_the_policys_own_gains() -> None:
    """A policy trained at half the robot's gains balances with these, times the segment's factors."""
    soft = dataclasses.replace(
        SPEC, stiffness=(40.0,), damping=(4.0,), effort_limit=(2.0,), speed_limit=(0.5,)
    )
    half = Segment(start=0.0, stop=1.0, stiffness=0.5)
    config = RichConfig(balance_s=1.0, segments=(half,))
    behaviour = RichBehaviour(DESCRIPTION, PolicyBehaviour(LinearPolicy(soft), DESCRIPTION), config, seed=0)
    command = behaviour.command(at(0.05), 0.0)
    sent = (command.stiffness, command.damping, command.effort_limit, command.speed_limit)
    assert [part[0] for part in sent] == [20.0, 4.0, 2.0, 0.5]
    assert behaviour.command(at(0.05), 2.0).stiffness[0] == 40.0


def test_motions_of_motors_are_around_no_effort() -> None:
    """For a motor a command is an effort: its default pose, 0.1 rad here, is none."""
    motor = dataclasses.replace(DESCRIPTION, actuation="motor", default_position=(0.1, 0.0))
    assert HoldBehaviour(motor).command(NOWHERE, 0.0).position_target[0] == 0.0
    start = dataclasses.replace(NOWHERE, position=np.array([0.1, 0.0]))
    assert ChirpBehaviour(motor).command(start, 0.0).position_target[0] == 0.0
    rich = RichBehaviour(motor, None, RichConfig(balance_s=0.0, amplitude=1e-6), seed=0)
    assert abs(rich.command(start, 0.0).position_target[0]) <= 1e-6
    spec = dataclasses.replace(SPEC, default_position=(0.1, 0.0))
    still = LinearPolicy(spec, disturb=lambda k, a: 0.0 * a)
    assert PolicyBehaviour(still, motor).command(NOWHERE, 0.0).position_target[0] == 0.0


def test_an_effort_has_a_spring_and_a_damper_to_the_start() -> None:
    """Track -0.5..0.5 m, start at 0.1 m: a reach of 0.9 * 0.4 = 0.36 m, at 0.9 m/s in 0.4 s.

    At 0.28 m the spring is 0.18 / 0.36 = 0.5, at 0.45 m/s the damper 0.5; together they are at their limit.
    """
    limits = dataclasses.replace(
        DESCRIPTION.limits, trip_position=((-0.5, 0.5), (-9.0, 9.0)), trip_velocity=(2.0, 99.0)
    )
    motor = dataclasses.replace(DESCRIPTION, actuation="motor", default_position=(0.1, 0.0), limits=limits)

    def sent(position: float, velocity: float, asked: float = 0.0) -> float:
        state = dataclasses.replace(
            NOWHERE, position=np.array([position, 3.0]), velocity=np.array([velocity, 3.0])
        )
        return float(Centring(motor).added(np.array([asked]), state)[0])

    assert sent(0.1, 0.0, 0.3) == 0.3
    assert sent(0.28, 0.0) == pytest.approx(-0.5) and sent(0.1, 0.45) == pytest.approx(-0.5)
    assert sent(0.28, 0.45, -0.2) == -1.0
    # A start pose at an end: around the middle. No limits: no feedback. A servo: its own.
    motor = dataclasses.replace(motor, default_position=(0.45, 0.0))
    assert sent(0.0, 0.0) == 0.0
    endless = dataclasses.replace(
        limits, trip_position=((-math.inf, math.inf),) * 2, trip_velocity=(math.inf, math.inf)
    )
    motor = dataclasses.replace(motor, limits=endless)
    assert sent(7.0, 7.0, 0.3) == 0.3
    motor = DESCRIPTION
    assert sent(0.28, 0.45, 0.3) == 0.3


def test_chirp_follows_the_integral_of_its_frequency() -> None:
    """At 1 s of 0.3..4 Hz over 4 s the phase is 2 pi (0.3 + 0.5 * 0.925) = 2 pi * 0.7625."""
    behaviour = ChirpBehaviour(DESCRIPTION)
    expected = 0.08 * math.sin(2 * math.pi * 0.7625)
    assert behaviour.command(NOWHERE, 1.0).position_target[0] == pytest.approx(expected, abs=1e-12)
    path = targets(behaviour)
    assert path[0] == 0.0
    assert 0.079 < np.abs(path).max() <= 0.08
    # The phase ends at 2 pi * 8.6: it passes 17 half turns on the way.
    assert np.count_nonzero(np.diff(np.sign(path[1:]))) == 17


def test_hold_holds() -> None:
    """The default pose, or the one given."""
    assert (targets(HoldBehaviour(DESCRIPTION), 0.1) == 0.0).all()
    assert (targets(HoldBehaviour(DESCRIPTION, np.array([0.07])), 0.1) == 0.07).all()


def recording(**changes: Any) -> Trajectory:
    """Return a recording of three commands at 50 Hz, sent with jitter, from 5 s on."""
    empty, column = np.empty(0), np.ones((3, 1))
    fields: dict[str, Any] = {
        "joint_names": ("cart", "pole"),
        "actuated": ("cart",),
        "receive_s": empty,
        "device_s": empty,
        "position": empty,
        "velocity": empty,
        "effort": empty,
        "status": empty,
        "command_sequence": empty,
        "command_age_s": empty,
        "sent_s": np.array([5.0, 5.024, 5.036]),
        "sent_sequence": np.arange(3),
        "requested_position": np.array([[0.1], [0.2], [0.3]]),
        "position_target": column * 0.0,
        "stiffness": column * 70,
        "damping": column * 7,
        "effort_limit": column * 3,
        "speed_limit": column * 0.9,
    }
    return Trajectory(**{**fields, **changes})


def test_replay_asks_by_time_for_what_was_asked() -> None:
    """Send jitter of 4 ms shifts nothing; a skipped cycle skips a command; the end holds the last."""
    behaviour = ReplayBehaviour(recording(), DESCRIPTION)
    asked = [behaviour.command(NOWHERE, t).position_target[0] for t in (0.0, 0.02, 0.04, 0.06, 9.0)]
    assert asked == [0.1, 0.2, 0.3, 0.3, 0.3]
    command = behaviour.command(NOWHERE, 0.0)
    gains = (command.stiffness[0], command.damping[0], command.effort_limit[0], command.speed_limit[0])
    assert gains == (70, 7, 3, 0.9)
    assert behaviour.duration_s == pytest.approx(0.056)


def test_replay_refuses_another_robot_and_an_empty_recording() -> None:
    """Joint names must be the same; there must be commands."""
    with pytest.raises(ConfigurationError, match="robot 'cartpole' has"):
        ReplayBehaviour(recording(actuated=("hip",)), DESCRIPTION)
    with pytest.raises(DatasetError, match="no command to replay"):
        ReplayBehaviour(recording(sent_s=np.empty(0)), DESCRIPTION)


@pytest.mark.parametrize(
    "make",
    [
        lambda: RichConfig(duration_s=0.0),
        lambda: RichConfig(hold_s=(0.3, 0.1)),
        lambda: RichConfig(hold_s=(0.0, 0.1)),
        lambda: ChirpConfig(low_hz=2.0, high_hz=1.0),
        lambda: Segment(start=0.5, stop=0.5),
        lambda: Segment(start=0.0, stop=1.5),
        lambda: Segment(start=0.0, stop=1.0, damping=0.0),
    ],
)
def test_settings_that_cannot_be_are_refused(make: Any) -> None:
    """Reversed ranges, empty segments, zero factors."""
    with pytest.raises(ConfigurationError):
        make()
