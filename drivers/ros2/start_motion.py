"""Takes a robot from where it stands to its start pose, and looks on the way whether it follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.control.safety.following import FollowingWatch
from deal_hw.description import RobotDescription
from deal_hw.errors import SafetyError, TransportTimeoutError
from deal_hw.motions.behaviours import position_command
from deal_hw.types import FloatArray, RobotState

_SPEED: Final = {"rad": 0.5, "m": 0.1}
"""Fastest motion [rad/s or m/s]; at most half of a joint's velocity limit."""
_NUDGE: Final = {"rad": 0.05, "m": 0.01}
"""How far a joint is moved to see that it follows [rad or m]; twice that if it does not."""
_FOLLOWS: Final = 0.4
"""Share of a nudge that a joint moves at least; friction and a weak gain keep it from the rest."""
_ARRIVED: Final = {"rad": 0.2, "m": 0.03}
"""A joint that stands this close to the start pose has arrived [rad or m]; a load bends it."""
_STILL: Final = {"rad": 0.1, "m": 0.02}
_SETTLE_S: Final = 0.3
"""After the first command, which holds the measured pose [s]."""
_ANSWER_S: Final = 0.5
"""Longest wait for a nudged joint [s]."""


class StartMotion:
    """The motion of :meth:`Ros2ControlRobot.home`; each step publishes targets and waits a control period.

    Args:
        description: The robot.
        clock: For the steps.
        publish: Publishes targets, (A,).
        wait: Reads states until a time [ns]; returns the newest.
        names_sent: Whether commands carry the joints' names, so that their order cannot be wrong.
        remedy: What to look at if the robot does not follow.
    """

    def __init__(
        self,
        description: RobotDescription,
        clock: Clock,
        publish: Callable[[FloatArray], object],
        wait: Callable[[int], RobotState],
        *,
        names_sent: bool,
        remedy: str,
    ) -> None:
        self._d, self._clock, self._publish, self._wait = description, clock, publish, wait
        self._names_sent, self._remedy = names_sent, remedy
        self._period_ns = round(1e9 / description.control_rate_hz)
        self._index = np.array(description.actuated_index)
        self._units = [description.position_units[j] for j in self._index]
        limit = np.array(description.limits.trip_velocity)[self._index]
        self._speed = np.minimum(self._of(_SPEED), 0.5 * limit)
        self._target = self._reached = np.zeros(len(self._index))
        self._watch = FollowingWatch(description)

    def run(self, end_ns: int) -> None:
        """Hold, nudge, move; the clock's time limit is ``end_ns`` [ns].

        Raises:
            SafetyError: A joint is outside its range, does not follow, or another one moves in its place.
            TransportTimeoutError: It does not arrive in time, or states cease.
        """
        start = self._measured(self._wait(self._clock.now_ns()))
        self._check_range(start)
        self._target = start.copy()
        for _ in range(round(_SETTLE_S * 1e9 / self._period_ns)):
            self._step(start)
        self._try_joints(start)
        goal = np.array(self._d.default_position)[self._index]
        self._go(goal)
        self._settle(goal, end_ns)

    def _try_joints(self, start: FloatArray) -> None:
        """Move the joints a little, one by one, or all at once if commands carry names."""
        nudge, goal = self._of(_NUDGE), np.array(self._d.limits.target).mean(axis=1)
        inwards = np.where(goal >= start, nudge, -nudge)
        joints = range(len(start))
        if self._names_sent:
            self._try(start, inwards, list(joints))
            return
        for a in joints:
            self._try(start, np.where(np.arange(len(start)) == a, inwards, 0.0), [a])

    def _try(self, start: FloatArray, nudge: FloatArray, joints: list[int]) -> None:
        before = self._measured(self._wait(self._clock.now_ns()))
        share = np.zeros(len(start))
        for size in (1.0, 2.0):
            self._go(start + size * nudge)
            share = self._answered(before, size * nudge, joints)
            if (share[joints] >= _FOLLOWS).all():
                self._go(start)
                return
            # What follows is judged here, by name: the small push so far is no sign beside the next.
            self._watch.reset()
        self._go(start)
        moved = np.abs(self._reached) / (2.0 * self._of(_NUDGE))
        moved[joints] = 0.0
        slow = ", ".join(self._d.actuated[a] for a in joints if share[a] < _FOLLOWS)
        if moved.max() >= _FOLLOWS:
            other = self._d.actuated[int(moved.argmax())]
            raise SafetyError(
                f"{self._d.name}: {slow} was sent a little way, and {other} moved: the order of `joints` in "
                "robot.yaml is not that of the controller's parameter `joints`, or `names` are exchanged"
            )
        raise SafetyError(
            f"{self._d.name}: {slow} was sent {2 * np.abs(nudge[joints]).max():.2g} "
            f"{self._units[joints[0]]} away and did not follow. {self._remedy}"
        )

    def _answered(self, before: FloatArray, nudge: FloatArray, joints: list[int]) -> FloatArray:
        """Wait until the joints have moved enough, or have had the time; return their shares, (A,)."""
        share = np.zeros(len(before))
        for _ in range(max(round(_ANSWER_S * 1e9 / self._period_ns), 1)):
            self._reached = self._measured(self._step(self._target)) - before
            share = np.divide(self._reached, nudge, out=np.zeros(len(nudge)), where=nudge != 0)
            if (share[joints] >= _FOLLOWS).all():
                break
        return share

    def _go(self, goal: FloatArray) -> None:
        """Move the target to a pose on a straight line, slowly."""
        begin = self._target
        steps = max(int(np.ceil((np.abs(goal - begin) / self._speed).max() * 1e9 / self._period_ns)), 1)
        for step in range(1, steps + 1):
            self._step(begin + (goal - begin) * step / steps)

    def _step(self, target: FloatArray) -> RobotState:
        """Publish a target, wait one control period, and check that the joints follow."""
        due_ns = self._clock.now_ns() + self._period_ns
        self._publish(target)
        self._target = target
        state = self._wait(due_ns)
        command, velocity = position_command(self._d, target), state.velocity[self._index]
        lost = self._watch.step(state.receive_ns, self._measured(state), velocity, command)
        if lost is not None:
            raise SafetyError(
                f"{self._d.name}: {lost.reason}. Is `joints` in robot.yaml in the controller's order? "
                f"{self._remedy}"
            )
        return state

    def _settle(self, goal: FloatArray, end_ns: int) -> None:
        while True:
            state = self._step(goal)
            off = np.abs(self._measured(state) - goal)
            speed = np.abs(state.velocity[self._index])
            if (off < self._of(_ARRIVED)).all() and (speed < self._of(_STILL)).all():
                return
            if self._clock.now_ns() >= end_ns:
                a = int((off / self._of(_ARRIVED)).argmax())
                raise TransportTimeoutError(
                    f"{self._d.name}: joint {self._d.actuated[a]} is still {off[a]:.2f} {self._units[a]} "
                    "from its start pose, or does not come to rest"
                )

    def _check_range(self, start: FloatArray) -> None:
        limits = np.array(self._d.limits.trip_position)[self._index]
        for a, (at, (low, high)) in enumerate(zip(start, limits, strict=True)):
            if not low <= at <= high:
                raise SafetyError(
                    f"{self._d.name}: joint {self._d.actuated[a]} is at {at:.2f} {self._units[a]}, outside "
                    f"{low:.2f} to {high:.2f}: move it by the robot's own means, or correct position_range"
                )

    def _measured(self, state: RobotState) -> FloatArray:
        return np.asarray(state.position[self._index])

    def _of(self, table: dict[str, float]) -> FloatArray:
        return np.array([table[unit] for unit in self._units])
