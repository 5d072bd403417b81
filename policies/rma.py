"""Rapid motor adaptation: a policy that is told what the simulator knows, and a network that feels it.

Kumar et al. 2021, "RMA: Rapid Motor Adaptation for Legged Robots" (arXiv 2107.04034). In the first phase an
encoder makes z = mu(e) of the extrinsics e, which only a simulator knows (gains, friction, payload, latency,
terrain), and PPO trains it together with the policy pi(o, z) (their Eq. 1 and 2). In the second phase the
adaptation module phi learns z from what the robot felt and did, with the least-squares loss
|phi(o, history) - mu(e)|², on robots that pi drives with phi's own output (their Section III-B). The robot
gets pi(o, phi(o, history)) as one network.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from deal_hw.errors import ConfigurationError
from deal_hw.policies.checkpoint import Checkpoint, read_checkpoint
from deal_hw.policies.network_policy import AdaptedNetwork, Feedback, layers
from deal_hw.policies.ppo import PpoConfig, PpoLearner, PpoTrainer
from deal_hw.policies.vector_env import ServoVectorEnv, TaskKnowledge
from deal_hw.policy import MAX_DELAY, Observation, PolicySpec

ENCODED: Final = 8
"""Length of the encoding z, as in the paper."""
ENCODER: Final = (64, 32)
"""Units of the encoder's hidden layers; the paper's has 256 and 128."""
ADAPTATION: Final = (128, 64)
"""Units of the adaptation module's hidden layers. The paper's begins with convolutions over time, which have
fewer weights; here each value of the history has weights of its own."""
LEAST_SPREAD: Final = 1e-9
"""Variance of the encoding below which all robots are the same."""
ADAPTATION_RATE: Final = 5e-4
"""Adam's learning rate of the adaptation module, from the paper's Appendix."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RmaConfig(PpoConfig):
    """Settings of RMA: those of PPO, and of the adaptation.

    Attributes:
        history: Control periods that the adaptation module looks back; the paper's is half a second.
        adaptation: Share of the steps, the last ones, in which it is trained.
    """

    history: int = 25
    adaptation: float = 0.25

    def __post_init__(self) -> None:
        # A class with slots has no super() without arguments.
        PpoConfig.__post_init__(self)
        if not 1 <= self.history < MAX_DELAY:
            raise ConfigurationError(
                f"history must be 1 to {MAX_DELAY - 1} control periods, got {self.history!r}"
            )
        if not 0 < self.adaptation < 1:
            raise ConfigurationError(f"adaptation must lie in (0, 1), got {self.adaptation!r}")


class InformedModel(MLPModel):  # type: ignore[misc]
    """An actor that is given the observation and the encoding of the extrinsics."""

    def __init__(self, example: TensorDict, *arguments: Any, **more: Any) -> None:
        super().__init__(example, *arguments, **more)
        self.encoder = layers(example["extrinsics"].shape[-1], ENCODER, ENCODED)

    def get_latent(self, obs: TensorDict, *_: Any) -> torch.Tensor:
        """Return observation and encoding, (N, O + ENCODED)."""
        return torch.cat([obs["observation"], self.encoder(obs["extrinsics"])], dim=-1)

    def _get_latent_dim(self) -> int:
        return int(self.obs_dim) + ENCODED


class RmaTrainer(PpoTrainer):
    """Trains on one CPU core, first the policy, then what it feels.

    A start may be a checkpoint of RMA or of PPO for the same task. From the latter the policy does at first
    what it did, whatever the extrinsics are.
    """

    name = "rma"
    config = RmaConfig

    def learner(self, env: ServoVectorEnv, config: RmaConfig) -> PpoLearner:
        """Return what learns."""
        task: TaskKnowledge = env
        if task.extrinsics() is None:
            raise ConfigurationError(
                "trainer rma learns to feel what the simulator draws for each robot, and this task does not "
                "say what that is; train it with ppo or sac"
            )
        env.observe_history(config.history)
        return _RmaLearner(env, config)


