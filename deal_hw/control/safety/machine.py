"""The safety state machine. Time is an argument; a flag is the name of a failed check.

    DISARMED --arm--> EASING_IN --time--> ACTIVE
                          |                  |
                          +--- any flag -----+--> PASSIVE (latched) --rearm--> DISARMED

Only an explicit re-arm leaves PASSIVE. It leads to DISARMED, so arming is a second decision.
"""

from __future__ import annotations

import enum
from collections.abc import Collection, Iterable, Mapping

from deal_hw.errors import SafetyError


class SafetyState(enum.Enum):
    """Whether commands may reach the robot."""

    DISARMED = "disarmed"
    """No command is sent."""
    EASING_IN = "easing in"
    """Targets move from the measured pose towards the policy's."""
    ACTIVE = "active"
    PASSIVE = "passive"
    """Latched: only the passive command is sent."""

    @property
    def armed(self) -> bool:
        """Whether commands are sent in this state."""
        return self in (SafetyState.EASING_IN, SafetyState.ACTIVE)


SAFETY_FLAGS: Mapping[str, str] = {
    "operator_stop": "The operator asked to stop.",
    "no_state": "No state sample has arrived yet.",
    "state_stale": "The newest state is too old, or was delayed on its way.",
    "clock_jump": "The device's clock jumped, as after a restart.",
    "device_fault": (
        "The device reports a fault, or the driver saw a problem after which the run must not continue."
    ),
    "device_watchdog": "The device stopped its motors because no commands arrived.",
    "device_disarmed": "The device reports that its motors do not follow commands.",
    "not_following": "A joint does not follow its commands.",
    "position": "A joint is outside its trip range.",
    "velocity": "A joint is faster than its trip speed.",
    "state_not_finite": "The state contains NaN or infinity.",
    "body_missing": "A robot with legs reports no state of its body.",
    "body_not_finite": "The inertial sensor reports NaN or infinity.",
    "orientation": "The orientation is no unit quaternion.",
    "tilt": "The base leans too far.",
    "tumble": "The base turns too fast.",
    "free_fall": "The robot has been falling for too long.",
    "flail": "A joint has been fast for too long.",
    "motor_temperature": "A motor is too hot, or its temperature is unknown.",
    "lost_commands": "A motor misses too many commands.",
    "battery_low": "The battery is too empty; arming asks for more.",
    "voltage_low": "The supply voltage is too low; arming asks for more.",
    "action_not_finite": "The requested command contains NaN or infinity.",
    "action_late": "The policy took too long.",
    "transport_errors": "Too large a share of the state frames is corrupt or lost.",
    "command_stale": "No command has been sent to a robot with legs for too long.",
}
"""Name of each check that can fail in a cycle -> what failed. Reasons are listed in this order."""

_ORDER = {name: number for number, name in enumerate(SAFETY_FLAGS)}


def in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Return names of failed checks in the order of :data:`SAFETY_FLAGS`; each must be one of them."""
    return tuple(sorted(names, key=_ORDER.__getitem__))


class SafetyMachine:
    """The state machine alone, without a robot or a clock.

    Args:
        ease_in_ns: Time from arming to full authority [ns].
    """

    def __init__(self, ease_in_ns: int) -> None:
        self._ease_in_ns = ease_in_ns
        self._armed_ns = 0
        self.state = SafetyState.DISARMED

    def arm(self, now_ns: int) -> None:
        """Go from DISARMED to EASING_IN.

        Raises:
            SafetyError: The machine is not DISARMED.
        """
        if self.state is not SafetyState.DISARMED:
            raise SafetyError(f"cannot arm in state {self.state.value}: re-arm explicitly first")
        self._armed_ns = now_ns
        self.state = SafetyState.EASING_IN

    def restart(self, now_ns: int) -> None:
        """Restart the time of easing in."""
        self._armed_ns = now_ns

    def update(self, now_ns: int, flags: Collection[str]) -> SafetyState:
        """Advance by one cycle: trip on any flag, else finish easing in after its time."""
        if self.state.armed and flags:
            self.state = SafetyState.PASSIVE
        elif self.state is SafetyState.EASING_IN and now_ns - self._armed_ns >= self._ease_in_ns:
            self.state = SafetyState.ACTIVE
        return self.state

    def authority(self, now_ns: int) -> float:
        """Return the share of the policy's command that is applied: 0 at arming, 1 in ACTIVE."""
        if self.state is SafetyState.EASING_IN:
            return (now_ns - self._armed_ns) / self._ease_in_ns
        return 1.0

    def stop(self) -> None:
        """Go to PASSIVE from any state."""
        self.state = SafetyState.PASSIVE

    def rearm(self) -> None:
        """Leave PASSIVE for DISARMED, the only way out of the latch.

        Raises:
            SafetyError: The machine is armed.
        """
        if self.state.armed:
            raise SafetyError(f"cannot re-arm in state {self.state.value}: stop first")
        self.state = SafetyState.DISARMED
