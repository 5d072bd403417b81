"""Contract of training: an environment and a configuration in, a policy out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from deal_hw.policy import Policy, PolicySpec

EnvT = TypeVar("EnvT", contravariant=True)
ConfigT = TypeVar("ConfigT", contravariant=True)
FoundT = TypeVar("FoundT")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingStatus:
    """How far a training is.

    Attributes:
        steps: Environment steps done.
        total: Environment steps to do.
        mean_return: Mean return of the last hundred episodes. Before the first ends, a resumed training has
            that of its checkpoint; else None.
        measures: Latest measures of the task, by name with unit, such as ``velocity_error_m_s``.
    """

    steps: int
    total: int
    mean_return: float | None
    measures: Mapping[str, float] = field(default_factory=dict)


TrainingProgress = Callable[[TrainingStatus], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingFiles:
    """Files and start of a training, and the request to stop it.

    Attributes:
        checkpoint: The file (.safetensors) from which a stopped training continues; None: none is written.
        start: A checkpoint whose networks are the start of a new training (a fine-tune); None: from scratch.
        resume: Continue from ``checkpoint``.
        log: Folder for TensorBoard's files; None: none are written.
        stop: Called at each step of the environment and of an optimiser; if it returns True, the training
            ends at once, with the current policy.
    """

    checkpoint: Path | None = None
    start: Path | None = None
    resume: bool = False
    log: Path | None = None
    stop: Callable[[], bool] = lambda: False

    def source(self, layout: PolicySpec, read: Callable[[Path, PolicySpec], FoundT]) -> FoundT | None:
        """Return the start of a training, read by ``read(path, layout)``; None: from scratch."""
        path = self.checkpoint if self.resume else self.start
        return None if path is None else read(path, layout)


class PolicyTrainer(Protocol, Generic[EnvT, ConfigT]):
    """Trains a policy in an environment."""

    name: str
    config: Callable[..., Any]
    """The class of its settings."""

    def train(
        self,
        env: EnvT,
        config: ConfigT,
        rng: np.random.Generator,
        progress: TrainingProgress | None = None,
        files: TrainingFiles | None = None,
    ) -> Policy:
        """Return the trained policy; the same generator state gives the same policy on the same machine.

        Raises:
            TrainingDivergedError: The networks contain numbers that are not finite; the checkpoint is the
                last good one.
            CheckpointError: A checkpoint cannot be read, or is of another training.
        """
        ...
