"""Dry friction that depends on speed and load: the budget that opposes motion at a joint.

After Stribeck, and "Extended Friction Models for the Physics Simulation of Servo Actuators" (models M1 to
M5, arXiv 2410.08650). With the torque of the motor m and that from outside e, at the joint, and the speed w:

    F = Kc + |Ke e - Km m| + s(w) (Kcs + |Kes e - Kms m|),    s(w) = exp(-(w / ws)²)

Their exponent of s is free. It trades with ws and Kcs, and 2 is what MuJoCo's LuGre element has. A joint at
rest that a motor holds has e = -m. So with Ke = Km = K its friction is 2 K times the torque it transmits.
With Kcs below 0 friction rises with speed, as in harmonic drives. Whoever applies a budget keeps it above 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deal_hw.types import FloatArray


@dataclass(frozen=True, kw_only=True)
class FrictionLaw:
    """Coefficients of the friction at D joints of N members; each (N, D).

    Attributes:
        coulomb: Kc, friction at speed, without load [N·m or N].
        stribeck: Kcs, further friction at rest, or less if negative [N·m or N].
        stribeck_speed: ws, speed at which that has fallen to 1/e [rad/s or m/s].
        motor: Km, friction a motor torque [-].
        external: Ke, friction an outside torque [-].
        motor_stribeck: Kms, further friction at rest a motor torque [-].
        external_stribeck: Kes, further friction at rest an outside torque [-].
    """

    coulomb: FloatArray
    stribeck: FloatArray
    stribeck_speed: FloatArray
    motor: FloatArray
    external: FloatArray
    motor_stribeck: FloatArray
    external_stribeck: FloatArray

    @cached_property
    def loaded(self) -> bool:
        """Whether any friction depends on a load."""
        return any(
            bool(np.any(k)) for k in (self.motor, self.external, self.motor_stribeck, self.external_stribeck)
        )

    def budget(
        self,
        speed: FloatArray,
        motor: FloatArray | None = None,
        external: FloatArray | None = None,
    ) -> FloatArray:
        """Return the largest torque of friction, (N, D) [N·m or N].

        Args:
            speed: Speeds of the joints, (N, D) [rad/s or m/s].
            motor: Torques of their motors, (N, D) [N·m or N]; None only without friction by load.
            external: Torques from outside, such as gravity, (N, D) [N·m or N]; likewise.
        """
        slow: FloatArray = np.exp(-((speed / self.stribeck_speed) ** 2))
        if motor is None or external is None:
            return self.coulomb + slow * self.stribeck
        moving = self.coulomb + np.abs(self.external * external - self.motor * motor)
        rest = self.stribeck + np.abs(self.external_stribeck * external - self.motor_stribeck * motor)
        return np.asarray(moving + slow * rest)
