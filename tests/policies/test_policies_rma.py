"""Rapid motor adaptation: what the simulator knows, what is felt of it, and where a training begins."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import CheckpointError, ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.cartpole_env import BalanceTask, CartPoleEnv
from deal_hw.policies.climb_env import ClimbEnv, ClimbTask
from deal_hw.policies.locomotion import judge
from deal_hw.policies.servo_loop import EXACT_SENSOR
from deal_hw.policies.tasks import OWN_TASK
from deal_hw.policies.vector_env import TaskKnowledge
from deal_hw.policy import MAX_DELAY, ObservationBuilder, ObservationTerm
from deal_hw.robots import recorded_description, training_task
from deal_hw.training import TrainingFiles
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import nominal_distribution, udr_distribution

SPACE = k9_space()
UNIFORM = ParameterDistribution.uniform(SPACE.with_ratio(2.0), (0.0, 0.02))
GO2 = recorded_description("go2")


def balance(count: int = 4, distribution: ParameterDistribution = UNIFORM) -> CartPoleEnv:
    task = BalanceTask(ticks=100, host_delay_s=(0.0, 0.0))
    return CartPoleEnv(DESCRIPTION, distribution, count, task=task, sensor=EXACT_SENSOR)


def climb(count: int = 4, udr: bool = False, **task: Any) -> ClimbEnv:
    drawn = udr_distribution if udr else nominal_distribution
    return ClimbEnv(GO2, drawn("go2", "climb"), count, task=ClimbTask(**task))


def test_extrinsics_are_the_drawn_values_about_the_nominal_ones() -> None:
    """A ratio of e is 1 on a log scale; a latency of one control period is 1; both change with an episode."""
    theta = SPACE.nominal.copy()
    log = SPACE.log_scale
    assert log.any()
    first = int(np.flatnonzero(log)[0])
    theta[first] *= 1.25
    env = balance(2, ParameterDistribution.point(SPACE, theta, 1.0 / DESCRIPTION.control_rate_hz))
    env.reset(seed=0)
    known = env.extrinsics()
    assert known.names == (*SPACE.names, "latency") and known.values.shape == (2, len(SPACE) + 1)
    wanted = np.zeros(len(SPACE) + 1)
    wanted[first], wanted[-1] = np.log(1.25), 1.0
    np.testing.assert_allclose(known.values / known.size, [wanted, wanted], atol=1e-9)
    drawn = balance(3)
    drawn.reset(seed=0)
    before = drawn.extrinsics().values.copy()
    drawn.reset(seed=1)
    assert not np.any(np.all(before == drawn.extrinsics().values, axis=1))


def test_a_climb_also_knows_the_ground_below_and_just_ahead_of_the_feet() -> None:
    """On the floor all is zero; beyond the edge the ground is as high as the platform."""
    env = climb(2, flat=0.0, rise_m=(0.1, 0.1), distance_m=(0.9, 0.9), start_noise_rad=0.0)
    env.reset(seed=0)
    names = env.extrinsics().names
    ground = [k for k, name in enumerate(names) if ".ground+" in name]
    assert len(ground) == 8 and len(set(names)) == len(names)
    assert not env.extrinsics().values[:, ground].any()
    env.step(np.zeros((2, 12)))
    # A stance over the edge: the front feet are on the platform, the rear feet before it.
    front = float(np.mean(env._places[0, env._feet[:2], 0]))
    env.terrain.place(np.arange(2), np.full(2, 0.1), np.full(2, front - 0.02))
    values = env.extrinsics().values[0, ground]
    np.testing.assert_allclose(values[:2], 0.1, atol=1e-6)
    np.testing.assert_allclose(values[2:4], 0.0, atol=1e-6)


def test_the_history_is_what_was_felt_and_done() -> None:
    """The new terms are former joints, base and actions, and read as the same terms did before."""
    env = climb(3)
    own = env.layout.observation
    env.observe_history(2)
    terms = env.layout.observation
    assert terms[: len(own)] == own and env.own_terms == len(own)
    assert {term.quantity for term in terms[len(own) :]} == {
        "position", "velocity", "action", "gravity", "angular_velocity",
    }  # fmt: skip
    env.observe_history(2)
    assert env.layout.observation == terms
    first, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    second = env.step(rng.uniform(-0.1, 0.1, (3, 12)))[0]
    third = env.step(rng.uniform(-0.1, 0.1, (3, 12)))[0]
    at = {term: k for k, term in enumerate(terms)}
    for term in (
        ObservationTerm("position", "FL_calf_joint", 1.0),
        ObservationTerm("velocity", "RR_hip_joint", 0.05),
        ObservationTerm("action", "FR_thigh_joint", 1.0, 1),
        ObservationTerm("angular_velocity", "x", 0.25),
    ):
        once, twice = (at[dataclasses.replace(term, delay=term.delay + k)] for k in (1, 2))
        np.testing.assert_array_equal(third[:, once], second[:, at[term]])
        np.testing.assert_array_equal(third[:, twice], first[:, at[term]])


def test_a_robot_builds_the_history_of_the_simulator() -> None:
    """One robot's builder, fed with the same states, gives what the environment gave."""
    env = balance(1, ParameterDistribution.point(SPACE, SPACE.nominal, 0.0))
    env.observe_history(4)
    robot = ObservationBuilder(env.layout)
    seen, _ = env.reset(seed=0)
    rng = np.random.default_rng(1)
    for _ in range(8):
        np.testing.assert_array_equal(robot.build(*(values[0] for values in env.sensed())), seen[0])
        action = rng.uniform(-0.2, 0.2, (1, 1))
        seen = env.step(action)[0]
        robot.record_action(action[0])


