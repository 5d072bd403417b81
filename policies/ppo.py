"""Proximal policy optimisation, by rsl-rl-lib, on a vectorised environment of ours."""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from deal_hw.policies.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from deal_hw.policies.network_policy import (
    Feedback,
    FeedbackNetwork,
    NetworkPolicy,
    check_config,
    diverged,
    ended_by,
    is_finite,
    mean_return,
    one_thread,
    trained_spec,
)
from deal_hw.policies.training_log import TrainingLog
from deal_hw.policies.vector_env import ServoVectorEnv, TaskKnowledge
from deal_hw.policy import Observation, PolicySpec
from deal_hw.training import TrainingFiles, TrainingProgress, TrainingStatus
from deal_hw.types import FloatArray

CLIP: Final = 0.2
"""Largest relative change of an action's probability in an update: the value of PPO's authors (arXiv
1707.06347)."""
TRACE: Final = 0.95
"""Lambda of the generalised advantage estimate, from the same paper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PpoConfig:
    """Settings of PPO; the defaults are what the shipped walking policy was trained with.

    Attributes:
        steps: Environment steps of all members together; rounded up to whole rollouts.
        hidden: Units of the hidden layers of actor and critic.
        rollout: Control periods of each member between updates.
        epochs: Passes of an update through a rollout.
        batches: Parts of a rollout in each pass.
        learning_rate: Adam's first learning rate; later it follows ``divergence``.
        divergence: Kullback-Leibler divergence of an update for which the learning rate is tuned [nat].
        gamma: Discount per tick.
        entropy: Weight of the entropy of the actions.
        exploration: Standard deviation of the first actions.
        reward_scale: Factor on the rewards for the critic.
        checkpoint_updates: Updates between two checkpoints; one more is written at the end.
    """

    steps: int = 12_000_000
    hidden: tuple[int, ...] = (128, 128)
    rollout: int = 24
    epochs: int = 5
    batches: int = 4
    learning_rate: float = 1e-3
    divergence: float = 0.01
    gamma: float = 0.99
    entropy: float = 0.005
    exploration: float = 0.5
    reward_scale: float = 0.02
    checkpoint_updates: int = 25

    def __post_init__(self) -> None:
        positive = "steps rollout epochs batches learning_rate divergence "
        positive += "exploration reward_scale checkpoint_updates"
        check_config(self, positive, "gamma")


class PpoTrainer:
    """Trains on one CPU core; the same generator state gives the same policy on the same machine.

    Where a GPU simulates the environment, the networks are on that GPU, too.
    """

    name = "ppo"
    config: ClassVar[Callable[..., Any]] = PpoConfig

    def train(
        self,
        env: ServoVectorEnv,
        config: PpoConfig,
        rng: np.random.Generator,
        progress: TrainingProgress | None = None,
        files: TrainingFiles | None = None,
    ) -> NetworkPolicy:
        """Return the policy after ``config.steps`` environment steps, or when ``files.stop`` says so.

        Args:
            env: The environment; it is seeded from ``rng``.
            config: The settings.
            rng: Source of all randomness. It seeds the global generator of torch.
            progress: Called after each update.
            files: Checkpoint, TensorBoard files, and the stop function.

        Returns:
            The mean action, without exploration, clipped to [-1, 1].

        Raises:
            TrainingDivergedError: The networks hold numbers that are not finite.
            CheckpointError: A checkpoint cannot be read, or does not fit.
        """
        files = files or TrainingFiles()
        with one_thread(), TrainingLog(files.log) as log:
            seed = int(rng.integers(2**31))
            torch.manual_seed(seed)
            learner = self.learner(env, config)
            found = files.source(env.layout, learner.read)
            if found is not None:
                if files.resume:
                    found.check_resumed(env.layout, config.steps)
                learner.load(found, whole=files.resume)
                # Another seed than at the start, to get other episodes.
                seed = int(np.random.default_rng([seed, learner.steps]).integers(2**31))
                torch.manual_seed(seed)
            learner.begin(seed)
            with ended_by(files.stop, *learner.optimisers) as check:
                while learner.steps < config.steps:
                    losses = learner.update(check)
                    if not learner.is_finite:
                        raise diverged(learner.steps, files.checkpoint)
                    status = TrainingStatus(
                        steps=min(learner.steps, config.steps),
                        total=config.steps,
                        mean_return=learner.mean_return,
                        measures=env.measures(),
                    )
                    log.write(status, losses)
                    if files.checkpoint is not None and learner.updates % config.checkpoint_updates == 0:
                        write_checkpoint(files.checkpoint, learner.checkpoint(), env.layout)
                    if progress is not None:
                        progress(status)
            if files.checkpoint is not None:
                write_checkpoint(files.checkpoint, learner.checkpoint(), env.layout)
        spec = trained_spec(
            env, self.name, config, seed, rsl_rl=version("rsl-rl-lib"), torch=str(torch.__version__)
        )
        spec = dataclasses.replace(spec, training={**spec.training, **learner.reached()})
        return NetworkPolicy(learner.network(), spec)

    def learner(self, env: ServoVectorEnv, config: Any) -> PpoLearner:
        """Return what learns."""
        return PpoLearner(env, config)


class PpoLearner:
    """rsl-rl's PPO with an environment of ours.

    Attributes:
        trainer: Name of the trainer, in checkpoints.
        starts_from: Trainers whose checkpoints may be the start of a training.
        actor_model: Class of the actor.
        groups: What actor and critic are given.
        steps: Environment steps so far.
        updates: Updates so far.
        optimisers: Those of the training.
    """

    trainer: ClassVar[str] = PpoTrainer.name
    starts_from: ClassVar[Sequence[str]] = (PpoTrainer.name,)
    _memories: ClassVar[Sequence[str]] = ("optimizer",)
    actor_model: ClassVar[type[MLPModel]] = MLPModel
    groups: ClassVar[Mapping[str, Sequence[str]]] = {
        "actor": ("observation",),
        "critic": ("observation", "privileged"),
    }

    def __init__(self, env: ServoVectorEnv, config: PpoConfig) -> None:
        self._env, self._config = env, config
        self._device = learning_device(env)
        O, A = len(env.layout.observation), len(env.layout.actuated)  # noqa: E741
        example = self._batch(np.zeros((env.num_envs, O), dtype=np.float32))
        groups = {name: list(parts) for name, parts in self.groups.items()}
        spread = {"class_name": "GaussianDistribution", "init_std": config.exploration, "std_type": "log"}
        hidden = list(config.hidden)
        actor = self.actor_model(example, groups, "actor", A, hidden, "elu", distribution_cfg=spread)
        self._actor = actor.to(self._device)
        self._critic = MLPModel(example, groups, "critic", 1, hidden, "elu").to(self._device)
        # Small first actions: learning starts at the default pose, not at a random one.
        with torch.no_grad():
            list(self._actor.mlp)[-1].weight.mul_(0.1)
        self._feedback = Feedback(env.feedback()).to(self._device)
        storage = RolloutStorage("rl", env.num_envs, config.rollout, example, [A], self._device)
        self._ppo = PPO(
            self._actor,
            self._critic,
            storage,
            num_learning_epochs=config.epochs,
            num_mini_batches=config.batches,
            clip_param=CLIP,
            gamma=config.gamma,
            lam=TRACE,
            entropy_coef=config.entropy,
            learning_rate=config.learning_rate,
            desired_kl=config.divergence,
            symmetry_cfg=self._symmetry(),
            device=self._device,
        )
        self.steps = self.updates = 0
        self._return = np.zeros(env.num_envs)
        self._recent: collections.deque[float] = collections.deque(maxlen=100)
        self._before: float | None = None
        self.optimisers: list[torch.optim.Optimizer] = [self._ppo.optimizer]

    def begin(self, seed: int) -> None:
        """Start the episodes."""
        self._seen = self._batch(self._env.reset(seed=seed)[0])

    def update(self, check: Callable[[], None]) -> dict[str, float]:
        """Roll out once, learn from it, and return the losses; call ``check`` before each step."""
        config, ppo = self._config, self._ppo
        with torch.no_grad():
            for _ in range(config.rollout):
                check()
                reward, over, truncated = self._step(
                    ppo.act(self._seen) + self._feedback(self._seen["observation"])
                )
                scaled = self._tensor((reward * config.reward_scale).astype(np.float32))
                ends = {"time_outs": self._tensor(truncated)}
                ppo.process_env_step(self._seen, scaled, self._tensor(over), ends)
            ppo.compute_returns(self._seen)
        losses = ppo.update()
        self._count_update()
        return {**losses, "learning_rate": ppo.learning_rate, "exploration": self._exploration()}

    def _step(self, action: torch.Tensor) -> tuple[FloatArray, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Take actions, (N, A); return rewards, which episodes are over and which of these by time, (N,)."""
        given = action.cpu().numpy().astype(np.float64)
        seen, reward, terminated, truncated, _ = self._env.step(given)
        over = terminated | truncated
        self._return += reward
        self._recent.extend(float(x) for x in self._return[over])
        self._return[over] = 0.0
        self._seen = self._batch(seen)
        return reward, over, truncated

    def _count_update(self) -> None:
        self.steps += self._config.rollout * self._env.num_envs
        self.updates += 1

    def read(self, path: Path, layout: PolicySpec) -> Checkpoint:
        """Read a checkpoint to start or go on from."""
        return read_checkpoint(path, layout)

    def reached(self) -> dict[str, Any]:
        """Return what is to be in the policy's record, plain JSON values; nothing by default."""
        return {}

    @property
    def mean_return(self) -> float | None:
        """See :class:`~deal_hw.training.TrainingStatus`."""
        return mean_return(self._recent, self._before)

    @property
    def is_finite(self) -> bool:
        """Whether all weights are finite."""
        return is_finite(*self._parts().values())

    def network(self) -> torch.nn.Module:
        """Return the actor without exploration, as layers, on the CPU from now on."""
        self._actor.cpu()
        layers, gain = self._layers(), self._env.feedback()
        if not gain.any():
            return torch.nn.Sequential(*layers, torch.nn.Hardtanh())
        return FeedbackNetwork(torch.nn.Sequential(*layers), Feedback(gain))

    def _layers(self) -> Iterable[torch.nn.Module]:
        """Return the layers of the whole observation, on the CPU."""
        layers: torch.nn.Sequential = self._actor.mlp
        return layers

    def checkpoint(self) -> Checkpoint:
        """Return the state needed to continue."""
        tensors = {
            f"{part}.{name}": value.cpu()
            for part, model in self._parts().items()
            for name, value in model.state_dict().items()
        }
        for part, optimiser in zip(self._memories, self.optimisers, strict=True):
            for i, state in optimiser.state_dict()["state"].items():
                tensors |= {f"{part}.{i}.{name}": value.cpu() for name, value in state.items()}
        notes = {
            "trainer": self.trainer,
            "steps": self.steps,
            "updates": self.updates,
            "learning_rate": self._ppo.learning_rate,
            "mean_return": self.mean_return,
            "hidden": list(self._config.hidden),
            "progress": self._env.progress(),
        }
        return Checkpoint(tensors=tensors, notes=notes)

    def load(self, found: Checkpoint, *, whole: bool) -> None:
        """Load the networks and, with ``whole``, the state of the training."""
        if whole or found.notes.get("trainer") not in self.starts_from:
            found.check(trainer=self.trainer)
        found.check(hidden=list(self._config.hidden))
        self._load_networks(found, whole)
        if found.notes["same_task"]:
            self._env.go_on(found.notes.get("progress", {}))
        if not whole:
            if not found.notes["same_task"]:
                # What is well learnt is hardly explored any more, and another task needs it again.
                spread: Any = self._actor.distribution
                with torch.no_grad():
                    spread.log_std_param.fill_(math.log(self._config.exploration))
            return
        for part, optimiser in zip(self._memories, self.optimisers, strict=True):
            state: dict[int, dict[str, torch.Tensor]] = {}
            for name, value in found.tensors.items():
                if name.startswith(f"{part}."):
                    _, index, key = name.split(".", 2)
                    state.setdefault(int(index), {})[key] = value
            groups = optimiser.state_dict()["param_groups"]
            optimiser.load_state_dict({"state": state, "param_groups": groups})
        self._ppo.learning_rate = float(found.notes["learning_rate"])
        self._ppo.optimizer.param_groups[0]["lr"] = self._ppo.learning_rate
        self.steps, self.updates = int(found.notes["steps"]), int(found.notes["updates"])
        self._before = found.notes.get("mean_return")

    def _load_networks(self, found: Checkpoint, whole: bool) -> None:
        self._load_parts(found, whole, self._parts())

    def _load_parts(self, found: Checkpoint, whole: bool, parts: Mapping[str, torch.nn.Module]) -> None:
        observed = int(found.notes["observed"])
        more = len(self._env.layout.observation) - observed
        added = None if whole else (observed, more)
        for part, model in parts.items():
            model.load_state_dict(found.part(part, model.state_dict(), added))

    def _parts(self) -> dict[str, torch.nn.Module]:
        """Return the networks by their names in a checkpoint."""
        return {"actor": self._actor, "critic": self._critic}

    def _batch(self, observation: Observation) -> TensorDict:
        tensors = {name: self._tensor(part) for name, part in self._given(observation).items()}
        return TensorDict(tensors, batch_size=[self._env.num_envs], device=self._device)

    def _given(self, observation: Observation) -> dict[str, npt.NDArray[np.float32]]:
        """Return what the networks are given, by group, (N, n) each."""
        return {"observation": observation, "privileged": self._env.privileged().astype(np.float32)}

    def _symmetry(self) -> dict[str, Any] | None:
        """Return rsl-rl's settings to learn from reflections, too; None for a robot without symmetry."""
        return _symmetry(self._env, self._device)

    def _tensor(self, values: npt.NDArray[Any]) -> torch.Tensor:
        return torch.as_tensor(values, device=self._device)

    def _exploration(self) -> float:
        spread: Any = self._actor.distribution
        return float(spread.log_std_param.detach().exp().mean())


def learning_device(env: TaskKnowledge) -> str:
    """Return torch's name of the device that learns: the GPU where one simulates the environment."""
    return "cuda" if env.engine == "warp" and torch.cuda.is_available() else "cpu"


def _symmetry(env: ServoVectorEnv, device: str) -> dict[str, Any] | None:
    """Return rsl-rl's settings to learn from reflections, too; None for a robot without symmetry."""
    mirrors = env.mirror()
    if mirrors is None:
        return None
    (seen, seen_sign), (done, done_sign) = (
        (list(mirror.source), torch.tensor(mirror.sign, dtype=torch.float32, device=device))
        for mirror in mirrors
    )

    def augment(env: Any, obs: Any, actions: torch.Tensor | None) -> tuple[Any, torch.Tensor | None]:
        """Return each batch followed by its reflection; rsl-rl gives one or both."""
        if obs is not None:
            other = obs.clone()
            other["observation"] = obs["observation"][:, seen] * seen_sign
            obs = torch.cat([obs, other])
        if actions is not None:
            actions = torch.cat([actions, actions[:, done] * done_sign])
        return obs, actions

    return {"env": env, "data_augmentation_func": augment, "use_data_augmentation": True}
