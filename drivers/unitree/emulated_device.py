"""An emulated robot of Unitree without real time and wire: what its firmware does in each millisecond."""

from __future__ import annotations

import abc
from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar, Final, Generic, TypeVar

import numpy as np

from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.command_log import CommandLog
from deal_hw.drivers.unitree.emulated_faults import StateFaults, WirePlan
from deal_hw.drivers.unitree.emulated_motors import PdMotors
from deal_hw.drivers.unitree.emulated_profile import SensorProfile
from deal_hw.drivers.unitree.emulated_truth import JointTruth
from deal_hw.drivers.unitree.motor_command import MotorCommand
from deal_hw.errors import FrameError
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.testing.joint_faults import HELD_DAMPING, FaultyJoints
from deal_hw.types import FloatArray

TICK_NS: Final = 1_000_000
STATE_MS: Final = 2
STOP_COMBINATION: Final = "L2+B"
SUBSCRIBED: Final = (topics.LOW_COMMAND, *(topics.request(name) for name in topics.SERVICES))
"""Topics that the robot reads."""
ASIDE_RAD: Final = 0.2
"""How far aside another program wants the joints [rad]."""
_MOST_RESTS: Final = 16
_RESTS: dict[tuple[int, bytes, bytes, SensorProfile], tuple[Any, FloatArray, FloatArray, FloatArray]] = {}
"""Simulation and motors of robots at rest, by how they began."""
Outgoing = tuple[str, bytes]
CommandT = TypeVar("CommandT", bound=MotorCommand)