class _RmaLearner(PpoLearner):
    trainer: ClassVar[str] = RmaTrainer.name
    starts_from: ClassVar[Sequence[str]] = (RmaTrainer.name, PpoTrainer.name)
    actor_model: ClassVar[type[MLPModel]] = InformedModel
    groups: ClassVar[Mapping[str, Sequence[str]]] = {
        "actor": ("observation",),
        "critic": ("observation", "privileged", "extrinsics"),
    }
    _memories: ClassVar[Sequence[str]] = ("optimizer", "adaptation_optimizer")

    def __init__(self, env: ServoVectorEnv, config: RmaConfig) -> None:
        known = env.extrinsics()
        self._size = dict(zip(known.names, known.size.tolist(), strict=True))
        super().__init__(env, config)
        self._rma = config
        self._feedback = Feedback(env.feedback()[:, : env.own_terms]).to(self._device)
        O = len(env.layout.observation)  # noqa: E741
        self._adaptation = layers(O, ADAPTATION, ENCODED).to(self._device)
        self.optimisers.append(torch.optim.Adam(self._adaptation.parameters(), lr=ADAPTATION_RATE))
        self._unexplained: float | None = None

    def update(self, check: Callable[[], None]) -> dict[str, float]:
        """Learn the policy or, in the last steps, the adaptation; call ``check`` before each step."""
        if self.steps < (1.0 - self._rma.adaptation) * self._rma.steps:
            return super().update(check)
        return self._adapt(check)

    def checkpoint(self) -> Checkpoint:
        """Return the state needed to continue."""
        found = super().checkpoint()
        return Checkpoint(
            tensors=found.tensors, notes={**found.notes, "extrinsics": list(self._size.items())}
        )

    def read(self, path: Path, layout: PolicySpec) -> Checkpoint:
        """Read a checkpoint of RMA, or one of PPO, which has no history."""
        return read_checkpoint(path, layout, own=self._env.own_terms)

    def reached(self) -> dict[str, Any]:
        """Return the names of the extrinsics, and the share of the encoding's variance that is not felt.

        That share is None before the adaptation begins, and where all robots are the same.
        """
        return {"extrinsics": list(self._size), "encoding_not_felt": self._unexplained}

    def _adapt(self, check: Callable[[], None]) -> dict[str, float]:
        """Roll out with what is felt, and learn from what is known."""
        config, seen, wanted = self._rma, [], []
        with torch.no_grad():
            for _ in range(config.rollout):
                check()
                seen.append(self._tensor(self._whole))
                wanted.append(self._actor.encoder(self._seen["extrinsics"]))
                own = self._seen["observation"]
                policy = self._actor.mlp(torch.cat([own, self._adaptation(seen[-1])], dim=-1))
                self._step(policy + self._feedback(own))
        inputs, targets = torch.cat(seen), torch.cat(wanted)
        losses = []
        for _ in range(config.epochs):
            for part in torch.randperm(len(inputs), device=self._device).chunk(config.batches):
                loss = torch.nn.functional.mse_loss(self._adaptation(inputs[part]), targets[part])
                self.optimisers[1].zero_grad()
                torch.autograd.backward(loss)
                self.optimisers[1].step()
                losses.append(loss.item())
        self._count_update()
        # The first pass's errors are on what the module had not seen yet.
        first, spread = float(np.mean(losses[: config.batches])), float(targets.var(dim=0).mean())
        if spread < LEAST_SPREAD:
            return {"adaptation": first}
        self._unexplained = round(first / spread, 4)
        return {"adaptation": first, "encoding_not_felt": self._unexplained}

    def _load_networks(self, found: Checkpoint, whole: bool) -> None:
        if "extrinsics" not in found.notes:
            # PPO's networks: new inputs of the first layers come last and are not read at first.
            own = self._env.own_terms
            for part, model in (("actor", self._actor), ("critic", self._critic)):
                mine = model.state_dict()
                like = {name: value for name, value in mine.items() if not name.startswith("encoder.")}
                model.load_state_dict({**mine, **found.part(part, like, (own, 0))})
            return
        sizes = dict(found.notes["extrinsics"])
        names, first = list(self._size), self._env.own_terms + self._env.privileged().shape[1]
        tensors = dict(found.tensors)
        for name, begin in (("actor.encoder.0.weight", 0), ("critic.mlp.0.weight", first)):
            tensors[name] = _by_name(tensors[name], begin, list(sizes), names)
        self._size |= {name: size for name, size in sizes.items() if name in self._size}
        super()._load_networks(Checkpoint(tensors=tensors, notes=found.notes, path=found.path), whole)

    def _layers(self) -> list[torch.nn.Module]:
        policy = torch.nn.Sequential(*self._actor.mlp)
        return [AdaptedNetwork(policy, self._adaptation.cpu(), self._env.own_terms)]

    def _parts(self) -> dict[str, torch.nn.Module]:
        return {**super()._parts(), "adaptation": self._adaptation}

    def _given(self, observation: Observation) -> dict[str, npt.NDArray[np.float32]]:
        self._whole = observation
        known = self._env.extrinsics()
        size = np.array([self._size[name] for name in known.names])
        return {
            **super()._given(observation[:, : self._env.own_terms]),
            "extrinsics": (known.values / size).astype(np.float32),
        }

    def _symmetry(self) -> None:
        """Return nothing: the reflection of extrinsics is not known."""


def _by_name(weight: torch.Tensor, first: int, names: Sequence[str], wanted: Sequence[str]) -> torch.Tensor:
    """Return a first layer's weight, (H, I), with the wanted inputs from ``first`` on, new ones zero."""
    new = weight.new_zeros((len(weight), len(wanted)))
    for column, name in enumerate(wanted):
        if name in names:
            new[:, column] = weight[:, first + names.index(name)]
    return torch.cat([weight[:, :first], new], dim=1)
