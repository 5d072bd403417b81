"""The climb's environment: platforms, levels, what is told, and how heights are counted."""

from __future__ import annotations

import dataclasses
import json
from typing import Any
from unittest import mock

import numpy as np
import pytest

from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.drivers.go2.emulator.truth import draw_truth
from deal_hw.errors import ConfigurationError, PolicyError
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.motions.obstacle import parse_obstacle
from deal_hw.motions.posture import PostureBehaviour, PostureConfig, limited_for
from deal_hw.motions.velocity import FixedVelocity
from deal_hw.policies.climb_env import ClimbEnv, ClimbTask
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policy import CLIMBED, ObservationBuilder, PolicySpec
from deal_hw.robots import recorded_description, training_task
from deal_hw.sim.legged.terrain import Kind, Scuffs, Terrain
from deal_hw.workflows.emulation import virtual_go2
from deal_hw.workflows.running.plan import RunPlan, _ask_height, make_behaviour
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import nominal_distribution

GO2 = recorded_description("go2")
FREE: dict[str, Any] = {"torque_weight": 0.0, "scuff_weight": 0.0}
"""Settings without the costs of torque and of scuffing."""


def make(count: int = 8, **task: object) -> ClimbEnv:
    quiet = {"push_ticks": 10**9, "start_speed": 0.0, "start_noise_rad": 0.0}
    return ClimbEnv(
        GO2,
        nominal_distribution("go2", "climb"),
        count,
        task=ClimbTask(**{**quiet, **task}),  # type: ignore[arg-type]
    )


def test_platforms_follow_the_levels_and_half_of_the_robots_are_told() -> None:
    """Heights lie evenly between the ends; a robot that is told nothing observes two zeros."""
    env = make(200, flat=0.0, levels=10, rise_m=(0.04, 0.22))
    env.level[:] = np.arange(200) % 10
    seen, _ = env.reset(seed=0)
    np.testing.assert_allclose(env.terrain.rise, 0.04 + 0.02 * (np.arange(200) % 10))
    assert ((env.terrain.distance >= 0.6) & (env.terrain.distance <= 1.2)).all()
    told = seen[:, -1] > 0.0
    assert 0.35 < told.mean() < 0.65
    np.testing.assert_allclose(seen[told, -1], env.terrain.rise[told], rtol=1e-6)
    np.testing.assert_allclose(seen[told, -2], env.terrain.distance[told], rtol=1e-6)
    assert not seen[~told, -2:].any()


def test_a_leg_that_presses_against_the_front_scuffs() -> None:
    """A front 1 cm ahead of a foot touches it; one 0.3 m ahead and the floor do not."""
    env = make(3, flat=0.0, rise_m=(0.1, 0.1))
    env.reset(seed=0)
    env.step(np.zeros((3, 12)))
    feet = np.asarray(env._places[:, env._feet[:2], 0]).max(axis=1)
    env.terrain.place(np.arange(3), np.array([0.1, 0.1, 0.0]), feet + np.array([0.01, 0.3, 0.01]))
    front = Scuffs(env.loop.batch)
    np.testing.assert_array_equal(front.now(np.arange(3)), [True, False, False])
    np.testing.assert_array_equal(front.now(np.array([2, 0])), [False, True])


def test_torque_and_scuffs_cost_as_their_weights_say() -> None:
    """By hand: three like robots, one at a front; a tick costs 3e-4 for each (N·m)², and 0.5 for scuffing."""
    task = ClimbTask()
    assert (task.torque_weight, task.scuff_weight) == (3e-4, 0.5)
    envs = [make(3, flat=0.0, rise_m=(0.1, 0.1), **weights) for weights in ({}, FREE)]
    rewards = []
    for env in envs:
        env.reset(seed=0)
        env.step(np.zeros((3, 12)))
        feet = np.asarray(env._places[:, env._feet[:2], 0]).max(axis=1)
        env.terrain.place(np.arange(3), np.array([0.1, 0.1, 0.0]), feet + np.array([0.01, 0.3, 0.01]))
        rewards.append(env.step(np.full((3, 12), 0.1))[1])
        np.testing.assert_array_equal(env.pressing, [True, False, False])
    squared = np.square(envs[0].loop.batch.engine.bind("actuator_force")).sum(axis=1)
    assert squared.min() > 10.0
    np.testing.assert_allclose(rewards[1] - rewards[0], 3e-4 * squared + np.array([0.5, 0.0, 0.0]))
    found = envs[0].measures()
    assert found["pressing"] == pytest.approx(1.0 / 6.0)
    assert found["torque_nm"] > 0.0


