"""The canter: its schedule, its reward by hand, its training by name, and the score of contacts."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.motions.scores.gait import gait_score, stances
from deal_hw.motions.velocity import check_fast, make_source
from deal_hw.policies.canter_env import NEAR_M, CanterEnv, CanterTask, ContactSchedule
from deal_hw.robots import recorded_description, training_task
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import TRAIN, TrainTaskSettings, nominal_distribution

GO2 = recorded_description("go2")
SCHEDULE = ContactSchedule()


def test_the_beats_are_those_of_a_canter_on_the_right_lead() -> None:
    """Left hind, then right hind and left fore together, then right fore; one foot is always down."""
    clock = np.arange(1000) / 1000
    down = SCHEDULE.stance(clock)
    begins = (down > np.roll(down, 1, axis=0)).argmax(axis=0) / 1000
    front_left, front_right, rear_left, rear_right = begins
    assert front_left == rear_right
    np.testing.assert_allclose([front_left - rear_left, front_right - front_left], 0.3)
    np.testing.assert_allclose(down.mean(axis=0), SCHEDULE.duty, atol=2e-3)
    assert down.sum(axis=1).min() == 1
    # A shorter stance leaves a suspension, from the right fore's lift-off to the left hind's touchdown.
    in_air = clock[ContactSchedule(duty=0.35).stance(clock).sum(axis=1) == 0]
    assert 0.04 < len(in_air) / 1000 < 0.06 and 0.14 < in_air.min() < in_air.max() < 0.2


def test_the_smooth_schedule_is_the_sharp_one_but_for_its_edges() -> None:
    """At a touchdown it is a half; two widths away it is within a twentieth; the mean is the duty."""
    clock = np.arange(1000) / 1000
    smooth, sharp = SCHEDULE.smooth_stance(clock), SCHEDULE.stance(clock)
    np.testing.assert_allclose(SCHEDULE.smooth_stance(np.array([0.5]))[0, 0], 0.5, atol=1e-3)
    since = SCHEDULE.since_touchdown(clock)
    off = np.minimum(np.abs((since + 0.5) % 1.0 - 0.5), np.abs((since - SCHEDULE.duty + 0.5) % 1.0 - 0.5))
    assert np.abs(smooth - sharp)[off > 2 * SCHEDULE.width].max() < 0.05
    np.testing.assert_allclose(smooth.mean(axis=0), SCHEDULE.duty, atol=1e-3)


@pytest.mark.parametrize(
    ("setting", "message"),
    [({"duty": 1.0}, "duty"), ({"width": 0.0}, "width"), ({"touchdown": (0.0, 0.5, 0.5, 1.0)}, "touchdown")],
)
def test_an_impossible_schedule_is_refused(setting: dict[str, object], message: str) -> None:
    """The message names the field."""
    with pytest.raises(ConfigurationError, match=message):
        ContactSchedule(**setting)  # type: ignore[arg-type]


def standing(weight: float) -> tuple[CanterEnv, float]:
    """Return robots that stand still at a command, and the mean reward of a tick."""
    task = CanterTask(
        schedule_weight=weight,
        standing=0.0,
        zeroed=0.0,
        push_ticks=10**9,
        command_ticks=10**9,
        start_speed=0.0,
    )
    env = CanterEnv(GO2, nominal_distribution("go2", "canter"), 4, task=task)
    env.reset(seed=0)
    rewards = [env.step(np.zeros((4, 12)))[1].mean() for _ in range(40)]
    return env, float(np.mean(rewards[20:]))


def test_feet_off_the_schedule_cost() -> None:
    """A robot that stands has each foot down in its swing: on average 1 - duty of the weight."""
    env, with_cost = standing(5.0)
    assert env.contacts().min() > 0.9
    _, without = standing(1e-9)
    assert without - with_cost == pytest.approx(5.0 * (1.0 - SCHEDULE.duty), abs=0.3)
    heights = env._wanted_heights()
    assert heights.shape == (4, 4) and 0.0 <= heights.min() and heights.max() <= env.task.swing_m
    # A foot counts in part below NEAR_M, and not above.
    env._places = np.zeros((4, env._places.shape[1], 3))
    env._places[:, env._feet, 2] = env._radius + np.array([0.0, 0.5, 1.0, 2.0]) * NEAR_M
    np.testing.assert_allclose(env.contacts(), [[1.0, 0.5, 0.0, 0.0]] * 4, atol=1e-9)


def test_the_canter_is_trained_by_name_and_starts_from_the_walk() -> None:
    """`train go2 --task canter`: the task's environment, whose layout is that of the walk's networks."""
    from deal_hw.policies.checkpoint import read_checkpoint

    settings = TRAIN.settings(robot="go2", task="canter", udr=True)
    assert isinstance(settings, TrainTaskSettings) and settings.task == "canter"
    env = training_task("go2", "canter").make(GO2, nominal_distribution("go2", "canter"), 1)
    assert isinstance(env, CanterEnv)
    read_checkpoint(required_policy("go2").with_suffix(".safetensors"), env.layout)
    with pytest.raises(UnknownNameError, match="canter"):
        training_task("go2", "gallop")


def test_a_fast_request_is_for_a_policy_that_was_trained_for_it() -> None:
    """1.4 m/s is refused with the walk's range, and with none; what is not beyond 1 m/s is only limited."""
    canter, walk = ((0.0, 1.5), (0.0, 0.0), (-0.5, 0.5)), ((-0.6, 1.0), (-0.5, 0.5), (-1.0, 1.0))
    check_fast(make_source("1.4,0,0"), canter)
    check_fast(make_source("-1,0.5,1"), canter)
    check_fast(make_source("remote"), ())
    for trained in (walk, ()):
        with pytest.raises(ConfigurationError, match=r"up to 1\.4 in x"):
            check_fast(make_source("1.4,0,0"), trained)
    with pytest.raises(ConfigurationError, match=r"allowed with it: -1 to 1\.5"):
        check_fast(make_source("-1.4,0,0"), canter)


