"""The table of trainers, and each on the toy cart-pole: nominal physics, perfect sensor, no latency."""

from __future__ import annotations

import dataclasses
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import CheckpointError, ConfigurationError, TrainingDivergedError, UnknownNameError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.cartpole_env import BalanceTask, CartPoleEnv, balance_spec
from deal_hw.policies.evaluate import evaluate_batch
from deal_hw.policies.onnx_export import export_network
from deal_hw.policies.reference_motion import ReferenceMotion
from deal_hw.policies.servo_loop import EXACT_SENSOR
from deal_hw.policies.single_env import SingleEnv
from deal_hw.policies.trainers import TRAINERS, make_trainer
from deal_hw.policy import Policy
from deal_hw.robots import trained_robots, training_task
from deal_hw.testing.trainer_suite import TrainerCase, TrainerSuite
from deal_hw.training import TrainingFiles
from deal_hw.types import FloatArray

SPACE = k9_space()
TOY = ParameterDistribution.point(SPACE, SPACE.nominal, 0.0)
TASK = BalanceTask(ticks=100, host_delay_s=(0.0, 0.0))


def upright_seconds(policy: Policy) -> float:
    """Return how long a policy holds the pole of the toy upright, of 5 s, in the mean over six starts."""
    from deal_hw.policies.network_policy import NetworkPolicy

    assert isinstance(policy, NetworkPolicy)
    start = np.zeros((6, 2))
    start[:, 1] = np.linspace(-0.05, 0.05, 6)
    theta = np.repeat(SPACE.nominal[None], 6, axis=0)
    results = evaluate_batch(
        policy,
        DESCRIPTION,
        SPACE,
        theta,
        np.zeros(6),
        np.random.default_rng(0),
        seconds=5.0,
        start_position=start,
        sensor=EXACT_SENSOR,
    )
    return float(np.mean([r.upright_s for r in results]))


def export(policy: Policy, path: Path) -> Policy:
    from deal_hw.policies.network_policy import NetworkPolicy

    assert isinstance(policy, NetworkPolicy)
    return export_network(policy.network, policy.spec, path)


ON_POLICY: dict[str, Any] = {
    "hidden": (32, 32),
    "rollout": 16,
    "learning_rate": 3e-3,
    "reward_scale": 0.1,
}


def toy_case(trainer: Any, members: int, config: Any, short_config: Any) -> TrainerCase:
    """Return a trainer with the toy."""
    return TrainerCase(
        trainer=trainer,
        make_env=lambda: CartPoleEnv(DESCRIPTION, TOY, members, task=TASK, sensor=EXACT_SENSOR),
        layout=balance_spec(DESCRIPTION, TASK),
        distribution=TOY,
        config=config,
        short_config=short_config,
        score=upright_seconds,
        learned=3.5,
        export=export,
    )


def sac_case() -> TrainerCase:
    """Return SAC and the toy."""
    from deal_hw.policies.sac import SacConfig, SacTrainer

    return toy_case(
        SacTrainer(),
        16,
        SacConfig(steps=8_000, hidden=(32, 32), warmup=500),
        SacConfig(steps=800, hidden=(32, 32), warmup=500),
    )


def ppo_case() -> TrainerCase:
    """Return PPO and the toy."""
    from deal_hw.policies.ppo import PpoConfig, PpoTrainer

    return toy_case(
        PpoTrainer(), 64, PpoConfig(steps=60_000, **ON_POLICY), PpoConfig(steps=1_024, **ON_POLICY)
    )


def rma_case() -> TrainerCase:
    """Return RMA and the toy; its short training has an update of each phase."""
    from deal_hw.policies.rma import RmaConfig, RmaTrainer

    return toy_case(
        RmaTrainer(),
        64,
        RmaConfig(steps=80_000, history=5, **ON_POLICY),
        RmaConfig(steps=2_048, history=5, adaptation=0.5, **ON_POLICY),
    )


class StyledCartPole(CartPoleEnv):
    """The toy without a reward of its own: all it has to learn from is a pole that stands upright."""

    def motion(self) -> FloatArray:
        """Return cart and pole, (N, 4)."""
        return np.hstack([self.loop.position, self.loop.velocity])

    def imitate(self) -> ReferenceMotion:
        """Return a pole that hardly moves, as an expert holds it."""
        still = np.random.default_rng(0).normal(size=(400, 4)) * [0.01, 0.005, 0.02, 0.05]
        return ReferenceMotion(names=("x", "angle", "v", "turn"), rate_hz=50.0, starts=(0,), values=still)

    def reward(self, *_: FloatArray) -> FloatArray:
        """Return nothing."""
        return np.zeros(self.num_envs)


def amp_case() -> TrainerCase:
    """Return AMP and the toy without a reward."""
    from deal_hw.policies.amp import AmpConfig, AmpTrainer

    case = toy_case(
        AmpTrainer(),
        64,
        AmpConfig(steps=120_000, style_weight=1.0, **ON_POLICY),
        AmpConfig(steps=1_024, **ON_POLICY),
    )
    make = lambda: StyledCartPole(DESCRIPTION, TOY, 64, task=TASK, sensor=EXACT_SENSOR)  # noqa: E731
    return dataclasses.replace(case, make_env=make)


