"""An elastic transmission with play: motor and link are two bodies, with a spring and a gap between them.

The model of elastic joints (Spong, "Modeling and Control of Elastic Joint Robots", Journal of Dynamic
Systems, Measurement, and Control 109, 1987), with a damper beside the spring and a gap of width b. All
quantities are those of the joint, behind the gear. With the motor's angle m, the link's q, the motor's torque
t and the resistance c of the motor to its own speed::

    J m'' = t - c m' - s
    s = k (m - q - b/2) + d (m' - q')      where m - q exceeds  b/2
    s = k (m - q + b/2) + d (m' - q')      where m - q is below -b/2
    s = 0                                  within the gap

The link feels s. Both bodies are stepped together: s depends on the speeds at the end of the step, which the
engine does not know yet. The motor's equation is solved for its own speed, so that s is a constant less a
multiple D of the link's speed at the end. For the engine that is a constant torque and an inertia h D added
to the link's (h is the step). A stiff spring adds J + h c: link and rotor are one body then.

The spring's angle counts at a share of the step. At the end of it (share 1) stiff springs are stable, and
oscillations lose amplitude in each step. At its beginning (share 0) they keep it, and stiff springs blow up.
With ``a = h² k (1/J + 1/Jl)`` the share is ``max(0, 1 - 1/a)``: oscillations of less than 1 radian a step
are damped by d alone, and any spring is stable while the link's inertia Jl is at least a fourth of the one
given here.

The speeds of c and d are a mean of those at both ends of the step. The end has the share ``1/2``, so that the
error is of second order: at the end alone c acts as an inertia h c / 2 too much. With
``x = h (c/J + d (1/J + 1/Jl))`` the share is ``1 - 1/x`` where that is more, so that strong dampers do not
ring, and at least that of the spring, so that stiff ones move as the rigid model. Any share from 1/2 on is
stable. A mode loses speed by the factor ``(1 - (1 - share) x) / (1 + share x + share' a)``, where share' is
the spring's. The roots of a step lie within the unit circle for
``4 + 2 (2 share - 1) x + (2 share' - 1) a > 0``.

A servo whose encoder is at the motor pulls the rotor to its goal as a spring of its stiffness kp does. That
spring has a share of its own, ``max(0, 1 - J / (h² kp))``, so that a light rotor and a stiff servo do not
blow up either.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray

Mask: TypeAlias = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class TransmissionLaw:
    """The transmissions of B joints of N members; (N, B) each.

    Attributes:
        stiffness: k, above 0 [N·m/rad or N/m].
        damping: d, at least 0 [N·m·s/rad or N·s/m].
        play: b, width of the gap, at least 0 [rad or m].
        inertia: J, the rotor's, above 0 [kg·m² or kg].
        link_inertia: Jl, about that of the link, for the shares of the step [kg·m² or kg].
        step_s: h [s].
    """

    stiffness: FloatArray
    damping: FloatArray
    play: FloatArray
    inertia: FloatArray
    link_inertia: FloatArray
    step_s: float

    @cached_property
    def _lightness(self) -> FloatArray:
        """Acceleration of the bodies from each other a torque between them, (N, B) [1/(kg·m²)]."""
        return np.asarray(1 / self.inertia + 1 / self.link_inertia)

    @cached_property
    def spring_share(self) -> FloatArray:
        """Share of the step after which the spring's angle counts, (N, B) [-]."""
        turned = self.step_s**2 * self.stiffness * self._lightness
        return np.asarray(1 - 1 / np.maximum(turned, 1.0))

    @cached_property
    def ahead_s(self) -> FloatArray:
        """The time of that share, (N, B) [s]."""
        return self.step_s * self.spring_share

    @cached_property
    def half_play(self) -> FloatArray:
        """Half of the gap's width, (N, B) [rad or m]."""
        return self.play / 2

    @cached_property
    def gapless(self) -> bool:
        """Whether no joint has play."""
        return not np.any(self.play)

    def deflection(self, torque: FloatArray) -> FloatArray:
        """Return motor less link angles at which the transmissions at rest pass torques, (N, B)."""
        return np.asarray(torque / self.stiffness + np.sign(torque) * self.half_play)

    def damper_share(self, resistance: FloatArray) -> FloatArray:
        """Return the share of the speeds at the end of the step in those of the dampers, (N, B) [-].

        Args:
            resistance: What the motor's torque loses with its speed, c, (N, B) [N·m·s/rad or N·s/m].
        """
        lost = self.step_s * (resistance / self.inertia + self.damping * self._lightness)
        least = np.maximum(0.5, self.spring_share)
        return np.asarray(np.maximum(least, 1 - 1 / np.maximum(lost, 1.0)))

    def factors(
        self, resistance: FloatArray, *, closed: bool, stiffness: FloatArray | float = 0.0
    ) -> FloatArray:
        """Return what a step multiplies by where the gaps are closed, or where they are open, (12, N, B).

        Args:
            resistance: What the motor's torque loses with its speed, c, (N, B) [N·m·s/rad or N·s/m].
            closed: Whether the gaps are closed.
            stiffness: What it loses with its angle, kp, (N, B) [N·m/rad or N/m]; 0 for an encoder at the
                link.

        Returns:
            Factors of deflection, motor's speed, link's speed and motor's torque in the motor's speed at the
            end, if the link stands still there, and the same four in the torque on the link. Then the share
            of the link's speed at the end that adds to the motor's, and the inertia that the link has beside
            its own. Last those of the motor's speed and torque in the speed at the end of a free rotor.
        """
        end = self.damper_share(resistance)
        carried, none = self.inertia / self.step_s, np.zeros_like(resistance)
        turned = self.step_s**2 * stiffness / self.inertia
        held = stiffness * self.step_s * (1 - 1 / np.maximum(turned, 1.0))
        rotor, kept = carried + end * resistance + held, carried - (1 - end) * resistance
        spring, damper = (self.stiffness, (1 - end) * self.damping) if closed else (none, none)
        grip = spring * self.ahead_s + (end * self.damping if closed else none)
        both = rotor + grip
        follows, left = grip / both, rotor / both
        # The part of grip that the rotor's speed does not follow.
        felt = grip * left
        own = -spring / both, (kept - damper) / both, damper / both, 1 / both
        torque = spring * left, damper * left + follows * kept, -damper * left - felt, follows
        return np.stack([*own, *torque, follows, self.step_s * felt, kept / rotor, 1 / rotor])


