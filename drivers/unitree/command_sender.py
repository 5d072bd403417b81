"""Sends commands to the motors: encodes, numbers and repeats them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.command_echo import CommandEcho
from deal_hw.drivers.transports import topics
from deal_hw.errors import FrameError, SafetyError
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import FloatArray, JointCommand

Encode: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray], bytes]
"""Returns the message with position [rad], velocity [rad/s], stiffness [N·m/rad], damping [N·m·s/rad] and
effort [N·m], (J,) each. Raises a FrameError where a number is not finite."""
PASSIVE_COPIES: Final = 3
"""How often the last command is sent: the robot holds it for ever, and single messages may be lost."""


class CommandSender:
    """Sends commands, keeps the last one's bytes to repeat it, and numbers the behaviour's commands.

    Attributes:
        in_force: Bytes of the command that the motors hold; b"" before the first.
        sequence: Number of the behaviour's last command; -1 before the first.
        echo: Finds which of them was in force at a time.
        damping: Gains of the passive command, (J,) [N·m·s/rad].
        effort_limit: Effort limits of the description, (J,) [N·m].

    Args:
        transport: Topics of the robot.
        clock: The clock of the messages' stamps.
        description: The robot.
        record: Takes each message that goes out, but no repeats.
        encode: Makes the message of a command.
        name: The robot, as messages begin.
    """

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        description: RobotDescription,
        record: Callable[[Message], object],
        encode: Encode,
        name: str,
    ) -> None:
        self._transport, self._clock, self._record = transport, clock, record
        self._encode, self._name = encode, name
        self.damping = np.array(description.passive_damping)
        self.effort_limit = np.array(description.effort_limit)
        self._speed_limit = np.array(description.speed_limit)
        self.echo = CommandEcho()
        self.reset()

    def reset(self) -> None:
        """Clear the memory of commands."""
        self.in_force, self.sequence = b"", -1
        self.echo.reset()

    def publish(self, topic: str, payload: bytes) -> int:
        """Send a message, record it and return when that was, by the clock [ns]."""
        stamp_ns = self._clock.now_ns()
        self._transport.send(Message(topic, payload, stamp_ns))
        self._record(Message("tx", payload, stamp_ns))
        return stamp_ns

    def send(self, command: JointCommand, *, damp_at: FloatArray | None = None) -> JointCommand:
        """Send the behaviour's next command.

        Args:
            command: The requested command.
            damp_at: Joint positions, (J,) [rad], if the robot is passive: damping is sent instead. None if it
                is armed.

        Returns:
            The sent command, rounded as on the wire. Its effort and speed limits are the description's,
            because the wire has none.

        Raises:
            SafetyError: A value is not finite, or the robot is passive and was never commanded.
        """
        parts = (
            command.position_target,
            command.velocity_target,
            command.stiffness,
            command.damping,
            command.effort,
        )
        try:
            payload = self._encode(*parts)
        except FrameError as error:
            raise SafetyError(f"{self._name}: {error}") from error
        if damp_at is not None:
            if not self.in_force:
                raise SafetyError(f"{self._name}: not armed; call arm() before the first command")
            parts = self._passive_command(damp_at)
            payload = self._encode(*parts)
        stamp_ns = self.publish(topics.LOW_COMMAND, payload)
        self.in_force = payload
        self.sequence += 1
        self.echo.note(self.sequence, stamp_ns)
        q, dq, kp, kd, tau = (part.astype(np.float32).astype(np.float64) for part in parts)
        return JointCommand(q, dq, kp, kd, tau, self.effort_limit.copy(), self._speed_limit.copy())

    def damp(self, position: FloatArray) -> None:
        """Send the passive command for joints at a position, (J,) [rad]; it is not numbered."""
        self.in_force = self._encode(*self._passive_command(position))
        self.publish(topics.LOW_COMMAND, self.in_force)

    def repeat(self) -> None:
        """Send the current command again, the same bytes; nothing before the first."""
        if self.in_force:
            self._transport.send(Message(topics.LOW_COMMAND, self.in_force, self._clock.now_ns()))

    def _passive_command(
        self, position: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        zero = np.zeros(len(self.damping))
        pose = position if np.isfinite(position).all() else zero
        return pose, zero, zero, self.damping, zero