def test_a_start_from_ppo_does_what_it_did_whatever_the_simulator_knows() -> None:
    """The shipped climb's actions on its own terms, from a start that is of the same task."""
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.policies.rma import RmaConfig, RmaTrainer

    path = required_policy("go2", "climb")
    env = climb(4, udr=True)
    learner = RmaTrainer().learner(env, RmaConfig(history=3))
    found = learner.read(path.with_suffix(".safetensors"), env.layout)
    assert found.notes["same_task"]
    learner.load(found, whole=False)
    seen = np.random.default_rng(0).standard_normal((5, len(env.layout.observation))).astype(np.float32)
    shipped = OnnxPolicy(path).act_batch(seen[:, : env.own_terms])
    import torch

    with torch.no_grad():
        mine = learner.network()(torch.as_tensor(seen)).numpy()
    np.testing.assert_allclose(mine, shipped, atol=1e-5)
    assert env.level.any()


def test_extrinsics_of_another_distribution_are_found_by_name(tmp_path: Path) -> None:
    """A start whose distribution drew more parameters, in another order: each keeps its weights."""
    from deal_hw.policies.rma import RmaConfig, RmaTrainer

    settings: dict[str, Any] = {"hidden": (16,), "history": 2, "rollout": 8, "adaptation": 0.5}
    file = tmp_path / "start.safetensors"
    RmaTrainer().train(
        balance(8),
        RmaConfig(steps=128, **settings),
        np.random.default_rng(0),
        files=TrainingFiles(checkpoint=file),
    )
    names = SPACE.names
    fewer = SPACE.with_free(reversed(names[1:]))
    env = balance(8, ParameterDistribution.uniform(fewer, (0.0, 0.02)))
    learner = RmaTrainer().learner(env, RmaConfig(**settings))
    found = learner.read(file, env.layout)
    learner.load(found, whole=False)
    before = found.tensors["actor.encoder.0.weight"].numpy()
    after = learner.checkpoint().tensors["actor.encoder.0.weight"].numpy()
    old, new = ([name for name, _ in one.notes["extrinsics"]] for one in (found, learner.checkpoint()))
    assert old == [*names, "latency"] and set(new) < set(old)
    for column, name in enumerate(new):
        np.testing.assert_array_equal(after[:, column], before[:, old.index(name)])


