"""An emulated humanoid on a crane: mechanics, motors, sensors, own controller, whatever its messages."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, TypeVar

import numpy as np

from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.emulated_device import (
    STATE_MS,
    STOP_COMBINATION,
    TICK_NS,
    Outgoing,
    UnitreeDevice,
)
from deal_hw.drivers.unitree.emulated_faults import WirePlan
from deal_hw.drivers.unitree.emulated_humanoid import HumanoidTruth, profile
from deal_hw.drivers.unitree.emulated_imu import roll_pitch_yaw, turned
from deal_hw.drivers.unitree.emulated_motors import HEAT_K_NM2, PdMotors, ServoModes
from deal_hw.drivers.unitree.motor_command import MotorCommand
from deal_hw.drivers.unitree.own_controller import PERIOD_MS, OwnController
from deal_hw.drivers.unitree.remote import Remote, parse_combination
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.types import FloatArray

SETTLE_TICKS: Final = 2000
PUBLISHED: Final = (
    topics.LOW_STATE,
    *(topics.response(name) for name in topics.SERVICES),
    topics.LOW_COMMAND,
)
"""Topics that the robot writes; the last one is its own controller's."""
ASIDE_NM_RAD: Final = 40.0
"""Stiffness of another program's commands."""
CommandT = TypeVar("CommandT", bound=MotorCommand)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensed:
    """What the robot's sensors report at a tick, joints (J,).

    Attributes:
        position: With bias, noise and quantisation, (J,) [rad].
        velocity: (J,) [rad/s].
        acceleration: (J,) [rad/s²].
        effort: The motors' estimate, (J,) [N·m].
        orientation: Quaternion wxyz, sensor in the world, (4,).
        angular_velocity: Sensor's frame, (3,) [rad/s].
        specific_force: Sensor's frame, (3,) [m/s²].
        rpy: Roll, pitch, yaw, (3,) [rad].
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    orientation: FloatArray
    angular_velocity: FloatArray
    specific_force: FloatArray
    rpy: FloatArray


class HungDevice(UnitreeDevice[CommandT]):
    """An emulated humanoid without real time and wire; its pelvis is held in the air.

    Attributes:
        published: Topics that it writes.
        types: Types of the topics that have another type than the Go2's.

    Args:
        truth: Hidden parameters, profile, seed.
        plan: Faults to make.
        no_load: Speed of each motor without load in the profile realistic, (J,) [rad/s].
        servo_modes: Modes in which the motors follow commands.
        heat_k_nm2: Final warming of a motor for the square of its torque [K/(N·m)²].
        controller: Mode of the robot's own controller at power-up; "" for none.
        remote: Whether a remote is in reach.
        tick_ms: The robot's clock at the beginning.
    """

    published: tuple[str, ...] = PUBLISHED
    types: Mapping[str, str] = {}
    own_period_ms: ClassVar[int] = PERIOD_MS

    def __init__(
        self,
        truth: HumanoidTruth,
        plan: WirePlan,
        *,
        no_load: tuple[float, ...],
        servo_modes: ServoModes,
        heat_k_nm2: float = HEAT_K_NM2,
        controller: str,
        remote: bool,
        tick_ms: int,
    ) -> None:
        self._truth, self._joints = truth, truth.joints
        p = profile(truth.profile)
        seeds = np.random.SeedSequence([truth.seed, truth.machine.stream]).spawn(4)
        self._sensor_rng, jitter_rng, self._drop_rng, fault_rng = map(np.random.default_rng, seeds)
        super().__init__(
            LeggedSimulation(truth.description.mjcf, self._joints, [], TICK_NS * 1e-9, base="pelvis"),
            truth,
            p,
            plan,
            joints=self._joints,
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
            truth.description.effort_limit,
            no_load,
            p.knee,
            servo_modes,
            heat_k_nm2,
        )
        self._noise = np.repeat(
            (p.position_noise, p.velocity_noise, p.acceleration_noise, p.effort_noise), count
        )
        self._own: OwnController[CommandT] = OwnController(count, controller, self._hold)
        self._remote: Remote | None = Remote() if remote else None
        self._broken = self._hot = -1
        limp = not controller
        self._sim.set_pose(np.array(truth.description.default_position) if limp else np.zeros(count))
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
        return {**self._truth.to_json(), "parameters": self._truth.parameters(), **self._happened()}

    # What each robot does in its own way.

    @abc.abstractmethod
    def _hold(self, position: FloatArray, stiffness: float, damping: float) -> CommandT:
        """Return the command that holds positions, (J,), with a kp and a kd for all joints."""

    @abc.abstractmethod
    def _encode(self, command: CommandT) -> bytes:
        """Return the message of a command."""

    @abc.abstractmethod
    def _encode_state(self, sensed: Sensed, tick_ms: int) -> bytes:
        """Return the message of a state at a time of the robot's clock [ms]."""

    @abc.abstractmethod
    def _fault_joint(self) -> int:
        """Return the index of the joint of a fault that has one."""

    def _true_body(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return orientation, angular velocity and specific force at the robot's inertial sensor, ideal."""
        sim = self._sim
        return sim.orientation(), sim.angular_velocity(), sim.specific_force()

    # The steps of a tick.

    def _begin_own_fault(self, name: str) -> None:
        match name:
            case "sport":
                self._own.select("ai", self._sim.position() + self._bias, self._tick)
            case "nan":
                self._broken = self._fault_joint()
            case "hot":
                self._hot = self._fault_joint()
            case "stop":
                self._remote = Remote(parse_combination(STOP_COMBINATION))
            case _:
                raise ValueError(f"no such fault: {name!r}")

    @property
    def _own_name(self) -> str:
        return self._own.name

    def leave_own(self) -> None:
        """Let its own controller leave the robot at once."""
        self._own.name = ""

    def _stiff_message(self, position: FloatArray) -> bytes:
        return self._encode(self._hold(position, ASIDE_NM_RAD, 1.0))

    def _update_own(self, now: int) -> None:
        if self._own.update(now):
            self._motors.accept(self._own.damped())

    def _own_command(self, now: int) -> tuple[CommandT, bytes | None]:
        command = self._own.command(now)
        return command, self._encode(command)

    def _answer(self, service: str, payload: bytes, position: FloatArray) -> bytes | None:
        return self._own.answer(service, payload, position, self._tick)

    def _answered(self) -> int:
        return self._own.answered

    def _reports(self, now: int) -> list[Outgoing]:
        if now % STATE_MS:
            return []
        sensed = self._sense()
        if self._profile.drop and self._drop_rng.random() < self._profile.drop:
            return []
        payload = self._encode_state(sensed, (now + self._tick_offset) & 0xFFFF_FFFF)
        sent = self._state_faults.apply(payload) if self._state_faults.any else [payload]
        return [(topics.LOW_STATE, one) for one in sent]

    def _sense(self) -> Sensed:
        sim, p = self._sim, self._profile
        count = len(self._joints)
        noise = (self._noise * self._sensor_rng.standard_normal(4 * count)).reshape(4, count)
        body = self._sensor_rng.standard_normal((3, 3))
        position = sim.position() + self._bias + noise[0]
        if p.position_resolution:
            position = np.rint(position / p.position_resolution) * p.position_resolution
        position, velocity = self.joint_faults.read(position, sim.velocity() + noise[1])
        if self._broken >= 0:
            position[self._broken] = velocity[self._broken] = math.nan
        orientation, angular_velocity, specific_force = self._true_body()
        w, x, y, z = orientation = turned(orientation, p.orientation_noise * body[0])
        return Sensed(
            position=position,
            velocity=velocity,
            acceleration=sim.acceleration() + noise[2],
            effort=self._motors.effort + noise[3],
            orientation=orientation,
            angular_velocity=angular_velocity + p.gyro_noise * body[1],
            specific_force=specific_force + p.specific_force_noise * body[2],
            rpy=roll_pitch_yaw(w, x, y, z),
        )
