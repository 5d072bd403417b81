"""Faults of the joints of an emulated robot: drives without torque, joints that are held, wrong readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Final

import numpy as np

from deal_hw.errors import UnknownNameError
from deal_hw.ranges import Checked, Range
from deal_hw.types import FloatArray

HELD_DAMPING: Final = 1e3
"""Damping of a joint that is held, where the simulation has no better way [N·m·s/rad]."""
WHOLE_TURN: Final = 2 * np.pi
"""An out-of-range reading, where the robot's sensors can show it [rad or m]: no joint turns so far."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointFaults(Checked):
    """Faults of the joints of an emulated robot, whose times count from the first command of the motors."""

    faulty_joint: str = ""
    """The joint whose reading is wrong; by default the first one with a drive."""

    limp_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The drives of all joints lose their torque after this time, and nothing on the wire says so [s]."""

    limp_s: Annotated[float, Range(0, 1e7, "s")] = 2.0
    """How long the drives have no torque [s]."""

    held_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """All joints are held where they are after this time, as by hands or in a crash [s]."""

    held_s: Annotated[float, Range(0, 1e7, "s")] = 2.0
    """How long the joints are held [s]."""

    frozen_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The reading of a joint stands still after this time [s]."""

    exchanged_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The readings of a joint and the next one are exchanged after this time [s]."""

    turned_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The reading of a joint has the other sign after this time [s]."""

    out_of_range_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The reading of a joint lies outside of its range after this time [s]."""


_BEGINS: Final = tuple(one.name for one in fields(JointFaults) if one.name.endswith("_after_s"))


class FaultyJoints:
    """The same in device time; they may also be given while the robot runs.

    Attributes:
        limp: Whether the drives have no torque now.
        held: Whether the joints are held now.
        source: The joint that each reading shows, (J,).
        sign: Sign of each reading, (J,).
        frozen: Readings that stand still, (J,).
        outside: Readings outside of their range, (J,).
        beyond: What these show, (J,) [rad or m].

    Args:
        faults: The faults.
        joints: Names of all joints, J.
        driven: Indices of the joints with a drive.
        beyond: As the attribute; by default :data:`WHOLE_TURN`.

    Raises:
        UnknownNameError: As :meth:`give`.
    """

    def __init__(
        self,
        faults: JointFaults,
        joints: Sequence[str],
        driven: Sequence[int],
        beyond: FloatArray | None = None,
    ) -> None:
        self._joints, self._driven = tuple(joints), tuple(driven)
        self._last: tuple[FloatArray, FloatArray] | None = None
        self.beyond = np.full(len(joints), WHOLE_TURN) if beyond is None else beyond
        self.give(faults)

    def give(self, faults: JointFaults, now_ns: int | None = None) -> None:
        """Take other faults in place of the present ones.

        Args:
            faults: The faults.
            now_ns: Their times count from this time [ns]; None: from :meth:`begin`.

        Raises:
            UnknownNameError: No joint has the name of the faulty one.
        """
        name, driven = faults.faulty_joint, self._driven
        if name and name not in self._joints:
            raise UnknownNameError("--faulty-joint", name, self._joints)
        self._faults, self._first_ns = faults, now_ns
        self._none = all(getattr(faults, name) is None for name in _BEGINS)
        count = len(self._joints)
        self.limp = self.held = False
        self.source, self.sign = np.arange(count), np.ones(count)
        self.frozen, self.outside = np.zeros((2, count), dtype=bool)
        self._joint = self._joints.index(name) if name else driven[0]
        others = [j for j in driven if j != self._joint] or [self._joint]
        self._other = next((j for j in others if j > self._joint), others[0])

    @property
    def now(self) -> str:
        """What is wrong at present, in a few words; "" for nothing."""
        wrong = {
            "limp": self.limp,
            "held": self.held,
            "frozen reading": self.frozen.any(),
            "exchanged readings": (self.source != np.arange(len(self.source))).any(),
            "turned reading": (self.sign < 0).any(),
            "reading out of range": self.outside.any(),
        }
        return next((text for text, is_so in wrong.items() if is_so), "")

    def begin(self, now_ns: int) -> None:
        """Count the times from now on; only the first call counts [ns]."""
        if self._first_ns is None:
            self._first_ns = now_ns

    def advance(self, now_ns: int) -> str | None:
        """Take the time [ns]; return :attr:`now` where something began or ended, else None."""
        if self._none or self._first_ns is None:
            return None
        passed_s, f, before = (now_ns - self._first_ns) * 1e-9, self._faults, self.now

        def during(after_s: float | None, length_s: float = np.inf) -> bool:
            return after_s is not None and after_s <= passed_s < after_s + length_s

        self.limp, self.held = during(f.limp_after_s, f.limp_s), during(f.held_after_s, f.held_s)
        j, other = self._joint, self._other
        if during(f.frozen_after_s):
            self.frozen[j] = True
        if during(f.exchanged_after_s):
            self.source[[j, other]] = other, j
        if during(f.turned_after_s):
            self.sign[j] = -1.0
        if during(f.out_of_range_after_s):
            self.outside[j] = True
        return None if self.now == before else self.now

    def read(self, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the readings show of positions and velocities, (J,) each."""
        seen = position[self.source] * self.sign, velocity[self.source] * self.sign
        seen = np.where(self.outside, self.beyond, seen[0]), seen[1]
        if self._last is not None and self.frozen.any():
            before, before_velocity = self._last
            seen = np.where(self.frozen, before, seen[0]), np.where(self.frozen, before_velocity, seen[1])
        self._last = seen
        return seen