def contacts(
    late: float = 0.0, duty: float = SCHEDULE.duty, hz: float = 2.5
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and forces of feet that step by the schedule, late by a share of a turn."""
    time_s = np.arange(0.3, 4.3, 0.002)
    plan = ContactSchedule(duty=duty)
    return time_s, 60.0 * plan.stance(time_s * hz - late)


def test_feet_in_time_have_no_error() -> None:
    """Duty, phases, one step a turn, and the suspension of a schedule with a short stance."""
    time_s, force = contacts(duty=0.38)
    score = gait_score(time_s, force, clock_hz=2.5, touchdown=SCHEDULE.touchdown, duty=0.38)
    assert score is not None and score.strides == 9
    np.testing.assert_allclose(score.duty, 0.38, atol=0.01)
    np.testing.assert_allclose(score.phase, SCHEDULE.touchdown, atol=0.01)
    np.testing.assert_allclose(score.steps, 1.0)
    assert score.duty_error < 0.01 and score.phase_error < 0.01
    assert score.suspended == pytest.approx(0.02, abs=0.01)


def test_late_and_short_steps_are_measured() -> None:
    """A tenth of a turn late and 0.1 too short come out as such."""
    time_s, force = contacts(late=0.1, duty=SCHEDULE.duty - 0.1)
    score = gait_score(time_s, force, clock_hz=2.5, touchdown=SCHEDULE.touchdown, duty=SCHEDULE.duty)
    assert score is not None
    assert score.duty_error == pytest.approx(0.1, abs=0.01) and score.phase_error == pytest.approx(
        0.1, abs=0.01
    )
    # All feet are late alike: the gait itself is kept.
    assert score.pattern_error < 0.01


def test_a_trot_has_another_pattern_than_the_canter() -> None:
    """By hand: RL is 0.2 turns early and FR 0.2 late for the plan; the others and the mean are in time."""
    time_s, _ = contacts()
    trot = ContactSchedule(touchdown=(0.5, 0.0, 0.0, 0.5))
    force = 60.0 * trot.stance(time_s * 2.5 - 0.3)
    score = gait_score(time_s, force, clock_hz=2.5, touchdown=SCHEDULE.touchdown, duty=SCHEDULE.duty)
    assert score is not None and score.pattern_error == pytest.approx(0.1, abs=0.01)
    assert score.phase_error == pytest.approx((0.3 + 0.5 + 0.1 + 0.3) / 4, abs=0.01)


def test_bounces_are_no_steps_and_a_standing_robot_has_no_phase() -> None:
    """A gap of 10 ms is closed; feet that never leave the floor have a duty of 1 and no touchdown."""
    time_s, force = contacts()
    force[::100] = 0.0
    score = gait_score(time_s, force, clock_hz=2.5, touchdown=SCHEDULE.touchdown, duty=SCHEDULE.duty)
    assert score is not None
    np.testing.assert_allclose(score.steps, 1.0)
    still = gait_score(
        time_s, np.full_like(force, 40.0), clock_hz=2.5, touchdown=SCHEDULE.touchdown, duty=SCHEDULE.duty
    )
    assert still is not None and np.isnan(still.phase).all() and np.isnan(still.phase_error)
    assert np.isnan(still.pattern_error)
    np.testing.assert_allclose(still.duty, 1.0)
    assert gait_score(time_s[:50], force[:50], clock_hz=2.5, touchdown=(0.0,) * 4, duty=0.4) is None


def test_a_foot_leaves_at_a_lower_force_than_it_comes_down() -> None:
    """Noise between both forces changes nothing."""
    force = np.array([[0.0], [10.0], [20.0], [10.0], [20.0], [3.0], [10.0]])
    found = stances(force, np.arange(7.0), 0.5)
    np.testing.assert_array_equal(found[:, 0], [False, False, True, True, True, False, False])