def test_contacts_are_looked_for_wherever_a_robot_may_touch() -> None:
    """Over a shipped climb's tries of 0.2 m the robots that scuff are those of a search among all robots."""
    env, policy = make(12, flat=0.0, rise_m=(0.2, 0.2)), OnnxPolicy(required_policy("go2", "climb"))
    env.observe_for(policy.spec)
    seen, _ = env.reset(seed=1)
    every, scuffed = Scuffs(env.loop.batch), 0
    for _ in range(150):
        seen, _, terminated, truncated, _ = env.step(policy.act_batch(seen))
        same = ~(terminated | truncated)
        np.testing.assert_array_equal(env.pressing[same], every.now(np.flatnonzero(same)))
        scuffed += int(env.pressing.sum())
    assert scuffed > 100


@pytest.mark.parametrize("name", FREE)
def test_a_cost_is_not_negative(name: str) -> None:
    """It would be a reward for what is to be avoided."""
    with pytest.raises(ConfigurationError, match=rf"{name} must not be negative, got -0\.1"):
        make(1, **{name: -0.1})


def test_the_commanded_way_is_taken_off_the_told_distance() -> None:
    """After ten ticks at 0.5 m/s 0.1 m less is left; the height stays, and blind stays blind."""
    spec = make(1).layout
    builder = ObservationBuilder(spec, (2,))
    builder.command[:] = (0.5, 0.0, 0.0)
    builder.obstacle[0] = (1.0, 0.2)
    state = np.concatenate([np.zeros(6), GO2.default_position])
    for _ in range(11):
        seen = builder.build(np.stack([state] * 2), np.zeros((2, 18)))
    np.testing.assert_allclose(seen[:, -2:], [[0.9, 0.2], [0.0, 0.0]], atol=1e-6)


def test_a_robot_that_climbs_goes_up_a_level_and_one_that_tried_goes_down() -> None:
    """The level follows the last episode; one that stood, or had no platform, stays; so does a new one."""
    env = make(6, flat=0.0)
    env.level[:] = 4
    env.reset(seed=0)
    assert (env.level == 4).all()
    env._climbed[:] = (True, False, True, False, False, False)
    # The second was to walk beyond the edge, the fourth stood, the fifth had no platform, the last one fell.
    env._way[:] = (0.0, 9.0, 9.0, 0.1, 9.0, 0.1)
    env._elapsed[:] = env.task.ticks
    env._elapsed[5] = 10
    env.terrain.rise[4] = 0.0
    env.level[2] = env.task.levels - 1
    env.begin_episodes(np.ones(6, dtype=bool), np.random.default_rng(1))
    np.testing.assert_array_equal(env.level[[0, 1, 3, 4, 5]], [5, 3, 4, 4, 3])
    assert 0 <= env.level[2] < env.task.levels and not env._climbed.any() and not env._way.any()


def test_a_robot_is_also_trained_to_stand() -> None:
    """So its policy may be asked to stop, as at the end of a run, before the robot lies down."""
    assert make(1).layout.command_range == ((0.0, 0.8), (0.0, 0.0), (-0.3, 0.3))


