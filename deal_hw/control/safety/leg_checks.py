"""Safety checks of a robot with legs, besides its joints: body, motors, battery.

Pure, like the rest of the safety module: no I/O, and time is the device clock of the samples. A repeated
sample adds nothing to a duration.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from deal_hw.description import LegLimits, RobotDescription
from deal_hw.types import BodyState, FloatArray, IntArray, RobotState

LOST_WINDOW_S = 1.0
"""Time window in which a motor's missed commands are counted [s]."""
UNIT_TOLERANCE = 0.01
"""A quaternion's norm may differ from 1 by this; single precision changes it by less than 1e-6."""

_NEVER = 2**63 - 1


def tilt(orientation: FloatArray) -> float:
    """Return the angle between a base's z axis and the vertical, 0..pi [rad].

    Args:
        orientation: Quaternion wxyz of any norm, base in the world, (4,).
    """
    w, x, y, z = (float(part) for part in orientation)
    return 2.0 * math.atan2(math.hypot(x, y), math.hypot(w, z))


class LegChecks:
    """The checks and their memory.

    Args:
        description: The robot, for joint names.
        limits: The limits.
        lost_window_s: Lost commands are counted over this time [s].
    """

    def __init__(
        self, description: RobotDescription, limits: LegLimits, lost_window_s: float = LOST_WINDOW_S
    ) -> None:
        self._names, self._limits = description.joint_names, limits
        self._flail_velocity = np.asarray(limits.flail_velocity)
        self._lost_window_s = lost_window_s
        self._lost_most = limits.lost_rate * lost_window_s
        self.reset()

    def reset(self) -> None:
        """Forget all samples, as on arming."""
        self._falling_since = _NEVER
        self._fast_since = np.full(len(self._names), _NEVER)
        self._lost_last: IntArray | None = None
        self._lost_total = np.zeros(len(self._names), dtype=np.int64)
        self._lost: deque[tuple[int, IntArray]] = deque()

    def failures(self, state: RobotState, *, arming: bool = False) -> dict[str, str]:
        """Return flag name -> reason as text, for each failed check.

        Args:
            state: The newest state; its device clock is the time.
            arming: Whether to apply the stricter limits of battery and voltage.
        """
        found: dict[str, str] = {}
        self._check_flail(state, found)
        if state.body is None:
            found["body_missing"] = "the robot reports no state of its body: no orientation, no battery"
            return found
        self._check_body(state.device_ns, state.body, found)
        self._check_motors(state.device_ns, state.body, found)
        self._check_supply(state.body, arming, found)
        return found

    def _check_flail(self, state: RobotState, found: dict[str, str]) -> None:
        fast = np.abs(state.velocity) > self._flail_velocity
        self._fast_since = np.where(fast, np.minimum(self._fast_since, state.device_ns), _NEVER)
        first = int(np.argmin(self._fast_since))
        if state.device_ns - int(self._fast_since[first]) >= round(self._limits.flail_s * 1e9):
            found["flail"] = (
                f"joint {self._names[first]!r} flails: faster than {self._flail_velocity[first]:g} rad/s "
                f"for {self._limits.flail_s:g} s, now {state.velocity[first]:.2f} rad/s"
            )

    def _check_body(self, now_ns: int, body: BodyState, found: dict[str, str]) -> None:
        if not all(
            np.isfinite(part).all() for part in (body.orientation, body.angular_velocity, body.acceleration)
        ):
            found["body_not_finite"] = "the inertial sensor reports a value that is not finite"
            return
        norm = float(np.linalg.norm(body.orientation))
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            found["orientation"] = (
                f"the orientation is no rotation: its quaternion has norm {norm:.3f}, not 1"
            )
        elif (angle := tilt(body.orientation)) > self._limits.tilt:
            found["tilt"] = f"the base leans by {angle:.2f} rad, at most {self._limits.tilt:g} are allowed"
        turn = float(np.max(np.abs(body.angular_velocity)))
        if turn > self._limits.tumble:
            found["tumble"] = (
                f"the base turns at {turn:.2f} rad/s, at most {self._limits.tumble:g} are allowed"
            )
        self._check_fall(now_ns, float(np.linalg.norm(body.acceleration)), found)

    def _check_fall(self, now_ns: int, force: float, found: dict[str, str]) -> None:
        limits = self._limits
        self._falling_since = min(self._falling_since, now_ns) if force < limits.free_fall else _NEVER
        if now_ns - self._falling_since >= round(limits.free_fall_s * 1e9):
            found["free_fall"] = (
                f"the robot falls: its specific force is below {limits.free_fall:g} m/s² for "
                f"{limits.free_fall_s:g} s, now {force:.2f} m/s²"
            )

    def _check_motors(self, now_ns: int, body: BodyState, found: dict[str, str]) -> None:
        hot = int(np.argmax(body.temperature))
        # Written so that NaN, a missing reading, does not pass.
        if not body.temperature[hot] <= self._limits.temperature:
            found["motor_temperature"] = (
                f"the motor of joint {self._names[hot]!r} is at {body.temperature[hot]:.0f} °C, at most "
                f"{self._limits.temperature:g} °C are allowed"
            )
        lost = self._lost_in_window(now_ns, body.lost)
        most = int(np.argmax(lost))
        if lost[most] > self._lost_most:
            found["lost_commands"] = (
                f"the motor of joint {self._names[most]!r} missed {lost[most]} commands in "
                f"{self._lost_window_s:g} s, at most {self._lost_most:g} are allowed"
            )

    def _lost_in_window(self, now_ns: int, lost: IntArray) -> IntArray:
        # A counter that decreases was restarted; its earlier counts remain.
        last = lost if self._lost_last is None else self._lost_last
        self._lost_total = self._lost_total + np.maximum(lost - last, 0)
        self._lost_last = lost.copy()
        self._lost.append((now_ns, self._lost_total))
        while now_ns - self._lost[0][0] > self._lost_window_s * 1e9:
            self._lost.popleft()
        return self._lost_total - self._lost[0][1]

    def _check_supply(self, body: BodyState, arming: bool, found: dict[str, str]) -> None:
        limits = self._limits
        to_arm = " to arm" if arming else ""
        share = limits.battery if arming else limits.battery_low
        # An unknown state of charge (NaN) passes: not every robot knows it. Every robot knows its voltage.
        if body.battery < share:
            found["battery_low"] = (
                f"the battery is at {100 * body.battery:.1f} %, at least {100 * share:g} % are needed{to_arm}"
            )
        volts = max(limits.arm_voltage, limits.voltage) if arming else limits.voltage
        if not body.voltage >= volts:
            found["voltage_low"] = (
                f"the supply has {body.voltage:.2f} V, at least {volts:g} V are needed{to_arm}"
            )
