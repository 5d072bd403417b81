"""The humanoid's task: reward by hand, reflections, springs, and what is learnt on top of them."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from deal_hw.errors import ConfigurationError, PolicyError
from deal_hw.policies.humanoid_env import HumanoidEnv, StrideTask, stride_spec
from deal_hw.policies.onnx_export import export_network
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.vector_env import Mirror
from deal_hw.policy import ObservationTerm
from deal_hw.robots import robot_description
from deal_hw.robots.humanoid.description import GEAR_NM, joint_type
from deal_hw.types import FloatArray
from deal_hw.workflows.train import nominal_distribution

HUMANOID = robot_description("humanoid")
EXACT = dataclasses.replace(HUMANOID, sensor=dataclasses.replace(HUMANOID.sensor, noise=(), resolution=()))


def make(count: int, **task: float) -> HumanoidEnv:
    return HumanoidEnv(EXACT, nominal_distribution("humanoid"), count, task=StrideTask(**task))  # type: ignore[arg-type]


def upright(count: int) -> tuple[FloatArray, FloatArray]:
    position = np.zeros((count, 27))
    position[:, 2] = 1.29
    return position, np.zeros_like(position)


def test_reward_by_hand() -> None:
    """Speed, drift, heading, tilt, motion, pose and effort; feet are tested below."""
    env = make(3, gait_weight=0.0)
    position, velocity = upright(3)
    # Ahead at the wanted speed, and to the side at 0.5 m/s: 1 + 3 - 1 * 0.25.
    velocity[0, :2] = 1.0, 0.5
    # At rest, turned by 60 degrees, a calm joint 0.5 rad off, one action of 0.5 after -0.5:
    # 1 + 0 - 2 * 0.5 - 0.2 * 0.25 - 0.02 * 0.25 - 0.01.
    position[1, 5], position[1, 6] = math.pi / 3, 0.5
    # Backwards at 3 m/s counts as the least, -3; tilted by 30 degrees about x, rising at 0.4 m/s, rolling at
    # 2 rad/s: 1 - 3 - 2 * 0.25 - 0.5 * 0.16 - 0.05 * 4.
    position[2, 3] = math.pi / 6
    velocity[2, [0, 2, 3]] = -3.0, 0.4, 2.0
    action, before = np.zeros((3, 21)), np.zeros((3, 21))
    action[1, 4], before[1, 4] = 0.5, -0.5
    wanted = [3.75, -0.065, -2.78]
    np.testing.assert_allclose(env.reward(position, velocity, action, before), wanted, atol=1e-12)


def test_feet_are_paid_for_following_the_clock() -> None:
    """On the floor, the foot that should stand is right and the one in mid-swing is 0.08 m too low."""
    env = make(2)
    env.reset(seed=0)
    env.step(np.zeros((2, 21)))
    np.testing.assert_allclose(env.foot_heights(), 0.0, atol=0.02)
    env._builder.clock[:] = 0.25, 0.75
    np.testing.assert_allclose(env.wanted_heights(), [[0.08, 0.0], [0.0, 0.08]], atol=1e-12)
    position, velocity = upright(2)
    lag = np.abs(env.foot_heights() - env.wanted_heights()).mean(axis=1)
    wanted = 1.0 + 6.0 * np.maximum(1.0 - math.pi * lag / 0.08, -1.0)
    nothing = np.zeros((2, 21))
    np.testing.assert_allclose(env.reward(position, velocity, nothing, nothing), wanted, atol=1e-12)


def test_standing_still_earns_nothing_by_the_feet(monkeypatch: pytest.MonkeyPatch) -> None:
    """A whole step of a foot, held in place: on average the share of the feet is zero."""
    env = make(2)
    env.reset(seed=0)
    env.step(np.zeros((2, 21)))
    position, velocity = upright(2)
    nothing = np.zeros((2, 21))
    monkeypatch.setattr(env, "foot_heights", lambda: np.zeros((2, 2)))
    earned = []
    for phase in np.linspace(0.0, 1.0, 1000, endpoint=False):
        env._builder.clock[:] = phase
        earned.append(env.reward(position, velocity, nothing, nothing) - 1.0)
    np.testing.assert_allclose(np.mean(earned, axis=0), 0.0, atol=0.01)


def test_half_of_the_episodes_start_with_a_speed() -> None:
    """Forward, at most 1 m/s; nothing else moves."""
    env = make(400)
    env.reset(seed=0)
    velocity = env.loop.velocity
    assert 0.4 < (velocity[:, 0] > 0).mean() < 0.6 and 0.9 < velocity[:, 0].max() <= 1.0
    assert not velocity[:, 1:].any()


def test_it_ends_when_it_tilts_or_sinks() -> None:
    """The limits are a cosine of 0.7, 45.6 degrees, and 0.9 m."""
    env = make(4)
    position, velocity = upright(4)
    position[:2, 4] = np.radians([45.0, 46.0])
    position[2:, 2] = 0.91, 0.89
    assert env.ended(position, velocity).tolist() == [False, True, False, True]


def reflected(values: FloatArray, mirror: Mirror) -> FloatArray:
    return np.asarray(values[..., list(mirror.source)] * np.array(mirror.sign))


def test_a_reflected_robot_does_the_reflected_thing() -> None:
    """From a state and its reflection, reflected actions give reflected observations and equal rewards."""
    env = make(2)
    env.reset(seed=0)
    seen, done = env.mirror()
    rng = np.random.default_rng(1)
    position, velocity = env.loop.position, 0.5 * rng.standard_normal((2, 27))
    position[0, 3:6] = 0.1 * rng.standard_normal(3)
    for values in (position, velocity):
        values[1, :6] = values[0, :6] * (1, -1, 1, -1, 1, -1)
        values[1, 6:] = reflected(values[0, 6:], done)
    theta = np.repeat(env.distribution.space.nominal[None], 2, axis=0)
    still = np.zeros((2, 21))
    env.loop.restart(np.ones(2, dtype=bool), theta, np.zeros(2), position, velocity, rng, still)
    env._builder.clock[:] = 0.1, 0.6
    for _ in range(10):
        action = rng.uniform(-0.5, 0.5, 21)
        observation, reward, *_ = env.step(np.stack([action, reflected(action, done)]))
        np.testing.assert_allclose(reflected(observation[0], seen), observation[1], atol=1e-6)
        assert reward[0] == pytest.approx(reward[1], abs=1e-9)


def test_springs_pull_each_joint_to_the_upright_pose() -> None:
    """A hip 0.1 rad off is driven back by 12 of its 120 N·m; nothing else acts."""
    env = make(1)
    feedback = env.feedback()
    seen = np.zeros(len(env.layout.observation))
    seen[env.layout.observation.index(ObservationTerm("position", "left_hip_y", 1.0))] = 0.1
    wanted = [-0.1 if name == "left_hip_y" else 0.0 for name in HUMANOID.actuated]
    np.testing.assert_allclose(feedback @ seen, wanted, atol=1e-12)
    torque = [feedback[k].min() * GEAR_NM[joint_type(name)] for k, name in enumerate(HUMANOID.actuated)]
    assert max(torque) < -10.0


def test_the_trained_network_contains_the_springs(tmp_path: Path) -> None:
    """One update: network and file are the same, and of a joint far off they still see the spring."""
    from deal_hw.policies.ppo import PpoConfig, PpoTrainer

    env = make(4)
    config = PpoConfig(steps=1, hidden=(16,), rollout=4, batches=1, epochs=1)
    policy = PpoTrainer().train(env, config, np.random.default_rng(0))
    found = export_network(policy.network, policy.spec, tmp_path / "policy.onnx")
    observation = np.zeros((2, len(env.layout.observation)), dtype=np.float32)
    knee = env.layout.observation.index(ObservationTerm("position", "left_knee", 1.0))
    observation[1, knee] = 0.5
    action = found.act_batch(observation)
    np.testing.assert_allclose(action, policy.act_batch(observation), atol=1e-5)
    row = HUMANOID.actuated.index("left_knee")
    assert action[1, row] - action[0, row] == pytest.approx(-0.5 * 100.0 / 80.0, abs=0.1)


@pytest.mark.parametrize(("rounding", "refused"), [(1.5e-5, False), (1e-3, True)])
def test_springs_of_single_precision_may_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rounding: float, refused: bool
) -> None:
    """Sums of the springs reach some tens: their last places are above the tolerance of actions near 1."""
    from deal_hw.policies.ppo import PpoConfig, PpoTrainer

    env = make(2)
    config = PpoConfig(steps=1, hidden=(16,), rollout=4, batches=1, epochs=1)
    policy = PpoTrainer().train(env, config, np.random.default_rng(0))
    real = OnnxPolicy.act_batch
    monkeypatch.setattr(OnnxPolicy, "act_batch", lambda self, seen: real(self, seen) + rounding)
    with pytest.raises(PolicyError, match="differs") if refused else contextlib.nullcontext():
        export_network(policy.network, policy.spec, tmp_path / "policy.onnx")


def test_it_learns_from_reflections(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each batch is followed by its reflection."""
    import rsl_rl.extensions.symmetry as rsl

    from deal_hw.policies.ppo import PpoConfig, PpoTrainer

    env = make(2)
    sizes: list[int] = []
    config = PpoConfig(steps=1, hidden=(16,), rollout=4, batches=1, epochs=1)
    real = rsl.Symmetry.augment_batch

    def augment(self: object, batch: object, count: int) -> None:
        real(self, batch, count)
        seen, done = (Mirror(m.source, m.sign) for m in env.mirror())
        actions, observations = batch.actions.numpy(), batch.observations["observation"].numpy()  # type: ignore[attr-defined]
        np.testing.assert_allclose(actions[count:], reflected(actions[:count], done), rtol=1e-6)
        np.testing.assert_allclose(observations[count:], reflected(observations[:count], seen), rtol=1e-6)
        sizes.append(len(actions))

    monkeypatch.setattr(rsl.Symmetry, "augment_batch", augment)
    PpoTrainer().train(env, config, np.random.default_rng(0))
    assert sizes == [2 * 2 * 4]


def test_the_spec_fits_the_robot() -> None:
    """Height, four vectors, clock, 21 positions, velocities and actions, at 1.25 steps of a foot a second."""
    spec = stride_spec(HUMANOID)
    spec.check_fits(HUMANOID)
    assert len(spec.observation) == 1 + 4 * 3 + 2 + 3 * 21
    assert spec.clock_hz == 1.25


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"speed_m_s": 0.0}, "speed_m_s must be positive"), ({"swing_share": 1.0}, r"swing_share must lie in")],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, float], message: str) -> None:
    """The message names the setting."""
    with pytest.raises(ConfigurationError, match=message):
        StrideTask(**settings)  # type: ignore[arg-type]
