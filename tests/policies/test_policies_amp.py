"""Adversarial motion priors: the reference motion, the style's reward, and what a task leaves to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import CheckpointError, ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.canter_env import REFERENCE, CanterEnv, CanterTask
from deal_hw.policies.cartpole_env import CartPoleEnv
from deal_hw.policies.reference_motion import LEAST_SPREAD, ReferenceMotion
from deal_hw.robots import recorded_description, training_task
from deal_hw.training import TrainingFiles
from deal_hw.workflows.train import nominal_distribution

GO2 = recorded_description("go2")
SPACE = k9_space()


def canter(count: int = 3, **task: Any) -> CanterEnv:
    quiet = {"push_ticks": 10**9, "start_speed": 0.0, "start_noise_rad": 0.0}
    drawn = nominal_distribution("go2", "canter")
    return CanterEnv(GO2, drawn, count, task=CanterTask(**{**quiet, **task}))


@given(lengths=st.lists(st.integers(2, 6), min_size=1, max_size=4), width=st.integers(1, 3))
def test_a_pair_is_a_row_and_the_next_one_of_its_piece(lengths: list[int], width: int) -> None:
    """Rows are numbered; no pair reaches over the end of a piece, and none is missing."""
    rows = sum(lengths)
    values = np.arange(rows, dtype=float)[:, None] + 1000.0 * np.arange(width)
    starts = tuple(int(k) for k in np.cumsum([0, *lengths[:-1]]))
    found = ReferenceMotion(
        names=tuple(f"x{k}" for k in range(width)), rate_hz=50.0, starts=starts, values=values
    )
    first = [
        k for start, length in zip(starts, lengths, strict=True) for k in range(start, start + length - 1)
    ]
    np.testing.assert_array_equal(found.pairs[:, 0], first)
    np.testing.assert_array_equal(found.pairs[:, width:], found.pairs[:, :width] + 1.0)


def motion(**changed: Any) -> ReferenceMotion:
    values = {"names": ("a", "b"), "rate_hz": 50.0, "starts": (0, 2), "values": np.arange(8.0).reshape(4, 2)}
    return ReferenceMotion(**{**values, **changed})


def test_a_motion_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Small whole numbers are kept exactly; a feature that does not move has the least spread."""
    still = motion(values=np.array([[0.0, 3.0], [1.0, 3.0], [2.0, 3.0], [3.0, 3.0]]))
    still.write(tmp_path / "m.npz")
    found = ReferenceMotion.read(tmp_path / "m.npz")
    assert (found.names, found.rate_hz, found.starts) == (still.names, still.rate_hz, still.starts)
    np.testing.assert_array_equal(found.values, still.values)
    np.testing.assert_allclose(found.centre, [1.5, 3.0])
    np.testing.assert_allclose(found.spread, [np.sqrt(1.25), LEAST_SPREAD])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"values": np.zeros((4, 3))}, r"needs values of shape \(T, 2\), got \(4, 3\)"),
        ({"values": np.full((4, 2), np.nan)}, "not finite"),
        ({"starts": (0, 3)}, "at least two rows"),
        ({"starts": (1, 3)}, "the first begins at row 0"),
        ({"starts": ()}, "the first begins at row 0"),
    ],
)
def test_a_motion_that_cannot_be_one_is_refused(changed: dict[str, Any], said: str) -> None:
    """Each with what was given."""
    with pytest.raises(ConfigurationError, match=said):
        motion(**changed)


def test_another_file_and_another_robot_are_refused(tmp_path: Path) -> None:
    """A text, an archive without the members, and the motion of another robot."""
    (tmp_path / "text.npz").write_text("no archive", encoding="utf-8")
    np.savez(tmp_path / "other.npz", values=np.zeros(3))
    for name in ("text.npz", "other.npz", "none.npz"):
        with pytest.raises(ConfigurationError, match=rf"{name} is no reference motion"):
            ReferenceMotion.read(tmp_path / name)
    motion().check(("a", "b"), 50.0)
    with pytest.raises(ConfigurationError, match=r"of another robot: 2 features at 50 Hz.*not in both: b, c"):
        motion().check(("a", "c"), 50.0)
    with pytest.raises(ConfigurationError, match="at 100 Hz"):
        motion().check(("a", "b"), 100.0)