def test_a_robot_on_the_platform_is_as_high_as_one_on_the_floor() -> None:
    """Heights are over the ground below: standing on top is no fall, and earns the reward of four feet."""
    env = make(2, flat=0.0, rise_m=(0.2, 0.2), distance_m=(0.6, 0.6), ticks=20, standing=0.0)
    env.reset(seed=0)
    position, velocity = env.loop.position.copy(), np.zeros((2, 18))
    floor = env.base_height(position)[0]
    position[1, 0] += 2.0
    position[1, 2] += 0.2
    env.loop.batch.set_state(position, velocity)
    for _ in range(10):
        _, reward, terminated, _, _ = env.step(np.zeros((2, 12)))
        assert not terminated.any()
    assert env.base_height(env.loop.position)[1] == pytest.approx(floor, abs=0.02)
    np.testing.assert_array_equal(env.on_top(), [[False] * 4, [True] * 4])
    assert reward[1] - reward[0] > 0.5 * env.task.top_weight
    np.testing.assert_array_equal(env.outcomes()["climbed"], [0.0, 1.0])
    # Also in the tick that ends the episode, after which it starts again.
    for _ in range(env.ticks):
        _, _, _, truncated, _ = env.step(np.zeros((2, 12)))
        if truncated.any():
            break
    assert truncated.all() and not env._climbed.any() and not env._way.any()
    np.testing.assert_array_equal(env.outcomes()["climbed"], [0.0, 1.0])


def test_robots_get_different_terrain_and_nobody_tells_of_a_slope() -> None:
    """Each kind has its own ends of the levels; of steps the height of one is told, of slopes nothing."""
    kinds: tuple[Kind, ...] = ("box", "steps", "slope")
    env = make(120, flat=0.0, blind=0.0, terrains=kinds, levels=2)
    env.level[:] = np.arange(120) % 2
    seen, _ = env.reset(seed=0)
    assert np.bincount(env.terrain.kind).min() > 20
    ends = np.array([env.task.ends_of(kind) for kind in kinds])
    np.testing.assert_allclose(env.terrain.rise, ends[env.terrain.kind, env.level])
    told = env.terrain.kind != kinds.index("slope")
    np.testing.assert_allclose(seen[told, -1], env.terrain.rise[told], rtol=1e-6)
    assert not seen[~told, -2:].any()


def test_steps_and_slopes_are_climbed_at_their_ends() -> None:
    """On the first step, and halfway up the ramp, feet are paid; only the platform behind counts."""
    env = make(4, flat=0.0, terrains=("steps", "slope"), ticks=20, standing=0.0)
    env.reset(seed=0)
    members = np.arange(4)
    kind, rise = np.array([0, 0, 1, 1]), np.array([0.1, 0.1, 0.1, 0.1])
    env.terrain.place(members, rise, np.full(4, 0.6), kind)
    position = env.loop.position.copy()
    for member, ahead in enumerate((0.6 + 0.15, 2.5, 0.6 + 1.0, 4.0)):
        position[member, 0] = ahead
    ground = env.terrain.height(position[:, :1])[:, 0]
    position[:, 2] += ground
    position[2, 4] = -0.1
    env.loop.batch.set_state(position, np.zeros((4, 18)))
    for _ in range(5):
        env.step(np.zeros((4, 12)))
    assert env.on_top()[[1, 2, 3]].all() and env.on_top()[0].any()
    np.testing.assert_array_equal(env.outcomes()["climbed"], [0.0, 1.0, 0.0, 1.0])
    np.testing.assert_allclose(ground, [0.1, 0.3, np.tan(0.1), 1.5 * np.sin(0.1)])


@pytest.mark.parametrize("terrains", [(), ("box", "box")])
def test_kinds_of_terrain_are_different_ones(terrains: tuple[Kind, ...]) -> None:
    """None, or one twice, is refused."""
    with pytest.raises(ConfigurationError, match="different kinds"):
        ClimbTask(terrains=terrains)


