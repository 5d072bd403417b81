"""The tasks of ant and Go2: environment contract, rewards by hand, and a training short enough to watch."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterDistribution, ParameterSpace
from deal_hw.policies.go2_env import Go2Env, WalkTask, walk_spec
from deal_hw.policies.humanoid_env import HumanoidEnv, StrideTask
from deal_hw.policies.locomotion import LocomotionEnv, judge
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.run_env import RunEnv, RunTask, run_spec
from deal_hw.policy import Observation, PolicySpec
from deal_hw.robots import default_space, recorded_description, robot_description
from deal_hw.types import FloatArray, JointCommand

ROOT = Path(__file__).resolve().parents[2]
ROBOTS = ("ant", "go2", "humanoid")
GO2 = recorded_description("go2")
NEVER = 10**9


def udr(robot: str) -> ParameterDistribution:
    space = default_space(robot)
    return ParameterDistribution.uniform(space.with_ratio(5.0), (0.0, 0.02))


def make(robot: str, count: int = 4, **task: Any) -> LocomotionEnv:
    if robot == "ant":
        return RunEnv(robot_description(robot), udr(robot), count, task=RunTask(**task))
    if robot == "humanoid":
        return HumanoidEnv(robot_description(robot), udr(robot), count, task=StrideTask(**task))
    return Go2Env(GO2, udr(robot), count, task=WalkTask(**task))


@pytest.fixture(scope="module", params=ROBOTS)
def env(request: pytest.FixtureRequest) -> LocomotionEnv:
    """Return an environment of four robots with episodes of 0.4 s."""
    options: dict[str, dict[str, Any]] = {
        "go2": {"start_speed": 0.0},
        "humanoid": {"start_speed_m_s": 0.0},
    }
    return make(request.param, ticks=20, **options.get(request.param, {}))


def state(count: int, joints: int) -> tuple[FloatArray, FloatArray]:
    """Return the states of robots at 0.26 m, upright and at rest."""
    position = np.zeros((count, 6 + joints))
    position[:, 2] = 0.26
    return position, np.zeros_like(position)


def test_what_comes_out_is_what_the_spaces_say(env: LocomotionEnv) -> None:
    """Shapes, types and finite values; gymnasium's own spaces contain what is observed and sampled."""
    observation, _ = env.reset(seed=3)
    env.action_space.seed(0)
    for _ in range(25):
        assert observation in env.observation_space
        assert np.isfinite(observation).all()
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        over = terminated | truncated
        assert reward.shape == terminated.shape == truncated.shape == (4,)
        assert np.isfinite(reward).all()
        assert not (terminated & truncated).any()
        assert over.any() == ("final_obs" in info)


