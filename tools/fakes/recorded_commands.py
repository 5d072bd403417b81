"""A policy with known answers, for methods that run a recording's policy in simulators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import Self

from deal_hw.types import FloatArray


@dataclass(eq=False)
class RecordedCommands:
    """Answers with given commands for any observation.

    Attributes:
        commands: The command of each control period, (T, A).
        history: Number of past control periods that it claims to use.
        ran_before: Whether it claims to have run before the recordings began.
    """

    commands: FloatArray
    history: int = 0
    ran_before: bool = False

    @classmethod
    def of(cls, target: FloatArray, period: int) -> Self:
        """Take a recording's commands: targets of device periods, (S, A), ``period`` in a control period."""
        return cls(target[period // 2 :: period])

    def restart(
        self, count: int, position: FloatArray, velocity: FloatArray, command: FloatArray, number: int
    ) -> None:
        """Begin with the command after ``number`` others, for N simulators."""
        self._count, self._next = count, number

    def __call__(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the next command, (N, A)."""
        self._next += 1
        return np.repeat(self.commands[self._next - 1][None], self._count, axis=0)
