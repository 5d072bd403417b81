"""The emulated Go2: mechanics, motors, firmware and services in virtual time. Messages in, messages out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

import numpy as np

from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION, JOINTS, LEGS
from deal_hw.drivers.go2.descriptions.on_stand_recording import DESCRIPTION as RECORDED
from deal_hw.drivers.go2.emulator.faults import FaultPlan
from deal_hw.drivers.go2.emulator.motors import Motors
from deal_hw.drivers.go2.emulator.profiles import profile as find_profile
from deal_hw.drivers.go2.emulator.remote_script import RemoteMoment
from deal_hw.drivers.go2.emulator.sensing import Sensing
from deal_hw.drivers.go2.emulator.sport_controller import LYING, PERIOD_MS, STANDING, Posture
from deal_hw.drivers.go2.emulator.sport_service import ServiceServer, SportMode
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import LowState, encode_low_state
from deal_hw.drivers.go2.messages.sport_state import POINTS, SportState, encode_sport_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.command_log import CommandLog
from deal_hw.drivers.unitree.emulated_faults import StateFaults
from deal_hw.drivers.unitree.remote import Remote, encode_remote, encode_wireless, parse_combination
from deal_hw.errors import FrameError
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.types import FloatArray

TICK_NS: Final = 1_000_000
STATE_MS: Final = 2
SLOW_MS: Final = 50
SPORT_STATE_PHASES: Final = (0, 3, 6)
"""Ticks of ten that send a SportModeState: 300 Hz, the rate seen on a robot."""
WIRELESS_MS: Final = 10
PUSH_MS: Final = 100
SETTLE_TICKS: Final = 1500
STOP_COMBINATION: Final = "L2+B"
LEGS_DOWN: Final = np.tile((0.0, 0.34, -0.85), 4)
"""Pose of limp legs in the air, without the hips: the calf's weight opens the knee to its stop."""

Outgoing = tuple[str, bytes]


