"""Safety between policy and motors: checks each cycle, clips what can be clipped, trips on the rest.

Pure: no I/O, no torch, and time is an argument. Limits are data of the robot (``description.limits``).
Clipping changes a command and reports it. After a trip no more commands are sent; it is latched, and its
reason is a text.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.control.safety.following import FollowingWatch, Unfollowed
from deal_hw.control.safety.leg_checks import LegChecks
from deal_hw.control.safety.machine import SafetyMachine, SafetyState, in_order
from deal_hw.description import RobotDescription
from deal_hw.errors import SafetyError
from deal_hw.types import FloatArray, JointCommand, RobotState, Status

__all__ = ["CycleInput", "Safety", "SafetyConfig", "SafetyDecision", "SafetyState"]

_DRIFT = 5e-4
"""Largest rate difference between host and device clock that counts as drift (a bad crystal has 1e-4)."""


LINK_ERROR_SHARE: Final = 0.3
"""Share of errors among the state frames due in the window that trips; a corrupt frame counts twice
(itself and its gap)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyConfig:
    """Limits of the safety module beside those of the robot."""

    clock_jump_s: float = 0.1
    """A device clock that runs ahead of the host's by this much has jumped [s]."""
    transport_error_window_s: float = 1.0
    """Time over which transport errors are counted [s]."""
    confirm_s: float = 0.2
    """The device must report itself armed within this time after arming [s]."""

    def __post_init__(self) -> None:
        for name in ("clock_jump_s", "transport_error_window_s", "confirm_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"SafetyConfig.{name} is {getattr(self, name)!r}; it must be above 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class CycleInput:
    """Inputs of the safety module in one cycle.

    Attributes:
        now_ns: Host clock [ns].
        state: The newest state; None before the first.
        action_age_ns: How long the policy took [ns].
        transport_errors: Transport errors since the connection, as the robot counts them.
        stop_reason: Reason of a requested stop, by the operator or on their behalf; "" without one.
        fault: A problem seen by the driver, after which the run must not continue; "" for none.
        command_age_ns: Time since the last sent or repeated command [ns]; -1: none yet. Used on robots with
        legs only.
    """

    now_ns: int
    state: RobotState | None
    action_age_ns: int = 0
    transport_errors: int = 0
    stop_reason: str = ""
    fault: str = ""
    command_age_ns: int = -1


@dataclass(frozen=True, slots=True)
class SafetyDecision:
    """Decision of the safety module in one cycle.

    Attributes:
        state: The state after the cycle.
        command: The command that may be sent; None if none may be (not finite, or passive).
        clipped: Names of the limits that changed the command.
        flags: Failed checks. While disarmed they do not trip.
        reason: Why it is passive, as text; "" otherwise.
        unfollowed: Joints that were found not to follow in this cycle; None: none.
    """

    state: SafetyState
    command: JointCommand | None
    clipped: tuple[str, ...]
    flags: tuple[str, ...]
    reason: str
    unfollowed: Unfollowed | None = None

    @property
    def send(self) -> bool:
        """Whether the command is to be sent: only while armed."""
        return self.state.armed and self.command is not None


class Safety:
    """Checks and filters the commands for one robot."""

    _start: FloatArray
    """Start of easing in, (A,); set at arming."""

    def __init__(self, description: RobotDescription, config: SafetyConfig | None = None) -> None:
        self._description = description
        self._config = config or SafetyConfig()
        self._filter = SafetyFilter(description)
        self._machine = SafetyMachine(round(description.limits.ease_in_s * 1e9))
        legs = description.limits.legs
        self._legs = None if legs is None else LegChecks(description, legs)
        self._following = FollowingWatch(description)
        self._command_age_ns = 0 if legs is None else round(legs.command_age_s * 1e9)
        self._index = list(description.actuated_index)
        self._errors_due = (
            LINK_ERROR_SHARE * self._config.transport_error_window_s * description.state_rate_hz
        )
        self.reason = ""
        """Why it is passive, as text."""
        self._reset(0)

    def _reset(self, now_ns: int) -> None:
        self._armed_ns = now_ns
        self._seen_armed = False
        self._previous: FloatArray | None = None
        self._offset_ns: int | None = None
        self._offset_at_ns = 0
        self._errors: deque[tuple[int, int]] = deque()
        self._first_ns: int | None = None
        self._in_force: JointCommand | None = None
        self._unfollowed: Unfollowed | None = None
        self._following.reset()
        if self._legs is not None:
            self._legs.reset()

    @property
    def state(self) -> SafetyState:
        """State of the state machine."""
        return self._machine.state

    def arm(self, cycle: CycleInput) -> None:
        """Allow commands from now on; the measured position is the first target.

        Raises:
            SafetyError: Not DISARMED, or a check failed already; the message names it.
        """
        self._reset(cycle.now_ns)
        wrong = self._failures(cycle, None, arming=True)
        if wrong or cycle.state is None:
            raise SafetyError("refusing to arm: " + "; ".join(wrong.values()))
        self._machine.arm(cycle.now_ns)
        self._start = self._previous = cycle.state.position[self._index]

    def step(self, cycle: CycleInput, wanted: JointCommand | None) -> SafetyDecision:
        """Check one cycle.

        Args:
            cycle: The cycle's inputs.
            wanted: The requested command; None before the first.
        """
        self._begin(cycle)
        failures = self._failures(cycle, wanted)
        unsound = "action_not_finite" in failures or "state_not_finite" in failures
        was_armed = self.state.armed
        flags = in_order(failures)
        state = self._machine.update(cycle.now_ns, flags)
        if was_armed and not state.armed:
            self.reason = "; ".join(failures[name] for name in flags)
        unfollowed, self._unfollowed = self._unfollowed, None
        if state is SafetyState.PASSIVE or wanted is None or cycle.state is None or unsound:
            self._in_force = None
            return SafetyDecision(state, None, (), flags, self.reason, unfollowed)
        command, clipped = self._clip(cycle.now_ns, wanted, cycle.state)
        self._in_force = command if state.armed else None
        return SafetyDecision(state, command, clipped, flags, self.reason)

    def stop(self, reason: str) -> None:
        """Go passive without a failed check, such as at the end of the run."""
        if self.state is not SafetyState.PASSIVE:
            self.reason = reason
        self._machine.stop()

    def rearm(self) -> None:
        """Leave PASSIVE for DISARMED: the operator's explicit decision.

        Raises:
            SafetyError: It is armed.
        """
        self._machine.rearm()
        self.reason = ""

    def _begin(self, cycle: CycleInput) -> None:
        # Arming a robot with legs takes seconds, in which it may sink. Easing in therefore starts from its
        # pose in the first cycle after that.
        if self._legs is None or not self.state.armed or self._first_ns is not None:
            return
        self._first_ns = cycle.now_ns
        self._machine.restart(cycle.now_ns)
        if cycle.state is not None:
            self._start = self._previous = cycle.state.position[self._index]

    def _clip(
        self, now_ns: int, wanted: JointCommand, state: RobotState
    ) -> tuple[JointCommand, tuple[str, ...]]:
        measured, velocity = state.position[self._index], state.velocity[self._index]
        previous = measured if self._previous is None else self._previous
        share = self._machine.authority(now_ns)
        if share < 1.0:
            eased = self._start + share * (wanted.position_target - self._start)
            wanted = dataclasses.replace(wanted, position_target=eased)
        command, clipped = self._filter.clip(wanted, previous, measured, velocity)
        self._previous = command.position_target
        return command, clipped

    def _failures(
        self, cycle: CycleInput, wanted: JointCommand | None, *, arming: bool = False
    ) -> dict[str, str]:
        """Return flag name -> reason as text for each failed check."""
        found: dict[str, str] = {}
        limits = self._description.limits
        if cycle.stop_reason:
            found["operator_stop"] = cycle.stop_reason
        if cycle.fault:
            found["device_fault"] = cycle.fault
        if cycle.state is None:
            found["no_state"] = "no state sample has arrived"
        else:
            self._check_age(cycle.now_ns, cycle.state, found)
            self._check_status(cycle.now_ns, cycle.state.status, found)
            self._check_motion(cycle.state, found)
            self._check_following(cycle.state, found)
            if self._legs is not None:
                found |= self._legs.failures(cycle.state, arming=arming)
        if wanted is not None and not self._filter.accepts(wanted):
            found["action_not_finite"] = "the policy asked for a command that is not finite"
        if cycle.action_age_ns > round(limits.action_age_s * 1e9):
            took_ms, limit_ms = cycle.action_age_ns * 1e-6, limits.action_age_s * 1e3
            found["action_late"] = f"the policy took {took_ms:.1f} ms, at most {limit_ms:g} ms are allowed"
        self._check_link(cycle.now_ns, cycle.transport_errors, found)
        self._check_command_age(cycle, found)
        return found

    def _check_age(self, now_ns: int, state: RobotState, found: dict[str, str]) -> None:
        # Data that waited in a buffer have a new receive stamp; only the device's clock shows their age. The
        # age therefore counts from the smallest transit time so far, which may rise by the clocks' drift.
        offset = state.receive_ns - state.device_ns
        if self._offset_ns is None:
            self._offset_ns, self._offset_at_ns = offset, state.receive_ns
        crept = self._offset_ns + round(_DRIFT * (state.receive_ns - self._offset_at_ns))
        ahead = self._offset_ns - offset
        if ahead > round(self._config.clock_jump_s * 1e9):
            found["clock_jump"] = f"the device's clock jumped ahead by {ahead * 1e-9:.3f} s"
        self._offset_ns, self._offset_at_ns = min(offset, crept), state.receive_ns
        age_ns = now_ns - state.receive_ns + offset - self._offset_ns
        limit_ns = round(self._description.limits.state_age_s * 1e9)
        if age_ns > limit_ns:
            found["state_stale"] = (
                f"the newest state is {age_ns * 1e-6:.0f} ms old, at most {limit_ns * 1e-6:g} ms are allowed"
            )

    def _check_status(self, now_ns: int, status: Status, found: dict[str, str]) -> None:
        if Status.FAULT in status:
            # The driver's own text is more precise.
            found.setdefault("device_fault", "the device reports a fault")
        if not self.state.armed:
            return
        # Samples from before the arming may still arrive, so the status counts only after the device has
        # confirmed the arming.
        self._seen_armed = self._seen_armed or (Status.ARMED in status and Status.WATCHDOG not in status)
        if not self._seen_armed and now_ns - self._armed_ns < self._config.confirm_s * 1e9:
            return
        if Status.WATCHDOG in status:
            found["device_watchdog"] = "the device's watchdog stopped its motors because no commands came"
        if Status.ARMED not in status:
            found["device_disarmed"] = "the device disarmed itself"

    def _check_motion(self, state: RobotState, found: dict[str, str]) -> None:
        if not (np.isfinite(state.position).all() and np.isfinite(state.velocity).all()):
            found["state_not_finite"] = "the robot reports a state that is not finite"
            return
        names, units = self._description.joint_names, self._description.position_units
        limits = self._description.limits
        for j, (low, high) in enumerate(limits.trip_position):
            if not low <= state.position[j] <= high:
                found["position"] = (
                    f"joint {names[j]!r} is at {state.position[j]:.3f} {units[j]}, outside {low:g}..{high:g}"
                )
        for j, most in enumerate(limits.trip_velocity):
            if abs(state.velocity[j]) > most:
                found["velocity"] = (
                    f"joint {names[j]!r} moves at {state.velocity[j]:.2f} {units[j]}/s, faster than {most:g}"
                )

    def _check_following(self, state: RobotState, found: dict[str, str]) -> None:
        # Without a command in force nothing says where the joints are to be.
        if self._in_force is None or "state_not_finite" in found:
            return
        position, velocity = state.position[self._index], state.velocity[self._index]
        self._unfollowed = self._following.step(state.receive_ns, position, velocity, self._in_force)
        if self._unfollowed is not None:
            found["not_following"] = self._unfollowed.reason

    def _check_link(self, now_ns: int, errors: int, found: dict[str, str]) -> None:
        window = self._errors
        window.append((now_ns, errors))
        while now_ns - window[0][0] > self._config.transport_error_window_s * 1e9:
            window.popleft()
        count = errors - window[0][1]
        if count > self._errors_due:
            found["transport_errors"] = (
                f"{count} transport errors in {self._config.transport_error_window_s:g} s, at most "
                f"{self._errors_due:g} are allowed"
            )

    def _check_command_age(self, cycle: CycleInput, found: dict[str, str]) -> None:
        # A robot that holds its last command for ever must not be left with one. The time counts from the
        # first cycle after arming at the earliest, since earlier commands belong to another run.
        if self._first_ns is None or not self.state.armed:
            return
        age_ns = cycle.now_ns - self._first_ns
        if cycle.command_age_ns >= 0:
            age_ns = min(age_ns, cycle.command_age_ns)
        if age_ns > self._command_age_ns:
            found["command_stale"] = (
                f"no command was sent for {age_ns * 1e-6:.0f} ms, at most "
                f"{self._command_age_ns * 1e-6:g} ms are allowed"
            )
