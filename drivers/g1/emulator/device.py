"""The emulated G1 on a crane: mechanics, motors, firmware and services in virtual time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

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
from deal_hw.drivers.unitree.command_log import CommandLog
from deal_hw.drivers.unitree.emulated_faults import StateFaults
from deal_hw.drivers.unitree.emulated_imu import roll_pitch_yaw, turned
from deal_hw.drivers.unitree.emulated_motors import PdMotors
from deal_hw.drivers.unitree.remote import Remote, encode_remote, parse_combination
from deal_hw.errors import ConfigurationError, FrameError
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.types import FloatArray

TICK_NS: Final = 1_000_000
STATE_MS: Final = 2
SETTLE_TICKS: Final = 2000
NO_LOAD_RAD_S: Final = 25.0
"""Speed without load in the profile realistic; assumed, the same for all motors [rad/s]."""
MOTOR_VOLTS: Final = 52.0
IMU_TEMPERATURE_C: Final = 45
HOT_C: Final = 130
ERROR_CODE: Final = 0x2
STOP_COMBINATION: Final = "L2+B"
_HEAT_OF_WINDING: Final = 1.5
"""Warming of a winding over that of the casing."""
PUBLISHED: Final = (
    topics.LOW_STATE,
    *(topics.response(name) for name in topics.SERVICES),
    topics.LOW_COMMAND,
)
"""Topics that the robot writes; the last one is its own controller's."""
SUBSCRIBED: Final = (topics.LOW_COMMAND, *(topics.request(name) for name in topics.SERVICES))
"""Topics that the robot reads."""
Outgoing = tuple[str, bytes]