@pytest.mark.slow
class TestAmp(TrainerSuite):
    """AMP keeps the contract of trainers."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> TrainerCase:
        """Return AMP and the toy."""
        return amp_case()


@pytest.mark.slow
class TestSac(TrainerSuite):
    """SAC keeps the contract of trainers."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> TrainerCase:
        """Return SAC and the toy."""
        return sac_case()


@pytest.mark.slow
class TestPpo(TrainerSuite):
    """PPO keeps the contract of trainers."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> TrainerCase:
        """Return PPO and the toy."""
        return ppo_case()


@pytest.mark.slow
class TestRma(TrainerSuite):
    """RMA keeps the contract of trainers."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> TrainerCase:
        """Return RMA and the toy."""
        return rma_case()


@pytest.mark.parametrize("make", [amp_case, sac_case, ppo_case, rma_case])
def test_a_request_to_stop_is_heard_within_an_update(make: Callable[[], TrainerCase], tmp_path: Path) -> None:
    """On a slow computer an update takes minutes: no further optimiser step, whole files.

    Eight steps are in the middle of the first updates of SAC (three optimisers) and of PPO (20 an update).
    """
    from torch.optim.optimizer import register_optimizer_step_pre_hook

    case, file, steps = make(), tmp_path / "checkpoint.safetensors", 0

    def count(*_: object) -> None:
        nonlocal steps
        steps += 1

    # Called before the hooks of one optimiser.
    counting = register_optimizer_step_pre_hook(count)
    try:
        policy = case.train(case.config, files=TrainingFiles(checkpoint=file, stop=lambda: steps >= 8))
    finally:
        counting.remove()
    assert steps == 8
    assert policy.act(np.zeros(len(policy.spec.observation), dtype=np.float32)).shape
    resumed: list[int] = []
    case.train(
        case.config,
        progress=lambda status: resumed.append(status.steps),
        files=TrainingFiles(checkpoint=file, resume=True, stop=lambda: bool(resumed)),
    )
    assert resumed


