"""The emulated G1 on a crane: its messages, versions and the faults of its motors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from deal_hw.drivers.g1.emulator.faults import G1FaultPlan
from deal_hw.drivers.g1.emulator.truth import G1Truth
from deal_hw.drivers.g1.joints import MACHINES, MACHINES_23, MACHINES_29
from deal_hw.drivers.g1.messages import (
    MODE_PR,
    G1Command,
    G1CommandEncoder,
    G1State,
    decode_low_command,
    encode_low_state,
)
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.emulated_device import require_finite
from deal_hw.drivers.unitree.hung_device import HungDevice, Sensed
from deal_hw.drivers.unitree.motor_command import MODE_SERVO
from deal_hw.drivers.unitree.remote import encode_remote
from deal_hw.errors import ConfigurationError, FrameError
from deal_hw.types import FloatArray

NO_LOAD_RAD_S: Final = 25.0
"""Speed without load in the profile realistic; assumed, the same for all motors [rad/s]."""
MOTOR_VOLTS: Final = 52.0
IMU_TEMPERATURE_C: Final = 45
HOT_C: Final = 130
ERROR_CODE: Final = 0x2
_HEAT_OF_WINDING: Final = 1.5
"""Warming of a winding over that of the casing."""


class G1Device(HungDevice[G1Command]):
    """An emulated G1 without real time and wire; its pelvis is held in the air.

    As on the robot, a LowCmd must echo the state's mode_machine; another one is ignored. Only mode_pr 0 is
    emulated.

    Attributes:
        types: Types of the topics that have another type than the Go2's.

    Args:
        truth: Hidden parameters, profile, seed.
        controller: Mode of the robot's own controller at power-up; "" for none.
        mode_machine: Version of the G1; None for the newest with the truth's joints.
        remote: Whether a remote is in reach.
        plan: Faults to make.
        tick_ms: The robot's clock at the beginning.
    """

    types: Mapping[str, str] = topics.HUMANOID_TYPES

    def __init__(
        self,
        truth: G1Truth,
        *,
        controller: str = "ai",
        mode_machine: int | None = None,
        remote: bool = True,
        plan: G1FaultPlan | None = None,
        tick_ms: int = 0,
    ) -> None:
        self._machine = newest_machine(truth.robot) if mode_machine is None else mode_machine
        if not 0 <= self._machine <= 255:
            raise ConfigurationError(f"mode_machine is a byte, got {mode_machine}; known: {dict(MACHINES)}")
        self._plan = plan or G1FaultPlan()
        self._encoder = G1CommandEncoder(truth.joints)
        self._failed = -1
        super().__init__(
            truth,
            self._plan,
            no_load=(NO_LOAD_RAD_S,) * len(truth.joints),
            servo_modes=(MODE_SERVO,),
            controller=controller,
            remote=remote,
            tick_ms=tick_ms,
        )

    def report(self) -> dict[str, Any]:
        """Return a report as plain JSON values: truth, messages, commands, faults."""
        return {**super().report(), "mode_machine": self._machine}

    def _begin_own_fault(self, name: str) -> None:
        match name:
            case "error":
                self._failed = self._fault_joint()
            case "machine":
                self._machine = 9
            case _:
                super()._begin_own_fault(name)

    def _fault_joint(self) -> int:
        joint = self._plan.fault_joint
        return self._joints.index(joint) if joint in self._joints else 0

    def _hold(self, position: FloatArray, stiffness: float, damping: float) -> G1Command:
        zero, ones = np.zeros(len(position)), np.ones(len(position))
        return G1Command(
            position,
            zero,
            stiffness * ones,
            damping * ones,
            zero,
            np.full(len(position), MODE_SERVO),
            mode_machine=self._machine,
        )

    def _encode(self, command: G1Command) -> bytes:
        return self._encoder.encode(command)

    def _decode(self, payload: bytes) -> G1Command:
        command = decode_low_command(payload, self._joints)
        require_finite(command)
        if command.mode_machine != self._machine:
            raise FrameError(
                f"LowCmd: mode_machine is {command.mode_machine}, that of this robot {self._machine}"
            )
        if command.mode_pr != MODE_PR:
            raise FrameError(f"LowCmd: mode_pr {command.mode_pr} (parallel motors) is not emulated")
        return command

    def _encode_state(self, sensed: Sensed, tick_ms: int) -> bytes:
        temperature, count = self._motors.temperature, len(self._joints)
        casing = temperature.astype(np.int64)
        winding = np.rint(casing + _HEAT_OF_WINDING * (temperature - casing.min())).astype(np.int64)
        error = np.zeros(count, dtype=np.int64)
        if self._hot >= 0:
            winding[self._hot] = HOT_C
        if self._failed >= 0:
            error[self._failed] = ERROR_CODE
        state = G1State(
            position=sensed.position,
            velocity=sensed.velocity,
            acceleration=sensed.acceleration,
            effort=sensed.effort,
            casing=casing,
            winding=winding,
            voltage=np.full(count, MOTOR_VOLTS),
            error=error,
            mode=self._motors.mode,
            orientation=sensed.orientation,
            angular_velocity=sensed.angular_velocity,
            specific_force=sensed.specific_force,
            rpy=sensed.rpy,
            imu_temperature=IMU_TEMPERATURE_C,
            tick_ms=tick_ms,
            remote=encode_remote(self._remote),
            mode_machine=self._machine,
        )
        return encode_low_state(state, self._joints)


def newest_machine(robot: str) -> int:
    """Return the newest mode_machine of "g1" or "g1_23dof"."""
    return max(MACHINES_29 if robot == "g1" else MACHINES_23)
