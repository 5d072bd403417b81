"""The twelve motors of an emulated quadruped."""

from __future__ import annotations

from deal_hw.drivers.unitree.emulated_motors import PdMotors
from deal_hw.drivers.unitree.emulated_profile import SensorProfile
from deal_hw.drivers.unitree.emulated_quadruped import QuadrupedTruth


class Motors(PdMotors):
    """Twelve motors in model order.

    Args:
        truth: True gains over commanded gains, encoder bias, and the machine's limits.
        profile: Torque-speed limit.
    """

    def __init__(self, truth: QuadrupedTruth, profile: SensorProfile) -> None:
        machine = truth.machine
        super().__init__(
            truth.stiffness,
            truth.damping,
            truth.encoder_bias,
            machine.effort_limit,
            machine.no_load,
            profile.knee,
            machine.servo_modes,
            machine.heat_k_nm2,
        )
