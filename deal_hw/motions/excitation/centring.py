"""Feedback that keeps a joint with a motor near its centre while efforts excite it.

A set-point tells a servo where to be; an effort tells a motor only how hard to push. A cart that gets a sum
of sines as its effort drifts to the end of its track within a second or two, and the safety module ends the
run. So a spring and a damper, as strong as the motor at the edge of the room, are added to an excitation. The
recording has the effort that was really sent, so calibration does not see a difference.
"""

from __future__ import annotations

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.motions.excitation.limits import MARGIN
from deal_hw.types import FloatArray, RobotState

CROSSING_S = 0.4
"""The damper is as strong as the motor at the speed that crosses the room in this time [s], or at half the
speed that trips, if that is lower. Of 50 drawn carts (seeds 2000 to 2009; track, trip speed, delay and rate
drawn; a motor that accelerates them at 2, 5, 10, 20 or 50 m/s2) 3 trip under a multisine and 4 under random
efforts; without the feedback 32 and 46. Those that trip have 50 m/s2, and reach 0.9 times their trip speed
within their delay and one period (tests/control/test_control_centring.py)."""


class Centring:
    """The feedback of one robot; zero for servos and for joints without limits.

    Args:
        description: The robot.
    """

    def __init__(self, description: RobotDescription) -> None:
        self._joints = list(description.actuated_index)
        A = len(self._joints)
        self._around, self._spring, self._damper = np.zeros(A), np.zeros(A), np.zeros(A)
        limits = description.limits
        for a, j in enumerate(self._joints):
            if description.servos[a]:
                continue
            (low, high), fastest = limits.trip_position[j], 0.5 * limits.trip_velocity[j]
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            if np.isfinite(half):
                # Around the start pose, unless that is near an end.
                start = description.default_position[j]
                self._around[a] = start if abs(start - middle) < 0.5 * half else middle
                reach = MARGIN * (half - abs(self._around[a] - middle))
                self._spring[a] = 1.0 / reach
                fastest = min(fastest, reach / CROSSING_S)
            self._damper[a] = 1.0 / fastest

    def added(self, effort: FloatArray, state: RobotState) -> FloatArray:
        """Return an effort with the feedback, within -1..1 of the effort limit, (A,).

        Args:
            effort: The excitation, (A,); a servo's set-point is returned unchanged.
            state: The newest state.
        """
        if not self._damper.any():
            return effort
        back = self._spring * (state.position[self._joints] - self._around)
        return np.clip(effort - back - self._damper * state.velocity[self._joints], -1.0, 1.0)
