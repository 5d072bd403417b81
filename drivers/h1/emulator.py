"""The emulated H1 on a crane: its hidden truth, its messages and the faults of its motors.

A motor follows commands in its own mode only: 0x0A at numbers 0 to 8, 0x01 at ankles and arms, as the
vendor's example sends them. Not published, and assumed: that a motor is off in the other mode, friction,
battery and temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from deal_hw.drivers.h1.description import (
    ARMATURE_KGM2,
    DESCRIPTION,
    FRICTIONLOSS_NM,
    JOINT_DAMPING_NMS_RAD,
    VELOCITY_LIMIT_RAD_S,
)
from deal_hw.drivers.h1.faults import H1FaultPlan
from deal_hw.drivers.h1.joints import JOINTS, MODES, ORDER, SERVO_MODE, TORSO
from deal_hw.drivers.unitree.emulated_device import require_finite
from deal_hw.drivers.unitree.emulated_humanoid import EmulatedHumanoid, HumanoidTruth
from deal_hw.drivers.unitree.go_messages.low_command import (
    GoCommand,
    GoCommandEncoder,
    decode_low_command,
)
from deal_hw.drivers.unitree.go_messages.low_state import LowState, encode_low_state
from deal_hw.drivers.unitree.humanoid import per_joint
from deal_hw.drivers.unitree.hung_device import HungDevice, Sensed
from deal_hw.drivers.unitree.remote import encode_remote
from deal_hw.types import FloatArray

HOT_C: Final = 130
IMU_TEMPERATURE_C: Final = 45
BATTERY_PERCENT: Final = 80
SUPPLY_V, SUPPLY_A = 60.0, 2.0
HEAT_K_NM2: Final = 0.0035
"""Final warming of a motor for the square of its torque, as the emulated B2's [K/(N·m)²]."""

H1: Final = EmulatedHumanoid(
    kind="H1",
    stream=0x41,
    descriptions={DESCRIPTION.name: DESCRIPTION},
    frictionloss=FRICTIONLOSS_NM,
    joint_damping=JOINT_DAMPING_NMS_RAD,
    armature=ARMATURE_KGM2,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class H1Truth(HumanoidTruth):
    """Hidden parameters of an H1."""

    machine: ClassVar[EmulatedHumanoid] = H1


class H1Device(HungDevice[GoCommand]):
    """An emulated H1 without real time and wire; its pelvis is held in the air, its inertial sensor turns.

    Args:
        truth: Hidden parameters, profile, seed.
        controller: Mode of the robot's own controller at power-up; "" for none.
        remote: Whether a remote is in reach.
        plan: Faults to make.
        tick_ms: The robot's clock at the beginning.
    """

    def __init__(
        self,
        truth: H1Truth,
        *,
        controller: str = "ai",
        remote: bool = True,
        plan: H1FaultPlan | None = None,
        tick_ms: int = 0,
    ) -> None:
        self._plan = plan or H1FaultPlan()
        self._encoder = GoCommandEncoder(ORDER.motors, MODES)
        super().__init__(
            truth,
            self._plan,
            no_load=per_joint(VELOCITY_LIMIT_RAD_S, JOINTS),
            servo_modes=(SERVO_MODE.tolist(),),
            heat_k_nm2=HEAT_K_NM2,
            controller=controller,
            remote=remote,
            tick_ms=tick_ms,
        )

    def _begin_own_fault(self, name: str) -> None:
        if name == "lost":
            self._motors.lose(self._fault_joint())
        else:
            super()._begin_own_fault(name)

    def _fault_joint(self) -> int:
        return JOINTS.index(self._plan.fault_joint)

    def _true_body(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return them in the torso, which turns about the pelvis's z axis; the pelvis is level and still."""
        angle = float(self._sim.position()[TORSO])
        orientation = np.array((np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)))
        turning = np.array((0.0, 0.0, float(self._sim.velocity()[TORSO])))
        # The vertical is the torso's own z axis, too.
        return orientation, turning, self._sim.specific_force()

    def _hold(self, position: FloatArray, stiffness: float, damping: float) -> GoCommand:
        zero, ones = np.zeros(len(position)), np.ones(len(position))
        return GoCommand(position, zero, stiffness * ones, damping * ones, zero, SERVO_MODE)

    def _encode(self, command: GoCommand) -> bytes:
        return self._encoder.encode(command)

    def _decode(self, payload: bytes) -> GoCommand:
        command = decode_low_command(payload, ORDER.motors)
        require_finite(command)
        return command

    def _encode_state(self, sensed: Sensed, tick_ms: int) -> bytes:
        motors = self._motors
        temperature = motors.temperature.astype(np.int64)
        if self._hot >= 0:
            temperature[self._hot] = HOT_C
        state = LowState(
            position=sensed.position,
            velocity=sensed.velocity,
            acceleration=sensed.acceleration,
            effort=sensed.effort,
            temperature=temperature,
            lost=motors.lost,
            mode=motors.mode,
            orientation=sensed.orientation,
            angular_velocity=sensed.angular_velocity,
            specific_force=sensed.specific_force,
            rpy=sensed.rpy,
            imu_temperature=IMU_TEMPERATURE_C,
            foot_force=np.zeros(4, np.int64),
            foot_force_estimate=np.zeros(4, np.int64),
            tick_ms=tick_ms,
            remote=encode_remote(self._remote),
            battery_percent=BATTERY_PERCENT,
            battery_current_ma=-round(1e3 * SUPPLY_A),
            battery_status=0,
            battery_cycles=0,
            cell_voltage_mv=np.zeros(15, np.int64),
            voltage=SUPPLY_V,
            current=SUPPLY_A,
        )
        return encode_low_state(state, ORDER)
