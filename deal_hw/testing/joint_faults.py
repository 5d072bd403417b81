"""Faults of the joints of an emulated robot: drives without torque, joints that are held, wrong readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from deal_hw.errors import UnknownNameError
from deal_hw.ranges import Checked, Range
from deal_hw.types import FloatArray

HELD_DAMPING: Final = 1e3
"""Damping of a joint that is held, where the simulation has no better way [N·m·s/rad]."""


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


class FaultyJoints:
    """The same in device time.

    Attributes:
        limp: Whether the drives have no torque now.
        held: Whether the joints are held now.
        source: The joint that each reading shows, (J,).
        sign: Sign of each reading, (J,).
        frozen: Readings that stand still, (J,).

    Args:
        faults: The faults.
        joints: Names of all joints, J.
        driven: Indices of the joints with a drive.

    Raises:
        UnknownNameError: As :meth:`give`.
    """

    def __init__(self, faults: JointFaults, joints: Sequence[str], driven: Sequence[int]) -> None:
        if faults.faulty_joint and faults.faulty_joint not in joints:
            raise UnknownNameError("--faulty-joint", faults.faulty_joint, joints)
        self._joints, self._driven = tuple(joints), tuple(driven)
        self._first_ns: int | None = None
        self._last: tuple[FloatArray, FloatArray] | None = None
        self.limp = self.held = False
        self.source = np.arange(len(joints))
        self.sign, self.frozen = np.ones(len(joints)), np.zeros(len(joints), dtype=bool)
        self.give(faults)

    def give(self, faults: JointFaults, now_ns: int | None = None) -> None:
        """Take other faults, whose times count from a time [ns]; None: from :meth:`begin`.

        Raises:
            UnknownNameError: No joint has the name of the faulty one.
        """
        name, driven = faults.faulty_joint, self._driven
        if name and name not in self._joints:
            raise UnknownNameError("--faulty-joint", name, self._joints)
        self._faults, self._first_ns = faults, now_ns
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
        }
        return next((text for text, is_so in wrong.items() if is_so), "")

    def begin(self, now_ns: int) -> None:
        """Count the times from now on; only the first call counts [ns]."""
        if self._first_ns is None:
            self._first_ns = now_ns

    def advance(self, now_ns: int) -> str | None:
        """Take the time [ns]; return :attr:`now` where something began or ended, else None."""
        if self._first_ns is None:
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
        return None if self.now == before else self.now

    def read(self, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the readings show of positions and velocities, (J,) each."""
        seen = position[self.source] * self.sign, velocity[self.source] * self.sign
        if self._last is not None and self.frozen.any():
            before, before_velocity = self._last
            seen = np.where(self.frozen, before, seen[0]), np.where(self.frozen, before_velocity, seen[1])
        self._last = seen
        return seen