class UnitreeDevice(abc.ABC, Generic[CommandT]):
    """The robot's mechanics, motors, firmware and services.

    Tick k, at device time k ms, has these steps. Received messages are handled, and commands that are due
    reach the motors. The motors compute their torques from the state at the start of the tick. At even ticks
    a LowState reports that state. One physics step of 1 ms follows. A message that arrives at exactly k ms is
    handled in tick k + 1.

    Attributes:
        subscribed: Topics that it reads.
        log: The user's commands, with times.
        joint_faults: Faults of the joints; may be given at any time.
        host_origin_ns: Host clock at device time 0, for the log [ns]; the caller keeps it correct.

    Args:
        sim: Its mechanics.
        truth: Hidden parameters.
        profile: Differences from ideal sensors and motors.
        plan: Faults to make.
        joints: Names of the joints, J.
        written: Topics that it may write; the last one is its own controller's.
        jitter_rng: Draws the delays of commands.
        fault_rng: Draws the faults of states.
        tick_ms: The robot's clock at the beginning.
    """

    subscribed: tuple[str, ...] = SUBSCRIBED
    own_period_ms: ClassVar[int]
    """Period of its own controller's commands."""

    _motors: PdMotors

    def __init__(
        self,
        sim: LeggedSimulation,
        truth: JointTruth,
        profile: SensorProfile,
        plan: WirePlan,
        *,
        joints: Sequence[str],
        written: tuple[str, ...],
        jitter_rng: np.random.Generator,
        fault_rng: np.random.Generator,
        tick_ms: int,
    ) -> None:
        self._sim, self._profile = sim, profile
        self._latency_ms, self._cut_s = truth.latency_ms, plan.cut_s
        self._friction, self._joint_damping = np.array(truth.frictionloss), np.array(truth.joint_damping)
        sim.set_dofs(
            damping=self._joint_damping, frictionloss=self._friction, armature=np.array(truth.armature)
        )
        self._bias = np.array(truth.encoder_bias)
        self._jitter_rng = jitter_rng
        self._service_of = {topics.request(name): name for name in topics.SERVICES}
        self._state_faults = StateFaults(plan, fault_rng)
        self.joint_faults = FaultyJoints(plan.joints, joints, range(len(joints)))
        self._due = deque(plan.due())
        self._inbox: list[tuple[str, bytes, int]] = []
        self._commands: deque[tuple[int, CommandT]] = deque()
        self._tick, self._tick_offset = 0, tick_ms
        self.host_origin_ns = 0
        self._frozen, self._cut_end, self._own_waits = False, 0, False
        self._sent = dict.fromkeys(written, 0)
        self._bad_requests = 0
        self.log = CommandLog()

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        return self._tick * TICK_NS

    @property
    def true_position(self) -> FloatArray:
        """True joint positions, (J,) [rad]; not reported."""
        return self._sim.position()

    @property
    def stiff(self) -> bool:
        """Whether a motor follows a position or gives a commanded torque."""
        return self._motors.stiff

    def jump_clock(self, seconds: float) -> None:
        """Let the robot's clock jump ahead, or back if negative [s]."""
        self._tick_offset += round(seconds * 1e3)

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
        if self.joint_faults.limp or self.joint_faults.held:
            self._motors.give_no_torque()
        if now % STATE_MS == 0:
            self._motors.warm(STATE_MS * 1e-3)
        out += self._reports(now)
        self._move(velocity)
        self._tick = now + 1
        if self._frozen or now < self._cut_end:
            return []
        for topic, _ in out:
            self._sent[topic] += 1
        return out

    def command_aside(self) -> bytes:
        """Return the message by which another program holds the joints a little aside of where they are."""
        return self._stiff_message(self._sim.position() + self._bias + ASIDE_RAD)

    def begin_fault(self, name: str) -> None:
        """Begin a fault; a plan calls this function at its time.

        Args:
            name: One of the ``MOMENTS`` of the robot's faults.
        """
        match name:
            case "freeze":
                self._frozen = True
            case "cut":
                self._cut_end = self._tick + round(self._cut_s * 1e3)
            case _:
                self._begin_own_fault(name)
        self.log.begin(name, self._tick, self.host_origin_ns + self._tick * TICK_NS)

    # What each robot does in its own way.

    @property
    @abc.abstractmethod
    def _own_name(self) -> str:
        """Mode of its own controller; "" once released."""

    @abc.abstractmethod
    def leave_own(self) -> None:
        """Let its own controller leave the robot at once, whatever it does; the motors keep its command."""

    @abc.abstractmethod
    def _stiff_message(self, position: FloatArray) -> bytes:
        """Return a message that holds the joints at positions, (J,) [rad]."""

    @abc.abstractmethod
    def _update_own(self, now: int) -> None:
        """Let its own controller follow the time."""

    @abc.abstractmethod
    def _own_command(self, now: int) -> tuple[CommandT, bytes | None]:
        """Return its own controller's command, and its message; None if that is not seen on the wire."""

    @abc.abstractmethod
    def _decode(self, payload: bytes) -> CommandT:
        """Return a user's command.

        Raises:
            FrameError: The robot does not take it.
        """

    @abc.abstractmethod
    def _answer(self, service: str, payload: bytes, position: FloatArray) -> bytes | None:
        """Return a service's response to a request, at measured positions (J,); None for none.

        Raises:
            FrameError: The payload is no request.
        """

    @abc.abstractmethod
    def _answered(self) -> int:
        """Return the number of answered requests."""

    @abc.abstractmethod
    def _reports(self, now: int) -> list[Outgoing]:
        """Return the messages that report the state at a tick."""

    @abc.abstractmethod
    def _begin_own_fault(self, name: str) -> None:
        """Begin a fault that not every robot has.

        Raises:
            ValueError: There is no such fault.
        """

    # The steps of a tick.

    def _let_time_pass(self, now: int) -> None:
        now_ns = now * TICK_NS
        if self.log.first_stiff_ms is not None:
            while self._due and self._due[0][0] <= now:
                self.begin_fault(self._due.popleft()[1])
            self.joint_faults.begin(now_ns)
        if (event := self.joint_faults.advance(now_ns)) is not None:
            self.log.begin(event or "sound joints", now, self.host_origin_ns + now_ns)

    def _move(self, velocity: FloatArray) -> None:
        """Run a physics step with the present motor efforts, from these velocities (J,)."""
        if self._profile.stribeck_ratio:
            slow = np.exp(-np.square(velocity / self._profile.stribeck_rad_s))
            self._sim.set_frictionloss(self._friction * (1.0 + self._profile.stribeck_ratio * slow))
        held = HELD_DAMPING if self.joint_faults.held else 0.0
        self._sim.set_damping(self._joint_damping + self._motors.brake + held)
        self._sim.step(self._motors.constant)

    def _settle(self, ticks: int) -> None:
        """Come to rest under the present command; device time does not advance.

        A bench or a test makes many robots that begin alike, so the rests of the last ones are kept.
        """
        motors = self._motors
        key = (ticks, self._sim.digest(), motors.contents(), self._profile)
        if key in _RESTS:
            saved, motors.effort, motors.constant, motors.brake = _RESTS[key]
            self._sim.load(saved)
            return
        for _ in range(ticks):
            velocity = self._sim.velocity()
            motors.update(self._sim.position(), velocity)
            self._move(velocity)
        while len(_RESTS) >= _MOST_RESTS:
            del _RESTS[next(iter(_RESTS))]
        _RESTS[key] = self._sim.save(), motors.effort, motors.constant, motors.brake

    def _handle(self, topic: str, payload: bytes, stamp_ns: int) -> list[Outgoing]:
        if topic == topics.LOW_COMMAND:
            self._take_command(payload, stamp_ns)
        elif (service := self._service_of.get(topic)) is not None:
            self.log.ask(service, self._tick, stamp_ns)
            try:
                answer = self._answer(service, payload, self._sim.position() + self._bias)
            except FrameError:
                self._bad_requests += 1
                return []
            return [] if answer is None else [(topics.response(service), answer)]
        return []

    def _take_command(self, payload: bytes, stamp_ns: int) -> None:
        try:
            command = self._decode(payload)
        except FrameError as error:
            self.log.refuse(str(error))
            return
        began = self.log.first_stiff_ms is not None
        self.log.accept(command, self._tick, stamp_ns)
        if not began and (first := self.log.first_stiff_ms) is not None:
            self._due = deque((first + after_ms, name) for after_ms, name in self._due)
        due = self._tick + self._latency_ms
        if jitter := self._profile.jitter_ms:
            due += int(self._jitter_rng.integers(0, jitter + 1))
        if self._commands:
            due = max(due, self._commands[-1][0])
        self._commands.append((due, command))

    def _command_drives(self, now: int) -> list[Outgoing]:
        user: CommandT | None = None
        while self._commands and self._commands[0][0] <= now:
            user = self._commands.popleft()[1]
        if user is not None:
            self._motors.accept(user)
        self._update_own(now)
        if not self._own_name:
            self._own_waits = False
            return []
        beat = now % self.own_period_ms == 0
        if not beat and not self._own_waits:
            return []
        # Its commands and those of the user alternate, so the robot shakes.
        if beat and user is not None and not self._own_waits:
            self._own_waits = True
            return []
        self._own_waits = False
        command, message = self._own_command(now)
        self._motors.accept(command)
        return [] if message is None else [(topics.LOW_COMMAND, message)]

    def _happened(self) -> dict[str, Any]:
        """Return messages, commands and faults so far, as plain JSON values."""
        return {
            "device_ms": self._tick,
            "sent": dict(self._sent),
            "wire_faults": dict(self._state_faults.counts),
            "requests_answered": self._answered(),
            "bad_requests": self._bad_requests,
            "sport": self._own_name,
            "commands": self.log.to_json(),
        }


def require_finite(command: MotorCommand) -> None:
    """Check that a command has only numbers.

    Raises:
        FrameError: One is not finite.
    """
    parts = command.position, command.velocity, command.stiffness, command.damping, command.effort
    if not np.isfinite(np.concatenate(parts)).all():
        raise FrameError("LowCmd: a number is not finite")
