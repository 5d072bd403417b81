"""Soft actor-critic, by stable-baselines3, on a vectorised environment of ours."""

from __future__ import annotations

import collections
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from deal_hw.errors import ConfigurationError
from deal_hw.policies.checkpoint import Checkpoint, write_checkpoint
from deal_hw.policies.network_policy import (
    NetworkPolicy,
    check_config,
    diverged,
    ended_by,
    is_finite,
    mean_return,
    one_thread,
    trained_spec,
)
from deal_hw.policies.sb3_model import model_path, read_start, restore_optimisers, write_model
from deal_hw.policies.training_log import TrainingLog
from deal_hw.policies.vector_env import ServoVectorEnv
from deal_hw.policy import Observation
from deal_hw.training import TrainingFiles, TrainingProgress, TrainingStatus
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SacConfig:
    """Settings of SAC; the defaults are what the shipped policy was trained with.

    Attributes:
        steps: Environment steps of all members together.
        hidden: Units of the hidden layers of actor and critics.
        gradient_steps: Updates per step of the whole batch of members.
        batch: Transitions in an update.
        learning_rate: Adam's first learning rate, for actor, critics and temperature.
        final_learning_rate: The last one; it falls linearly.
        gamma: Discount per tick.
        tau: Rate at which the target critics follow at each update.
        entropy: First temperature; it is tuned from there.
        target_entropy: Entropy of the policy for which the temperature is tuned [nat].
        warmup: Environment steps with random actions before the first update.
        buffer: Transitions kept.
        averaged: Last share of the steps over which the actor's weights are averaged. The last few updates
            differ from seed to seed; the mean differs less.
    """

    steps: int = 48_000
    hidden: tuple[int, ...] = (64, 64)
    gradient_steps: int = 8
    batch: int = 512
    learning_rate: float = 3e-3
    final_learning_rate: float = 3e-4
    gamma: float = 0.98
    tau: float = 0.02
    entropy: float = 0.1
    target_entropy: float = -1.5
    warmup: int = 1_000
    buffer: int = 200_000
    averaged: float = 0.25

    def __post_init__(self) -> None:
        positive = "steps gradient_steps batch learning_rate final_learning_rate entropy buffer"
        check_config(self, positive, "gamma tau averaged")
        if not 0 <= self.warmup < self.steps:
            raise ConfigurationError(
                f"{self.steps} steps: give more than the {self.warmup} steps of warmup, which are random"
            )


class SacTrainer:
    """Trains on one CPU core; the same generator state gives the same policy on the same machine."""

    name = "sac"
    config = SacConfig

    def train(
        self,
        env: ServoVectorEnv,
        config: SacConfig,
        rng: np.random.Generator,
        progress: TrainingProgress | None = None,
        files: TrainingFiles | None = None,
    ) -> NetworkPolicy:
        """Return the policy after ``config.steps`` environment steps, or when ``files.stop`` says so.

        Args:
            env: The environment; it is seeded from ``rng``.
            config: The settings.
            rng: Source of all randomness. It seeds the global generators of random, numpy and torch, which
                stable-baselines3 uses.
            progress: Called about a hundred times.
            files: Checkpoint, TensorBoard files, and the stop function. A checkpoint holds the networks, not
                the transitions: a resumed training collects new ones. The model of stable-baselines3 beside
                it holds the optimisers' state, which a resumed training loads. It can be a start, too.

        Returns:
            The mean action, without exploration.

        Raises:
            TrainingDivergedError: The networks hold numbers that are not finite.
            CheckpointError: A checkpoint cannot be read, or does not fit.
        """
        files = files or TrainingFiles()
        with one_thread(), TrainingLog(files.log) as log:
            seed = int(rng.integers(2**31))
            found = files.source(env.layout, read_start)
            done = int(found.notes["steps"]) if found is not None and files.resume else 0
            if done:
                seed = int(np.random.default_rng([seed, done]).integers(2**31))
            adapter = _Adapter(env, seed)
            model = _model(adapter, config, seed)
            if found is not None:
                if files.resume:
                    found.check_resumed(env.layout, config.steps)
                _load(model, config, found)
                model.num_timesteps = done
                adapter.before = found.notes.get("mean_return") if files.resume else None
            if files.resume and files.checkpoint is not None:
                restore_optimisers(model_path(files.checkpoint), model)
            mean = _MeanActor(config.steps * (1.0 - config.averaged))
            report = _Report(adapter, config, progress, files, log)
            with ended_by(files.stop, *_optimisers(model)) as adapter.check:
                model.learn(config.steps - done, callback=[mean, report], reset_num_timesteps=False)
            report.end()
        actor = mean.apply(model)
        network = torch.nn.Sequential(*actor.latent_pi, actor.mu, torch.nn.Tanh())
        spec = trained_spec(
            env,
            self.name,
            config,
            seed,
            stable_baselines3=stable_baselines3.__version__,
            torch=str(torch.__version__),
        )
        return NetworkPolicy(network, spec)


def _optimisers(model: Any) -> list[torch.optim.Optimizer]:
    return [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]


def _load(model: SAC, config: SacConfig, found: Checkpoint) -> None:
    found.check(trainer=SacTrainer.name, hidden=list(config.hidden))
    model.policy.load_state_dict(found.part("policy", model.policy.state_dict()))
    temperature: Any = model.log_ent_coef
    with torch.no_grad():
        temperature.copy_(found.part("entropy", {"log": temperature})["log"])