def test_ppo_does_not_start_from_a_policy_with_a_history(tmp_path: Path) -> None:
    """It observes more than the task: said, with the file."""
    from deal_hw.policies.ppo import PpoConfig, PpoTrainer
    from deal_hw.policies.rma import RmaConfig, RmaTrainer

    file, rng = tmp_path / "rma.safetensors", np.random.default_rng(0)
    settings: dict[str, Any] = {"hidden": (16,), "rollout": 8}
    RmaTrainer().train(balance(8), RmaConfig(steps=64, **settings), rng, files=TrainingFiles(checkpoint=file))
    with pytest.raises(CheckpointError, match=r"rma\.safetensors is of a policy with another observation"):
        PpoTrainer().train(balance(8), PpoConfig(steps=64, **settings), rng, files=TrainingFiles(start=file))


@pytest.mark.slow
def test_what_is_felt_tells_of_what_is_drawn() -> None:
    """The length of the pole is felt in part from 0.3 s: less than 1, which is what the mean would leave."""
    from deal_hw.policies.rma import RmaConfig, RmaTrainer

    config = RmaConfig(
        steps=60_000,
        hidden=(32, 32),
        rollout=16,
        learning_rate=3e-3,
        reward_scale=0.1,
        history=15,
        # A processor's rounding grows to another policy. With 0.5 three seeds had 0.75 to 1.13, with 0.8
        # six had 0.50 to 0.94.
        adaptation=0.8,
    )
    length = ParameterDistribution.uniform(SPACE.with_free(["pole.length"]).with_ratio(4.0), (0.0, 0.0))
    policy = RmaTrainer().train(balance(64, length), config, np.random.default_rng(0))
    record = policy.spec.training
    assert record["extrinsics"] == ["pole.length", "latency"]
    assert 0.0 < record["encoding_not_felt"] < 1.0


def test_a_judge_observes_as_the_policy_does() -> None:
    """A policy with a history and one that observes no platform act in the same environment."""

    class Seen:
        def __init__(self, terms: tuple[ObservationTerm, ...]) -> None:
            self.spec = dataclasses.replace(climb(1).layout, observation=terms)
            self.widths: set[int] = set()

        def act_batch(self, observations: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
            self.widths.add(observations.shape[1])
            return np.zeros((len(observations), 12))

    own = climb(1).layout.observation
    longer = climb(1)
    longer.observe_history(1)
    for terms in (own[:-2], own, longer.layout.observation):
        policy = Seen(terms)
        assert judge(policy, climb(2, ticks=3), seed=0)["robots"] == 2
        assert policy.widths == {len(terms)}


def test_settings_and_tasks_without_a_past_are_refused() -> None:
    """The message says what is allowed; the user's own environment has no history that is known."""
    from deal_hw.policies.rma import RmaConfig, RmaTrainer

    for wrong, message in (
        ({"history": 0}, f"history must be 1 to {MAX_DELAY - 1} control periods, got 0"),
        ({"history": MAX_DELAY}, "history must be 1 to"),
        ({"adaptation": 1.0}, r"adaptation must lie in \(0, 1\), got 1.0"),
        ({"gamma": 0.0}, r"gamma must lie in \(0, 1\]"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            RmaConfig(**wrong)
    assert OWN_TASK.usual_members("rma") == OWN_TASK.usual_members("ppo")
    own: Any = TaskKnowledge()
    with pytest.raises(ConfigurationError, match=r"trainer rma learns to feel .* train it with ppo or sac"):
        RmaTrainer().learner(own, RmaConfig())


def test_every_robot_of_ours_can_be_trained_with_rma() -> None:
    """Each task knows its extrinsics by name and can look back; the history fits a policy's limits."""
    for robot in ("cartpole", "so101", "ant"):
        env = training_task(robot).make(recorded_description(robot), udr_distribution(robot), 2)
        env.observe_history(25)
        env.reset(seed=0)
        known = env.extrinsics()
        assert len(known.names) == known.values.shape[1] == len(known.size) and (known.size > 0).all()
        assert np.isfinite(known.values).all()