def test_the_reward_of_a_style_is_a_parabola_about_one() -> None:
    """AMP, Eq. 5, by hand."""
    import torch

    from deal_hw.policies.amp import style_reward

    found = style_reward(torch.tensor([1.0, 0.0, -1.0, 3.0, 2.0, -5.0]))
    np.testing.assert_allclose(found.numpy(), [1.0, 0.75, 0.0, 0.0, 0.75, 0.0])


def test_the_loss_of_a_linear_discriminator_by_hand() -> None:
    """D(x) = 2 x1 - x2: its squared gradient is 5 everywhere."""
    import torch

    from deal_hw.policies.amp import discriminator_loss

    linear = torch.nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        linear.weight.copy_(torch.tensor([[2.0, -1.0]]))
    real, made = torch.tensor([[1.0, 1.0], [0.0, 0.0]]), torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    # Outputs 1 and 0 on the reference, -1 and 2 on the policy: errors 0, -1, 0 and 3.
    loss, penalty = discriminator_loss(linear, real, made)
    assert float(loss.detach()) == pytest.approx(0.5 + 4.5)
    assert float(penalty.detach()) == pytest.approx(5.0)


def test_the_features_of_a_robot_that_stands() -> None:
    """Gravity is down, nothing moves, joints are in their default pose."""
    env = canter(2, standing=1.0)
    env.reset(seed=0)
    values = dict(zip(env.motion_names(), env.motion().T, strict=True))
    np.testing.assert_allclose(values["gravity_z"], -1.0, atol=0.01)
    np.testing.assert_allclose(values["velocity_x"], 0.0, atol=0.02)
    assert (np.abs(values["height"] - 0.27) < 0.05).all()
    np.testing.assert_allclose(values["FL_calf_joint"], env.loop.position[:, 8])
    np.testing.assert_allclose(values["RR_calf_joint_velocity"], env.loop.velocity[:, -1])


def test_the_reference_leaves_commands_and_safety() -> None:
    """Of a tick at rest stays the reward of the commanded velocity, by hand; the gait's terms are gone."""
    env = canter(standing=0.0)
    found = env.imitate()
    assert found.names == env.motion_names() and len(found.starts) == 30
    assert env.task.fall_cost == CanterTask().fall_cost
    env.reset(seed=0)
    still, action = np.zeros_like(env.loop.velocity), np.full((3, 12), 0.3)
    command, task = env.command, env.task
    wanted = 2.0 * np.exp(-np.square(command[:, :2]).sum(axis=1) / task.tracking_width)
    wanted += task.turn_weight * np.exp(-np.square(command[:, 2]) / task.turn_width) + task.alive_reward
    np.testing.assert_allclose(env.reward(env.loop.position, still, action, action), wanted, atol=1e-9)
    changed = env.reward(env.loop.position, still, action, action - 0.1)
    np.testing.assert_allclose(changed, wanted - task.action_weight * 12 * 0.01, atol=1e-9)


def test_the_shipped_reference_canters_ahead_at_the_commanded_speeds() -> None:
    """Its pieces go at 0.5 to 1.5 m/s, or stand; a leg makes 2.5 strides a second."""
    found = ReferenceMotion.read(REFERENCE)
    names, pieces = list(found.names), np.split(found.values, found.starts[1:])
    speeds = np.array([piece[:, names.index("velocity_x")].mean() for piece in pieces])
    moving = speeds > 0.3
    assert moving.sum() >= 20 and speeds[moving].min() > 0.4 and 1.2 < speeds.max() < 1.7
    assert np.abs(speeds[~moving]).max(initial=0.0) < 0.1
    for piece in np.array(pieces, dtype=object)[moving]:
        thigh = piece[:, names.index("RL_thigh_joint")].astype(float)
        spectrum = np.abs(np.fft.rfft(thigh - thigh.mean()))
        assert np.fft.rfftfreq(len(thigh), 0.02)[spectrum.argmax()] == pytest.approx(2.5, abs=0.3)


