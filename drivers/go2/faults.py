"""What goes wrong with an emulated Go2 on request: on the wire, in the firmware, in the motors, around it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from deal_hw.drivers.go2.description import JOINTS
from deal_hw.errors import ConfigurationError, UnknownNameError

SHARES: Final = ("drop", "duplicate", "reorder", "corrupt")
MOMENTS: Final = ("wire", "freeze", "stale", "lost", "sport", "battery", "nan", "hot", "stop", "push")
"""Faults that begin at a moment, as in ``<name>_after_s``; ``wire`` is that of the four shares."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultPlan:
    """Faults and when each begins, counted from the user's first stiff command [s]; None: never.

    Attributes:
        drop: Share of states that are lost, 0 to 1.
        duplicate: Share that comes twice.
        reorder: Share that comes after its successor.
        corrupt: Share in which one byte is changed.
        wire_after_s: When those four begin; they are there from the start by default.
        freeze_after_s: The robot says nothing any more; it still hears.
        stale_after_s: The same state is sent again and again.
        lost_after_s: A motor gives no torque and counts lost commands.
        lost_joint: Which.
        sport_after_s: Sport mode comes back and stands the robot up.
        battery_after_s: The battery is nearly empty.
        nan_after_s: A joint's position and velocity become NaN.
        nan_joint: Which.
        hot_after_s: A motor reports 95 °C.
        hot_joint: Which.
        stop_after_s: L2 and B are pressed on the remote, and held.
        push_after_s: Somebody pushes the base sideways for 0.1 s.
        push: The push's impulse, to the left [N·s].
    """

    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    wire_after_s: float | None = None
    freeze_after_s: float | None = None
    stale_after_s: float | None = None
    lost_after_s: float | None = None
    lost_joint: str = "FL_calf_joint"
    sport_after_s: float | None = None
    battery_after_s: float | None = None
    nan_after_s: float | None = None
    nan_joint: str = "FL_calf_joint"
    hot_after_s: float | None = None
    hot_joint: str = "FL_calf_joint"
    stop_after_s: float | None = None
    push_after_s: float | None = None
    push: float = 25.0

    def __post_init__(self) -> None:
        for name in SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigurationError(f"{name} is a share from 0 to 1, got {getattr(self, name)}")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name.endswith("_after_s") and value is not None and not value >= 0.0:
                raise ConfigurationError(f"{entry.name} must be 0 or more seconds, got {value}")
            if entry.name.endswith("_joint") and value not in JOINTS:
                raise UnknownNameError("Go2 joint", value, JOINTS)

    def due(self) -> list[tuple[int, str]]:
        """Return when faults begin, in ms since the first stiff command, and which; earliest first."""
        found = []
        for name in MOMENTS:
            after_s = getattr(self, f"{name}_after_s")
            if after_s is not None:
                found.append((round(after_s * 1e3), name))
        return sorted(found)


class StateFaults:
    """Applies the four shares to messages of one topic.

    Attributes:
        counts: How often each happened.

    Args:
        plan: The shares.
        rng: Source of randomness.
    """

    def __init__(self, plan: FaultPlan, rng: np.random.Generator) -> None:
        self.counts = dict.fromkeys(SHARES, 0)
        self._shares = np.array([getattr(plan, name) for name in SHARES])
        self.any = bool(self._shares.any())
        self._rng = rng
        self._held: bytes | None = None

    def apply(self, payload: bytes) -> list[bytes]:
        """Return what goes out instead of this message, in order."""
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
