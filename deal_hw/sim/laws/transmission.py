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

Dry friction f of the motor adds ``-f sign(m')`` to its torque, or as much as holds it at rest. Whether it
slides follows from its speed at the end of the step without friction, if the link keeps its own speed: it
holds where f would turn that round. A motor that is held is the fixed end of the link's spring. Most friction
of a geared motor is before its play, where it does not hold the link.
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

    def dampers(self, end: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what closed gaps pass for the bodies' speeds from each other at both ends of a step, (N, B).

        Args:
            end: The share of the speeds at the end, (N, B) [-].
        """
        return (1 - end) * self.damping, self.stiffness * self.ahead_s + end * self.damping

    def factors(self, resistance: FloatArray, stiffness: FloatArray | float = 0.0) -> FloatArray:
        """Return what a step multiplies by, (12, N, B).

        Args:
            resistance: What the motor's torque loses with its speed, c, (N, B) [N·m·s/rad or N·s/m].
            stiffness: What it loses with its angle, kp, (N, B) [N·m/rad or N/m]; 0 for an encoder at the
                link.

        Returns:
            Where the gap is closed, factors of deflection, motor's speed, link's speed and motor's torque in
            the motor's speed at the end, if the link stands still there, and the same four in the torque on
            the link. Then the share of the link's speed at the end that adds to the motor's, and the inertia
            that the link has beside its own. Last those of the motor's speed and torque in the speed at the
            end of a free rotor, as it is within the gap.
        """
        end = self.damper_share(resistance)
        carried = self.inertia / self.step_s
        turned = self.step_s**2 * stiffness / self.inertia
        held = stiffness * self.step_s * (1 - 1 / np.maximum(turned, 1.0))
        rotor, kept = carried + end * resistance + held, carried - (1 - end) * resistance
        spring, (damper, grip) = self.stiffness, self.dampers(end)
        both = rotor + grip
        follows, left = grip / both, rotor / both
        # The part of grip that the rotor's speed does not follow.
        felt = grip * left
        own = -spring / both, (kept - damper) / both, damper / both, 1 / both
        torque = spring * left, damper * left + follows * kept, -damper * left - felt, follows
        return np.stack([*own, *torque, follows, self.step_s * felt, kept / rotor, 1 / rotor])


def within(values: FloatArray, most: FloatArray) -> FloatArray:
    """Return values limited to ``most`` to either side."""
    return np.asarray(np.minimum(np.maximum(values, -most), most))


class Couplings:
    """What links feel of their motors in each step, and how the motors follow them.

    A joint's gap is closed or open, and its motor has a torque that falls with its speed or one at its limit.
    The factors of both motors are computed once; those that act change with them.

    Args:
        law: The transmissions.
        resistance: What the motors' torques lose with their speeds, c, (N, B) [N·m·s/rad or N·s/m].
        stiffness: What they lose with the motors' own angles, (N, B) [N·m/rad or N/m]; 0 for encoders at the
            links.
        friction: Dry friction of the motors, (N, B) [N·m or N]; None for none.
        damping: Damping of the motors themselves, which acts at their limits, too, (N, B) [N·m·s/rad or
            N·s/m].

    Attributes:
        inertia: What the links have beside their own, (N, B) [kg·m² or kg].
    """

    def __init__(
        self,
        law: TransmissionLaw,
        resistance: FloatArray,
        stiffness: FloatArray | float = 0.0,
        friction: FloatArray | None = None,
        damping: FloatArray | float = 0.0,
    ) -> None:
        self._law, shape = law, resistance.shape
        self._friction = friction if friction is not None and np.any(friction) else None
        if self._friction is not None:
            # Of a spring whose motor stands still.
            self._damper, self._grip = law.dampers(law.damper_share(0 * resistance))
        self._gapless = not np.any(law.play)
        self._motors = law.factors(resistance + damping, stiffness), law.factors(0 * resistance + damping)
        self._nowhere: Mask = np.zeros(shape, dtype=bool)
        self._held = self._nowhere
        self._products, self._sums = np.zeros((2, 4, *shape)), np.zeros((2, *shape))
        # Speeds of the motors at the end, if the links stand still there.
        self._own = self._sums[0]
        self._act(self._motors[0])

    def couple(self, state: FloatArray, held: Mask | None = None) -> tuple[FloatArray, bool]:
        """Return the constant torque on the links during the next step, and whether `inertia` changed.

        The torque is overwritten in the next step.

        Args:
            state: Motor less link angle [rad or m], which is overwritten by what exceeds the gap; speed of
                the motor, speed of the link [rad/s or m/s]; torque of the motor [N·m or N]: at standstill, t,
                or the limit where it is held; (4, N, B).
            held: Where the motor is at its limit, (N, B); None for nowhere.
        """
        held = self._nowhere if held is None else held
        changed = held is not self._held and bool(np.count_nonzero(held != self._held))
        if changed:
            self._held = held
            self._act(np.where(held, self._motors[1], self._motors[0]))
        if self._gapless and self._friction is None:
            self._add(state)
            return self._sums[1], changed
        deflection, motor_speed, link_speed, torque = state
        # Whether the gap is closed is asked of a rotor that nothing holds yet.
        free = self._kept * motor_speed
        free += self._free * torque
        if self._friction is not None:
            free -= within(free, self._free * self._friction)
        reached = free - link_speed
        reached *= self._law.ahead_s
        reached += deflection
        half = self._law.half_play
        closed = np.abs(reached) >= half
        deflection -= np.copysign(half, reached)
        self._add(state)
        self._follows, self.inertia = self._fits
        if self._friction is not None:
            self._rub(state, self._friction)
        np.copyto(free, self._sums[0], where=closed)
        self._own = free
        # As numbers: a product with truth values costs three times as much. Gaps open and close all the time.
        fits = closed.astype(float)
        self._sums[1] *= fits
        self._follows, self.inertia = self._follows * fits, self.inertia * fits
        return self._sums[1], True

    def _rub(self, state: FloatArray, friction: FloatArray) -> None:
        """Let dry friction act on motors whose gaps are closed.

        Whether a motor slides, and where to, is that of its speed at the end without friction, if the link
        keeps its own. A motor that does not slide holds its end of the spring.
        """
        deflection, motor_speed, link_speed, _ = state
        speeds, torques = self._factors[:, 3]
        speed = self._sums[0] + self._follows * link_speed
        slides = np.abs(speed) >= speeds * friction
        against = np.copysign(friction, speed)
        spring = self._law.stiffness * deflection + self._damper * motor_speed
        spring -= (self._damper + self._grip) * link_speed
        self._sums[0] = np.where(slides, self._sums[0] - speeds * against, 0.0)
        self._sums[1] = np.where(slides, self._sums[1] - torques * against, spring)
        self._follows = np.where(slides, self._follows, 0.0)
        self.inertia = np.where(slides, self.inertia, self._law.step_s * self._grip)

    def _add(self, state: FloatArray) -> None:
        """Add what closed gaps make of a state, (4, N, B)."""
        np.multiply(self._factors, state, out=self._products)
        np.add.reduce(self._products, axis=1, out=self._sums)

    def follow(self, link_speed: FloatArray, motor_speed: FloatArray) -> None:
        """Write the motors' speeds at the end of the step into the last argument, (N, B) each."""
        np.multiply(self._follows, link_speed, out=motor_speed)
        motor_speed += self._own

    def _act(self, factors: FloatArray) -> None:
        """Let factors act, (12, N, B)."""
        self._factors = factors[:8].reshape(self._products.shape)
        self._fits, self._kept, self._free = factors[8:10], factors[10], factors[11]
        self._follows, self.inertia = self._fits
