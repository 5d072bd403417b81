"""Faults of an emulated robot on the wire, and when each begins."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import numpy as np

from deal_hw.testing.joint_faults import JointFaults

SHARES: Final = ("drop", "duplicate", "reorder", "corrupt")


@dataclass(frozen=True, kw_only=True)
class WirePlan:
    """Faults of every emulated robot of Unitree; times count from the first stiff command.

    Attributes:
        MOMENTS: Faults with a start time, as in ``<name>_after_s``.
    """

    MOMENTS: ClassVar[tuple[str, ...]] = ("freeze", "cut")

    drop: float = 0.0
    """Share of states that are lost."""

    duplicate: float = 0.0
    """Share of states that arrive twice."""

    reorder: float = 0.0
    """Share of states that arrive after their successor."""

    corrupt: float = 0.0
    """Share of states in which one byte is changed."""

    freeze_after_s: float | None = None
    """Time after which the robot sends nothing; it still receives [s]."""

    cut_after_s: float | None = None
    """Time after which the wire is cut in both directions; the robot keeps its last command [s]."""

    cut_s: float = 1.0
    """How long the wire is cut [s]."""

    joints: JointFaults = field(default_factory=JointFaults)
    """Faults of the joints."""

    def due(self) -> list[tuple[int, str]]:
        """Return the start of each fault, in ms since the first stiff command, and its name, in order."""
        found = ((name, getattr(self, f"{name}_after_s")) for name in self.MOMENTS)
        return sorted((round(after_s * 1e3), name) for name, after_s in found if after_s is not None)


class StateFaults:
    """Applies the four shares to messages of one topic.

    Attributes:
        counts: How often each happened.

    Args:
        plan: Has the four shares as attributes.
        rng: Source of randomness.
    """

    def __init__(self, plan: Any, rng: np.random.Generator) -> None:
        self.counts = dict.fromkeys(SHARES, 0)
        self._shares = np.array([getattr(plan, name) for name in SHARES])
        self.any = bool(self._shares.any())
        self._rng = rng
        self._held: bytes | None = None

    def apply(self, payload: bytes) -> list[bytes]:
        """Return the messages that replace this one, in order."""
        drop, duplicate, reorder, corrupt = self._rng.random(4) < self._shares
        late = [] if self._held is None else [self._held]
        self._held = None
        if drop:
            self.counts["drop"] += 1
            return late
        if corrupt:
            self.counts["corrupt"] += 1
            changed = bytearray(payload)
            changed[int(self._rng.integers(len(payload)))] ^= int(self._rng.integers(1, 256))
            payload = bytes(changed)
        if reorder and not late:
            self.counts["reorder"] += 1
            self._held = payload
            return []
        if duplicate:
            self.counts["duplicate"] += 1
            return [payload, payload, *late]
        return [payload, *late]
