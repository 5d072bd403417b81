"""A policy that is a torch network, and common functions of its trainers."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from deal_hw.errors import ConfigurationError, TrainingDivergedError
from deal_hw.policies.vector_env import ServoVectorEnv
from deal_hw.policy import Observation, PolicySpec
from deal_hw.types import FloatArray


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
        """Do nothing: past values are part of the observation."""

    def act(self, observation: Observation) -> FloatArray:
        """Return the action, (A,), for an observation, (O,)."""
        action: FloatArray = self.act_batch(observation[None])[0]
        return action

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, A), for observations, (B, O)."""
        with torch.no_grad():
            action = self.network(torch.as_tensor(observations, dtype=torch.float32))
        return np.asarray(action.numpy(), dtype=np.float64)


def layers(inputs: int, hidden: Sequence[int], outputs: int) -> torch.nn.Sequential:
    """Return a network of linear layers with ELU between them."""
    found: list[torch.nn.Module] = []
    for before, after in itertools.pairwise([inputs, *hidden, outputs]):
        found += [torch.nn.Linear(before, after), torch.nn.ELU()]
    return torch.nn.Sequential(*found[:-1])


class Feedback(torch.nn.Module):
    """A fixed linear feedback of the observation.

    No layer of torch, whose first weights would take draws from the generator that seeds a training.

    Attributes:
        weight: Its gain, (A, O).
    """

    weight: torch.Tensor

    def __init__(self, gain: FloatArray) -> None:
        super().__init__()
        self.register_buffer("weight", torch.as_tensor(gain, dtype=torch.float32))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return its part of the actions, (B, A), for observations, (B, O)."""
        return observation @ self.weight.T


class FeedbackNetwork(torch.nn.Module):
    """The sum of a network and of a feedback, clipped to [-1, 1]."""

    def __init__(self, network: torch.nn.Module, feedback: Feedback) -> None:
        super().__init__()
        self.network, self.feedback = network, feedback

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the actions, (B, A), for observations, (B, O)."""
        return torch.nn.functional.hardtanh(self.network(observation) + self.feedback(observation))


class AdaptedNetwork(torch.nn.Module):
    """A policy that is given the first terms of the observation, and what an adaptation module makes of all.

    Attributes:
        policy: Own terms and encoding, (B, own + Z), in; actions, (B, A), out.
        adaptation: Observations (B, O) in, encodings (B, Z) out.
        own: Number of the first terms.
    """

    def __init__(self, policy: torch.nn.Module, adaptation: torch.nn.Module, own: int) -> None:
        super().__init__()
        self.policy, self.adaptation, self.own = policy, adaptation, own

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the actions, (B, A), for observations, (B, O)."""
        given = [observation[:, : self.own], self.adaptation(observation)]
        actions: torch.Tensor = self.policy(torch.cat(given, dim=-1))
        return actions


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread inside the context.

    For networks of this size a second thread costs more than it gains. And one thread sums in a fixed order.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _StoppedError(Exception):
    """The training was asked to stop."""


@contextlib.contextmanager
def ended_by(stop: Callable[[], bool], *optimisers: torch.optim.Optimizer) -> Iterator[Callable[[], None]]:
    """End the block as soon as ``stop`` returns True.

    An update of a network is hundreds of steps of an optimiser, minutes on a busy computer, and a library
    makes them. So ``stop`` is also called before each of them. Weights between two steps are whole.

    Args:
        stop: Whether to end.
        optimisers: Those of the training.

    Yields:
        A function that ends the block if ``stop`` returns True, to call at each step of the environment.
    """

    def check(*_: object) -> None:
        if stop():
            raise _StoppedError

    hooks = [optimiser.register_step_pre_hook(check) for optimiser in optimisers]
    try:
        yield check
    except _StoppedError:
        pass
    finally:
        for hook in hooks:
            hook.remove()


def mean_return(recent: Iterable[float], before: float | None) -> float | None:
    """Return the mean of the recent episodes' returns; without any, that of the resumed training."""
    values = list(recent)
    return float(np.mean(values)) if values else before


def check_config(config: Any, positive: str, shares: str) -> None:
    """Check a trainer's settings: numbers above 0, numbers in (0, 1], each by their names, and the layers.

    Raises:
        ConfigurationError: One is not.
    """
    for name in positive.split():
        if not getattr(config, name) > 0:
            raise ConfigurationError(f"{name} must be positive, got {getattr(config, name)!r}")
    for name in shares.split():
        if not 0 < getattr(config, name) <= 1:
            raise ConfigurationError(f"{name} must lie in (0, 1], got {getattr(config, name)!r}")
    if not config.hidden or min(config.hidden) < 1:
        raise ConfigurationError(
            f"hidden must name at least one layer of at least one unit, got {config.hidden!r}"
        )


def is_finite(*networks: torch.nn.Module) -> bool:
    """Return whether all weights are finite."""
    return all(bool(torch.isfinite(p).all()) for network in networks for p in network.parameters())


def diverged(steps: int, checkpoint: Path | None) -> TrainingDivergedError:
    """Return the error of a training with weights that are not finite."""
    kept = (
        "no checkpoint was written"
        if checkpoint is None
        else f"the checkpoint {checkpoint} was written before"
    )
    return TrainingDivergedError(
        f"the training diverged after {steps} steps: a network holds a number that is not finite; {kept}. "
        "Lower the learning rate and start from there"
    )


def trained_spec(env: ServoVectorEnv, algorithm: str, config: Any, seed: int, **versions: str) -> PolicySpec:
    """Return the spec of a policy with the record of its training."""
    settings = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in dataclasses.asdict(config).items()
    }
    training = {
        **env.layout.training,
        **env.reached(),
        "algorithm": algorithm,
        "members": env.num_envs,
        "seed": seed,
        "config": settings,
        "versions": versions,
    }
    return dataclasses.replace(env.layout, training=training)