class Couplings:
    """What links feel of their motors in each step, and how the motors follow them.

    A joint is in one of four cases: its gap is closed or open, and its motor has a torque that falls with its
    speed or one at its limit. The factors of all cases are computed once; those that act change with them.

    Args:
        law: The transmissions.
        resistance: What the motors' torques lose with their speeds, c, (N, B) [N·m·s/rad or N·s/m].
        stiffness: What they lose with the motors' own angles, (N, B) [N·m/rad or N/m]; 0 for encoders at the
            links.

    Attributes:
        inertia: What the links have beside their own, (N, B) [kg·m² or kg].
    """

    def __init__(
        self, law: TransmissionLaw, resistance: FloatArray, stiffness: FloatArray | float = 0.0
    ) -> None:
        self._law, shape = law, resistance.shape
        # By gap (closed, open), then by motor (free, held).
        motors = (resistance, stiffness), (0 * resistance, 0.0)
        self._table = np.array(
            [[law.factors(c, closed=fits, stiffness=kp) for c, kp in motors] for fits in (True, False)]
        )
        self._nowhere: Mask = np.zeros(shape, dtype=bool)
        self._held, self._open = self._nowhere, self._nowhere
        # Deflection, motor's speed, link's speed and motor's torque; then their products, and their sums.
        self._state, self._products = np.zeros((4, *shape)), np.zeros((2, 4, *shape))
        self._sums = np.zeros((2, *shape))
        self._act(self._table[0, 0])

    def couple(
        self,
        deflection: FloatArray,
        motor_speed: FloatArray,
        link_speed: FloatArray,
        torque: FloatArray,
        held: Mask | None = None,
    ) -> tuple[FloatArray, bool]:
        """Return the constant torque on the links during the next step, and whether `inertia` changed.

        The torque is overwritten in the next step.

        Args:
            deflection: Motor less link angle, (N, B) [rad or m].
            motor_speed: Speed of the motor, (N, B) [rad/s or m/s].
            link_speed: Speed of the link, (N, B) [rad/s or m/s].
            torque: Torque of the motor: at standstill, t, or the limit where it is held, (N, B) [N·m or N].
            held: Where the motor is at its limit, (N, B); None for nowhere.
        """
        held, opened = self._nowhere if held is None else held, self._nowhere
        changed = held is not self._held and bool(np.count_nonzero(held != self._held))
        if not self._law.gapless:
            # Whether the gap is closed is asked of a rotor that nothing holds yet.
            kept, free = self._free
            if changed:
                kept, free = np.where(held, self._table[0, 1, 10:], self._table[0, 0, 10:])
            half = self._law.half_play
            reached = deflection + self._law.ahead_s * (kept * motor_speed + free * torque - link_speed)
            opened = np.abs(reached) < half
            deflection = deflection - np.copysign(half, reached)
            changed = changed or bool(np.count_nonzero(opened != self._open))
        if changed:
            self._held, self._open = held, opened
            self._act(self._choose(held, opened))
        state = self._state
        state[0], state[1], state[2], state[3] = deflection, motor_speed, link_speed, torque
        np.multiply(self._factors, state, out=self._products)
        np.add.reduce(self._products, axis=1, out=self._sums)
        return self._sums[1], changed

    def motor_speed(self, link_speed: FloatArray) -> FloatArray:
        """Return the motors' speeds at the end of the step from those of the links, (N, B)."""
        return np.asarray(self._sums[0] + self._follows * link_speed)

    def _choose(self, held: Mask, opened: Mask) -> FloatArray:
        """Return the factors of joints whose motors are held and whose gaps are open there, (12, N, B)."""
        closed, apart = self._table
        if not np.count_nonzero(opened):
            return np.asarray(np.where(held, closed[1], closed[0]))
        if np.count_nonzero(held):
            closed, apart = (np.where(held, rows[1], rows[0])[None] for rows in (closed, apart))
        return np.asarray(np.where(opened, apart[0], closed[0]))

    def _act(self, factors: FloatArray) -> None:
        """Let factors act, (12, N, B)."""
        self._factors = factors[:8].reshape(self._products.shape)
        self._follows, self.inertia, self._free = factors[8], factors[9], factors[10:]