class Go2Device:
    """An emulated Go2 without real time and wire.

    Tick k, at device time k ms, has these steps. Received messages are handled, and commands that are due
    reach the motors. The motors compute their torques from the state at the start of the tick. At even ticks
    a LowState reports that state. One physics step of 1 ms follows. A message that arrives at exactly k ms is
    handled in tick k + 1.

    Attributes:
        log: The user's commands, with times.
        sport_on_wire: Whether sport mode's own commands are published.
        host_origin_ns: Host clock at device time 0, for the log [ns]; the caller keeps it correct.

    Args:
        truth: Hidden parameters, profile, seed.
        on_stand: Whether the base is on a stand.
        start: Limp, lying or with its legs hanging down, or standing with sport mode in control.
        sport: Name of the sport mode that is active at power-up; "" for none.
        sport_on_wire: Whether sport mode's own commands are seen on ``rt/lowcmd``.
        plan: Faults to make.
        remote: The remote's states, in order of time; None: no remote is in reach.
        tick_ms: The robot's clock at the beginning.
    """

    def __init__(
        self,
        truth: Go2Truth,
        *,
        on_stand: bool = False,
        start: Literal["lying", "standing"] = "lying",
        sport: str = "normal",
        sport_on_wire: bool = True,
        plan: FaultPlan | None = None,
        remote: Sequence[RemoteMoment] | None = (),
        tick_ms: int = 0,
    ) -> None:
        self._truth = truth
        self._profile = profile = find_profile(truth.profile)
        self._plan = plan or FaultPlan()
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence([truth.seed, 0x602]).spawn(4)]
        sensor_rng, self._jitter_rng, self._drop_rng, fault_rng = streams
        mjcf = (RECORDED if on_stand else DESCRIPTION).mjcf
        self._sim = LeggedSimulation(mjcf, JOINTS, [f"{leg}_foot" for leg in LEGS], TICK_NS * 1e-9)
        self._friction = np.array(truth.frictionloss)
        self._joint_damping = np.array(truth.joint_damping)
        self._sim.set_dofs(
            damping=self._joint_damping, frictionloss=self._friction, armature=np.array(truth.armature)
        )
        self._sim.add_payload(truth.payload_kg)
        self._sim.set_floor_friction(truth.floor_friction)
        self._bias = np.array(truth.encoder_bias)
        self._motors = Motors(truth, profile)
        self._sensing = Sensing(self._sim, self._motors, truth, profile, sensor_rng)
        self._sport = SportMode(sport)
        self._services = ServiceServer(self._sport)
        self._service_of = {topics.request(name): name for name in topics.SERVICES}
        self.sport_on_wire, self._sport_waits = sport_on_wire, False
        self._encoder = LowCommandEncoder()
        self._state_faults = StateFaults(self._plan, fault_rng)
        self._due = deque(self._plan.due())
        self._wire_faulty = self._state_faults.any and self._plan.wire_after_s is None
        self._hold(None if remote is None else Remote())
        self._remote_script = deque(remote or ())
        self._inbox: list[tuple[str, bytes, int]] = []
        self._commands: deque[tuple[int, LowCommand]] = deque()
        self._tick, self._tick_offset = 0, tick_ms
        self.host_origin_ns = 0
        self._frozen, self._cut_end = False, 0
        self._stale: bytes | None = None
        self._push_end: int | None = None
        self._last: LowState | None = None
        self._feet_before = np.zeros((4, 3)), 0
        self._sent = dict.fromkeys(PUBLISHED, 0)
        self._bad_requests = 0
        self._largest_tilt = 0.0
        self.log = CommandLog()
        self._begin(start, LEGS_DOWN if on_stand else LYING)

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        return self._tick * TICK_NS

    @property
    def published(self) -> tuple[str, ...]:
        """Topics that it writes."""
        return PUBLISHED if self.sport_on_wire else PUBLISHED[:-1]

    @property
    def subscribed(self) -> tuple[str, ...]:
        """Topics that it reads."""
        return SUBSCRIBED

    @property
    def types(self) -> Mapping[str, str]:
        """No topic has another type than usual."""
        return {}

    @property
    def true_position(self) -> FloatArray:
        """True joint positions, (12,) [rad]; not reported."""
        return self._sim.position()

    @property
    def base_position(self) -> FloatArray:
        """True position of the base in the world, (3,) [m]; not reported."""
        return self._sim.base_position()

    @property
    def base_height(self) -> float:
        """Height of the base over the floor [m]; not reported."""
        return float(self.base_position[2])

    @property
    def heading(self) -> float:
        """Angle of the base's x axis about the vertical, from the world's x axis [rad]; not reported."""
        w, x, y, z = self._sim.orientation()
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def tilt(self) -> float:
        """Angle between the base's z axis and the vertical [rad]; not reported."""
        _, x, y, _ = self._sim.orientation()
        return math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))

    @property
    def sport_name(self) -> str:
        """Name of the active sport mode; "" once released."""
        return self._sport.name

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
        self._let_time_pass(now)
        out += self._command_drives(now)
        velocity = self._sim.velocity()
        self._motors.update(self._sim.position(), velocity)
        if now % STATE_MS == 0:
            self._motors.warm(STATE_MS * 1e-3)
            self._sensing.battery.drain(self._motors.effort, velocity, STATE_MS * 1e-3)
        out += self._reports(now)
        self._move(velocity)
        self._tick = now + 1
        if self._frozen or now < self._cut_end:
            return []
        for topic, _ in out:
            self._sent[topic] += 1
        return out

    def report(self) -> dict[str, Any]:
        """Return a report as plain JSON values: truth, messages, commands, faults, final state."""
        return {
            **self._truth.to_json(),
            "parameters_at_kp20_kd1.5": self._truth.parameters(20.0, 1.5),
            "walk_parameters": self._truth.walk_parameters(),
            "device_ms": self._tick,
            "sent": dict(self._sent),
            "wire_faults": dict(self._state_faults.counts),
            "requests_answered": self._services.answered,
            "bad_requests": self._bad_requests,
            "sport": self._sport.name,
            "commands": self.log.to_json(),
            "base_height_m": self.base_height,
            "largest_tilt_rad": self._largest_tilt,
        }

    # Faults, at any time; a plan calls the same function.

    def begin_fault(self, name: str) -> None:
        """Begin a fault.

        Args:
            name: One of ``deal_hw.drivers.go2.emulator.faults.MOMENTS``.
        """
        plan = self._plan
        match name:
            case "wire":
                self._wire_faulty = True
            case "freeze":
                self._frozen = True
            case "cut":
                self._cut_end = self._tick + round(plan.cut_s * 1e3)
            case "stale":
                self._stale = encode_low_state(self._last or self._state(self._tick))
            case "lost":
                self._motors.lose(JOINTS.index(plan.lost_joint))
            case "sport":
                self._sport.select("normal", self._sim.position() + self._bias, self._tick)
            case "battery":
                self._sensing.empty_battery()
            case "nan":
                self._sensing.broken = JOINTS.index(plan.nan_joint)
            case "hot":
                self._sensing.hot = JOINTS.index(plan.hot_joint)
            case "stop":
                self._hold(Remote(parse_combination(STOP_COMBINATION)))
                self._remote_script.clear()
            case "push":
                self._sim.push((0.0, plan.push / (PUSH_MS * 1e-3), 0.0))
                self._push_end = self._tick + PUSH_MS
            case _:
                raise ValueError(f"no such fault: {name!r}")
        self.log.begin(name, self._tick, self.host_origin_ns + self._tick * TICK_NS)

    # The steps of a tick.

    def _begin(self, start: str, limp: FloatArray) -> None:
        """Settle in the start posture; device time does not advance."""
        sim, motors, controller = self._sim, self._motors, self._sport.controller
        sim.set_pose(STANDING if start == "standing" else limp, 0.34 if start == "standing" else 0.13)
        if start == "standing":
            controller.take(Posture.STANDING, STANDING, -10_000)
        motors.accept(controller.command(0))
        for _ in range(SETTLE_TICKS):
            velocity = sim.velocity()
            motors.update(sim.position(), velocity)
            self._move(velocity)
        if not self._sport.name and start == "lying":
            self._motors = self._sensing.motors = Motors(self._truth, self._profile)

    def _move(self, velocity: FloatArray) -> None:
        """Run a physics step with the present motor efforts, from these velocities (12,)."""
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
                answer = self._services.answer(
                    service, payload, self._sim.position() + self._bias, self._tick
                )
            except FrameError:
                self._bad_requests += 1
                return []
            return [] if answer is None else [(topics.response(service), answer)]
        return []

    def _take_command(self, payload: bytes, stamp_ns: int) -> None:
        try:
            command = decode_low_command(payload)
            _check_finite(command)
        except FrameError as error:
            self.log.refuse(str(error))
            return
        if self.log.first_stiff_ms is None:
            self.log.accept(command, self._tick, stamp_ns)
            if (first := self.log.first_stiff_ms) is not None:
                self._due = deque((first + after_ms, name) for after_ms, name in self._due)
        else:
            self.log.accept(command, self._tick, stamp_ns)
        due = self._tick + self._truth.latency_ms
        if jitter := self._profile.jitter_ms:
            due += int(self._jitter_rng.integers(0, jitter + 1))
        if self._commands:
            due = max(due, self._commands[-1][0])
        self._commands.append((due, command))

    def _let_time_pass(self, now: int) -> None:
        if self.log.first_stiff_ms is not None:
            while self._due and self._due[0][0] <= now:
                self.begin_fault(self._due.popleft()[1])
        while self._remote_script and self._remote_script[0].at_ms <= now:
            self._hold(self._remote_script.popleft().remote)
        if self._push_end is not None and now >= self._push_end:
            self._sim.push((0.0, 0.0, 0.0))
            self._push_end = None

    def _command_drives(self, now: int) -> list[Outgoing]:
        user: LowCommand | None = None
        while self._commands and self._commands[0][0] <= now:
            user = self._commands.popleft()[1]
        if user is not None:
            self._motors.accept(user)
        self._sport.update(now)
        if not self._sport.name:
            self._sport_waits = False
            return []
        beat = now % PERIOD_MS == 0
        if not beat and not self._sport_waits:
            return []
        # Commands of sport mode and of the user alternate, so the robot shakes.
        if beat and user is not None and not self._sport_waits:
            self._sport_waits = True
            return []
        self._sport_waits = False
        command = self._sport.controller.command(now)
        self._motors.accept(command)
        return [(topics.LOW_COMMAND, self._encoder.encode(command))] if self.sport_on_wire else []

    def _reports(self, now: int) -> list[Outgoing]:
        out: list[Outgoing] = []
        if now % STATE_MS == 0:
            self._last = state = self._state(now)
            self._largest_tilt = max(self._largest_tilt, self.tilt)
            payload = self._stale or encode_low_state(state)
            if not (self._profile.drop and self._drop_rng.random() < self._profile.drop):
                sent = self._state_faults.apply(payload) if self._wire_faulty else [payload]
                out += [(topics.LOW_STATE, one) for one in sent]
            if now % SLOW_MS == 0:
                out.append((topics.LOW_STATE_SLOW, payload))
        if self._sport.name and (now % 10 in SPORT_STATE_PHASES or now % SLOW_MS == 0):
            payload = self._sport_state(now)
            if now % 10 in SPORT_STATE_PHASES:
                out.append((topics.SPORT_STATE, payload))
            if now % SLOW_MS == 0:
                out.append((topics.SPORT_STATE_SLOW, payload))
        if self._remote is not None and now % WIRELESS_MS == 0:
            out.append((topics.WIRELESS, encode_wireless(self._remote)))
        return out

    def _state(self, now: int) -> LowState:
        return self._sensing.state((now + self._tick_offset) & 0xFFFF_FFFF, self._remote_bytes)

    def _hold(self, remote: Remote | None) -> None:
        self._remote, self._remote_bytes = remote, encode_remote(remote)

    def _sport_state(self, now: int) -> bytes:
        low = self._last or self._state(now)
        controller = self._sport.controller
        feet = self._sim.foot_position()
        before, before_ms = self._feet_before
        foot_velocity = (feet - before) / ((now - before_ms) * 1e-3) if now > before_ms else np.zeros((4, 3))
        self._feet_before = feet, now
        position = self._sim.base_position()
        return encode_sport_state(
            SportState(
                stamp_ns=now * TICK_NS,
                error_code=0,
                orientation=low.orientation,
                angular_velocity=low.angular_velocity,
                specific_force=low.specific_force,
                rpy=low.rpy,
                imu_temperature=low.imu_temperature,
                mode=controller.posture.value,
                progress=controller.progress(now),
                gait=0,
                foot_raise_height=0.0,
                position=position,
                body_height=float(position[2]),
                velocity=self._sim.base_velocity(),
                yaw_speed=float(low.angular_velocity[2]),
                range_obstacle=np.zeros(4),
                foot_force=low.foot_force,
                foot_position=feet,
                foot_velocity=foot_velocity,
                path=np.zeros((POINTS, 7)),
            )
        )


PUBLISHED: Final = (
    topics.LOW_STATE,
    topics.LOW_STATE_SLOW,
    topics.SPORT_STATE,
    topics.SPORT_STATE_SLOW,
    topics.WIRELESS,
    *(topics.response(name) for name in topics.SERVICES),
    topics.LOW_COMMAND,
)
"""Topics that the robot writes; the last one is sport mode's."""
SUBSCRIBED: Final = (topics.LOW_COMMAND, *(topics.request(name) for name in topics.SERVICES))
"""Topics that the robot reads."""


def _check_finite(command: LowCommand) -> None:
    parts = command.position, command.velocity, command.stiffness, command.damping, command.effort
    if not np.isfinite(np.concatenate(parts)).all():
        raise FrameError("LowCmd: a number is not finite")
