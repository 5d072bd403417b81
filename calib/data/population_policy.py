"""What the policy of a recording is to a search: commands for a population of simulators."""

from __future__ import annotations

from typing import Protocol

from deal_hw.types import FloatArray


class PopulationPolicy(Protocol):
    """pi_0, the policy that produced all commands of the recordings, for N simulators at once.

    A shallow copy that was started again is independent: each thread has its own.
    """

    @property
    def history(self) -> int:
        """Length of its memory [control periods]."""
        ...

    @property
    def ran_before(self) -> bool:
        """Whether it ran before the recordings began; if not, their first command is its first."""
        ...

    def restart(
        self, count: int, position: FloatArray, velocity: FloatArray, command: FloatArray, number: int
    ) -> None:
        """Start N simulators, ``count``, from one common past.

        Past states are (h, C), oldest first, the policy's commands in them (h, A). ``number`` counts its
        commands so far; at least h.
        """
        ...

    def __call__(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the commands of the next control period, (N, A), from positions and velocities, (N, C)."""
        ...
