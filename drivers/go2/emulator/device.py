"""The emulated Go2: mechanics, motors, firmware and services in virtual time. Messages in, messages out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, Literal

import numpy as np

from deal_hw.drivers.go2.descriptions.floor import JOINTS, LEGS
from deal_hw.drivers.go2.emulator.faults import FaultPlan
from deal_hw.drivers.go2.emulator.motors import Motors
from deal_hw.drivers.go2.emulator.remote_script import RemoteMoment
from deal_hw.drivers.go2.emulator.sensing import Sensing
from deal_hw.drivers.go2.emulator.sport_controller import LYING, PERIOD_MS, STANDING, Posture
from deal_hw.drivers.go2.emulator.sport_service import ServiceServer, SportMode
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import encode_low_state
from deal_hw.drivers.go2.messages.sport_state import POINTS, SportState, encode_sport_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.emulated_device import (
    STATE_MS,
    STOP_COMBINATION,
    TICK_NS,
    Outgoing,
    UnitreeDevice,
    require_finite,
)
from deal_hw.drivers.unitree.emulated_quadruped import QuadrupedTruth
from deal_hw.drivers.unitree.go_messages.low_state import LowState
from deal_hw.drivers.unitree.remote import Remote, encode_remote, encode_wireless, parse_combination
from deal_hw.rotations import heading
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.sim.legged.terrain import Terrain
from deal_hw.types import FloatArray

SLOW_MS: Final = 50
SPORT_STATE_PHASES: Final = (0, 3, 6)
"""Ticks of ten that send a SportModeState: 300 Hz, the rate seen on a robot."""
WIRELESS_MS: Final = 10
PUSH_MS: Final = 100
SETTLE_TICKS: Final = 1500


class Go2Device(UnitreeDevice[LowCommand]):
    """An emulated Go2, or another quadruped of its kind, without real time and wire.

    Attributes:
        sport_on_wire: Whether sport mode's own commands are published.

    Args:
        truth: Hidden parameters, profile, seed; of the robot that is emulated.
        on_stand: Whether the base is on a stand.
        start: Limp, lying or with its legs hanging down, or standing with sport mode in control.
        sport: Name of the sport mode that is active at power-up; "" for none.
        sport_on_wire: Whether sport mode's own commands are seen on ``rt/lowcmd``.
        plan: Faults to make.
        remote: The remote's states, in order of time; None: no remote is in reach.
        tick_ms: The robot's clock at the beginning.
        terrain: What is ahead of it on the floor; None for a flat floor.
    """

    own_period_ms: ClassVar[int] = PERIOD_MS

    def __init__(
        self,
        truth: QuadrupedTruth,
        *,
        on_stand: bool = False,
        start: Literal["lying", "standing"] = "lying",
        sport: str = "normal",
        sport_on_wire: bool = True,
        plan: FaultPlan | None = None,
        remote: Sequence[RemoteMoment] | None = (),
        tick_ms: int = 0,
        terrain: Terrain | None = None,
    ) -> None:
        self._truth, self._plan = truth, plan or FaultPlan()
        machine = self._machine = truth.machine
        profile = machine.profile(truth.profile)
        seeds = np.random.SeedSequence([truth.seed, machine.stream]).spawn(4)
        sensor_rng, jitter_rng, self._drop_rng, fault_rng = map(np.random.default_rng, seeds)
        mjcf = machine.stand_mjcf if on_stand else machine.floor_mjcf
        super().__init__(
            LeggedSimulation(mjcf, JOINTS, [f"{leg}_foot" for leg in LEGS], TICK_NS * 1e-9, terrain=terrain),
            truth,
            profile,
            self._plan,
            joints=JOINTS,
            written=PUBLISHED,
            jitter_rng=jitter_rng,
            fault_rng=fault_rng,
            tick_ms=tick_ms,
        )
        self._sim.add_payload(truth.payload_kg)
        self._sim.set_floor_friction(truth.floor_friction)
        self._motors = Motors(truth, profile)
        self._sensing = Sensing(self._sim, self._motors, truth, profile, sensor_rng, self.joint_faults)
        self._sport = SportMode(machine, sport)
        self._services = ServiceServer(self._sport)
        self.sport_on_wire = sport_on_wire
        self._encoder = LowCommandEncoder(machine.servo_modes[0])
        self._wire_faulty = self._state_faults.any and self._plan.wire_after_s is None
        self._hold(None if remote is None else Remote())
        self._remote_script = deque(remote or ())
        self._stale: bytes | None = None
        self._push_end: int | None = None
        self._last: LowState | None = None
        self._feet_before = np.zeros((4, 3)), 0
        self._largest_tilt = 0.0
        self._begin(start, np.array(machine.hanging) if on_stand else LYING)

    @property
    def published(self) -> tuple[str, ...]:
        """Topics that it writes."""
        return PUBLISHED if self.sport_on_wire else PUBLISHED[:-1]

    @property
    def types(self) -> Mapping[str, str]:
        """No topic has another type than usual."""
        return {}

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
        return float(heading(self._sim.orientation()))

    @property
    def tilt(self) -> float:
        """Angle between the base's z axis and the vertical [rad]; not reported."""
        _, x, y, _ = self._sim.orientation()
        return math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))

    @property
    def sport_name(self) -> str:
        """Name of the active sport mode; "" once released."""
        return self._sport.name

    def report(self) -> dict[str, Any]:
        """Return a report as plain JSON values: truth, messages, commands, faults, final state."""
        stiffness, damping = self._machine.stand_gains
        at_gains = f"parameters_at_kp{stiffness:g}_kd{damping:g}"
        return {
            **self._truth.to_json(),
            at_gains: self._truth.parameters(stiffness, damping),
            "walk_parameters": self._truth.walk_parameters(),
            **self._happened(),
            "base_height_m": self.base_height,
            "largest_tilt_rad": self._largest_tilt,
        }

    def _begin_own_fault(self, name: str) -> None:
        plan = self._plan
        match name:
            case "wire":
                self._wire_faulty = True
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

    # The steps of a tick.

    def _begin(self, start: str, limp: FloatArray) -> None:
        """Settle in the start posture; device time does not advance."""
        sim, motors, controller = self._sim, self._motors, self._sport.controller
        machine = self._machine
        stands = start == "standing"
        sim.set_pose(STANDING if stands else limp, machine.standing_m if stands else machine.lying_m)
        if stands:
            controller.take(Posture.STANDING, STANDING, -10_000)
        motors.accept(controller.command(0))
        self._settle(SETTLE_TICKS)
        if not self._sport.name and not stands:
            self._motors = self._sensing.motors = Motors(self._truth, self._profile)

    @property
    def _own_name(self) -> str:
        return self._sport.name

    def leave_own(self) -> None:
        """Let sport mode leave the robot at once."""
        self._sport.name = ""

    def _stiff_message(self, position: FloatArray) -> bytes:
        stiffness, damping = self._machine.stand_gains
        mode = np.full(12, self._machine.servo_modes[0])
        zero, ones = np.zeros(12), np.ones(12)
        return self._encoder.encode(LowCommand(position, zero, stiffness * ones, damping * ones, zero, mode))

    def _update_own(self, now: int) -> None:
        self._sport.update(now)

    def _own_command(self, now: int) -> tuple[LowCommand, bytes | None]:
        command = self._sport.controller.command(now)
        return command, self._encoder.encode(command) if self.sport_on_wire else None

    def _answer(self, service: str, payload: bytes, position: FloatArray) -> bytes | None:
        return self._services.answer(service, payload, position, self._tick)

    def _answered(self) -> int:
        return self._services.answered

    def _decode(self, payload: bytes) -> LowCommand:
        command = decode_low_command(payload)
        require_finite(command)
        return command

    def _let_time_pass(self, now: int) -> None:
        super()._let_time_pass(now)
        while self._remote_script and self._remote_script[0].at_ms <= now:
            self._hold(self._remote_script.popleft().remote)
        if self._push_end is not None and now >= self._push_end:
            self._sim.push((0.0, 0.0, 0.0))
            self._push_end = None

    def _reports(self, now: int) -> list[Outgoing]:
        out: list[Outgoing] = []
        if now % STATE_MS == 0:
            self._sensing.battery.drain(self._motors.effort, self._sim.velocity(), STATE_MS * 1e-3)
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
