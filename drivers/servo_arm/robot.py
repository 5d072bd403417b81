"""An arm whose joints are servos on one bus: reads and commands all of them together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Final, NamedTuple

import numpy as np

from deal_hw.clock import Clock
from deal_hw.control.safety.following import FollowingWatch
from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.absence import AbsenceWatch, CollisionWatch
from deal_hw.drivers.servo_arm.commands import CommandCodec, Registers, clipped
from deal_hw.drivers.servo_arm.examination import ArmExamination, ArmInfo
from deal_hw.drivers.servo_arm.families import DAMPING, OFF, ON, Family, ServoSample
from deal_hw.drivers.servo_bus.interface import (
    BITS_PER_BYTE,
    ServoBus,
    SilentServosError,
    SpoiltAnswerError,
    Writes,
)
from deal_hw.drivers.servo_bus.polled_robot import PolledRobot, status_of, two_servos
from deal_hw.drivers.servo_bus.samples import SampleGrid
from deal_hw.errors import FrameError, SafetyError, TransportTimeoutError
from deal_hw.motions.behaviours import position_command
from deal_hw.sim.robots.hardware_section import RAD, HardwareSection
from deal_hw.transport import Transport
from deal_hw.types import FloatArray, JointCommand, RobotState, Status

_HOMING_RAD_S: Final = 0.5
"""Fastest joint on the way to the start pose [rad/s]: a person beside the arm can step back."""
_ARRIVED_RAD: Final = 0.2
"""Homing ends this near to the start pose: proportional control sags under gravity [rad]."""
_SETTLED_RAD_S: Final = 0.1
_REACH: Final = 3.0
"""A joint that moved further than at this multiple of its velocity limit was misread, the first time."""
_JUMP_TICKS: Final = 30
"""And by more than this: an encoder's noise is a few ticks."""
_PATIENCE_NS: Final = 200_000_000
"""For one sample on the way to the start pose [ns]."""
_MOST_FAILURES: Final = 5
"""Failed requests in a row that raise; with 5 % corrupt answers this happens once in 10**6."""


class _Sent(NamedTuple):
    """A sent command, with the goals by which the servos show that they follow it."""

    sequence: int
    sent_ns: int
    goals: Mapping[int, int]