def test_a_task_without_a_reference_is_refused() -> None:
    """The walk and the cart-pole have none; the message says which trainers serve."""
    from deal_hw.policies.amp import AmpConfig, AmpTrainer

    drawn = ParameterDistribution.point(SPACE, SPACE.nominal, 0.0)
    walk = training_task("go2").make(GO2, nominal_distribution("go2"), 1)
    for env in (walk, CartPoleEnv(DESCRIPTION, drawn, 2)):
        with pytest.raises(ConfigurationError, match=r"this task has none.*train it with ppo or sac"):
            AmpTrainer().train(env, AmpConfig(steps=100), np.random.default_rng(0))
    with pytest.raises(ConfigurationError, match="style_weight must be positive, got 0"):
        AmpConfig(style_weight=0.0)
    with pytest.raises(ConfigurationError, match="passes must be at least 1, got 0"):
        AmpConfig(passes=0)


def test_motions_are_computed_once_a_tick_and_are_those_before_the_next_one() -> None:
    """Also of a robot that is restarted after two ticks: at the next step it does what was noted."""
    from deal_hw.policies.amp import AmpConfig, AmpTrainer

    class Watched(CanterEnv):
        def motion(self) -> Any:
            noted.append(super().motion())
            return noted[-1]

        def step(self, actions: Any) -> Any:
            np.testing.assert_array_equal(noted[-1], super().motion())
            return super().step(actions)

    noted: list[Any] = []
    env = Watched(GO2, nominal_distribution("go2", "canter"), 3, task=CanterTask(ticks=2))
    config = AmpConfig(steps=24, rollout=4, hidden=(16,))
    AmpTrainer().train(env, config, np.random.default_rng(0))
    assert len(noted) == 1 + config.steps // env.num_envs


@pytest.mark.slow
def test_a_training_begins_from_the_networks_of_ppo(tmp_path: Path) -> None:
    """At first it does what the start does; its checkpoint is no start of PPO."""
    from deal_hw.policies.amp import AmpConfig, AmpTrainer
    from deal_hw.policies.ppo import PpoConfig, PpoTrainer

    file, rng = tmp_path / "start.safetensors", np.random.default_rng
    small: dict[str, Any] = {"hidden": (16,), "rollout": 4}
    PpoTrainer().train(canter(), PpoConfig(steps=12, **small), rng(0), None, TrainingFiles(checkpoint=file))
    learners = []

    class Kept(AmpTrainer):
        def learner(self, env: Any, config: AmpConfig) -> Any:
            learners.append(super().learner(env, config))
            return learners[0]

    before = {name: value.clone() for name, value in _tensors(file).items() if name.startswith("actor.mlp")}
    config = AmpConfig(steps=12, learning_rate=1e-12, **small)
    own = tmp_path / "amp.safetensors"
    policy = Kept().train(canter(), config, rng(1), None, TrainingFiles(checkpoint=own, start=file))
    after = learners[0]._actor.state_dict()
    for name, value in before.items():
        np.testing.assert_allclose(after[name.removeprefix("actor.")].numpy(), value.numpy(), atol=1e-4)
    assert policy.spec.training["algorithm"] == "amp" and 0.0 <= policy.spec.training["style"] <= 1.0
    assert any(name.startswith("discriminator.") for name in _tensors(own))
    with pytest.raises(CheckpointError):
        PpoTrainer().train(canter(), PpoConfig(steps=12, **small), rng(0), None, TrainingFiles(start=own))


def _tensors(path: Path) -> Any:
    from safetensors.torch import load_file

    return load_file(path)