def toy() -> CartPoleEnv:
    """Return the toy with four members."""
    return CartPoleEnv(DESCRIPTION, TOY, 4, task=TASK, sensor=EXACT_SENSOR)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train shortly with SAC; return the checkpoint."""
    file = tmp_path_factory.mktemp("kept") / "policy.safetensors"
    make_trainer("sac").train(
        toy(), sac_case().short_config, np.random.default_rng(0), files=TrainingFiles(checkpoint=file)
    )
    return file


@pytest.mark.slow
def test_stable_baselines3_goes_on_with_the_model_that_is_kept(kept: Path, tmp_path: Path) -> None:
    """The zip opens in SAC.load on a registered task's spaces, trains there, and is a start of ours again."""
    import torch
    from stable_baselines3 import SAC
    from stable_baselines3.common.env_util import make_vec_env

    from deal_hw.policies.sb3_model import model_path, read_start

    path = model_path(kept)
    vector = make_vec_env(lambda: SingleEnv(CartPoleEnv(DESCRIPTION, TOY, 1, task=TASK)), n_envs=2)
    model = SAC.load(path, env=vector, device="cpu")
    assert model.num_timesteps == sac_case().short_config.steps
    before = [value.clone() for value in model.policy.actor.parameters()]
    model.learn(40, reset_num_timesteps=False)
    model.learning_starts = 0
    model.learn(40, reset_num_timesteps=False)
    after = list(model.policy.actor.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    model.save(tmp_path / "theirs.zip")
    start = read_start(tmp_path / "theirs.zip", toy().layout)
    for name, value in model.policy.state_dict().items():
        assert torch.equal(start.tensors[f"policy.{name}"], value)
    files = TrainingFiles(start=tmp_path / "theirs.zip", stop=lambda: True)
    policy = make_trainer("sac").train(toy(), sac_case().short_config, np.random.default_rng(1), files=files)
    assert policy.spec.training["algorithm"] == "sac"


@pytest.mark.slow
def test_a_resumed_training_takes_up_the_optimisers_memory(kept: Path, tmp_path: Path) -> None:
    """Where checkpoint and model are of one moment; a model of another moment is left alone."""
    import torch
    from stable_baselines3 import SAC

    from deal_hw.policies.sb3_model import model_path, restore_optimisers

    model = SAC.load(model_path(kept), device="cpu")
    fresh = SAC.load(model_path(kept), device="cpu")
    for optimiser in (fresh.actor.optimizer, fresh.critic.optimizer, fresh.ent_coef_optimizer):
        assert optimiser is not None
        optimiser.state.clear()
    assert restore_optimisers(model_path(kept), fresh)
    mine, theirs = fresh.actor.optimizer.state_dict(), model.actor.optimizer.state_dict()
    assert mine["state"] and float(mine["state"][0]["step"]) == float(theirs["state"][0]["step"]) > 0
    with torch.no_grad():
        next(fresh.policy.parameters()).add_(1.0)
    assert not restore_optimisers(model_path(kept), fresh)
    assert not restore_optimisers(tmp_path / "none.zip", fresh)


@pytest.mark.slow
def test_only_the_same_unfinished_training_is_resumed(kept: Path) -> None:
    """A complete one would lose its averaged weights; of another distribution it would claim all steps."""
    rng, files = np.random.default_rng(0), TrainingFiles(checkpoint=kept, resume=True)
    with pytest.raises(CheckpointError, match="has done 800 of 800 steps: nothing is left to resume"):
        make_trainer("sac").train(toy(), sac_case().short_config, rng, files=files)
    other = dataclasses.replace(TOY, latency_s=(0.0, 0.001))
    env = CartPoleEnv(DESCRIPTION, other, 4, task=TASK, sensor=EXACT_SENSOR)
    with pytest.raises(CheckpointError, match=r"trained under another distribution .* with --start"):
        make_trainer("sac").train(
            env, dataclasses.replace(sac_case().short_config, steps=900), rng, files=files
        )


def test_models_that_are_none_are_refused(tmp_path: Path) -> None:
    """A file that is no archive, and one that has pickles alone: nothing of it is executed."""
    from deal_hw.policies.sb3_model import read_start

    marker = tmp_path / "executed"

    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (marker,)

    (tmp_path / "x.zip").write_text("no archive")
    with zipfile.ZipFile(tmp_path / "y.zip", "w") as archive:
        archive.writestr("policy.pth", pickle.dumps(Evil(), protocol=2))
        archive.writestr("data", pickle.dumps(Evil(), protocol=2))
    for name in ("x.zip", "y.zip", "none.zip"):
        with pytest.raises(CheckpointError, match="SAC model"):
            read_start(tmp_path / name, toy().layout)
    assert not marker.exists()


def test_a_training_that_diverges_is_stopped_and_keeps_its_checkpoint(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """From the third update on the critic is NaN: the error names steps and checkpoint, which is sound."""
    import torch
    from rsl_rl.algorithms import PPO

    from deal_hw.policies.ppo import PpoConfig, PpoTrainer

    file = tmp_path / "checkpoint.safetensors"
    config = PpoConfig(steps=10_000, hidden=(8,), checkpoint_updates=1)
    make = toy_case(PpoTrainer(), 16, config, config).make_env
    real, calls = PPO.update, []

    def update(self: PPO) -> dict[str, float]:
        losses: dict[str, float] = real(self)
        calls.append(1)
        if len(calls) == 3:
            with torch.no_grad():
                next(self.critic.parameters()).fill_(float("nan"))
        return losses

    monkeypatch.setattr(PPO, "update", update)
    with pytest.raises(
        TrainingDivergedError, match=r"diverged after 1152 steps.*checkpoint\.safetensors was written before"
    ):
        PpoTrainer().train(make(), config, np.random.default_rng(0), files=TrainingFiles(checkpoint=file))
    steps: list[int] = []
    PpoTrainer().train(
        make(),
        PpoConfig(steps=1_152, hidden=(8,)),
        np.random.default_rng(0),
        lambda status: steps.append(status.steps),
        TrainingFiles(checkpoint=file, resume=True),
    )
    assert steps == [1_152]


@pytest.mark.parametrize("name", list(TRAINERS))
def test_every_trainer_loads_under_its_name(name: str) -> None:
    """A trainer says the name that the table has it under."""
    assert make_trainer(name).name == name


def test_unknown_trainer_lists_the_trainers() -> None:
    """A wrong name is answered with the right ones."""
    with pytest.raises(UnknownNameError, match=r"td3.*amp, ppo, rma, sac"):
        make_trainer("td3")


@pytest.mark.parametrize("name", list(TRAINERS))
@pytest.mark.parametrize("robot", trained_robots())
def test_every_task_has_settings_for_every_trainer(robot: str, name: str) -> None:
    """A trainer beside the usual one can be chosen for each robot, and the steps with it."""
    trainer, config = training_task(robot).trainer_and_config(name, 123_456)
    assert (trainer.name, config.steps) == (name, 123_456)
    assert training_task(robot).usual_members(name) > 0


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("ppo", {"steps": 0}, "steps must be positive, got 0"),
        ("ppo", {"gamma": 0.0}, r"gamma must lie in \(0, 1\], got 0.0"),
        ("ppo", {"hidden": ()}, "hidden must name at least one layer"),
        ("sac", {"steps": 0}, "steps must be positive, got 0"),
        ("sac", {"gamma": 1.5}, r"gamma must lie in \(0, 1\], got 1.5"),
        ("sac", {"hidden": ()}, "hidden must name at least one layer"),
        ("sac", {"steps": 100, "warmup": 100}, r"100 steps: give more than the 100 steps of warmup"),
    ],
)
def test_settings_that_mean_nothing_are_refused(name: str, settings: dict[str, Any], message: str) -> None:
    """The message names the setting, what was given and what is allowed."""
    _, known = training_task("cartpole").trainer_and_config(name, 200_000)
    with pytest.raises(ConfigurationError, match=message):
        type(known)(**settings)