def test_the_critic_alone_sees_the_ground() -> None:
    """A robot that is told nothing observes the same before any platform; the critic's samples differ."""
    low, high = (make(4, flat=0.0, blind=1.0, rise_m=(r, r), distance_m=(0.8, 0.8)) for r in (0.05, 0.2))
    seen = [env.reset(seed=3)[0] for env in (low, high)]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert (high.privileged() - low.privileged()).max() == pytest.approx(4.0 * 0.15)


@pytest.mark.parametrize("text", ["1", "1,0.1,2", "far,0.1", "-1,0.1", "1,0.9", "nan,0.1", "1,0"])
def test_a_wrong_platform_is_refused(text: str) -> None:
    """The message says what to give."""
    with pytest.raises(ConfigurationError, match="--obstacle"):
        parse_obstacle(text)


def test_a_flat_policy_is_not_told_of_a_platform() -> None:
    """A walking policy that cannot use the numbers is refused, instead of walking into the platform."""

    class Flat:
        spec = training_task("go2").make(GO2, nominal_distribution("go2"), 1).layout

        def reset(self) -> None: ...

        def act(self, observation: object) -> np.ndarray:
            return np.zeros(12)

    plan = RunPlan(robot="go2", policy="walk.onnx", obstacle="1,0.15")
    with pytest.raises(PolicyError, match="walk does not observe a platform"):
        make_behaviour(plan, GO2, load=lambda _: Flat())
    climbs = Flat()
    climbs.spec = make(1).layout
    found = make_behaviour(plan, GO2, load=lambda _: climbs)
    assert isinstance(found, PolicyBehaviour) and found.follows_obstacle


def test_a_policy_that_observes_a_platform_has_the_limits_of_a_climb() -> None:
    """Only the turn of the base differs from the walk's; so it is through standing up and lying down."""
    assert isinstance(make(1)._filter, SafetyFilter)
    walk, climb = GO2.limits.legs, GO2.limits.climbing
    assert walk is not None and climb is not None
    assert (walk.tumble, climb.tumble) == (6.0, 8.0)
    assert dataclasses.replace(climb, tumble=walk.tumble) == walk

    class Still:
        def __init__(self, spec: PolicySpec) -> None:
            self.spec = spec

        def reset(self) -> None: ...

        def act(self, observation: object) -> np.ndarray:
            return np.zeros(12)

    flat = training_task("go2").make(GO2, nominal_distribution("go2"), 1).layout
    for spec, legs in ((make(1).layout, climb), (flat, walk)):
        inner = PolicyBehaviour(Still(spec), GO2)
        whole = PostureBehaviour(inner, GO2, 2.0, PostureConfig())
        assert limited_for(inner, GO2).limits.legs == limited_for(whole, GO2).limits.legs == legs
    # A robot without limits of its own for climbing keeps those for legs.
    usual = dataclasses.replace(GO2, limits=dataclasses.replace(GO2.limits, climbing=None))
    assert limited_for(PolicyBehaviour(Still(make(1).layout), usual), usual) == usual


@pytest.mark.slow
def test_a_climb_is_not_ended_by_the_turn_of_a_stumble() -> None:
    """Robot 8 turns at 6.5 rad/s before the platform, and climbs all the same."""
    policy = OnnxPolicy(required_policy("go2", "climb"))
    ahead, platform = FixedVelocity((0.6, 0.0, 0.0)), Terrain(kind="box", rise=0.2)
    told: dict[str, Any] = {
        "record": False,
        "terrain": platform,
        "obstacle": (1.0, 0.2),
        "hold_heading": True,
    }
    done = virtual_go2.walk(draw_truth("realistic", 8), policy, ahead, 6.0, **told)
    assert done.report.outcome is Outcome.FINISHED and done.track.place[:, 0].max() > 1.5
    with mock.patch.object(virtual_go2, "limited_for", lambda behaviour, description: description):
        done = virtual_go2.walk(draw_truth("realistic", 8), policy, ahead, 6.0, **told)
    assert done.report.outcome is Outcome.TRIPPED and "the base turns" in done.report.reason


