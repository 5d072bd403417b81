"""The control loop: one class for collecting, deploying and replaying, and for benches in virtual time.

Settings and report come first, then the repeater of commands, then the loop; nothing else uses the parts.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.control.loop.timing import LoopTiming, LoopTimingReport
from deal_hw.control.process.channel import (
    ARMING,
    CONNECTING,
    HANDING_BACK,
    HOMING,
    LOWERING,
    MAKING_PASSIVE,
    RUNNING,
    Outcome,
)
from deal_hw.control.safety.passive import PassiveConfig, make_passive
from deal_hw.control.safety.safety import CycleInput, Safety, SafetyDecision, SafetyState
from deal_hw.data.recording.record import CycleFlag, CycleRecord
from deal_hw.errors import ConfigurationError, DealHwError, TransportError, TransportTimeoutError
from deal_hw.motions.behaviours import Behaviour
from deal_hw.motions.planned_end import ENDING_EVENT, PlannedEnd
from deal_hw.robot import Robot
from deal_hw.schema import plain
from deal_hw.transport import Message
from deal_hw.types import NOT_FOLLOWING, Event, JointCommand, RobotState

HOME_TIMEOUT_S: Final = 20.0
"""Longest homing [s]."""
LOWER_TIMEOUT_S: Final = 20.0
"""Longest way to the rest pose at a planned end [s]."""
ARM_TIMEOUT_S: Final = 1.0
"""Longest wait until the robot reports that its motors follow commands [s]."""
STATE_TIMEOUT_S: Final = 1.0
"""Longest wait for the first state sample [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """Settings of one run."""

    duration_s: float
    """Length of the run, counted in control periods [s]."""
    dry_run: bool = False
    """Compute everything but send no command: the robot is neither homed nor armed."""
    home: bool = True
    """Bring the robot to its start pose first."""
    passive: PassiveConfig = field(default_factory=PassiveConfig)
    """How the passive command is repeated at the end, until the robot confirms it."""
    record_wire: bool = True
    """Also record the raw bytes."""
    hand_back: bool = False
    """At the end, return the robot to its own controller."""
    hand_back_timeout_s: float = 10.0

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ConfigurationError(f"a run of {self.duration_s!r} s is too short; give a length above 0 s")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopReport:
    """Result of one run.

    Attributes:
        outcome: How it ended.
        reason: The reason, for the operator.
        passive_confirmed: Whether the robot itself reported that its motors no longer follow commands; also
        True if it was never commanded.
        loop_timing: How regular the loop's cycles were.
        clipped: Number of cycles in which a limit changed the command, by limit.
        cycles_sent: Commands sent.
        error: Name of the error's class, after a failure.
        flags: Failed checks of the safety module that ended it.
        warnings: What the operator must know of the end.
    """

    outcome: Outcome
    reason: str
    passive_confirmed: bool
    loop_timing: LoopTimingReport
    clipped: dict[str, int]
    cycles_sent: int
    error: str = ""
    flags: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = plain(self)
        return values


class Repeater:
    """Repeats the current command when it is due; in the loop's thread, between its cycles.

    A robot's motors hold the last command for ever, but should get it often. The same command is repeated, so
    recording and calibration have one command per cycle.

    Attributes:
        sent_ns: Time of the last sent command, new or repeated [ns]; -1 before the first.

    Args:
        robot: The robot; ``description.repeat_rate_hz`` 0 means that nothing is repeated.
        clock: The loop's clock.
    """

    def __init__(self, robot: Robot, clock: Clock) -> None:
        rate_hz = robot.description.repeat_rate_hz
        self._robot, self._clock = robot, clock
        self._period_ns = round(1e9 / rate_hz) if rate_hz > 0 else 0
        self._due_ns = -1
        self.sent_ns = -1

    def note_sent(self, now_ns: int) -> None:
        """Note that a new command was sent."""
        self.sent_ns = now_ns
        self._due_ns = now_ns + self._period_ns if self._period_ns else -1

    def stop(self) -> None:
        """Repeat nothing until the next new command."""
        self._due_ns = -1

    def wake_ns(self, deadline_ns: int) -> int:
        """Return the latest wake-up time, at most ``deadline_ns`` [ns]."""
        return deadline_ns if self._due_ns < 0 else min(deadline_ns, self._due_ns)

    def repeat_if_due(self) -> None:
        """Send the command again if it is due; missed periods are skipped."""
        now_ns = self._clock.now_ns()
        if self._due_ns < 0 or now_ns < self._due_ns:
            return
        self._robot.repeat()
        self.sent_ns = now_ns
        self._due_ns += self._period_ns * ((now_ns - self._due_ns) // self._period_ns + 1)


__all__ = ["RUNNING", "ControlLoop", "LoopConfig", "LoopReport", "OperatorStop", "Outcome", "Sink"]

Sink = Callable[[CycleRecord], bool]
"""Takes a record without waiting; False: refused. Raises a DealHwError if no record can be taken any more."""


_MOST_WIRE_BYTES = 48_000
"""Most raw bytes in one record, limited by the size of a datagram; a cycle of a Go2 has 13 000."""
_MOST_STATE_BYTES = 72_000
"""Most states in one record: 0.2 s of a Go2's. More states, after a longer stall, would lose the record of
that stall."""


class OperatorStop(BaseException):
    """The operator requested a stop during a wait for the robot; no error, so not a subclass of Exception."""


class ControlLoop:
    """Connects, homes, arms, runs cycles on absolute deadlines, always ends with a passive robot.

    Args:
        robot: The robot; the loop connects and disconnects it.
        behaviour: Source of the commands.
        safety: Checks every command.
        clock: The clock of deadlines and stamps; virtual for benches.
        sink: Takes each cycle's record.
        config: Settings.
        progress: The heartbeat: called with the phase's name and the longest time until the next call [s].
        scheduling: Scheduling granted by the operating system, for the report.
        end: The behaviour's planned end, which may come before ``config.duration_s``; None: it has none.
    """

    def __init__(
        self,
        robot: Robot,
        behaviour: Behaviour,
        safety: Safety,
        clock: Clock,
        sink: Sink,
        config: LoopConfig,
        *,
        progress: Callable[[str, float], None] = lambda phase, silence_s: None,
        scheduling: str = "default",
        end: PlannedEnd | None = None,
    ) -> None:
        self._robot, self._behaviour, self._safety = robot, behaviour, safety
        self._clock, self._sink, self._config, self._progress = clock, sink, config, progress
        self._scheduling, self._end = scheduling, end or PlannedEnd()
        self._loop_timing = LoopTiming(clock, robot.description.control_rate_hz)
        self._repeater = Repeater(robot, clock)
        self._stop_reason, self._gently = "", False
        self._warnings: list[str] = []
        self._raise_on_stop = self._connected = self._commanding = False
        self._state: RobotState | None = None
        self._pending: list[RobotState] = []
        self._events: list[Event] = []
        self._clipped: dict[str, int] = {}
        self._noted_flags: tuple[str, ...] = ()
        self._passive_flags: tuple[str, ...] = ()
        self._states = self._blind = self._losses = self._sent = self._errors_seen = 0

    def request_stop(self, reason: str = "stopped by the operator", *, gently: bool = False) -> None:
        """End the run; may be called from a signal handler and from the behaviour.

        Args:
            reason: Why, for the operator; the first one counts.
            gently: Lower a robot that can be lowered before it goes limp, as at a planned end. Another
                request makes it passive at once.
        """
        self._gently = gently and not self._stop_reason
        self._stop_reason = self._stop_reason or reason
        if self._raise_on_stop:
            # Once: a second exception could interrupt the passive route that the first one began.
            self._raise_on_stop = False
            raise OperatorStop(reason)

    def note(self, kind: str, message: str, **data: Any) -> None:
        """Put an event into the next record."""
        self._events.append(Event(self._clock.now_ns(), kind, message, data))

    def run(self) -> LoopReport:
        """Run once. Errors are returned in the report, after the robot was made passive."""
        outcome, reason, error, confirmed = Outcome.FAILED, "", "", False
        running = False
        try:
            # In a block of its own: a stop that comes while an error is on its way out of it is still caught
            # below.
            try:
                self._raise_on_stop = True
                if self._stop_reason:
                    raise OperatorStop(self._stop_reason)
                self._prepare()
            finally:
                self._raise_on_stop = False
            running = self._commanding
            outcome, reason = self._cycles()
            if outcome is Outcome.FINISHED:
                self._lower()
            elif outcome is Outcome.STOPPED:
                self._lower_if_gently()
        except (OperatorStop, KeyboardInterrupt):
            outcome, reason = Outcome.STOPPED, self._stop_reason or "stopped by the operator"
            self._lower_if_gently()
        except Exception as err:
            reason, error = str(err) or type(err).__name__, type(err).__name__
            if isinstance(err, TransportError) and running:
                # The connection is lost while commands are sent. This counts as a trip of the safety module:
                # it is latched, and the passive command is sent over any connection there is.
                outcome, reason, error = Outcome.TRIPPED, f"the connection is lost: {reason}", ""
                self._passive_flags = ("link_lost",)
                self.note("passive", reason, flags=["link_lost"])
        finally:
            # The robot comes first, before any step that might fail.
            confirmed = self._make_passive()
            if confirmed and outcome in (Outcome.FINISHED, Outcome.STOPPED):
                self._hand_back()
            self._close(reason)
        return LoopReport(
            outcome=outcome,
            reason=reason,
            passive_confirmed=confirmed,
            loop_timing=self._report(),
            clipped=self._clipped,
            cycles_sent=self._sent,
            error=error,
            flags=self._passive_flags,
            warnings=tuple(self._warnings),
        )

    def _prepare(self) -> None:
        c = self._config
        self._progress(CONNECTING, 10.0)
        self._robot.connect()
        self._connected = True
        self._behaviour.reset()
        if c.home and not c.dry_run:
            # Reported before it happens, so that a supervisor that finds this process dead knows whether to
            # send damping.
            self._progress(HOMING, HOME_TIMEOUT_S + STATE_TIMEOUT_S + 2.0)
            self._commanding = self._robot.homes_by_motor
            self._robot.home(HOME_TIMEOUT_S)
        self._await_state()
        if not c.dry_run:
            self._safety.arm(self._input())
            self._progress(ARMING, ARM_TIMEOUT_S + STATE_TIMEOUT_S + 2.0)
            self._commanding = True
            self._robot.arm(ARM_TIMEOUT_S)
            self.note("armed", "the motors follow commands")
            # States that waited in buffers are old; the first cycle uses only newer ones.
            self._drain()
            self._await_state()
        # The recording starts with the sample that the first command uses, not while the robot is set up by
        # hand.
        self._pending = self._pending[-1:]

    def _await_state(self) -> None:
        self._receive(self._robot.read_state(STATE_TIMEOUT_S))
        self._drain()

    def _cycles(self) -> tuple[Outcome, str]:
        count = round(self._config.duration_s * self._robot.description.control_rate_hz)
        while True:
            self._collect_until(self._loop_timing.deadline_ns)
            if self._loop_timing.next_index >= count or self._end.over:
                break
            if self._ends_gently:
                self._safety.stop(self._stop_reason)
                return Outcome.STOPPED, self._stop_reason
            index, deadline_ns = self._loop_timing.begin()
            self._progress(RUNNING, self._robot.description.limits.silence_s)
            verdict = self._cycle(index, deadline_ns)
            if verdict.state is SafetyState.PASSIVE:
                stopped = verdict.flags[:1] == ("operator_stop",)
                return (Outcome.STOPPED if stopped else Outcome.TRIPPED), verdict.reason
            if self._config.dry_run and self._stop_reason:
                return Outcome.STOPPED, self._stop_reason
        self._safety.stop("the run is over")
        if self._end.reason:
            return Outcome.STOPPED, self._end.reason
        return Outcome.FINISHED, "the run is over"

    def _cycle(self, index: int, deadline_ns: int) -> SafetyDecision:
        start_ns = self._clock.now_ns()
        state, flags = self._state, CycleFlag.NONE
        wanted: JointCommand | None = None
        if self._loop_timing.late_ns >= self._loop_timing.period_ns:
            flags |= CycleFlag.OVERRUN
        if not self._pending:
            self._blind += 1
            flags |= CycleFlag.NO_STATE
        # A policy must not see values that are not finite: its memory would keep them.
        if state is not None and _is_finite(state):
            with self._loop_timing.section("behaviour"):
                wanted = self._behaviour.command(state, index * self._loop_timing.period_ns * 1e-9)
            for step in self._end.steps():
                self.note(ENDING_EVENT, step)
        computed_ns = self._clock.now_ns()
        age_ns = computed_ns - state.receive_ns if state is not None else -1
        if age_ns >= 0:
            self._loop_timing.note_state_age(age_ns)
        with self._loop_timing.section("safety"):
            cycle = self._input(computed_ns - start_ns)
            verdict = self._safety.step(cycle, wanted)
        flags |= self._note_verdict(verdict)
        sent, sent_ns = None, -1
        if verdict.send and verdict.command is not None:
            with self._loop_timing.section("send"):
                sent_ns = self._clock.now_ns()
                sent = self._robot.send_command(verdict.command)
                self._repeater.note_sent(sent_ns)
                self._sent += 1
        else:
            self._repeater.stop()
            if verdict.state is SafetyState.PASSIVE and self._commanding:
                self._robot.passive()
        with self._loop_timing.section("record"):
            self._hand_over(
                index,
                deadline_ns,
                start_ns,
                requested=wanted,
                sent=sent,
                sent_ns=sent_ns,
                state_age_ns=age_ns,
                flags=flags,
            )
        return verdict

    def _note_verdict(self, verdict: SafetyDecision) -> CycleFlag:
        flags = CycleFlag.NONE
        for name in verdict.clipped:
            self._clipped[name] = self._clipped.get(name, 0) + 1
            if self._clipped[name] == 1:
                self.note("clipped", f"the safety filter changed a command: {name}", limit=name)
        if verdict.clipped:
            flags |= CycleFlag.CLIPPED
        if "action_late" in verdict.flags:
            flags |= CycleFlag.POLICY_LATE
        if self._robot.transport_errors > self._errors_seen:
            self._errors_seen = self._robot.transport_errors
            flags |= CycleFlag.LINK_ERROR
        if (lost := verdict.unfollowed) is not None:
            self.note(NOT_FOLLOWING, lost.reason, since_ns=lost.since_ns, joints=list(lost.joints))
        if verdict.state is SafetyState.PASSIVE:
            self._passive_flags = verdict.flags
            self.note("passive", verdict.reason, flags=list(verdict.flags))
        elif verdict.flags and verdict.flags != self._noted_flags:
            self.note("would trip", "while disarmed: " + ", ".join(verdict.flags), flags=list(verdict.flags))
        self._noted_flags = verdict.flags
        return flags

    def _hand_over(
        self,
        index: int,
        deadline_ns: int,
        start_ns: int,
        *,
        requested: JointCommand | None = None,
        sent: JointCommand | None = None,
        sent_ns: int = -1,
        state_age_ns: int = -1,
        flags: CycleFlag = CycleFlag.NONE,
    ) -> None:
        wire = _newest(self._robot.take_wire()) if self._config.record_wire else ()
        record = CycleRecord(
            cycle=index,
            deadline_ns=deadline_ns,
            start_ns=start_ns,
            states=_newest_states(self._pending),
            action=self._behaviour.action,
            requested=requested,
            sent=sent,
            sent_sequence=self._robot.last_sequence if sent is not None else -1,
            sent_ns=sent_ns,
            state_age_ns=state_age_ns,
            safety_state=self._safety.state.value,
            flags=int(flags),
            events=tuple(self._events),
            wire=wire,
            lost=self._losses,
        )
        self._pending, self._events = [], []
        if not self._sink(record):
            self._losses += 1

    def _collect_until(self, deadline_ns: int) -> None:
        """Take states as they arrive, so that each has its own receive stamp; repeat the command."""
        while (now_ns := self._clock.now_ns()) < deadline_ns:
            left_ns = max(self._repeater.wake_ns(deadline_ns) - now_ns, 0)
            with contextlib.suppress(TransportTimeoutError):
                self._receive(self._robot.read_state(left_ns * 1e-9))
            self._repeater.repeat_if_due()
        self._drain()

    def _drain(self) -> None:
        try:
            while True:
                self._receive(self._robot.read_state(0.0))
        except TransportTimeoutError:
            return

    def _receive(self, state: RobotState) -> None:
        self._state = state
        self._pending.append(state)
        self._states += 1

    def _input(self, action_age_ns: int = 0) -> CycleInput:
        now_ns, sent_ns = self._clock.now_ns(), self._repeater.sent_ns
        return CycleInput(
            now_ns=now_ns,
            state=self._state,
            action_age_ns=action_age_ns,
            transport_errors=self._robot.transport_errors,
            stop_reason=("" if self._ends_gently else self._stop_reason) or self._robot.operator_stop,
            command_age_ns=now_ns - sent_ns if sent_ns >= 0 else -1,
            fault=self._robot.fault,
        )

    @property
    def _ends_gently(self) -> bool:
        """Whether the operator's stop lowers the robot first; commands then end between two cycles."""
        return self._gently and self._robot.lowers and not self._config.dry_run

    def _make_passive(self) -> bool:
        """Send the passive command until the robot confirms it; return whether it did.

        A robot that this run never commanded may stand under its own controller, so nothing is sent.
        """
        if self._safety.state.armed:
            self._safety.stop("the run ended")
        if not self._commanding:
            return True
        self._progress(MAKING_PASSIVE, 2.0)
        # Samples read here are not recorded, since it is unknown which of them came after the passive
        # command.
        return make_passive(
            self._robot,
            self._clock,
            self._config.passive,
            progress=lambda text, silence_s: self._progress(f"{MAKING_PASSIVE}: {text}", silence_s),
        )

    def _lower(self) -> None:
        """Bring a robot that can to a pose in which it may go limp; a stop ends this at once."""
        if not self._robot.lowers or self._config.dry_run or not self._commanding:
            return
        self._progress(LOWERING, LOWER_TIMEOUT_S + 2.0)
        try:
            self._raise_on_stop = True
            if self._stop_reason and not self._gently:
                raise OperatorStop(self._stop_reason)
            holds = self._robot.lower(LOWER_TIMEOUT_S)
            self.note("lowered", holds or "the robot is where it may go limp")
            self._warnings += [holds] if holds else []
        except DealHwError as err:
            self.note("warning", f"the robot was not lowered before its motors went off: {err}")
        finally:
            self._raise_on_stop = False

    def _lower_if_gently(self) -> None:
        """The same after the operator's stop; another stop, or a bug, leaves it at being passive."""
        if self._ends_gently:
            with contextlib.suppress(OperatorStop, KeyboardInterrupt, Exception):
                self._lower()

    def _hand_back(self) -> None:
        if not self._config.hand_back or self._config.dry_run or not self._connected:
            return
        timeout_s = self._config.hand_back_timeout_s
        self._progress(HANDING_BACK, timeout_s + 2.0)
        try:
            self._robot.hand_back(timeout_s)
            self.note("handed back", "the robot's own controller has the robot again")
        except Exception as err:
            self.note("warning", f"the robot did not return to its own controller: {err}")

    def _close(self, reason: str) -> None:
        """Send the remaining records, then disconnect.

        Nothing is raised, not even for a bug: the report must say whether the robot is passive.
        """
        try:
            now = self._clock.now_ns()
            self.note("ended", reason or "the run ended")
            self._hand_over(self._loop_timing.next_index, now, now)
        except Exception:
            self._losses += 1
        with contextlib.suppress(Exception):
            self._robot.disconnect()

    def _report(self) -> LoopTimingReport:
        return self._loop_timing.report(
            states=self._states,
            cycles_without_state=self._blind,
            losses=self._losses,
            transport_errors=self._robot.transport_errors,
            scheduling=self._scheduling,
        )


def _newest(wire: Sequence[Message]) -> tuple[Message, ...]:
    """Return the newest raw bytes that fit into a record; setting up a robot may produce more."""
    left = _MOST_WIRE_BYTES
    for count, message in enumerate(reversed(wire)):
        left -= len(message.payload) + len(message.channel) + 16
        if left < 0:
            return tuple(wire[len(wire) - count :])
    return tuple(wire)


def _newest_states(states: Sequence[RobotState]) -> tuple[RobotState, ...]:
    """Return the newest states that fit into a record; dropped ones show as a gap in the states' numbers."""
    if not states:
        return ()
    newest = states[-1]
    numbers = 6 + 3 * newest.position.size
    if newest.body is not None:
        numbers += 18 + newest.body.foot_force.size + 2 * newest.body.temperature.size
    return tuple(states[-(_MOST_STATE_BYTES // (8 * numbers)) :])


def _is_finite(state: RobotState) -> bool:
    """Return whether all inputs of a behaviour are finite."""
    body = () if state.body is None else (state.body.orientation, state.body.angular_velocity)
    return all(bool(np.isfinite(part).all()) for part in (state.position, state.velocity, *body))
