"""Writes TensorBoard files during a training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

from deal_hw.training import TrainingStatus


class TrainingLog:
    """Writes scalars over environment steps to a folder; None writes nothing."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._writer: Any = None

    def __enter__(self) -> Self:
        if self._folder is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(self._folder))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.close()

    def write(self, status: TrainingStatus, losses: Mapping[str, float]) -> None:
        """Write the values after an update."""
        if self._writer is None:
            return
        rows = {} if status.mean_return is None else {"train/mean_return": status.mean_return}
        rows |= {f"task/{name}": value for name, value in status.measures.items()}
        rows |= {f"losses/{name}": value for name, value in losses.items()}
        for name, value in rows.items():
            self._writer.add_scalar(name, value, status.steps)
