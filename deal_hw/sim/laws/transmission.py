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
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True)
class Coupling:
    """What a link feels of its motor in one step, and how the motor follows the link; (N, B) each.

    Attributes:
        torque: Constant torque on the link [N·m or N].
        inertia: Inertia that the link has beside its own [kg·m² or kg].
        own_speed: Speed of the motor at the end of the step, if the link stands still there [rad/s or m/s].
        follows: Share of the link's speed that adds to it [-].
    """

    torque: FloatArray
    inertia: FloatArray
    own_speed: FloatArray
    follows: FloatArray

    def motor_speed(self, link_speed: FloatArray) -> FloatArray:
        """Return the motors' speeds at the end of the step from those of the links, (N, B)."""
        return np.asarray(self.own_speed + self.follows * link_speed)


@dataclass(frozen=True, kw_only=True)
class TransmissionLaw:
    """The transmissions of B joints of N members; (N, B) each.

    Attributes:
        stiffness: k, above 0 [N·m/rad or N/m].
        damping: d, at least 0 [N·m·s/rad or N·s/m].
        play: b, width of the gap, at least 0 [rad or m].
        inertia: J, the rotor's, above 0 [kg·m² or kg].
        link_inertia: Jl, about that of the link, for the share of the step [kg·m² or kg].
        step_s: h [s].
    """

    stiffness: FloatArray
    damping: FloatArray
    play: FloatArray
    inertia: FloatArray
    link_inertia: FloatArray
    step_s: float

    @cached_property
    def _ahead_s(self) -> FloatArray:
        """Part of the step after which the spring's angle counts, (N, B) [s]."""
        turned = self.step_s**2 * self.stiffness * (1 / self.inertia + 1 / self.link_inertia)
        return np.asarray(self.step_s * np.maximum(0.0, 1.0 - 1.0 / turned))

    @cached_property
    def _grip(self) -> FloatArray:
        """Torque a difference of the speeds at the end of the step, (N, B) [N·m·s/rad]."""
        return np.asarray(self.stiffness * self._ahead_s + self.damping)

    @cached_property
    def _carried(self) -> FloatArray:
        """Torque that stops a rotor of 1 rad/s in one step, (N, B) [N·m·s/rad]."""
        return self.inertia / self.step_s

    @cached_property
    def _gapless(self) -> bool:
        """Whether no joint has play."""
        return not np.any(self.play)

    def deflection(self, torque: FloatArray) -> FloatArray:
        """Return motor less link angles at which the transmissions at rest pass torques, (N, B)."""
        return np.asarray(torque / self.stiffness + np.sign(torque) * self.play / 2)

    def couple(
        self,
        deflection: FloatArray,
        motor_speed: FloatArray,
        link_speed: FloatArray,
        torque: FloatArray,
        resistance: FloatArray,
    ) -> Coupling:
        """Return the coupling during the next step, (N, B) throughout.

        Args:
            deflection: Motor less link angle [rad or m].
            motor_speed: Speed of the motor [rad/s or m/s].
            link_speed: Speed of the link [rad/s or m/s].
            torque: Torque of the motor at standstill, t [N·m or N].
            resistance: What it loses with the motor's speed, c [N·m·s/rad or N·s/m].
        """
        drive = self._carried * motor_speed + torque
        rotor = self._carried + resistance
        if self._gapless:
            grip, push = self._grip, self.stiffness * deflection
        else:
            # Whether the gap is closed is asked of a rotor that nothing holds yet.
            reached = deflection + self._ahead_s * (drive / rotor - link_speed)
            half = self.play / 2
            closed = np.abs(reached) >= half
            grip = np.where(closed, self._grip, 0.0)
            push = np.where(closed, self.stiffness * (deflection - np.copysign(half, reached)), 0.0)
        both = rotor + grip
        own_speed, follows = (drive - push) / both, grip / both
        # The part of grip that the rotor's speed does not follow.
        felt = follows * rotor
        return Coupling(
            torque=push + grip * own_speed - felt * link_speed,
            inertia=self.step_s * felt,
            own_speed=own_speed,
            follows=follows,
        )