class G1Device:
    """An emulated G1 without real time and wire; its pelvis is held in the air.

    Tick k, at device time k ms, has the steps of the emulated Go2's: received messages are handled, commands
    that are due reach the motors, at even ticks a LowState reports the state, and one physics step follows.
    As on the robot, a LowCmd must echo the state's mode_machine; another one is ignored. Only mode_pr 0 is
    emulated.

    Attributes:
        log: The user's commands, with times.
        host_origin_ns: Host clock at device time 0, for the log [ns]; the caller keeps it correct.
        published: Topics that it writes.
        subscribed: Topics that it reads.
        types: Types of the topics that have another type than the Go2's.

    Args:
        truth: Hidden parameters, profile, seed.
        controller: Mode of the robot's own controller at power-up; "" for none.
        mode_machine: Version of the G1; None for the newest with the truth's joints.
        remote: Whether a remote is in reach.
        plan: Faults to make.
        tick_ms: The robot's clock at the beginning.
    """

    subscribed: tuple[str, ...] = SUBSCRIBED
    published: tuple[str, ...] = PUBLISHED
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
        self._truth, self._joints = truth, truth.joints
        self._machine = newest_machine(truth.robot) if mode_machine is None else mode_machine
        if not 0 <= self._machine <= 255:
            raise ConfigurationError(f"mode_machine is a byte, got {mode_machine}; known: {dict(MACHINES)}")
        self._profile = profile = find_profile(truth.profile)
        self._plan = plan or G1FaultPlan()
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence([truth.seed, 0x61]).spawn(4)]
        self._sensor_rng, self._jitter_rng, self._drop_rng, fault_rng = streams
        description = DESCRIPTIONS[truth.robot]
        self._sim = LeggedSimulation(description.mjcf, self._joints, [], TICK_NS * 1e-9, base="pelvis")
        self._friction = np.array(truth.frictionloss)
        self._joint_damping = np.array(truth.joint_damping)
        self._sim.set_dofs(
            damping=self._joint_damping, frictionloss=self._friction, armature=np.array(truth.armature)
        )
        self._bias = np.array(truth.encoder_bias)
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
        self._own_waits = False
        self._encoder = G1CommandEncoder(self._joints)
        self._service_of = {topics.request(name): name for name in topics.SERVICES}
        self._state_faults = StateFaults(self._plan, fault_rng)
        self._due = deque(self._plan.due())
        self._remote: Remote | None = Remote() if remote else None
        self._inbox: list[tuple[str, bytes, int]] = []
        self._commands: deque[tuple[int, G1Command]] = deque()
        self._tick, self._tick_offset = 0, tick_ms
        self.host_origin_ns = 0
        self._frozen, self._cut_end = False, 0
        self._broken = self._hot = self._failed = -1
        self._sent = dict.fromkeys(PUBLISHED, 0)
        self._bad_requests = 0
        self.log = CommandLog()
        self._settle()

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        return self._tick * TICK_NS

    @property
    def true_position(self) -> FloatArray:
        """True joint positions, (J,) [rad]; not reported."""
        return self._sim.position()

    @property
    def true_velocity(self) -> FloatArray:
        """True joint velocities, (J,) [rad/s]; not reported."""
        return self._sim.velocity()

    @property
    def controller_name(self) -> str:
        """Mode of the robot's own controller; "" once released."""
        return self._own.name

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Take a message; the next tick handles it.

        Args:
            topic: Its topic.
            payload: CDR with its header.
            stamp_ns: Host clock at reception, for the log [ns].
        """
        if self._tick >= self._cut_end:
            self._inbox.append((topic, payload, stamp_ns))

    def advance_to(self, device_ns: int) -> list[Outgoing]:
        """Run every tick up to and including ``device_ns``; return the messages sent meanwhile."""
        out: list[Outgoing] = []
        while self._tick * TICK_NS <= device_ns:
            out += self.tick()
        return out

    def tick(self) -> list[Outgoing]:
        """Run one tick; return the messages sent in it, in order."""
        now = self._tick
        out: list[Outgoing] = []
        for message in self._inbox:
            out += self._handle(*message)
        self._inbox.clear()
        if self.log.first_stiff_ms is not None:
            while self._due and self._due[0][0] <= now:
                self.begin_fault(self._due.popleft()[1])
        out += self._command_drives(now)
        velocity = self._sim.velocity()
        self._motors.update(self._sim.position(), velocity)
        if now % STATE_MS == 0:
            self._motors.warm(STATE_MS * 1e-3)
            out += self._report_state(now)
        self._move(velocity)
        self._tick = now + 1
        if self._frozen or now < self._cut_end:
            return []
        for topic, _ in out:
            self._sent[topic] += 1
        return out

    def report(self) -> dict[str, Any]:
        """Return a report as plain JSON values: truth, messages, commands, faults."""
        return {
            **self._truth.to_json(),
            "parameters": self._truth.parameters(),
            "mode_machine": self._machine,
            "device_ms": self._tick,
            "sent": dict(self._sent),
            "wire_faults": dict(self._state_faults.counts),
            "requests_answered": self._own.answered,
            "bad_requests": self._bad_requests,
            "sport": self._own.name,
            "commands": self.log.to_json(),
        }

    def begin_fault(self, name: str) -> None:
        """Begin a fault.

        Args:
            name: One of ``deal_hw.drivers.g1.emulator.faults.MOMENTS``.
        """
        joint = self._joints.index(self._plan.fault_joint) if self._plan.fault_joint in self._joints else 0
        match name:
            case "freeze":
                self._frozen = True
            case "cut":
                self._cut_end = self._tick + round(self._plan.cut_s * 1e3)
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
        self.log.begin(name, self._tick, self.host_origin_ns + self._tick * TICK_NS)

    # The steps of a tick.

    def _settle(self) -> None:
        """Come to rest under the own controller, or with damped joints; device time does not advance."""
        limp = not self._own.name
        self._sim.set_pose(np.array(hung_pose(self._joints)) if limp else np.zeros(len(self._joints)))
        self._motors.accept(self._own.damped() if limp else self._own.command(0))
        for _ in range(SETTLE_TICKS):
            velocity = self._sim.velocity()
            self._motors.update(self._sim.position(), velocity)
            self._move(velocity)

    def _move(self, velocity: FloatArray) -> None:
        """Run a physics step with the present motor efforts, from these velocities (J,)."""
        if self._profile.stribeck_ratio:
            slow = np.exp(-np.square(velocity / self._profile.stribeck_rad_s))
            self._sim.set_frictionloss(self._friction * (1.0 + self._profile.stribeck_ratio * slow))
        self._sim.set_damping(self._joint_damping + self._motors.brake)
        self._sim.step(self._motors.constant)

    def _handle(self, topic: str, payload: bytes, stamp_ns: int) -> list[Outgoing]:
        if topic == topics.LOW_COMMAND:
            self._take_command(payload, stamp_ns)
        elif (service := self._service_of.get(topic)) is not None:
            self.log.ask(service, self._tick, stamp_ns)
            try:
                answer = self._own.answer(service, payload, self._sim.position() + self._bias, self._tick)
            except FrameError:
                self._bad_requests += 1
                return []
            return [] if answer is None else [(topics.response(service), answer)]
        return []

    def _take_command(self, payload: bytes, stamp_ns: int) -> None:
        try:
            command = decode_low_command(payload, self._joints)
            self._check(command)
        except FrameError as error:
            self.log.refuse(str(error))
            return
        began = self.log.first_stiff_ms is not None
        self.log.accept(command, self._tick, stamp_ns)
        if not began and (first := self.log.first_stiff_ms) is not None:
            self._due = deque((first + after_ms, name) for after_ms, name in self._due)
        due = self._tick + self._truth.latency_ms
        if jitter := self._profile.jitter_ms:
            due += int(self._jitter_rng.integers(0, jitter + 1))
        if self._commands:
            due = max(due, self._commands[-1][0])
        self._commands.append((due, command))

    def _check(self, command: G1Command) -> None:
        parts = command.position, command.velocity, command.stiffness, command.damping, command.effort
        if not np.isfinite(np.concatenate(parts)).all():
            raise FrameError("LowCmd: a number is not finite")
        if command.mode_machine != self._machine:
            raise FrameError(
                f"LowCmd: mode_machine is {command.mode_machine}, that of this robot {self._machine}"
            )
        if command.mode_pr != MODE_PR:
            raise FrameError(f"LowCmd: mode_pr {command.mode_pr} (parallel motors) is not emulated")

    def _command_drives(self, now: int) -> list[Outgoing]:
        user: G1Command | None = None
        while self._commands and self._commands[0][0] <= now:
            user = self._commands.popleft()[1]
        if user is not None:
            self._motors.accept(user)
        if self._own.update(now):
            self._motors.accept(self._own.damped())
        if not self._own.name:
            self._own_waits = False
            return []
        beat = now % PERIOD_MS == 0
        if not beat and not self._own_waits:
            return []
        # Its commands and those of the user alternate, so the robot shakes.
        if beat and user is not None and not self._own_waits:
            self._own_waits = True
            return []
        self._own_waits = False
        command = self._own.command(now)
        self._motors.accept(command)
        return [(topics.LOW_COMMAND, self._encoder.encode(command))]

    def _report_state(self, now: int) -> list[Outgoing]:
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
