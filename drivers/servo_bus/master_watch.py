"""Recognises another program or computer that commands the servos of a bus: a second master."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from deal_hw.drivers.servo_bus.registers import Register

WINDOW_NS: Final = 5_000_000_000
"""Two signs within this time are another master [ns]."""
KEPT: Final = 64
"""Different goals of a servo that are remembered: those of more than a second at 50 commands a second."""


class ForeignSign(NamedTuple):
    """What shows another master.

    Attributes:
        servo: Id of the servo that shows a goal which was never sent; None for a packet on the line.
        goal: That goal [ticks].
        packet: The packet, in words; "" for a goal.
    """

    servo: int | None = None
    goal: int = 0
    packet: str = ""

    def text(self, name: str = "") -> str:
        """Return what was seen, what it means and what to do, for a fault.

        Args:
            name: The servo's joint or part.
        """
        seen = (
            f"on the bus came {self.packet}"
            if self.servo is None
            else f"servo {self.servo} ({name}) has the goal {self.goal} ticks"
        )
        return (
            f"another program commands this bus: {seen}, which this run did not send. It may give the motors "
            "torque and goals again: end it, or take its adapter off the bus, then start again"
        )


class MasterWatch:
    """Tells our own goals from those of another master, by what the servos answer.

    A goal is ours if it is one of the last that were sent, or if the servo showed it before as ours: after a
    lost command a servo still has an older goal. Any other goal is a sign of another master. So is a packet
    on the line that asks servos and was not sent from here, where the adapter receives such packets.

    One sign may be a corrupt byte that passed a checksum. Two within :data:`WINDOW_NS` are another master:
    two different goals, a goal that is there again after a newer command, or again although the servo had
    taken the newest one, or two packets. Another master that writes at least as often as states are read is
    found with the second or third state that shows it.

    Args:
        goal: The register of the goal.
        decode: Returns the goal [ticks] in the register's bytes.
    """

    def __init__(self, goal: Register, decode: Callable[[bytes], int]) -> None:
        self._goal, self._decode = goal, decode
        self.restart()

    def restart(self) -> None:
        """Forget all: goals, and signs. A servo's goal is judged from the next write to it on."""
        self._sent: dict[int, deque[bytes]] = {}
        self._ours: dict[int, bytes] = {}
        self._signs: deque[int] = deque(maxlen=2)
        self._odd: frozenset[tuple[int, bytes]] = frozenset()
        self._odd_command = -1
        self._taken: dict[int, int] = {}
        self.commands = 0
        self.sign: ForeignSign | None = None

    def wrote(self, address: int, values: Mapping[int, bytes]) -> None:
        """Note a write of registers, by servo; others than the goal do not matter."""
        begin = self._goal.address - address
        if begin < 0:
            return
        new = False
        for servo, data in values.items():
            goal = data[begin : begin + self._goal.size]
            if len(goal) < self._goal.size:
                continue
            kept = self._sent.setdefault(servo, deque(maxlen=KEPT))
            if not kept or kept[-1] != goal:
                kept.append(goal)
            new = True
        self.commands += new

    def read(self, address: int, found: Mapping[int, bytes], commands: int, now_ns: int) -> None:
        """Take registers that servos have answered.

        Args:
            address: The first register.
            found: The bytes, by servo.
            commands: :attr:`commands` when they were requested.
            now_ns: Present time [ns].
        """
        begin = self._goal.address - address
        if begin < 0:
            return
        odd = set()
        for servo, data in found.items():
            goal, sent = data[begin : begin + self._goal.size], self._sent.get(servo)
            if len(goal) < self._goal.size:
                continue
            # Until the first write is taken, a servo has the goal that it had before.
            if sent is None or goal == self._ours.get(servo) or goal in sent:
                self._ours[servo] = goal
                if sent and goal == sent[-1]:
                    self._taken[servo] = commands
            else:
                odd.add((servo, goal))
        # The goals of one corrupt command stay until the next one; those that came after it are no command's.
        same = commands == self._odd_command and odd <= self._odd
        if not odd or (same and all(self._taken.get(servo) != commands for servo, _ in odd)):
            return
        self._odd, self._odd_command = frozenset(odd), commands
        servo, goal = min(odd)
        self._note(ForeignSign(servo, self._decode(goal)), now_ns)

    def request(self, packet: str, now_ns: int) -> None:
        """Take a packet on the line that asks servos and was not sent from here, in words."""
        self._note(ForeignSign(packet=packet), now_ns)

    def _note(self, sign: ForeignSign, now_ns: int) -> None:
        self._signs.append(now_ns)
        if len(self._signs) == self._signs.maxlen and now_ns - self._signs[0] <= WINDOW_NS:
            self.sign = self.sign or sign