def test_told_feet_are_to_rise_over_the_edge_and_blind_ones_are_free() -> None:
    """By hand, in the middle of a step, 0.1 m before an edge of 0.1 m: 0.16 m; elsewhere 0.06 m."""
    env = make(2, flat=0.0, blind=0.0, rise_m=(0.1, 0.1), distance_m=(0.8, 0.8))
    env.reset(seed=0)
    env._builder.obstacle[1] = 0.0
    # A quarter turn: FL and RR are in the middle of their swing.
    env._builder.clock[:] = 0.25
    env._places = np.zeros((2, env._places.shape[1], 3))
    env._places[:, env._feet, 0] = [0.7, 0.2, 0.85, 0.3]
    env._places[:, env._feet, 2] = env._radius + 0.02
    wanted = env._wanted_heights()
    # The third foot stands over the platform, 0.08 m below its top. A blind robot's near feet are free.
    np.testing.assert_allclose(wanted, [[0.16, 0.0, 0.0, 0.06], [0.02, 0.0, -0.08, 0.06]], atol=1e-9)
    errors = env._foot_errors(np.full((2, 4), 0.08))
    np.testing.assert_allclose(errors[0], [0.5, 0.08 / 0.06, 0.08 / 0.06, 0.08 / 0.06])


def test_the_record_has_the_highest_platform_that_most_robots_climbed() -> None:
    """Told tries count, at the level at which they were made; a level with few tries does not."""
    env = make(2, flat=0.0, blind=0.0, levels=10, rise_m=(0.04, 0.22))
    env.reset(seed=0)
    assert env.reached() == {CLIMBED: 0.0}
    for level, successes, failures in ((1, 40, 0), (3, 20, 15), (4, 10, 30), (9, 5, 0)):
        for number in range(successes + failures):
            env.level[:], env._elapsed[:], env._way[:] = level, env.task.ticks, 9.0
            env._climbed[:], env._told[:] = number < successes, (True, False)
            env.begin_episodes(np.array([True, True]), np.random.default_rng(0))
    # 0.04 + 3/9 of 0.18 m.
    assert env.reached() == {CLIMBED: 0.1}


def test_a_higher_platform_than_in_training_is_asked_about() -> None:
    """An operator decides; where nobody can answer it is refused. A policy without a record is not asked."""
    asked: list[str] = []

    class Operator(RunView):
        def confirm(self, warning: str, question: str) -> bool | None:
            asked.append(warning)
            return len(asked) > 1

    spec = dataclasses.replace(make(1).layout, training={CLIMBED: 0.1})
    plan = RunPlan(robot="go2", policy="climb.onnx", obstacle="1,0.15")
    with pytest.raises(PolicyError, match=r"platform of 0\.15 m.* is 0\.1 m: the robot may fall.*terminal"):
        _ask_height(plan, spec, RunView())
    with pytest.raises(PolicyError, match=r"not run; use a platform of at most 0\.1 m"):
        _ask_height(plan, spec, Operator())
    _ask_height(plan, spec, Operator())
    assert len(asked) == 2
    _ask_height(dataclasses.replace(plan, obstacle="1,0.1"), spec, RunView())
    _ask_height(plan, make(1).layout, RunView())


def test_a_training_goes_on_at_the_levels_that_were_reached() -> None:
    """A fine-tune would otherwise begin with steps that its policy has long climbed, and end with them."""
    env, other = make(3, levels=5), make(5, levels=5)
    env.reset(seed=0)
    env.level[:] = (1, 4, 2)
    env._tries[3].extend([True] * 30)
    progress = json.loads(json.dumps(env.progress()))
    other.go_on(progress)
    np.testing.assert_array_equal(other.level, [1, 4, 2, 1, 4])
    assert other.reached() == env.reached() and other.reached()[CLIMBED] > 0.1
    other.reset(seed=0)
    np.testing.assert_array_equal(other.level, [1, 4, 2, 1, 4])
    other.go_on({})
    np.testing.assert_array_equal(other.level, [1, 4, 2, 1, 4])
