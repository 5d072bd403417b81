"""The emulated G1 on a crane: mechanics, motors, firmware and services in virtual time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np

from deal_hw.drivers.g1.description import EFFORT_LIMIT_NM, hung_pose, per_joint
from deal_hw.drivers.g1.emulator.controller import PERIOD_MS, OwnController
from deal_hw.drivers.g1.emulator.faults import G1FaultPlan
from deal_hw.drivers.g1.emulator.profiles import profile as find_profile
from deal_hw.drivers.g1.emulator.truth import DESCRIPTIONS, G1Truth
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
from deal_hw.drivers.unitree.emulated_device import (
    STATE_MS,
    STOP_COMBINATION,
    TICK_NS,
    Outgoing,
    UnitreeDevice,
    require_finite,
)
from deal_hw.drivers.unitree.emulated_imu import roll_pitch_yaw, turned
from deal_hw.drivers.unitree.emulated_motors import PdMotors
from deal_hw.drivers.unitree.remote import Remote, encode_remote, parse_combination
from deal_hw.errors import ConfigurationError, FrameError
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.types import FloatArray

SETTLE_TICKS: Final = 2000
NO_LOAD_RAD_S: Final = 25.0
"""Speed without load in the profile realistic; assumed, the same for all motors [rad/s]."""
MOTOR_VOLTS: Final = 52.0
IMU_TEMPERATURE_C: Final = 45
HOT_C: Final = 130
ERROR_CODE: Final = 0x2
_HEAT_OF_WINDING: Final = 1.5
"""Warming of a winding over that of the casing."""
PUBLISHED: Final = (
    topics.LOW_STATE,
    *(topics.response(name) for name in topics.SERVICES),
    topics.LOW_COMMAND,
)
"""Topics that the robot writes; the last one is its own controller's."""