def test_a_seed_decides_everything(env: LocomotionEnv) -> None:
    """Parameters, latencies, starts and commands come from the seed, not from what was before."""
    actions = np.random.default_rng(0).uniform(-1, 1, (22, 4, len(env.layout.actuated)))
    runs = []
    for seed in (5, 5, 6):
        first = env.reset(seed=seed)[0]
        runs.append(np.stack([first, *(env.step(action)[0] for action in actions)]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_episodes_start_from_robots_that_have_settled(env: LocomotionEnv) -> None:
    """Nobody starts in the air, fallen, or moving."""
    env.reset(seed=0)
    position, velocity = env.loop.position, env.loop.velocity
    assert not env.ended(position, velocity).any()
    assert (position[:, 2] <= env.loop.batch.robot.model.qpos0[2]).all()
    np.testing.assert_array_equal(velocity, 0.0)


def test_ant_reward_by_hand() -> None:
    """1 * 1.5 + 0.2 - 0.1 * (0.5^2 + 0.5^2) = 1.65; sideways counts nothing."""
    env = make("ant", 2)
    position, velocity = state(2, 8)
    velocity[0, :3] = 1.5, 9.0, 0.0
    action = np.zeros((2, 8))
    action[0, :2] = 0.5, -0.5
    reward = env.reward(position, velocity, action, np.ones((2, 8)))
    np.testing.assert_allclose(reward, [1.65, 0.2], atol=1e-12)


def test_ant_ends_on_its_back_or_in_the_air() -> None:
    """At a tilt of 89 degrees it may go on, at 91 not; nor above a metre."""
    env = make("ant", 3)
    position, velocity = state(3, 8)
    position[:2, 4] = np.radians([89.0, 91.0])
    position[2, 2] = 1.01
    assert env.ended(position, velocity).tolist() == [False, True, True]


def test_go2_reward_by_hand() -> None:
    """Tracking, height, tilt, fast joints; velocities count in the base's frame. Feet are tested below."""
    env = make("go2", 3, gait_weight=0.0, slip_weight=0.0)
    assert isinstance(env, Go2Env)
    env.command[:] = 0.0
    env.command[1:, 0] = 0.4
    position, velocity = state(3, 12)
    position[:, 2], position[:, 6:] = 0.27, GO2.default_position
    # Stands as commanded, 2 cm low: 1.5 + 0.8 + 0.3 - 20 * 0.02^2 = 2.592.
    position[0, 2] = 0.25
    # Heads along the world's y axis at 0.2 m/s, 0.2 too slow, and yaws at 0.5 rad/s; one action changed by 1:
    # 1.5 exp(-0.04 / 0.2) + 0.8 exp(-0.25 / 0.2) + 0.3 - 0.03.
    position[1, 5] = math.pi / 2
    velocity[1, :6] = 0.0, 0.2, 0.0, 0.0, 0.0, 0.5
    # Tilted by 30 degrees, sin^2 = 0.25, a hip 0.2 rad off, another joint at 0.8 of its trip speed:
    # 1.5 exp(-0.16 / 0.2) + 0.8 + 0.3 - 3 * 0.25 - 0.3 * 0.04 - 5 * 0.2^2.
    position[2, 3] = math.pi / 6
    position[2, 6] += 0.2
    velocity[2, 8] = -0.8 * GO2.limits.trip_velocity[2]
    before, action = np.zeros((3, 12)), np.zeros((3, 12))
    action[1, 7] = -1.0
    wanted = [2.592, 1.5 * math.exp(-0.2) + 0.8 * math.exp(-1.25) + 0.27, 1.5 * math.exp(-0.8) + 0.138]
    np.testing.assert_allclose(env.reward(position, velocity, action, before), wanted, atol=1e-12)


def test_go2_feet_are_paid_for_following_the_clock() -> None:
    """Over a whole step, standing earns all of it at a command to stand; at one to walk, not the half sine.

    Its mean over a step is (2 / pi) / 2, so 1 - 0.318 is left.
    """
    for standing, wanted in ((1.0, 1.0), (0.0, 1.0 - 1.0 / math.pi)):
        env = make(
            "go2",
            4,
            standing=standing,
            zeroed=0.0,
            push_ticks=NEVER,
            command_ticks=NEVER,
            start_speed=0.0,
            start_noise_rad=0.0,
            payload_kg=(0.0, 0.0),
        )
        env.reset(seed=1)
        env.step(np.zeros((4, 12)))
        env.measures()
        for _ in range(20):
            env.step(np.zeros((4, 12)))
        assert env.measures()["gait"] == pytest.approx(wanted, abs=0.12)


def test_go2_measures_leave_out_a_member_whose_physics_diverged() -> None:
    """Its state is NaN in that tick; the means are those of the others, and it counts as a fall."""
    env = make("go2", 4, push_ticks=NEVER, payload_kg=(0.0, 0.0))
    env.reset(seed=1)
    env.step(np.zeros((4, 12)))
    env.measures()
    position, velocity = env.loop.position, env.loop.velocity
    velocity[0] = 1e12
    env.loop.batch.set_state(position, velocity)
    assert env.step(np.zeros((4, 12)))[2].tolist() == [True, False, False, False]
    found = env.measures()
    assert all(np.isfinite(value) for value in found.values())
    assert found["falls_a_minute"] == pytest.approx(60 * 50 / 4)
    assert "falls" not in found


def test_go2_ends_when_it_tilts_or_sinks() -> None:
    """The limits are a cosine of 0.7, 45.6 degrees, and 0.15 m."""
    env = make("go2", 4)
    position, velocity = state(4, 12)
    position[:2, 3] = np.radians([45.0, 46.0])
    position[2:, 2] = 0.151, 0.149
    assert env.ended(position, velocity).tolist() == [False, True, False, True]


def test_go2_commands_are_drawn_and_observed() -> None:
    """A tenth stands, a quarter of the others' parts is zero, all are in range, and the policy sees them."""
    env = make("go2", 400)
    assert isinstance(env, Go2Env)
    observation, _ = env.reset(seed=0)
    command = env.command
    still = (command == 0).all(axis=1)
    assert 20 <= still.sum() <= 70
    assert 0.2 <= (command[~still] == 0).mean() <= 0.3
    low, high = np.array(env.task.command_range).T
    assert (command >= low).all() and (command <= high).all()
    reported = [k for k, term in enumerate(env.layout.observation) if term.quantity == "command"]
    np.testing.assert_allclose(observation[:, reported], command, rtol=1e-6)


def test_go2_targets_are_those_of_the_filter_that_deploys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Batched, and from what is reported, each member is sent what the filter makes of its command alone."""
    env = make("go2", 3, push_ticks=NEVER, command_ticks=NEVER)
    env.reset(seed=0)
    assert isinstance(env, Go2Env)
    sent: list[FloatArray] = []
    real = env.loop.step

    def step(target: FloatArray, rng: np.random.Generator) -> FloatArray:
        sent.append(target.copy())
        return real(target, rng)  # type: ignore[return-value]

    monkeypatch.setattr(env.loop, "step", step)
    filters, spec, previous = SafetyFilter(GO2), env.layout, np.tile(GO2.default_position, (3, 1))
    rng, changed = np.random.default_rng(2), 0
    for _ in range(6):
        action = rng.uniform(-1.0, 1.0, (3, 12))
        seen = env.loop.reported_position[:, 6:].copy(), env.loop.reported_velocity[:, 6:].copy()
        env.step(action)
        for i in range(3):
            wanted = JointCommand(
                position_target=np.array(GO2.default_position) + np.array(spec.action_scale) * action[i],
                velocity_target=np.zeros(12),
                effort=np.zeros(12),
                stiffness=np.array(spec.stiffness),
                damping=np.array(spec.damping),
                effort_limit=np.array(spec.effort_limit),
                speed_limit=np.array(spec.speed_limit),
            )
            command, clipped = filters.clip(wanted, previous[i], seen[0][i], seen[1][i])
            np.testing.assert_allclose(sent[-1][i], command.position_target, atol=1e-12)
            previous[i] = command.position_target
            changed += bool(clipped)
    assert changed > 3


def test_go2_sees_what_it_asked_for_and_not_what_was_sent() -> None:
    """As when deployed, where the policy does not see what the filter made of its action."""
    env = make("go2", 1, push_ticks=NEVER)
    env.reset(seed=0)
    observation = env.step(np.ones((1, 12)))[0]
    last = [k for k, t in enumerate(env.layout.observation) if t.quantity == "action"]
    np.testing.assert_allclose(observation[0, last], 1.0)
    assert env.measures()["clipped"] == 1.0


def test_go2_is_pushed() -> None:
    """At rest by its own doing; with a push at every tick the base moves within one."""
    speeds = []
    for ticks in (NEVER, 1):
        env = make("go2", 8, push_ticks=ticks, start_speed=0.0, start_noise_rad=0.0)
        env.reset(seed=0)
        env.step(np.zeros((8, 12)))
        speeds.append(np.abs(env.loop.velocity[:, :2]).max())
    assert speeds[0] < 0.15 < speeds[1]


def test_what_is_calibrated_is_not_drawn_by_the_task() -> None:
    """A distribution that holds the floor's friction rules; payload and encoders are still drawn."""
    friction = Parameter(
        name="grip", kind="geom_friction", elements=("floor",), unit="-", nominal=0.6, low=0.5, high=0.7
    )
    given = ParameterDistribution.uniform(ParameterSpace([friction]), (0.0, 0.0))
    names = Go2Env(GO2, given, 2).loop.batch.space.names
    assert names[:2] == ("grip", "base.body_mass") and len(names) == 14


@pytest.mark.parametrize(("spec", "robot"), [(run_spec, "ant"), (walk_spec, "go2")])
def test_specs_fit_their_robots_and_stay_inside_the_limits(spec: type[PolicySpec], robot: str) -> None:
    """What is trained here may be deployed there: no reachable target is outside the safety limits."""
    description = recorded_description(robot)
    layout: PolicySpec = spec(description, "udr")  # type: ignore[call-arg, arg-type]
    layout.check_fits(description)
    low, high = np.array(description.limits.target).T
    middle = np.array(description.default_position) if description.actuation == "position" else np.zeros(8)
    assert (middle - layout.action_scale >= low).all() and (middle + layout.action_scale <= high).all()


class Still:
    """A policy that does nothing."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return zeros, (B, A)."""
        return np.zeros((len(observations), len(self.spec.actuated)))


def test_judgement_counts_the_first_episode_only() -> None:
    """Ants at rest, speed not counted: nobody falls, and 20 ticks at 0.2 give 4, not more."""
    found = judge(Still(make("ant").layout), make("ant", 6, ticks=20, forward_weight=0.0), 1)
    assert found["fall_rate"] == 0.0 and found["time_up"] == 1.0 and found["robots"] == 6
    assert found["return_mean"] == pytest.approx(4.0)


def test_what_ended_early_is_judged_up_to_there() -> None:
    """Robots that count as fallen at once get one fall each and no time up but the tick of the fall."""
    env = make("go2", 3, ticks=10)
    assert isinstance(env, Go2Env)
    env.task = dataclasses.replace(env.task, lowest_m=1.0)
    found = judge(Still(env.layout), env, 1)
    assert found["fall_rate"] == 1.0 and found["time_up"] == pytest.approx(0.1)
    assert found["return_mean"] == -env.task.fall_cost and found["forward_speed_m_s"] is None


def test_a_fixed_base_is_refused() -> None:
    """The message names the robot and what it lacks."""
    description = dataclasses.replace(GO2, floating_base=None)
    with pytest.raises(ConfigurationError, match="'go2' has a fixed base; locomotion needs a free one"):
        RunEnv(description, udr("go2"), 1)
    with pytest.raises(ConfigurationError, match="'go2' has 0 feet in its description; walking needs 4"):
        Go2Env(robot_description("go2"), udr("go2"), 1)


@pytest.mark.parametrize(
    ("task", "settings", "message"),
    [
        (RunTask, {"ticks": 0}, "ticks must be at least 1, got 0"),
        (RunTask, {"top_height_m": 0.0}, "top_height_m must be positive, got 0.0"),
        (WalkTask, {"ticks": 0}, "ticks must be at least 1, got 0"),
        (WalkTask, {"tracking_width": 0.0}, "tracking_width must be positive, got 0.0"),
        (WalkTask, {"friction": (0.5, 0.1)}, r"friction must be \(low, high\)"),
        (WalkTask, {"command_range": ((1.0, 0.0),)}, r"command_range\[0\] must be \(low, high\)"),
        (WalkTask, {"standing": 2.0}, r"standing must lie in \[0, 1\], got 2.0"),
    ],
)
def test_settings_that_mean_nothing_are_refused(
    task: type[RunTask | WalkTask], settings: dict[str, float], message: str
) -> None:
    """The message names the setting and what was given."""
    with pytest.raises(ConfigurationError, match=message):
        task(**settings)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    """Return the training command as a module."""
    spec = importlib.util.spec_from_file_location(
        "train_demo_policy", ROOT / "tools" / "train_demo_policy.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "steps"), [("ant", 5_120), ("go2", 384)])
def test_a_short_training_makes_a_policy_that_acts(
    robot: str, steps: int, tool: ModuleType, tmp_path: Path
) -> None:
    """A few updates give a small file, its record, and actions in [-1, 1]."""
    path = tmp_path / f"{robot}.onnx"
    tool.train(robot, path, seed=1, steps=steps, members=8, judged=4)
    policy = OnnxPolicy(path)
    observation = np.random.default_rng(0).standard_normal(len(policy.spec.observation)).astype(np.float32)
    assert np.abs(policy.act(observation)).max() <= 1.0
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["training"]["config"]["steps"] == steps
    assert record["evaluation"]["robots"] == record["at_rest"]["robots"] == 4
    assert path.stat().st_size < 200_000


@pytest.mark.slow
def test_a_stopped_training_goes_on_with_its_curve(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped after two points, then resumed: one curve to the last step, and the time of both parts."""
    path, checkpoint = tmp_path / "walk.onnx", tmp_path / "run" / "walk.safetensors"
    options = {"seed": 1, "steps": 4 * 24 * 4, "members": 4, "judged": 2, "checkpoint": checkpoint}
    with monkeypatch.context() as patch:
        patch.setattr(tool.Curve, "over", lambda self: len(self.points) >= 2)
        tool.train("humanoid", path, **options)
    first = json.loads(path.with_suffix(".json").read_text())
    assert [point["steps"] for point in first["curve"]] == [96, 192]
    # As after a crash: the record is missing, and the curve holds a point that is later than the checkpoint.
    path.with_suffix(".json").unlink()
    curve = checkpoint.with_suffix(".curve.json")
    kept = json.loads(curve.read_text())
    kept["points"].append({**kept["points"][-1], "steps": 288, "cpu_hours": 1.0})
    curve.write_text(json.dumps(kept))
    tool.train("humanoid", path, resume=True, **options)
    record = json.loads(path.with_suffix(".json").read_text())
    assert [point["steps"] for point in record["curve"]] == [96, 192, 288, 384]
    assert record["reached"]["steps"] == 384 and record["resumed"]
    assert 3600 < record["cpu_seconds"] < 2 * 3600
    assert {"mean_return", "time_up", "speed_m_s", "gait"} <= record["curve"][-1].keys()
    shipped = path.with_suffix(".safetensors")
    assert shipped.stat().st_size < checkpoint.stat().st_size


def test_a_training_ends_with_its_processor_hours(tool: ModuleType, tmp_path: Path) -> None:
    """An hour spent before counts: with a limit of one hour, nothing is left."""
    curve = tmp_path / "walk.curve.json"
    points = [{"steps": 10, "cpu_hours": 1.0, "mean_return": None}]
    curve.write_text(json.dumps({"before": [], "points": points}))
    assert not tool.Curve(curve, resume=False, hours=1.0).over()
    assert tool.Curve(curve, resume=True, hours=1.0).over()
    assert not tool.Curve(curve, resume=True, hours=2.0).over()
    # So do those of a training whose checkpoint is the start.
    later = tool.Curve(tmp_path / "later.curve.json", start=curve, hours=1.0)
    assert later.over() and later.before == points and not later.points