def _model(adapter: _Adapter, config: SacConfig, seed: int) -> SAC:
    model = SAC(
        "MlpPolicy",
        adapter,
        learning_rate=LinearSchedule(config.learning_rate, config.final_learning_rate, 1.0),
        buffer_size=config.buffer,
        learning_starts=config.warmup,
        batch_size=config.batch,
        tau=config.tau,
        gamma=config.gamma,
        train_freq=1,
        gradient_steps=config.gradient_steps,
        ent_coef=f"auto_{config.entropy:g}",
        target_entropy=config.target_entropy,
        policy_kwargs={"net_arch": list(config.hidden), "optimizer_kwargs": {"fused": True}},
        seed=seed,
        device="cpu",
    )
    # The default logger leaves an empty folder in the temporary directory.
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


class _Adapter(VecEnv):
    """Adapts a Gymnasium vector environment (SAME_STEP autoreset) to stable-baselines3's older interface."""

    def __init__(self, env: ServoVectorEnv, seed: int) -> None:
        # First, because VecEnv's constructor reads its render mode.
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._seed = seed
        self._return = np.zeros(env.num_envs)
        self._recent: collections.deque[float] = collections.deque(maxlen=100)
        self.before: float | None = None
        """Mean return of the training that is resumed."""
        self.check: Callable[[], None] = lambda: None
        """Called before each step."""

    @property
    def mean_return(self) -> float | None:
        """See :class:`~deal_hw.training.TrainingStatus`."""
        return mean_return(self._recent, self.before)

    def reset(self) -> Observation:
        return self.env.reset(seed=self._seed)[0]

    def step_async(self, actions: FloatArray) -> None:
        self.check()
        self._actions = actions

    def step_wait(self) -> tuple[Observation, FloatArray, np.ndarray[Any, Any], list[dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        over = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._return += reward
        for i in np.flatnonzero(over):
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
            }
            self._recent.append(float(self._return[i]))
        self._return[over] = 0.0
        return observation, reward, over, infos

    def close(self) -> None:
        """Leave the environment open: it is the caller's."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        # stable-baselines3 passes on the seed that the trainer has already given to reset().
        return [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("members of the batch have no attributes of their own")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError("members of the batch have no methods of their own")

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        return [False] * self.num_envs


def _actor(model: Any) -> Any:
    return model.policy.actor


class _MeanActor(BaseCallback):
    """Averages the actor's weights from a given step on."""

    def __init__(self, start: float) -> None:
        super().__init__()
        self._start, self._count = start, 0
        self._sum: list[torch.Tensor] = []

    def _on_step(self) -> bool:
        if self.num_timesteps > self._start:
            now = [p.detach() for p in _actor(self.model).parameters()]
            self._sum = (
                [a + b for a, b in zip(self._sum, now, strict=True)]
                if self._sum
                else [p.clone() for p in now]
            )
            self._count += 1
        return True

    def apply(self, model: SAC) -> Any:
        """Set the actor's weights to their mean, if there is one, and return it."""
        actor = _actor(model)
        with torch.no_grad():
            for parameter, total in zip(actor.parameters(), self._sum, strict=bool(self._sum)):
                parameter.copy_(total / self._count)
        return actor


class _Report(BaseCallback):
    """Reports and writes checkpoints about a hundred times in total, and at the end."""

    def __init__(
        self,
        adapter: _Adapter,
        config: SacConfig,
        progress: TrainingProgress | None,
        files: TrainingFiles,
        log: TrainingLog,
    ) -> None:
        super().__init__()
        self._adapter, self._config, self._progress, self._files = adapter, config, progress, files
        self._log = log
        self._next = self._told = 0

    def _on_training_start(self) -> None:
        self._told = self.model.num_timesteps

    def _on_step(self) -> bool:
        if self.num_timesteps >= min(self._next, self._config.steps):
            self._tell()
        return True

    def end(self) -> None:
        """Report the last steps, if the training was stopped, and write the checkpoint."""
        if self.model.num_timesteps > self._told:
            self._tell()
        else:
            self._keep()

    def _tell(self) -> None:
        done, total = self.model.num_timesteps, self._config.steps
        self._next, self._told = done + max(1, total // 100), done
        if not is_finite(self.model.policy):
            raise diverged(done, self._files.checkpoint)
        status = TrainingStatus(
            steps=min(done, total),
            total=total,
            mean_return=self._adapter.mean_return,
            measures=self._adapter.env.measures(),
        )
        self._log.write(status, _losses(self.model))
        self._keep()
        if self._progress is not None:
            self._progress(status)

    def _keep(self) -> None:
        if self._files.checkpoint is None:
            return
        model: Any = self.model
        tensors = {f"policy.{name}": value for name, value in model.policy.state_dict().items()}
        notes = {
            "trainer": SacTrainer.name,
            "steps": model.num_timesteps,
            "mean_return": self._adapter.mean_return,
            "hidden": list(self._config.hidden),
        }
        found = Checkpoint(tensors={**tensors, "entropy.log": model.log_ent_coef}, notes=notes)
        write_checkpoint(self._files.checkpoint, found, self._adapter.env.layout)
        write_model(model_path(self._files.checkpoint), model)


def _losses(model: Any) -> dict[str, float]:
    values = model.logger.name_to_value.items()
    return {name.removeprefix("train/"): float(v) for name, v in values if name.startswith("train/")}
