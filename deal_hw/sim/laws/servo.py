"""What a position servo's firmware makes of the error of its position: counts, a dead zone, a punch.

A servo has its goal g and its position r in counts of its encoder. Its motor gets no voltage while they
differ by at most a dead zone b. Beyond that the effort begins with a punch p and rises with the gain k::

    e = Q(g) - Q(r),    Q(x) = c round(x / c)
    effort = 0                              for |e| <= b
    effort = sign(e) (p + k (|e| - b))      for |e| > b

That is the graph of compliance margin, compliance slope and punch in the manual of the Dynamixel AX-12
(Robotis, control table, addresses 26 to 29 and 48). With p = k b it is the other usual form: no error within
the zone, the whole error beyond. Feetech's names are "dead zone" and "minimum startup force" (STS3215,
addresses 26, 27 and 24), without an equation.

What else is in such a servo needs no law of its own. Its gain acts on the voltage, ``V clip(Kp e, -1, 1)``.
With the torque constant kt and the resistance R, ``torque = kt V clip(Kp e, -1, 1) / R - kt² w / R``. That is
a servo of stiffness ``kt V Kp / R``, damping ``kt² / R`` and effort limit ``kt V / R``, whose motor has the
speed without load ``V / kt`` (:mod:`deal_hw.sim.laws.motor`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray

MARGIN: Final = 1e-6
"""Errors that exceed the dead zone by less have no effort [rad or m]. Otherwise rounding would decide about
an error of as many counts as the dead zone has."""


@dataclass(frozen=True, kw_only=True)
class ServoLaw:
    """The firmware of B servos of N members; each (N, B). A reading is ``scale * true + bias``.

    Attributes:
        resolution: c, the encoder's count [rad or m of the reading]; 0 for none.
        dead_zone: b, largest error without effort [rad or m of the reading].
        punch: p, effort just beyond it [N·m or N].
        scale: Encoder scales [-].
        bias: Encoder biases [rad or m].
    """

    resolution: FloatArray
    dead_zone: FloatArray
    punch: FloatArray
    scale: FloatArray
    bias: FloatArray

    def acting_error(self, goal: FloatArray, position: FloatArray, stiffness: FloatArray) -> FloatArray:
        """Return the errors that give a servo without these laws the same effort, (N, B) [rad or m].

        Args:
            goal: Goals as true positions of the joints, (N, B) [rad or m].
            position: True positions of the joints, (N, B) [rad or m].
            stiffness: Efforts an error of the true position, (N, B), above 0 [N·m/rad or N/m].
        """
        error = self._read(goal) - self._read(position)
        beyond = np.abs(error) - self.dead_zone
        acting = beyond if self._true else beyond / self.scale
        if self._begins:
            acting = acting + self.punch / stiffness
        return np.asarray(np.copysign(np.where(beyond > MARGIN, acting, 0.0), error))

    def _read(self, position: FloatArray) -> FloatArray:
        """Return how encoders read true positions, (N, B)."""
        reading = position if self._true else self.scale * position + self.bias
        if self._counts is None:
            return reading
        counted = np.rint(reading / self._counts) * self._counts
        return np.where(self._coarse, counted, reading)

    @cached_property
    def _true(self) -> bool:
        """Whether all readings are the true positions, but for counts."""
        return bool(np.all(self.scale == 1) and not np.any(self.bias))

    @cached_property
    def _begins(self) -> bool:
        """Whether any servo has a punch."""
        return bool(np.any(self.punch))

    @cached_property
    def _coarse(self) -> npt.NDArray[np.bool_]:
        """Which encoders have counts, (N, B)."""
        return self.resolution > 0

    @cached_property
    def _counts(self) -> FloatArray | None:
        """Counts, (N, B), 1 for encoders without any; None where none has any."""
        return np.where(self._coarse, self.resolution, 1.0) if self._coarse.any() else None
