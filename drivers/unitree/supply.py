"""Tells robots of the same messages apart by the voltage of their supply."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Supply:
    """The supply of a kind of robot.

    Attributes:
        kind: The robot, in a sentence.
        lowest: No robot of this kind has less [V].
        highest: No robot of this kind has more [V].
        other: What a robot with another supply may be, and what to do.
    """

    kind: str
    lowest: float
    highest: float
    other: str

    def complaint(self, voltage: float) -> str:
        """Return why a robot with this voltage [V] is not of this kind; "" if it may be, or does not say."""
        if not (voltage < self.lowest or voltage > self.highest):
            return ""
        bound = f"at least {self.lowest:g}" if voltage < self.lowest else f"at most {self.highest:g}"
        return f"its supply has {voltage:.1f} V, and that of a {self.kind} {bound} V: {self.other}"
