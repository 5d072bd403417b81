"""Faults of an emulated robot's states on the wire."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

SHARES: Final = ("drop", "duplicate", "reorder", "corrupt")


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