class G1Device(UnitreeDevice[G1Command]):
    """An emulated G1 without real time and wire; its pelvis is held in the air.

    As on the robot, a LowCmd must echo the state's mode_machine; another one is ignored. Only mode_pr 0 is
    emulated.

    Attributes:
        published: Topics that it writes.
        types: Types of the topics that have another type than the Go2's.

    Args:
        truth: Hidden parameters, profile, seed.
        controller: Mode of the robot's own controller at power-up; "" for none.
        mode_machine: Version of the G1; None for the newest with the truth's joints.
        remote: Whether a remote is in reach.
        plan: Faults to make.
        tick_ms: The robot's clock at the beginning.
    """

    published: tuple[str, ...] = PUBLISHED
    types: Mapping[str, str] = topics.HUMANOID_TYPES
    own_period_ms: ClassVar[int] = PERIOD_MS

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
        self._truth, self._joints = truth, truth.joints
        self._machine = newest_machine(truth.robot) if mode_machine is None else mode_machine
        if not 0 <= self._machine <= 255:
            raise ConfigurationError(f"mode_machine is a byte, got {mode_machine}; known: {dict(MACHINES)}")
        profile = find_profile(truth.profile)
        self._plan = plan or G1FaultPlan()
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence([truth.seed, 0x61]).spawn(4)]
        self._sensor_rng, jitter_rng, self._drop_rng, fault_rng = streams
        mjcf = DESCRIPTIONS[truth.robot].mjcf
        super().__init__(
            LeggedSimulation(mjcf, self._joints, [], TICK_NS * 1e-9, base="pelvis"),
            truth,
            profile,
            self._plan,
            written=PUBLISHED,
            jitter_rng=jitter_rng,
            fault_rng=fault_rng,
            tick_ms=tick_ms,
        )
        count = len(self._joints)
        self._motors = PdMotors(
            truth.stiffness,
            truth.damping,
            truth.encoder_bias,
            per_joint(EFFORT_LIMIT_NM, self._joints),
            (NO_LOAD_RAD_S,) * count,
            profile.knee,
        )
        p = profile
        self._noise = np.repeat(
            (p.position_noise, p.velocity_noise, p.acceleration_noise, p.effort_noise), count
        )
        self._own = OwnController(count, controller, self._machine)
        self._encoder = G1CommandEncoder(self._joints)
        self._remote: Remote | None = Remote() if remote else None
        self._broken = self._hot = self._failed = -1
        limp = not controller
        self._sim.set_pose(np.array(hung_pose(self._joints)) if limp else np.zeros(count))
        self._motors.accept(self._own.damped() if limp else self._own.command(0))
        self._settle(SETTLE_TICKS)

    @property
    def true_velocity(self) -> FloatArray:
        """True joint velocities, (J,) [rad/s]; not reported."""
        return self._sim.velocity()

    @property
    def controller_name(self) -> str:
        """Mode of the robot's own controller; "" once released."""
        return self._own.name

    def report(self) -> dict[str, Any]:
        """Return a report as plain JSON values: truth, messages, commands, faults."""
        return {
            **self._truth.to_json(),
            "parameters": self._truth.parameters(),
            "mode_machine": self._machine,
            **self._happened(),
        }

    def _begin_own_fault(self, name: str) -> None:
        joint = self._joints.index(self._plan.fault_joint) if self._plan.fault_joint in self._joints else 0
        match name:
            case "sport":
                self._own.select("ai", self._sim.position() + self._bias, self._tick)
            case "nan":
                self._broken = joint
            case "hot":
                self._hot = joint
            case "error":
                self._failed = joint
            case "stop":
                self._remote = Remote(parse_combination(STOP_COMBINATION))
            case "machine":
                self._machine = 9
            case _:
                raise ValueError(f"no such fault: {name!r}")

    @property
    def _own_name(self) -> str:
        return self._own.name

    def _update_own(self, now: int) -> None:
        if self._own.update(now):
            self._motors.accept(self._own.damped())

    def _own_command(self, now: int) -> tuple[G1Command, bytes | None]:
        command = self._own.command(now)
        return command, self._encoder.encode(command)

    def _answer(self, service: str, payload: bytes, position: FloatArray) -> bytes | None:
        return self._own.answer(service, payload, position, self._tick)

    def _answered(self) -> int:
        return self._own.answered

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

    def _reports(self, now: int) -> list[Outgoing]:
        if now % STATE_MS:
            return []
        state = self._state((now + self._tick_offset) & 0xFFFF_FFFF)
        if self._profile.drop and self._drop_rng.random() < self._profile.drop:
            return []
        payload = encode_low_state(state, self._joints)
        sent = self._state_faults.apply(payload) if self._state_faults.any else [payload]
        return [(topics.LOW_STATE, one) for one in sent]

    def _state(self, tick_ms: int) -> G1State:
        sim, motors, p = self._sim, self._motors, self._profile
        count = len(self._joints)
        noise = (self._noise * self._sensor_rng.standard_normal(4 * count)).reshape(4, count)
        body = self._sensor_rng.standard_normal((3, 3))
        position = sim.position() + self._bias + noise[0]
        if p.position_resolution:
            position = np.rint(position / p.position_resolution) * p.position_resolution
        velocity = sim.velocity() + noise[1]
        if self._broken >= 0:
            position[self._broken] = velocity[self._broken] = math.nan
        casing = motors.temperature.astype(np.int64)
        winding = np.rint(casing + _HEAT_OF_WINDING * (motors.temperature - casing.min())).astype(np.int64)
        error = np.zeros(count, dtype=np.int64)
        if self._hot >= 0:
            winding[self._hot] = HOT_C
        if self._failed >= 0:
            error[self._failed] = ERROR_CODE
        w, x, y, z = orientation = turned(sim.orientation(), p.orientation_noise * body[0])
        return G1State(
            position=position,
            velocity=velocity,
            acceleration=sim.acceleration() + noise[2],
            effort=motors.effort + noise[3],
            casing=casing,
            winding=winding,
            voltage=np.full(count, MOTOR_VOLTS),
            error=error,
            mode=motors.mode,
            orientation=orientation,
            angular_velocity=sim.angular_velocity() + p.gyro_noise * body[1],
            specific_force=sim.specific_force() + p.specific_force_noise * body[2],
            rpy=roll_pitch_yaw(w, x, y, z),
            imu_temperature=IMU_TEMPERATURE_C,
            tick_ms=tick_ms,
            remote=encode_remote(self._remote),
            mode_machine=self._machine,
        )


def newest_machine(robot: str) -> int:
    """Return the newest mode_machine of "g1" or "g1_23dof"."""
    return max(MACHINES_29 if robot == "g1" else MACHINES_23)
