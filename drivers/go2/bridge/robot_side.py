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
TAKE_OVER_NS: Final = 5_000_000_000
"""After a mode's end, the program that released it has this long to command the motors [ns]. deal-hw's driver
pauses for 1 s, as the vendor's example does, listens for 0.5 s (``takeover.LISTEN_S``), and looks whether the
robot stands or hangs; to damp meanwhile would make it refuse the robot. The robot holds the mode's last
command."""
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
        self._patience_ns, self._fresh = SILENCE_NS, False

    def commanded(self, now_ns: int) -> None:
        """Note a motor command of the robot's side; the robot then no longer holds our damping."""
        # While a mode is active, its own commands are among them.
        self._patience_ns = TAKE_OVER_NS if self.mode else SILENCE_NS
        self._quiet_ns, self._fresh = now_ns, False

    def left(self, now_ns: int, *, mode: str | None, handed: bool = False) -> None:
        """Note that the bridge leaves the robot to others.

        Args:
            now_ns: The bridge's clock [ns].
            mode: The mode that is known to be active; "" for none.
            handed: Whether a mode was asked to take the robot.
        """
        self.mode, self._quiet_ns, self._fresh = mode, now_ns, False
        self._patience_ns = HAND_BACK_NS if handed else TAKE_OVER_NS if mode else SILENCE_NS

    def answered(self, mode: str) -> None:
        """Note the answer to the last question."""
        self.mode = mode
        if mode:
            self._quiet_ns, self._patience_ns = self._asked_ns, TAKE_OVER_NS
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
        if self.mode != "" or quiet_ns < self._patience_ns:
            return ""
        if not self._fresh and quiet_ns < self._patience_ns + ANSWER_NS:
            return ""
        seen = "no mode is active" if self._fresh else "motion_switcher does not answer"
        return f"nobody has commanded the motors for {quiet_ns / 1e9:.1f} s, and {seen}"
