"""Adversarial motion priors: a policy that moves like a reference motion while it does its task.

Peng et al. 2021, "AMP: Adversarial Motion Priors for Stylized Physics-Based Character Control" (arXiv
2104.02180), with the choices of Escontrela et al. 2022 for a quadruped (arXiv 2203.15103). A discriminator
learns to tell transitions (s, s') of the reference from the policy's, with the least-squares loss (their
Eq. 4) and a penalty on its gradient at the reference (Eq. 8). The policy gets the reward of its task and that
of its style, max(0, 1 - (D(s, s') - 1)² / 4) (Eq. 5). The terms of the task that describe a gait are left
out: the reference says how to move.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import torch

from deal_hw.errors import ConfigurationError
from deal_hw.policies.checkpoint import Checkpoint
from deal_hw.policies.network_policy import layers
from deal_hw.policies.ppo import PpoConfig, PpoLearner, PpoTrainer
from deal_hw.policies.vector_env import ServoVectorEnv
from deal_hw.types import FloatArray

DISCRIMINATOR: Final = (128, 64)
"""Units of the discriminator's hidden layers; Escontrela et al. have 1024 and 512, on a GPU."""
DISCRIMINATOR_RATE: Final = 1e-4
"""Adam's learning rate of the discriminator."""
PENALTY: Final = 10.0
"""Weight of the gradient penalty, from both papers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AmpConfig(PpoConfig):
    """Settings of AMP: those of PPO, and of the style.

    Attributes:
        style_weight: Reward of a transition that the discriminator takes for one of the reference.
        passes: Passes of the discriminator through each rollout.
    """

    style_weight: float = 3.0
    passes: int = 2

    def __post_init__(self) -> None:
        # A class with slots has no super() without arguments.
        PpoConfig.__post_init__(self)
        if not self.style_weight > 0:
            raise ConfigurationError(f"style_weight must be positive, got {self.style_weight!r}")
        if self.passes < 1:
            raise ConfigurationError(f"passes must be at least 1, got {self.passes!r}")


class AmpTrainer(PpoTrainer):
    """Trains on one CPU core a policy that is rewarded for its task and for moving like a reference.

    A start may be a checkpoint of AMP or of PPO.
    """

    name = "amp"
    config = AmpConfig

    def learner(self, env: ServoVectorEnv, config: AmpConfig) -> PpoLearner:
        """Return what learns."""
        return _AmpLearner(env, config)


class _AmpLearner(PpoLearner):
    trainer: ClassVar[str] = AmpTrainer.name
    starts_from: ClassVar[Sequence[str]] = (AmpTrainer.name, PpoTrainer.name)
    _memories: ClassVar[Sequence[str]] = ("optimizer", "discriminator_optimizer")

    def __init__(self, env: ServoVectorEnv, config: AmpConfig) -> None:
        self._reference = env.imitate()
        super().__init__(env, config)
        self._amp = config
        features = len(self._reference.names)
        self._discriminator = layers(2 * features, DISCRIMINATOR, 1).to(self._device)
        self.optimisers.append(torch.optim.Adam(self._discriminator.parameters(), lr=DISCRIMINATOR_RATE))
        self._real = self._scaled(self._reference.pairs)
        self._motion = np.empty((env.num_envs, features))
        self._pairs: list[torch.Tensor] = []
        self._styles: list[float] = []
        self._style: float | None = None

    def begin(self, seed: int) -> None:
        """Start the episodes."""
        super().begin(seed)
        self._motion = self._env.motion()

    def update(self, check: Callable[[], None]) -> dict[str, float]:
        """Roll out once, learn the policy, then the discriminator; call ``check`` before each step."""
        self._pairs, self._styles = [], []
        losses = super().update(check)
        self._style = float(np.mean(self._styles))
        return {**losses, "style": self._style, **self._discriminate(check)}

    def reached(self) -> dict[str, Any]:
        """Return the mean reward of the style in the last update, 0 to 1; None before the first."""
        return {"style": None if self._style is None else round(self._style, 4)}

    def _step(self, action: torch.Tensor) -> tuple[FloatArray, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        before = self._motion
        reward, over, truncated = super()._step(action)
        self._motion = self._env.motion()
        both = np.hstack([before, self._motion])
        # Where an episode is over, the second half is of the next one; a diverged member has no motion.
        usable = ~over & np.isfinite(both).all(axis=1)
        pairs = self._scaled(both[usable])
        style = np.zeros(len(both))
        style[usable] = style_reward(self._discriminator(pairs)[:, 0]).cpu().numpy()
        self._pairs.append(pairs)
        self._styles.append(float(style[usable].mean()) if usable.any() else 0.0)
        return reward + self._amp.style_weight * style, over, truncated

    def _discriminate(self, check: Callable[[], None]) -> dict[str, float]:
        """Teach the discriminator the reference and the policy's last transitions; return its losses."""
        config, mine = self._amp, torch.cat(self._pairs)
        losses, penalties = [], []
        for _ in range(config.passes):
            for rows in torch.randperm(len(mine), device=self._device).chunk(config.batches):
                check()
                drawn = torch.randint(len(self._real), (len(rows),), device=self._device)
                loss, penalty = discriminator_loss(self._discriminator, self._real[drawn], mine[rows])
                self.optimisers[1].zero_grad()
                torch.autograd.backward(loss + PENALTY * penalty)
                self.optimisers[1].step()
                losses.append(loss.item())
                penalties.append(penalty.item())
        return {"discriminator": float(np.mean(losses)), "gradient": float(np.mean(penalties))}

    def _load_networks(self, found: Checkpoint, whole: bool) -> None:
        known = found.notes.get("trainer") == self.trainer
        self._load_parts(found, whole, self._parts() if known else super()._parts())

    def _parts(self) -> dict[str, torch.nn.Module]:
        return {**super()._parts(), "discriminator": self._discriminator}

    def _scaled(self, pairs: FloatArray) -> torch.Tensor:
        """Return transitions, (M, 2 F), in units of the reference's spread, as they are judged."""
        centre, spread = np.tile(self._reference.centre, 2), np.tile(self._reference.spread, 2)
        return self._tensor(((pairs - centre) / spread).astype(np.float32))


def style_reward(output: torch.Tensor) -> torch.Tensor:
    """Return the reward of transitions for the discriminator's outputs on them (AMP, Eq. 5)."""
    return torch.clamp(1.0 - 0.25 * torch.square(output - 1.0), min=0.0)


def discriminator_loss(
    discriminator: torch.nn.Module, real: torch.Tensor, made: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the least-squares loss (AMP, Eq. 4) and the squared gradient at the reference (Eq. 8).

    Args:
        discriminator: It has 1 to learn for the reference and -1 for the policy.
        real: Transitions of the reference, (B, 2 F).
        made: Transitions of the policy, (B, 2 F).
    """
    real = real.clone().requires_grad_(True)
    output = discriminator(real)
    (slope,) = torch.autograd.grad(output.sum(), real, create_graph=True)
    loss = torch.square(output - 1.0).mean() + torch.square(discriminator(made) + 1.0).mean()
    return loss, torch.square(slope).sum(dim=1).mean()
