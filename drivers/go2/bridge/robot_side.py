"""What the bridge knows of the robot's own side: other programs that command it, and its own controller.

It decides when nobody controls an idle robot, so that the bridge damps it. It does no I/O.
"""

from __future__ import annotations

from typing import Final

SILENCE_NS: Final = 500_000_000
"""A program that sent no motor command for this long does not command the robot any more [ns]. A program that
takes the robot over waits as long for others (``takeover.LISTEN_S``)."""
ASK_NS: Final = 500_000_000
"""Time between two questions which mode is active, as ``motion_switcher`` is asked elsewhere [ns]."""
ANSWER_NS: Final = 2_000_000_000
"""Without an answer for this long after the silence, what was known before counts [ns]."""
HAND_BACK_NS: Final = 10_000_000_000
"""A mode that was asked to take the robot has this long to become active
(``LoopConfig.hand_back_timeout_s``) [ns]. Until then the robot holds the damping of its last controller."""
BUSY: Final = "busy"
"""Stands for a mode that is being switched."""


class RobotSide:
    """Knowledge of the robot's side while the bridge is idle.

    Attributes:
        mode: Name of the active mode by the newest answer; "" for none; None: never answered.
    """

    def __init__(self) -> None:
        self.mode: str | None = None
        self._quiet_ns = self._asked_ns = 0
        self._fresh = self._handed = False

    def commanded(self, now_ns: int) -> None:
        """Note a motor command of another program; the robot then no longer holds our damping."""
        self._quiet_ns, self._fresh, self._handed = now_ns, False, False

    def left(self, now_ns: int, *, mode: str | None, handed: bool = False) -> None:
        """Note that the bridge leaves the robot to others.

        Args:
            now_ns: The bridge's clock [ns].
            mode: The mode that is known to be active; "" for none.
            handed: Whether a mode was asked to take the robot.
        """
        self.mode, self._handed = mode, handed
        self._quiet_ns, self._fresh = now_ns, False

    def answered(self, mode: str) -> None:
        """Note the answer to the last question."""
        self.mode = mode
        if mode:
            self._handed = False
        self._fresh = self._asked_ns >= self._quiet_ns

    def to_ask(self, now_ns: int) -> bool:
        """Return whether to ask now which mode is active; the question counts as sent."""
        if now_ns - self._asked_ns < ASK_NS:
            return False
        self._asked_ns = now_ns
        return True

    def deserted(self, now_ns: int) -> str:
        """Return why nobody controls the robot, as text; "" if somebody does or might."""
        quiet_ns = now_ns - self._quiet_ns
        if self.mode != "" or quiet_ns < SILENCE_NS or (self._handed and quiet_ns < HAND_BACK_NS):
            return ""
        if not self._fresh and quiet_ns < SILENCE_NS + ANSWER_NS:
            return ""
        seen = "no mode is active" if self._fresh else "motion_switcher does not answer"
        return f"nobody has commanded the motors for {quiet_ns / 1e9:.1f} s, and {seen}"