class ServoArm(PolledRobot[ServoBus]):
    """An arm of servos.

    A state needs all servos. They have no common clock: times are this computer's, and each servo's position
    is moved from its turn on the wire to the state's time by its velocity. Every sample holds the servos'
    goals: a command counts as in force once all show it.

    Zeros and directions are those of robot.yaml; the servos' own are not changed. The command's stiffness and
    damping scale the gains that belong to those of the description. The reported effort is the motor's duty
    times the effort limit, which is right for a motor that stands still.

    Connecting changes nothing on the servos: an arm that a killed run left stiff stays up.

    Attributes:
        info: What the servos report; None before ``connect``.
        source: Where ids, zeros and directions stand, for messages.

    Args:
        transport: A byte stream at the bus' baud rate.
        clock: The clock of the transport's stamps.
        description: The robot.
        hardware: Its servos.
        family: Their kind.
    """

    stopped_by = "the servos' supply switch"
    lowers: ClassVar[bool] = True
    source: ClassVar[str] = "robot.yaml"
    info: ArmInfo | None

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        description: RobotDescription,
        hardware: HardwareSection,
        family: Family,
    ) -> None:
        bus = family.bus(transport, clock, hardware.baud_rate, hardware.answer_ms * 1e-3)
        super().__init__(transport, clock, bus, description.state_rate_hz, "the servos' supply and cable")
        self.description = description  # type: ignore[misc]  # A user's robot is known at run time.
        self._family = family
        self._take_hardware(hardware)
        self._ids = tuple(servo.id for servo in self._servos)
        self._rest = tuple(servo.rest for servo in self._servos)
        self.watchdog_s = family.watchdog_s  # type: ignore[misc]
        fastest = max((v for v in description.limits.trip_velocity if np.isfinite(v)), default=np.inf)
        self._reach = _REACH * fastest / RAD
        self._forget()

    def _take_hardware(
        self, hardware: HardwareSection, limits: Mapping[int, tuple[int, int]] | None = None
    ) -> None:
        """Take the servos' facts and, by id, the range of their goals [ticks]."""
        self._hardware = hardware
        self._codec = CommandCodec(self.description, hardware, limits)
        self._servos = self._codec.joints

    def _forget(self) -> None:
        super()._forget()
        self._grid = SampleGrid(round(self._period_ns / 1e3))
        self._in_force: _Sent | None = None
        self._written: Registers | None = None
        self._begin_ns = self._clock.now_ns()
        self._absence = AbsenceWatch(self._ids, self._begin_ns)
        self._collision = CollisionWatch(self._ids, self._begin_ns)
        self._newest: dict[int, ServoSample] = {}
        self._newest_ns = self._unsound = 0
        self._doubted = self._holds = False
        self._found_limp: FloatArray | None = None

    def _examine(self) -> ArmInfo:
        """Find all servos, and check their models and settings; nothing is changed."""
        return self._examination().run()

    def _examination(self) -> ArmExamination:
        return ArmExamination(
            self._bus, self._family, self._hardware, self.description, self._where, self.source
        )

    # Motion to the start pose, and torque.

    def home(self, timeout_s: float) -> None:
        """Give torque where the arm is, and move all joints on straight lines to the start pose, slowly.

        Raises:
            TransportTimeoutError: It did not arrive, or the servos fell silent.
            SafetyError: A joint is outside its range, or a servo reports an error.
        """
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        self._homed, self._homing = False, True
        try:
            start = self._torque_on(end_ns)
            self._move(start, np.array(self.description.default_position), end_ns)
            self._homed = True
        except Exception:
            # Not after the operator's stop, which lowers the arm first.
            self.passive()
            raise
        finally:
            self._homing = False

    def arm(self, timeout_s: float) -> None:
        """Give torque where the arm is, if it has none.

        Raises:
            SafetyError: It was never homed, or a servo reports an error.
        """
        if not self._homed:
            raise SafetyError(
                f"{self.description.name}: the arm was not brought to its start pose; call home() first"
            )
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if any(sample.torque != ON for sample in self._samples(end_ns).values()):
            self._torque_on(end_ns)
        # A watchdog that tripped since homing is cleared.
        self._bus.post(self._family.alive(self._ids, True))
        self._states.clear()
        self._asked = ()
        while True:
            state = self.read_state(self._left_s(end_ns))
            if Status.ARMED in state.status and Status.WATCHDOG not in state.status:
                break
        self._states.append(state)
        self._armed, self._anchored, self._alive_ns = True, False, self._clock.now_ns()
        self._sent.clear()
        self._grid.begin()

    def lower(self, timeout_s: float) -> str:
        """Move all joints on straight lines to where the arm may go limp, slowly.

        That is the rest pose of robot.yaml, or else the pose in which this run found the arm without torque.
        An arm that had torque, as after a killed run, has no such pose: it stays where it is.

        Raises:
            TransportTimeoutError: It did not arrive, or the servos fell silent.
            SafetyError: A joint does not follow, or a servo reports an error.
        """
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        rest = self._found_limp if None in self._rest else np.array(self._rest, dtype=float)
        self._asked = ()
        samples = self._samples(end_ns)
        # With the nominal gains and limits: those of the last command may be too weak to carry the arm.
        self._written = None
        self._bus.post(self._writes(self._codec.at({i: clipped(one.ticks) for i, one in samples.items()})))
        if rest is not None:
            self._move(self._codec.positions(samples), rest, end_ns)
            return ""
        self._holds = True
        return (
            f"{self.description.name} holds its pose with stiff motors, since no pose is known in which it "
            f"may go limp. Hold the arm, then switch its torque off: deal-hw stop ROBOT --port {self._where}"
            f". A `rest` of each servo ({self.source}) lets a run lower it"
        )

    def _torque_on(self, end_ns: int) -> FloatArray:
        """Give torque at the measured positions, with the nominal gains; return these, (J,) [rad]."""
        samples = self._clear_faults(end_ns)
        start = self._codec.positions(samples)
        self._check_start(start)
        self._holds = False
        if all(sample.torque != ON for sample in samples.values()):
            self._found_limp = start
        registers = self._codec.at({i: clipped(sample.ticks) for i, sample in samples.items()})
        self._written = None
        while True:
            # The goal comes before the torque: a servo would jump to an old one.
            self._bus.post(
                [
                    *self._family.alive(self._ids, False),
                    *self._family.prepare(self._ids),
                    *self._writes(registers),
                ]
            )
            if all(sample.goal == registers.goals[i] for i, sample in self._samples(end_ns).items()):
                break
            self._require_time(end_ns, "the servos do not take their goals")
        while True:
            self._bus.post(self._family.torque(self._ids, ON))
            if all(sample.torque == ON for sample in self._samples(end_ns).values()):
                break
            self._require_time(end_ns, "the servos give no torque")
        # From here on they notice when this host dies.
        self._bus.post(self._family.alive(self._ids, True))
        self._written = registers
        return start

    def _require_time(self, end_ns: int, what: str) -> None:
        if self._clock.now_ns() >= end_ns:
            raise TransportTimeoutError(f"{self._where}: {what}; switch their supply off and on")

    def _check_start(self, start: FloatArray) -> None:
        limits = self.description.limits.trip_position
        for servo, at, (low, high) in zip(self._servos, start, limits, strict=True):
            if not low <= at <= high:
                raise SafetyError(
                    f"{self.description.name}: joint {servo.joint} is at {at:.2f} rad, outside {low:.2f} "
                    f"to {high:.2f}: move it by hand (without torque: deal-hw stop), or check zero and "
                    f"direction of its servo ({self.source})"
                )

    def _move(self, start: FloatArray, end: FloatArray, end_ns: int) -> None:
        """Move the joints on straight lines to a pose, and wait until they are near and still.

        Raises:
            SafetyError: A joint does not follow, or a servo reports an error.
            TransportTimeoutError: The arm did not arrive in time.
        """
        watch, index = FollowingWatch(self.description), list(self.description.actuated_index)
        fastest = min(_HOMING_RAD_S, *(0.5 * v for v in self.description.limits.trip_velocity))
        steps = max(round(np.abs(end - start).max() / fastest * self.description.state_rate_hz), 1)
        step, target = 0, start
        while True:
            # Before the next goals are sent: these would hide the goals of another program.
            samples = self._samples(self._clock.now_ns() + _PATIENCE_NS)
            self._judge(samples)
            if self._fault:
                raise SafetyError(self._fault)
            position, velocity = self._codec.positions(samples), self._codec.velocities(samples)
            command = position_command(self.description, target[index])
            lost = watch.step(self._clock.now_ns(), position[index], velocity[index], command)
            if lost is not None:
                raise SafetyError(f"{self.description.name}: {lost.reason}")
            off = np.abs(position - end)
            if step == steps and off.max() < _ARRIVED_RAD and np.abs(velocity).max() < _SETTLED_RAD_S:
                return
            if self._clock.now_ns() >= end_ns:
                worst = int(off.argmax())
                raise TransportTimeoutError(
                    f"{self.description.name}: joint {self._servos[worst].joint} is still {off[worst]:.2f} "
                    "rad from its pose: it is blocked, or its gain is too low to carry the arm"
                )
            step = min(step + 1, steps)
            target = start + (end - start) * step / steps
            self._bus.post(self._family.goals(self._codec.goals(target)))
            self._clock.sleep_until_ns(self._poller.asked_ns + self._period_ns)

    def _clear_faults(self, end_ns: int) -> dict[int, ServoSample]:
        """Clear a fault if the servos report none now; return their samples."""
        samples = self._samples(end_ns)
        self._fault, self._watchdog = "", False
        self._judge(samples)
        if self._fault:
            raise SafetyError(self._fault)
        self._grid.begin()
        return samples

    def _samples(self, end_ns: int) -> dict[int, ServoSample]:
        """Return a sample of every servo, now.

        Raises:
            TransportTimeoutError: The servos are silent, or one of them; then the message names it.
            FrameError: Their answers are corrupt.
        """
        address, size = self._family.block
        self._absence.answered(self._clock.now_ns())
        failures, patient_ns = 0, self._clock.now_ns() + _PATIENCE_NS
        while True:
            try:
                self._poller.asked_ns = self._bus.ask(self._absence.order, address, size)
                found = self._bus.take(end_ns)
            except (SilentServosError, FrameError) as error:
                if why := self._named(error):
                    raise TransportTimeoutError(f"{self._where}: {why}") from error
                failures += 1
                now_ns = self._clock.now_ns()
                if now_ns >= end_ns or (failures >= _MOST_FAILURES and now_ns >= patient_ns):
                    raise
                self._bus.settle()
                continue
            if found is None:
                raise TransportTimeoutError(f"{self._where}: the servos do not answer in time")
            self._poller.answered()
            if why := self._answered():
                raise SafetyError(f"{self._where}: {why}")
            return {i: self._family.sample(i, data) for i, data in found.items()}

    # States.

    def _whom(self) -> tuple[int, ...]:
        return self._absence.order

    def _request(self, servos: tuple[int, ...]) -> int:
        return self._bus.ask(servos, *self._family.block)

    def _take(self, deadline_ns: int) -> None:
        try:
            found = self._bus.take(deadline_ns)
        except (SilentServosError, FrameError) as error:
            self._asked = ()
            self._latch(self._named(error))
            return
        if found is None:
            return
        asked, self._asked = self._asked, ()
        self._poller.answered()
        why = self._answered()
        if asked != self._ids:
            # In the other order the times of the servos' turns are others.
            return
        samples = {i: self._family.sample(i, data) for i, data in found.items()}
        if self._sound(samples):
            self._receive(samples)
            # A servo's own fault comes first: one that restarts has a goal that nobody sent.
            self._latch(why)
        else:
            self._unsound += 1

    def _sound(self, samples: Mapping[int, ServoSample]) -> bool:
        """Return whether a sample follows from the one before it; if not, the next one is taken as it is.

        A check of 8 bits lets one of some hundred corrupt answers pass. One of these must neither trip a run
        nor reach a policy.
        """
        before, since_s = self._newest, (self._poller.asked_ns - self._newest_ns) / 1e9
        self._newest, self._newest_ns = dict(samples), self._poller.asked_ns
        if not before:
            return True
        most = self._reach * since_s + _JUMP_TICKS
        far = any(abs(one.ticks - before[i].ticks) > most for i, one in samples.items())
        changed = any(
            (bool(one.fault), one.torque) != (bool(before[i].fault), before[i].torque)
            for i, one in samples.items()
        )
        if (far or (self._armed and changed)) and not self._doubted:
            self._doubted, self._newest = True, before
            return False
        self._doubted = False
        return True

    def _answered(self) -> str:
        """Note that all servos answered; return what is wrong with the bus all the same, or ""."""
        now_ns = self._clock.now_ns()
        self._absence.answered(now_ns)
        if not self._bus.doubled:
            self._collision.answered(now_ns)
            return self._foreign()
        return self._foreign() or self._collided([i for i in self._ids if i not in self._bus.doubled])

    def _named(self, error: SilentServosError | FrameError) -> str:
        """Return what a failed request shows, and what to do; "" while it is not known.

        While no servo answers, it is the cable or the supply of all, and states grow old.
        """
        if foreign := self._foreign():
            return foreign
        if isinstance(error, SpoiltAnswerError):
            return self._collided(error.answered)
        if not isinstance(error, SilentServosError):
            return ""
        absent = self._absence.missed(error.answered, self._clock.now_ns())
        if absent is None:
            return ""
        return (
            f"servo {absent} ({self._joint(absent)}) stopped answering: it restarted, or lost its supply or "
            "its cable. Check both, end other programs on the bus, then start again"
        )

    def _collided(self, answered: Sequence[int]) -> str:
        """Return of which servo alone the answers are corrupt, by those that answered soundly."""
        servo = self._collision.missed(answered, self._clock.now_ns())
        return "" if servo is None else two_servos(servo, self._joint(servo))

    def _foreign(self) -> str:
        """Return that another program commands the servos, and what to do; "" if none does."""
        sign = self._bus.watch.sign
        return "" if sign is None else sign.text("" if sign.servo is None else self._joint(sign.servo))

    def _joint(self, servo: int) -> str:
        return next(one.joint for one in self._servos if one.id == servo)

    def _receive(self, samples: Mapping[int, ServoSample]) -> None:
        self._judge(samples)
        byte_us = BITS_PER_BYTE * 1e6 / self._hardware.baud_rate
        answer_us = self._bus.answer_bytes(1, self._family.block[1], False) * byte_us
        # The first servo answers when it has read the request.
        request_us = (self._family.request_bytes + len(self._ids)) * byte_us
        first_us = round((self._poller.asked_ns - self._begin_ns) / 1e3 + request_us)
        shift_us = self._grid.place(first_us)
        if shift_us is None:
            return
        device_ns = (first_us + shift_us) * 1000
        self._follow(samples, device_ns)
        velocity = self._codec.velocities(samples)
        # A servo's turn on the wire comes after those before it.
        turn_us = np.arange(len(self._ids)) * answer_us
        sent = self._in_force
        self._states.append(
            RobotState(
                position=self._codec.positions(samples) + velocity * 1e-6 * (shift_us - turn_us),
                velocity=velocity,
                effort=self._codec.efforts(samples),
                receive_ns=self._bus.stamp_ns,
                device_ns=device_ns,
                sequence=self._grid.number,
                command_sequence=-1 if sent is None else sent.sequence,
                command_age_ns=-1 if sent is None else device_ns - (sent.sent_ns - self._begin_ns),
                status=self._status(samples),
            )
        )

    def _judge(self, samples: Mapping[int, ServoSample]) -> None:
        """Latch a servo's reported error, or lost torque."""
        for servo in self._servos:
            sample = samples[servo.id]
            if sample.fault:
                self._latch(f"servo {servo.id} ({servo.joint}) reports: {sample.fault}")
            if self._armed and sample.torque != ON:
                self._homed = self._armed = False
                self._latch(
                    f"servo {servo.id} ({servo.joint}) lost its torque: it restarted, or another program "
                    "uses the bus. Check the supply, end other programs, then start again"
                )

    def _follow(self, samples: Mapping[int, ServoSample], device_ns: int) -> None:
        """Find the command that the servos follow."""
        asked = [sent for sent in self._sent if sent.sent_ns <= self._poller.asked_ns]
        if not asked:
            return
        goals = {i: samples[i].goal for i in self._ids}
        found = next((sent for sent in reversed(asked) if sent.goals == goals), None)
        if found is not asked[-1] and asked[-1].sequence != self._missed_command:
            self._missed_command = asked[-1].sequence
            self._lost_commands += 1
            # A lost packet may have had gains, too.
            self._written = None
        if found is None or found.sent_ns - self._begin_ns > device_ns:
            # The sample was moved back to its point on the grid, before the command arrived.
            return
        self._in_force = found
        while self._sent[0] is not found:
            self._sent.popleft()

    def _status(self, samples: Mapping[int, ServoSample]) -> Status:
        return status_of(
            {
                Status.ARMED: not self._holds and all(sample.torque == ON for sample in samples.values()),
                Status.HOMED: self._homed,
                Status.HOMING: self._homing,
                Status.WATCHDOG: self._watchdog or any(sample.tripped for sample in samples.values()),
                Status.FAULT: self._fault,
            }
        )

    # Commands.

    def send_command(self, command: JointCommand) -> JointCommand:
        """Send position targets; no register takes a velocity target or a feed-forward effort.

        Raises:
            SafetyError: A value is not finite.
        """
        registers = self._codec.encode(command)
        self._sequence += 1
        if self._armed:
            # Without torque nothing is written: it is not known of every servo that a goal does not switch
            # its torque on.
            sent_ns = self._bus.post(self._writes(registers))
            self._written, self._alive_ns, self._anchored = registers, sent_ns, False
            self._sent.append(_Sent(self._sequence, sent_ns, registers.goals))
        return self._codec.decode(registers)

    def _writes(self, registers: Registers) -> Writes:
        """Return the writes of a command: goals, and what changed of the rest."""
        before = self._written
        gains = {i: one for i, one in registers.gains.items() if before is None or before.gains[i] != one}
        shares = {i: one for i, one in registers.shares.items() if before is None or before.shares[i] != one}
        return [
            *(self._family.gains(gains) if gains else ()),
            *(self._family.efforts(shares) if shares else ()),
            *self._family.goals(registers.goals),
        ]

    def passive(self) -> None:
        """Brake or switch the motors off, as robot.yaml says; sent once, never waits.

        States received before are discarded, and so is an answer that is still expected.
        """
        self._disarm()
        self._homed = False
        if self._holds:
            # Lowered to where it is: torque stays, and no watchdog of a servo ends it.
            self._bus.post(self._family.alive(self._ids, False))
            return
        state = DAMPING if self._hardware.passive == "damping" else OFF
        self._bus.post([*self._family.alive(self._ids, False), *self._family.torque(self._ids, state)])

    @property
    def if_cut(self) -> str:
        """What the arm does if the connection is cut."""
        if self.watchdog_s:
            return (
                f"If the cable is cut, the servos' own watchdog has stopped them after {self.watchdog_s:g} "
                "s; they hold their position until their supply is switched off"
            )
        return super().if_cut

    @property
    def transport_errors(self) -> int:
        """Number of corrupt, missing or misread answers, and of commands that the servos did not show."""
        return super().transport_errors + self._unsound
