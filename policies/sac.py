"""Soft actor-critic, by stable-baselines3, on a vectorised environment of ours."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from deal_hw.errors import ConfigurationError
from deal_hw.policies.vector_env import ServoVectorEnv
from deal_hw.policy import Observation, PolicySpec
from deal_hw.training import TrainingProgress
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SacConfig:
    """Settings of SAC; the defaults are what the shipped policy was trained with.

    Attributes:
        steps: Environment steps of all members together.
        hidden: Units of the hidden layers of actor and critics.
        gradient_steps: Updates for each step of the whole batch of members.
        batch: Transitions in an update.
        learning_rate: Adam's, for actor, critics and temperature, at the start.
        final_learning_rate: At the end; it falls linearly.
        gamma: Discount a tick.
        tau: Share of the critics that their targets take over at each update.
        entropy: Temperature at the start; it is tuned from there.
        target_entropy: Entropy of the policy that the temperature is tuned for [nat].
        warmup: Environment steps with random actions before the first update.
        buffer: Transitions kept.
        averaged: Share of the steps, at the end, over which the actor's weights are averaged. The last actor
            is off by its last few updates, which differ from seed to seed; their mean less so.
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
        for name in (
            "steps",
            "gradient_steps",
            "batch",
            "learning_rate",
            "final_learning_rate",
            "entropy",
            "buffer",
        ):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"{name} must be positive, got {getattr(self, name)!r}")
        for name in ("gamma", "tau", "averaged"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigurationError(f"{name} must lie in (0, 1], got {getattr(self, name)!r}")
        if not self.hidden or min(self.hidden) < 1:
            raise ConfigurationError(
                f"hidden must name at least one layer of at least one unit, got {self.hidden!r}"
            )
        if not 0 <= self.warmup < self.steps:
            raise ConfigurationError(
                f"{self.steps} steps: give more than the {self.warmup} steps of warmup, which are random"
            )


class NetworkPolicy:
    """A policy that is a torch network: observations (B, O) in, actions (B, A) in [-1, 1] out."""

    def __init__(self, network: torch.nn.Module, spec: PolicySpec) -> None:
        self.network = network.eval()
        self._spec = spec

    @property
    def spec(self) -> PolicySpec:
        """What the policy observes and what its action means."""
        return self._spec

    def reset(self) -> None:
        """Nothing to forget: the observation carries the past."""

    def act(self, observation: Observation) -> FloatArray:
        """Return the action, (A,), for an observation, (O,)."""
        action: FloatArray = self.act_batch(observation[None])[0]
        return action

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, A), for observations, (B, O)."""
        with torch.no_grad():
            action = self.network(torch.as_tensor(observations, dtype=torch.float32))
        return np.asarray(action.numpy(), dtype=np.float64)


class SacTrainer:
    """Trains on one CPU core; the same generator state gives the same policy on the same machine."""

    name = "sac"

    def train(
        self,
        env: ServoVectorEnv,
        config: SacConfig,
        rng: np.random.Generator,
        progress: TrainingProgress | None = None,
    ) -> NetworkPolicy:
        """Return the policy after ``config.steps`` environment steps.

        Args:
            env: The environment; it is seeded from ``rng``.
            config: The settings.
            rng: Where all randomness comes from. The global generators of random, numpy and torch are seeded
                from it, as stable-baselines3 draws from them.
            progress: Called about a hundred times.

        Returns:
            The mean action, without exploration.
        """
        threads = torch.get_num_threads()
        # For networks of this size a second thread costs more than it computes; and one thread sums in one
        # order.
        torch.set_num_threads(1)
        try:
            seed = int(rng.integers(2**31))
            adapter = _Adapter(env, seed)
            model = _model(adapter, config, seed)
            mean = _MeanActor(config.steps * (1.0 - config.averaged))
            model.learn(config.steps, callback=[_Report(adapter, config.steps, progress), mean])
        finally:
            torch.set_num_threads(threads)
        actor = mean.apply()
        network = torch.nn.Sequential(*actor.latent_pi, actor.mu, torch.nn.Tanh())
        return NetworkPolicy(network, _spec_of(env, config, seed))


def _model(adapter: _Adapter, config: SacConfig, seed: int) -> SAC:
    def learning_rate(remaining: float) -> float:
        return config.final_learning_rate + remaining * (config.learning_rate - config.final_learning_rate)

    return SAC(
        "MlpPolicy",
        adapter,
        learning_rate=learning_rate,
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


def _spec_of(env: ServoVectorEnv, config: SacConfig, seed: int) -> PolicySpec:
    training = {
        **env.layout.training,
        "algorithm": "sac",
        "members": env.num_envs,
        "seed": seed,
        "config": {**asdict(config), "hidden": list(config.hidden)},
        "versions": {"stable_baselines3": stable_baselines3.__version__, "torch": str(torch.__version__)},
    }
    return dataclasses.replace(env.layout, training=training)


class _Adapter(VecEnv):
    """Shows a Gymnasium vector environment (SAME_STEP autoreset) to stable-baselines3, which is older."""

    def __init__(self, env: ServoVectorEnv, seed: int) -> None:
        # First, because VecEnv's constructor asks it for its render mode.
        self._env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._seed = seed
        self._return = np.zeros(env.num_envs)
        self.recent_returns: collections.deque[float] = collections.deque(maxlen=100)

    def reset(self) -> Observation:
        return self._env.reset(seed=self._seed)[0]

    def step_async(self, actions: FloatArray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Observation, FloatArray, np.ndarray[Any, Any], list[dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self._env.step(self._actions)
        over = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._return += reward
        for i in np.flatnonzero(over):
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
            }
            self.recent_returns.append(float(self._return[i]))
        self._return[over] = 0.0
        return observation, reward, over, infos

    def close(self) -> None:
        """The environment is the caller's: it stays open."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        # stable-baselines3 passes the seed on that the trainer has already given to reset().
        return [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self._env, attr_name)] * self.num_envs

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
    """Averages the actor's weights from some step on."""

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

    def apply(self) -> Any:
        """Give the actor its mean weights and return it."""
        actor = _actor(self.model)
        with torch.no_grad():
            for parameter, total in zip(actor.parameters(), self._sum, strict=True):
                parameter.copy_(total / self._count)
        return actor


class _Report(BaseCallback):
    """Calls the progress callback about a hundred times."""

    def __init__(self, adapter: _Adapter, total: int, progress: TrainingProgress | None) -> None:
        super().__init__()
        self._adapter, self._total, self._progress = adapter, total, progress
        self._next = 0

    def _on_step(self) -> bool:
        done = self.num_timesteps
        if self._progress is not None and (done >= self._next or done >= self._total):
            self._next = done + max(1, self._total // 100)
            recent = self._adapter.recent_returns
            self._progress(min(done, self._total), self._total, float(np.mean(recent)) if recent else 0.0)
        return True
