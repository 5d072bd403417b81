"""The emulated Go2's twelve motors."""

from __future__ import annotations

from deal_hw.drivers.go2.descriptions.floor import EFFORT_LIMIT_NM, VELOCITY_LIMIT_RAD_S, per_joint
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.unitree.emulated_motors import PdMotors
from deal_hw.drivers.unitree.emulated_profile import SensorProfile


class Motors(PdMotors):
    """Twelve motors in model order.

    Args:
        truth: True gains over commanded gains, encoder bias.
        profile: Torque-speed limit.
    """

    def __init__(self, truth: Go2Truth, profile: SensorProfile) -> None:
        super().__init__(
            truth.stiffness,
            truth.damping,
            truth.encoder_bias,
            per_joint(EFFORT_LIMIT_NM),
            per_joint(VELOCITY_LIMIT_RAD_S),
            profile.knee,
        )
